"""Dashboards, figures, films and reports.

The recordings below need NumPy only. `run_dashboard` and `learning_dashboards` import Rerun,
`figures` imports Matplotlib.
"""

from hrc_learn.log.recordings import DemonstrationsRecording as DemonstrationsRecording
from hrc_learn.log.recordings import DemonstrationTrace as DemonstrationTrace
from hrc_learn.log.recordings import ErrorMap as ErrorMap
from hrc_learn.log.recordings import FitRecording as FitRecording
from hrc_learn.log.recordings import LearningRecording as LearningRecording
