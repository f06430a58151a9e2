"""Demonstrations made ready for learning: cut, filtered, resampled, brought to one pace."""

from hrc_learn.demos.preprocessing.alignment import WarpingPath as WarpingPath
from hrc_learn.demos.preprocessing.alignment import align as align
from hrc_learn.demos.preprocessing.alignment import warp as warp
from hrc_learn.demos.preprocessing.filters import butterworth as butterworth
from hrc_learn.demos.preprocessing.filters import compensate_delay as compensate_delay
from hrc_learn.demos.preprocessing.filters import (
    estimate_joint_velocity as estimate_joint_velocity,
)
from hrc_learn.demos.preprocessing.filters import estimate_twist as estimate_twist
from hrc_learn.demos.preprocessing.filters import local_polynomial as local_polynomial
from hrc_learn.demos.preprocessing.filters import savitzky_golay as savitzky_golay
from hrc_learn.demos.preprocessing.resampling import at_times as at_times
from hrc_learn.demos.preprocessing.resampling import equalise_durations as equalise_durations
from hrc_learn.demos.preprocessing.resampling import resample as resample
from hrc_learn.demos.preprocessing.resampling import set_duration as set_duration
from hrc_learn.demos.preprocessing.segmentation import RestCriterion as RestCriterion
from hrc_learn.demos.preprocessing.segmentation import cut as cut
from hrc_learn.demos.preprocessing.segmentation import resting as resting
from hrc_learn.demos.preprocessing.segmentation import split_at_rest as split_at_rest
from hrc_learn.demos.preprocessing.segmentation import trim_rest as trim_rest
