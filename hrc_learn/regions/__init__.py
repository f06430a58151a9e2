"""Regions of joint, Cartesian and image space and the potentials that steer by them."""

from .joint import JointRegion as JointRegion
from .orientation import OrientationRegion as OrientationRegion
from .position import PositionRegion as PositionRegion
from .posture import PostureRegion as PostureRegion
from .region import Region as Region
from .vision import VisionRegion as VisionRegion
