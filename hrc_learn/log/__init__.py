"""Step logs and run recordings, in NumPy; `hrc_learn.viz` draws them."""

from hrc_learn.log.recordings import CameraRecording as CameraRecording
from hrc_learn.log.recordings import Event as Event
from hrc_learn.log.recordings import JointRanges as JointRanges
from hrc_learn.log.recordings import LoggedSteps as LoggedSteps
from hrc_learn.log.recordings import RunRecording as RunRecording
from hrc_learn.log.recordings import StepLog as StepLog
