"""The control step for real-time loops: compiled ahead of time, NumPy in and out."""

from .export import NoCompilerError as NoCompilerError
from .export import export_step as export_step
from .metronome import Metronome as Metronome
from .runner import EagerRunner as EagerRunner
from .runner import PackageRunner as PackageRunner
from .runner import StepRunner as StepRunner
from .runner import open_step as open_step
