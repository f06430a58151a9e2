"""Rotations and poses; every delicate numeric of the package is in `numerics`."""

from . import quaternion as quaternion
from .pose import Pose as Pose
