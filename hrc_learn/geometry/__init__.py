"""Rotations, poses and shapes; `numerics` holds the numerically delicate functions."""

from hrc_learn.geometry import quaternion as quaternion
from hrc_learn.geometry.numerics import minimum_jerk as minimum_jerk
from hrc_learn.geometry.pose import Pose as Pose
from hrc_learn.geometry.shapes import Body as Body
from hrc_learn.geometry.shapes import Box as Box
from hrc_learn.geometry.shapes import Capsule as Capsule
from hrc_learn.geometry.shapes import MeshFile as MeshFile
from hrc_learn.geometry.shapes import MeshPart as MeshPart
from hrc_learn.geometry.shapes import mesh_points as mesh_points
from hrc_learn.geometry.shapes import read_mesh as read_mesh
