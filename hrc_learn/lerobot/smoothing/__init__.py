"""Smooth actions for any policy and any robot of LeRobot."""

from hrc_learn.lerobot.smoothing.action_limits import ActionLimits as ActionLimits
from hrc_learn.lerobot.smoothing.action_limits import demonstrated_limits as demonstrated_limits
from hrc_learn.lerobot.smoothing.action_limits import gathered_limits as gathered_limits
from hrc_learn.lerobot.smoothing.processor import PREPROCESSOR as PREPROCESSOR
from hrc_learn.lerobot.smoothing.processor import SmoothActionsStep as SmoothActionsStep
from hrc_learn.lerobot.smoothing.processor import add_smoothing as add_smoothing
from hrc_learn.lerobot.smoothing.processor import read_pipeline as read_pipeline
from hrc_learn.lerobot.smoothing.processor import remove_smoothing as remove_smoothing
from hrc_learn.lerobot.smoothing.robot import ActionUpsampler as ActionUpsampler
from hrc_learn.lerobot.smoothing.robot import SmoothRobot as SmoothRobot
from hrc_learn.lerobot.smoothing.robot import SmoothRobotConfig as SmoothRobotConfig
