"""Preparation of demonstrations for learning: cutting, filtering, resampling, alignment."""

from hrc_learn.demos.preprocessing.filters import butterworth as butterworth
from hrc_learn.demos.preprocessing.filters import (
    estimate_joint_velocity as estimate_joint_velocity,
)
from hrc_learn.demos.preprocessing.filters import estimate_twist as estimate_twist
from hrc_learn.demos.preprocessing.filters import local_polynomial as local_polynomial
from hrc_learn.demos.preprocessing.filters import savitzky_golay as savitzky_golay
from hrc_learn.demos.preprocessing.segmentation import RestCriterion as RestCriterion
from hrc_learn.demos.preprocessing.segmentation import cut as cut
from hrc_learn.demos.preprocessing.segmentation import resting as resting
from hrc_learn.demos.preprocessing.segmentation import split_at_rest as split_at_rest
from hrc_learn.demos.preprocessing.segmentation import trim_rest as trim_rest
from hrc_learn.demos.preprocessing.timing import WarpingPath as WarpingPath
from hrc_learn.demos.preprocessing.timing import align as align
from hrc_learn.demos.preprocessing.timing import at_times as at_times
from hrc_learn.demos.preprocessing.timing import compensate_delay as compensate_delay
from hrc_learn.demos.preprocessing.timing import equalise_durations as equalise_durations
from hrc_learn.demos.preprocessing.timing import resample as resample
from hrc_learn.demos.preprocessing.timing import set_duration as set_duration
from hrc_learn.demos.preprocessing.timing import warp as warp
