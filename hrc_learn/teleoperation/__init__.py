"""Human input (by script, keys, gamepad or browser), hand guiding, recorded demonstrations.

Devices are in `teleoperation.devices`, the browser page in `teleoperation.page`. Scenarios and
scripted demonstrations need the simulator and have modules of their own.
"""

from hrc_learn.teleoperation.hand_guiding import CombinedInput as CombinedInput
from hrc_learn.teleoperation.hand_guiding import HandGuidedArm as HandGuidedArm
from hrc_learn.teleoperation.hand_guiding import (
    InteractionForceConfig as InteractionForceConfig,
)
from hrc_learn.teleoperation.hand_guiding import (
    force_to_nullspace_input as force_to_nullspace_input,
)
from hrc_learn.teleoperation.scripted_expert import ScriptedForce as ScriptedForce
from hrc_learn.teleoperation.scripted_expert import ScriptedPerturbation as ScriptedPerturbation
from hrc_learn.teleoperation.scripted_expert import random_pulls as random_pulls
from hrc_learn.teleoperation.touch import Touch as Touch
from hrc_learn.teleoperation.touch import TouchConfig as TouchConfig
