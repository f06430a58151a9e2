"""Policies for LeRobot that plan motions."""

from hrc_learn.lerobot.policy.configuration_backbones import ActDmpConfig as ActDmpConfig
from hrc_learn.lerobot.policy.configuration_backbones import (
    DiffusionDmpConfig as DiffusionDmpConfig,
)
from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig as DMPConfig
from hrc_learn.lerobot.policy.configuration_motion_chunk import (
    MotionChunkConfig as MotionChunkConfig,
)
