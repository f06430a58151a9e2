"""The Panda as a LeRobot robot: simulated, and real."""

from hrc_learn.lerobot.robots.franka_panda import FrankaPanda as FrankaPanda
from hrc_learn.lerobot.robots.franka_panda import FrankaPandaConfig as FrankaPandaConfig
from hrc_learn.lerobot.robots.mujoco_panda import MujocoPanda as MujocoPanda
from hrc_learn.lerobot.robots.mujoco_panda import MujocoPandaConfig as MujocoPandaConfig
