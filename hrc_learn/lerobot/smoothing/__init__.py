"""Smooth actions for any policy and any robot of LeRobot.

Imports itself, NumPy, PyTorch, LeRobot and `controller/motion_filter.py`: the distribution
`lerobot-smooth` (`plugins/lerobot_smooth`) is this folder with that file.
"""

from .action_limits import ActionLimits as ActionLimits
from .action_limits import demonstrated_limits as demonstrated_limits
from .action_limits import gathered_limits as gathered_limits
from .processor import PREPROCESSOR as PREPROCESSOR
from .processor import SmoothActionsStep as SmoothActionsStep
from .processor import add_smoothing as add_smoothing
from .processor import read_pipeline as read_pipeline
from .processor import remove_smoothing as remove_smoothing
from .robot import ActionUpsampler as ActionUpsampler
from .robot import SmoothRobot as SmoothRobot
from .robot import SmoothRobotConfig as SmoothRobotConfig
