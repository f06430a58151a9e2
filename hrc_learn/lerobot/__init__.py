"""At home in LeRobot: importing this registers what its command lines then know by name.

`--policy.discover_packages_path=hrc_learn.lerobot` does so, and so does installing
`plugins/lerobot_policy_dmp`. Networks, simulator, browser page and drivers are imported when
they are asked for.
"""

from hrc_learn.lerobot import camera_watch as camera_watch
from hrc_learn.lerobot import envs as envs
from hrc_learn.lerobot import robots as robots
from hrc_learn.lerobot import smoothing as smoothing
from hrc_learn.lerobot import teleoperators as teleoperators
from hrc_learn.lerobot.policy.configuration_backbones import ActDmpConfig as ActDmpConfig
from hrc_learn.lerobot.policy.configuration_backbones import (
    DiffusionDmpConfig as DiffusionDmpConfig,
)
from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig as DMPConfig
from hrc_learn.lerobot.policy.configuration_motion_chunk import (
    MotionChunkConfig as MotionChunkConfig,
)
