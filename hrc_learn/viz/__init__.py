"""Dashboards, figures, films and reports.

The recordings below need NumPy only. `run_dashboard` and `learning_dashboards` import Rerun,
`figures` and `figure_parts` Matplotlib.
"""

from hrc_learn.viz.recordings import DemonstrationsRecording as DemonstrationsRecording
from hrc_learn.viz.recordings import DemonstrationTrace as DemonstrationTrace
from hrc_learn.viz.recordings import ErrorMap as ErrorMap
from hrc_learn.viz.recordings import FitRecording as FitRecording
from hrc_learn.viz.recordings import LearningRecording as LearningRecording
