"""LeRobot integration: importing this package registers its policies, robots and teleoperators.

LeRobot's commands find them by `--policy.discover_packages_path=hrc_learn.lerobot`, or once
`plugins/lerobot_policy_dmp` is installed. Networks, simulator, browser page and drivers are
imported on demand.
"""

from hrc_learn.lerobot import camera_watch as camera_watch
from hrc_learn.lerobot import envs as envs
from hrc_learn.lerobot import smoothing as smoothing

# LeRobot looks here for the class of a device, which is named like its configuration.
from hrc_learn.lerobot.arm_teleoperators import ArmExpert as ArmExpert
from hrc_learn.lerobot.arm_teleoperators import ArmPage as ArmPage
from hrc_learn.lerobot.driven_arms import FrankaPanda as FrankaPanda
from hrc_learn.lerobot.driven_arms import Ros2ArmRobot as Ros2ArmRobot
from hrc_learn.lerobot.driven_arms import Ros2Camera as Ros2Camera
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot as MujocoArmRobot
from hrc_learn.lerobot.policy.dmp_policy import DMPConfig as DMPConfig
from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkConfig as MotionChunkConfig
