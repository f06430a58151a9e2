"""Policies for LeRobot that plan motions: `dmp` and `motion_chunk`."""

from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig as DMPConfig
from hrc_learn.lerobot.policy.configuration_motion_chunk import (
    MotionChunkConfig as MotionChunkConfig,
)
