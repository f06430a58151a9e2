"""Makes hrc_learn known to LeRobot, which imports this by its name."""

from hrc_learn.lerobot import ActDmpConfig as ActDmpConfig
from hrc_learn.lerobot import DiffusionDmpConfig as DiffusionDmpConfig
from hrc_learn.lerobot import DMPConfig as DMPConfig
from hrc_learn.lerobot import MotionChunkConfig as MotionChunkConfig
