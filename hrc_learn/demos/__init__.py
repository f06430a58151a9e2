"""Demonstrations: recorded as LeRobot datasets, read back as plain arrays, checked."""

from .check import check_dataset as check_dataset
from .checks.report import Report as Report
from .demonstration import Demonstration as Demonstration
from .demonstration_set import DemonstrationSet as DemonstrationSet
from .demonstration_source import DemonstrationSource as DemonstrationSource
from .finding import DatasetError as DatasetError
from .finding import Finding as Finding
from .finding import UnitsWarning as UnitsWarning
from .padding import PaddedDemonstrations as PaddedDemonstrations
from .reader import load_demos as load_demos
from .reader import open_demos as open_demos
from .roles import ROLES as ROLES
from .writer import DatasetWriter as DatasetWriter
from .writer import recover_dataset as recover_dataset
