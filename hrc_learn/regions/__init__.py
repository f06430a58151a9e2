"""Regions of joint, Cartesian and image space, with potentials that guide the robot."""

from hrc_learn.regions.region import AxisRegion as AxisRegion
from hrc_learn.regions.region import JointRegion as JointRegion
from hrc_learn.regions.region import OrientationRegion as OrientationRegion
from hrc_learn.regions.region import PositionRegion as PositionRegion
from hrc_learn.regions.region import PostureRegion as PostureRegion
from hrc_learn.regions.region import Region as Region
from hrc_learn.regions.region import VisionRegion as VisionRegion
