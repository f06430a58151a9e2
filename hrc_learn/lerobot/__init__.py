"""LeRobot integration: importing this package registers its policies, robots and teleoperators.

LeRobot's commands find them by `--policy.discover_packages_path=hrc_learn.lerobot`, or once
`plugins/lerobot_policy_dmp` is installed. Networks, simulator, browser page and drivers are
imported on demand.
"""

from hrc_learn.lerobot import camera_watch as camera_watch
from hrc_learn.lerobot import envs as envs
from hrc_learn.lerobot import robots as robots
from hrc_learn.lerobot import smoothing as smoothing
from hrc_learn.lerobot import teleoperators as teleoperators
from hrc_learn.lerobot.policy.dmp_policy import DMPConfig as DMPConfig
from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkConfig as MotionChunkConfig
