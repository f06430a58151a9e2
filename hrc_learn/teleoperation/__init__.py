"""A person at the arm: scripted, at the keys, at a gamepad, or in a browser; and
demonstrations recorded from them.
"""

from hrc_learn.teleoperation.combined_input import BothHands as BothHands
from hrc_learn.teleoperation.combined_input import Eased as Eased
from hrc_learn.teleoperation.combined_input import EasingConfig as EasingConfig
from hrc_learn.teleoperation.interaction_force import DragConfig as DragConfig
from hrc_learn.teleoperation.interaction_force import PullMapping as PullMapping
from hrc_learn.teleoperation.interaction_force import PullSpell as PullSpell
from hrc_learn.teleoperation.interaction_force import ScriptedPuller as ScriptedPuller
from hrc_learn.teleoperation.interaction_force import drag_effort as drag_effort
from hrc_learn.teleoperation.interaction_force import hand_twist as hand_twist
from hrc_learn.teleoperation.interaction_force import pull_effort as pull_effort
from hrc_learn.teleoperation.scripted_expert import GuidedPath as GuidedPath
from hrc_learn.teleoperation.scripted_expert import ScriptedExpert as ScriptedExpert
from hrc_learn.teleoperation.scripted_expert import Tremor as Tremor
