"""Arms as LeRobot robots: any in simulation, and a real Panda."""

from hrc_learn.lerobot.robots.franka_panda import FrankaPanda as FrankaPanda
from hrc_learn.lerobot.robots.franka_panda import FrankaPandaConfig as FrankaPandaConfig
from hrc_learn.lerobot.robots.mujoco_arm import MujocoArmRobot as MujocoArmRobot
from hrc_learn.lerobot.robots.mujoco_arm import MujocoArmRobotConfig as MujocoArmRobotConfig
