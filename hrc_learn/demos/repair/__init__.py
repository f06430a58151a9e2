"""What can be repaired of a dataset, in a copy."""

from .dataset import repair_dataset as repair_dataset
from .options import RepairOptions as RepairOptions
from .report import RepairReport as RepairReport
