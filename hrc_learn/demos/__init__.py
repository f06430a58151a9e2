"""Demonstrations: recorded as LeRobot datasets, read back as plain arrays, checked."""

from hrc_learn.demos.demonstration import Demonstration as Demonstration
from hrc_learn.demos.demonstration import DemonstrationSet as DemonstrationSet
from hrc_learn.demos.demonstration import PaddedDemonstrations as PaddedDemonstrations
from hrc_learn.demos.hub import push_dataset as push_dataset
from hrc_learn.demos.image_features import Detector as Detector
from hrc_learn.demos.image_features import attach_features as attach_features
from hrc_learn.demos.image_features import extract_features as extract_features
from hrc_learn.demos.issue import DatasetError as DatasetError
from hrc_learn.demos.issue import Issue as Issue
from hrc_learn.demos.issue import UnitsWarning as UnitsWarning
from hrc_learn.demos.issue import ValidationReport as ValidationReport
from hrc_learn.demos.read.images import ImageReader as ImageReader
from hrc_learn.demos.read.images import load_images as load_images
from hrc_learn.demos.read.reader import DemonstrationSource as DemonstrationSource
from hrc_learn.demos.read.reader import load_demos as load_demos
from hrc_learn.demos.read.reader import open_demos as open_demos
from hrc_learn.demos.read.roles import ROLES as ROLES
from hrc_learn.demos.read.thumbnails import thumbnails as thumbnails
from hrc_learn.demos.validation.check import check_dataset as check_dataset
from hrc_learn.demos.write.assembly import recover_all as recover_all
from hrc_learn.demos.write.assembly import recover_dataset as recover_dataset
from hrc_learn.demos.write.writer import DatasetWriter as DatasetWriter
