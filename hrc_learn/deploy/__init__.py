"""Compile a controller's step ahead of time, and run it on NumPy arrays in real-time loops."""

from hrc_learn.deploy.export import export_step as export_step
from hrc_learn.deploy.runner import EagerRunner as EagerRunner
from hrc_learn.deploy.runner import PackageRunner as PackageRunner
from hrc_learn.deploy.runner import Rate as Rate
from hrc_learn.deploy.runner import StepRunner as StepRunner
from hrc_learn.deploy.runner import open_step as open_step
from hrc_learn.deploy.scalar_program import UnknownOperationError as UnknownOperationError
