"""Smooth, limit-checked actions for any policy, as steps of its processors."""

from hrc_learn.lerobot.processor.checkpoint_steps import add_smoothing as add_smoothing
from hrc_learn.lerobot.processor.smooth_actions import SmoothActionsStep as SmoothActionsStep
from hrc_learn.lerobot.processor.smooth_actions import WatchStateStep as WatchStateStep
