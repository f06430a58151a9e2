"""Makes arms over topics of ROS 2 known to LeRobot, which imports this by its name."""

from hrc_learn.lerobot import Ros2ArmRobot as Ros2ArmRobot
from hrc_learn.lerobot import Ros2Camera as Ros2Camera
