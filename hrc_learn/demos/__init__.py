"""Demonstrations: recorded as LeRobot datasets, read as plain arrays, checked and repaired."""

from hrc_learn.demos.dataset_assembly import recover_all as recover_all
from hrc_learn.demos.dataset_assembly import recover_dataset as recover_dataset
from hrc_learn.demos.dataset_writer import DatasetWriter as DatasetWriter
from hrc_learn.demos.demonstration import Demonstration as Demonstration
from hrc_learn.demos.demonstration import DemonstrationSet as DemonstrationSet
from hrc_learn.demos.demonstration import PaddedDemonstrations as PaddedDemonstrations
from hrc_learn.demos.image_features import Detector as Detector
from hrc_learn.demos.image_features import Extraction as Extraction
from hrc_learn.demos.image_features import attach_features as attach_features
from hrc_learn.demos.image_features import extract_features as extract_features
from hrc_learn.demos.images import ImageReader as ImageReader
from hrc_learn.demos.images import load_images as load_images
from hrc_learn.demos.issues import DatasetError as DatasetError
from hrc_learn.demos.issues import Issue as Issue
from hrc_learn.demos.issues import UnitsWarning as UnitsWarning
from hrc_learn.demos.issues import ValidationReport as ValidationReport
from hrc_learn.demos.quality.check import check_dataset as check_dataset
from hrc_learn.demos.quality.merging import merge_datasets as merge_datasets
from hrc_learn.demos.quality.ranking import rank_episodes as rank_episodes
from hrc_learn.demos.quality.ranking import write_curated as write_curated
from hrc_learn.demos.quality.repair import RepairOptions as RepairOptions
from hrc_learn.demos.quality.repair import repair_dataset as repair_dataset
from hrc_learn.demos.read.quantities import ROLES as ROLES
from hrc_learn.demos.read.source import DemonstrationSource as DemonstrationSource
from hrc_learn.demos.read.source import load_demos as load_demos
from hrc_learn.demos.read.source import open_demos as open_demos
