"""Makes hrc_learn known to LeRobot, which imports this by its name."""

from hrc_learn.lerobot import DMPConfig as DMPConfig
from hrc_learn.lerobot import MotionChunkConfig as MotionChunkConfig
