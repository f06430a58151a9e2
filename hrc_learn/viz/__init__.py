"""Logging, dashboards, figures and reports of runs.

`StepLog` and the recording dataclasses need numpy only. What draws imports its library when
it is asked for: `hrc_learn.viz.run_dashboard` and `fit_dashboard` import rerun,
`hrc_learn.viz.figures` imports matplotlib.
"""

from .demonstrations_recording import DemonstrationsRecording as DemonstrationsRecording
from .demonstrations_recording import ShownDemonstration as ShownDemonstration
from .learning_recording import ErrorMap as ErrorMap
from .learning_recording import LearningRecording as LearningRecording
from .logged_steps import Event as Event
from .logged_steps import LoggedSteps as LoggedSteps
from .recording import CameraRecording as CameraRecording
from .recording import FitRecording as FitRecording
from .recording import JointLimits as JointLimits
from .recording import RunRecording as RunRecording
from .shapes import Body as Body
from .shapes import Box as Box
from .shapes import Capsule as Capsule
from .shapes import MeshFile as MeshFile
from .shapes import arm_bodies as arm_bodies
from .step_log import StepLog as StepLog
from .sweep_recording import SweepRecording as SweepRecording
from .sweep_recording import SweptTrials as SweptTrials
