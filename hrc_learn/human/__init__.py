"""The person beside the arm: scripted experts."""

from .coarse_orientation import coarse_orientation as coarse_orientation
from .coarse_orientation import gripper_down as gripper_down
from .expert import GuidedPath as GuidedPath
from .expert import ScriptedExpert as ScriptedExpert
from .expert import Tremor as Tremor
from .expert import minimum_jerk as minimum_jerk
from .pull import PullMapping as PullMapping
from .pull import PullSpell as PullSpell
from .pull import ScriptedPuller as ScriptedPuller
from .pull import pull_effort as pull_effort
