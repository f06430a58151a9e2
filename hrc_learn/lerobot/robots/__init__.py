"""The Panda as a LeRobot robot: simulated, and real."""

from hrc_learn.lerobot.robots.config_franka_panda import FrankaPandaConfig as FrankaPandaConfig
from hrc_learn.lerobot.robots.config_mujoco_panda import MujocoPandaConfig as MujocoPandaConfig
from hrc_learn.lerobot.robots.franka_panda import FrankaPanda as FrankaPanda
from hrc_learn.lerobot.robots.mujoco_panda import MujocoPanda as MujocoPanda
