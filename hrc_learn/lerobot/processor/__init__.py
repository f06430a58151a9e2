"""Smooth, limit-checked actions for any policy, as steps of its processors."""

from .adding import add_smoothing as add_smoothing
from .smooth_actions import SmoothActionsStep as SmoothActionsStep
from .smooth_actions import WatchStateStep as WatchStateStep
