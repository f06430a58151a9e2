"""The person beside the arm: scripted, at the keys, at a gamepad, or in a browser.

The page in a browser is `hrc_learn.human.page`, devices are `hrc_learn.human.devices`; they
import viser and pygame when they are opened.
"""

from ..geometry.minimum_jerk import minimum_jerk as minimum_jerk
from .both_hands import BothHands as BothHands
from .coarse_orientation import coarse_orientation as coarse_orientation
from .coarse_orientation import gripper_down as gripper_down
from .drag import DragConfig as DragConfig
from .drag import drag_effort as drag_effort
from .drag import hand_twist as hand_twist
from .eased import Eased as Eased
from .eased import EasingConfig as EasingConfig
from .expert import GuidedPath as GuidedPath
from .expert import ScriptedExpert as ScriptedExpert
from .expert import Tremor as Tremor
from .pull import PullMapping as PullMapping
from .pull import PullSpell as PullSpell
from .pull import ScriptedPuller as ScriptedPuller
from .pull import pull_effort as pull_effort
