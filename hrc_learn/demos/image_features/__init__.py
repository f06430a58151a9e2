"""Image features found in a dataset's videos, kept in files beside it."""

from .attaching import attach_features as attach_features
from .extraction import Detector as Detector
from .extraction import extract_features as extract_features
