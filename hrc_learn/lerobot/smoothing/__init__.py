"""Smooth actions for any policy and any robot of LeRobot.

Imports only itself, NumPy, PyTorch and LeRobot: the distribution `lerobot-smooth`
(`plugins/lerobot_smooth`) is this folder under the name `lerobot_smooth`.
"""

from .action_limits import ActionLimits as ActionLimits
from .action_limits import calibrated_ranges as calibrated_ranges
from .action_limits import demonstrated_limits as demonstrated_limits
from .action_limits import gathered_limits as gathered_limits
from .action_limits import urdf_limits as urdf_limits
from .motion_filter import LIMIT_KINDS as LIMIT_KINDS
from .motion_filter import MotionFilter as MotionFilter
from .motion_filter import MotionState as MotionState
from .processor import POSTPROCESSOR as POSTPROCESSOR
from .processor import PREPROCESSOR as PREPROCESSOR
from .processor import Changes as Changes
from .processor import SmoothActionsStep as SmoothActionsStep
from .processor import WatchStateStep as WatchStateStep
from .processor import add_smoothing as add_smoothing
from .processor import read_pipeline as read_pipeline
from .processor import remove_smoothing as remove_smoothing
from .robot import SmoothRobot as SmoothRobot
from .robot import SmoothRobotConfig as SmoothRobotConfig
from .upsampling import ActionUpsampler as ActionUpsampler
