"""What can be repaired of a dataset, in a copy."""

from hrc_learn.demos.repair.episode_edit import RepairOptions as RepairOptions
from hrc_learn.demos.repair.episode_edit import RepairReport as RepairReport
from hrc_learn.demos.repair.repair import repair_dataset as repair_dataset
