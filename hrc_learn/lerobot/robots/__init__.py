"""The Panda as a LeRobot robot: simulated, and real."""

from .config_franka_panda import FrankaPandaConfig as FrankaPandaConfig
from .config_mujoco_panda import MujocoPandaConfig as MujocoPandaConfig
from .franka_panda import FrankaPanda as FrankaPanda
from .mujoco_panda import MujocoPanda as MujocoPanda
