"""Smooth actions for any policy and any robot of LeRobot.

Imports only itself, NumPy, PyTorch and LeRobot: the distribution `lerobot-smooth`
(`plugins/lerobot_smooth`) is this folder under the name `lerobot_smooth`.
"""

from .action_limits import ActionLimits as ActionLimits
from .action_limits import demonstrated_limits as demonstrated_limits
from .action_limits import gathered_limits as gathered_limits
from .motion_filter import ActionUpsampler as ActionUpsampler
from .processor import PREPROCESSOR as PREPROCESSOR
from .processor import SmoothActionsStep as SmoothActionsStep
from .processor import add_smoothing as add_smoothing
from .processor import read_pipeline as read_pipeline
from .processor import remove_smoothing as remove_smoothing
from .robot import SmoothRobot as SmoothRobot
from .robot import SmoothRobotConfig as SmoothRobotConfig
