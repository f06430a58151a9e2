"""Who leads an arm: a script that shows a job, or a person in a browser."""

from hrc_learn.lerobot.teleoperators.arm_teleoperators import ArmExpert as ArmExpert
from hrc_learn.lerobot.teleoperators.arm_teleoperators import (
    ArmExpertConfig as ArmExpertConfig,
)
from hrc_learn.lerobot.teleoperators.arm_teleoperators import ArmPage as ArmPage
from hrc_learn.lerobot.teleoperators.arm_teleoperators import (
    ArmPageConfig as ArmPageConfig,
)
