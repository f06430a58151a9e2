"""Logging, dashboards, figures and reports of runs.

`StepLog` and the recording dataclasses need numpy only. What draws imports its library when
it is asked for: `hrc_learn.viz.run_dashboard` and `fit_dashboard` import rerun,
`hrc_learn.viz.figures` imports matplotlib.
"""

from hrc_learn.viz.recordings import CameraRecording as CameraRecording
from hrc_learn.viz.recordings import DemonstrationsRecording as DemonstrationsRecording
from hrc_learn.viz.recordings import ErrorMap as ErrorMap
from hrc_learn.viz.recordings import FitRecording as FitRecording
from hrc_learn.viz.recordings import JointLimits as JointLimits
from hrc_learn.viz.recordings import LearningRecording as LearningRecording
from hrc_learn.viz.recordings import RunRecording as RunRecording
from hrc_learn.viz.recordings import ShownDemonstration as ShownDemonstration
from hrc_learn.viz.recordings import SweepRecording as SweepRecording
from hrc_learn.viz.recordings import SweptTrials as SweptTrials
from hrc_learn.viz.step_log import Event as Event
from hrc_learn.viz.step_log import LoggedSteps as LoggedSteps
from hrc_learn.viz.step_log import StepLog as StepLog
