"""Teleoperators: a scripted demonstrator, or a person at the browser page."""

from hrc_learn.lerobot.teleoperators.arm_teleoperators import ArmExpert as ArmExpert
from hrc_learn.lerobot.teleoperators.arm_teleoperators import (
    ArmExpertConfig as ArmExpertConfig,
)
from hrc_learn.lerobot.teleoperators.arm_teleoperators import ArmPage as ArmPage
from hrc_learn.lerobot.teleoperators.arm_teleoperators import (
    ArmPageConfig as ArmPageConfig,
)
