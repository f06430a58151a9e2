"""Demonstrations made ready for learning: cut, smoothed, resampled, brought to one pace.

Every step takes a `Demonstration` and returns a new one (`DemonstrationSet.map` applies it to
all), but for those that need several at once, which take and return a set.
"""

from .alignment import align as align
from .cutting import cut as cut
from .delay import compensate_delay as compensate_delay
from .duration import equalise_durations as equalise_durations
from .duration import set_duration as set_duration
from .local_polynomial import local_polynomial as local_polynomial
from .resampling import at_times as at_times
from .resampling import resample as resample
from .rest import RestCriterion as RestCriterion
from .rest import resting as resting
from .rest import split_at_rest as split_at_rest
from .rest import trim_rest as trim_rest
from .smoothing import butterworth as butterworth
from .smoothing import savitzky_golay as savitzky_golay
from .velocity import estimate_joint_velocity as estimate_joint_velocity
from .velocity import estimate_twist as estimate_twist
from .warping import WarpingPath as WarpingPath
from .warping import warp as warp
