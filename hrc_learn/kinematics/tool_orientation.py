"""Tool orientations: the paper's rule for three-axis devices, and tangents of approaches.

A three-axis haptic device moves the end effector but cannot turn it. Therefore,
`coarse_orientation` (eq. coarse_orientation of the paper) derives the tilt from the sideways
position: straight down in front of the robot, level at the end of its reach. `Approach`
(section Collaboration Task) is an orientation for grasping, which points along the tangent of
the demonstrated motion near the object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.store import JsonFile, Radians

NEAR = 0.05
"""Length of the last part of a path [m]; the direction of this part is the tangent."""

# Tangents are not used if their root-mean-square angle to their mean exceeds this angle [rad].
# They are not used either if the angle between their mean and the pointing direction of the end
# effector exceeds it: the end effector then approached the object from the side.
MAX_SPREAD = math.radians(30)
# Shorter vectors are rounding noise and have no direction.
_SHORTEST = 1e-12


def gripper_down() -> Float[Tensor, "4"]:
    """Orientation of a gripper that points down and closes along the base's x axis (wxyz)."""
    return torch.tensor([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0], dtype=torch.float64)


def coarse_orientation(
    position: Float[Tensor, "*batch 3"], reach: float = 0.6, tilt: float = math.pi / 2
) -> Float[Tensor, "*batch 4"]:
    """Orientation of the end effector as a function of its position.

    With the y position r_2, the paper gives the angle r_5 = beta_0 r_2 / Y_0, limited to
    +-beta_0, but not its axis. We tilt the gripper-down frame by this angle about the base's x
    axis: a hand that moves to the right (-y) points to the right.

    Args:
        position: Position of the end effector [m].
        reach: Y_0 [m].
        tilt: beta_0 [rad].

    Returns:
        Unit quaternions (wxyz).
    """
    angle = tilt * (position[..., 1] / reach).clamp(-1.0, 1.0)
    zero = torch.zeros_like(angle)
    turn = quaternion.exp(torch.stack([angle, zero, zero], dim=-1))
    return quaternion.multiply(turn, gripper_down().to(position))


def turn_about_vertical(
    orientation: Float[Tensor, "4"], reference: Float[Tensor, "4"]
) -> float:
    """Turn about the base's z axis that brings a reference nearest to an orientation [rad].

    Args:
        orientation: Orientation to come near to (wxyz).
        reference: Orientation that is turned (wxyz).

    Returns:
        From -pi to pi.
    """
    w, _, _, z = quaternion.multiply(orientation, quaternion.conjugate(reference)).tolist()
    # Twist about z of the rotation between both (swing-twist decomposition).
    return math.remainder(2 * math.atan2(z, w), 2 * math.pi)


@dataclass(frozen=True, kw_only=True)
class Approach(JsonFile):
    """Orientation of the end effector in front of an object, from demonstrated approaches.

    Objects lie at any yaw, so the rotation about the vertical is removed: the orientation is
    that of a gripper that closes along x. The saved file has the same fields.
    """

    version: Literal[1] = 1
    orientation_wxyz: tuple[float, float, float, float]
    """Unit quaternion; its z axis is the direction of approach to the object."""
    spread_rad: Radians
    """Root-mean-square angle between the demonstrations' tangents and their mean [rad]."""
    turned_rad: Radians
    """Angle from the mean demonstrated orientation to `orientation_wxyz` [rad]; 0 if the
    tangents are not used."""

    def __post_init__(self) -> None:
        if not math.isclose(math.hypot(*self.orientation_wxyz), 1.0, abs_tol=1e-3):
            raise ValueError("orientation_wxyz is no unit quaternion")

    @property
    def orientation(self) -> Float[Tensor, "4"]:
        """The orientation as a tensor (wxyz), in float64."""
        return torch.tensor(self.orientation_wxyz, dtype=torch.float64)

    @property
    def direction(self) -> Float[Tensor, "3"]:
        """Unit vector of the approach to the object, in the base frame."""
        return quaternion.to_matrix(self.orientation)[:, 2]

    @classmethod
    def fit(cls, paths: Sequence[Pose]) -> "Approach":
        """Turn the mean demonstrated orientation, as little as needed, to point along the path.

        Args:
            paths: Poses of the end effector in each demonstration, which ends in front of the
                object: position (time, 3) [m], orientation (time, 4).

        Raises:
            ValueError: If there is no path.
        """
        if not paths:
            raise ValueError("an approach is learned from one demonstration or more: got none.")
        paths = [_unturned(path) for path in paths]
        ends = torch.stack([path.orientation[-1] for path in paths])
        demonstrated = quaternion.mean(ends)
        tangents = torch.stack([tangent(path.position) for path in paths])
        mean = tangents.mean(dim=0)
        mean = mean / mean.norm().clamp(min=_SHORTEST)
        spread = float(_angle(tangents, mean).square().mean().sqrt())
        points = quaternion.to_matrix(demonstrated)[:, 2]
        turned = float(_angle(points, mean))
        if not max(spread, turned) < MAX_SPREAD:
            turned = 0.0
        axis = torch.linalg.cross(points, mean)
        turn = quaternion.exp(turned * axis / axis.norm().clamp(min=_SHORTEST))
        w, x, y, z = quaternion.multiply(turn, demonstrated).tolist()
        return cls(orientation_wxyz=(w, x, y, z), spread_rad=spread, turned_rad=turned)


def tangent(position: Float[Tensor, "time 3"]) -> Float[Tensor, "3"]:
    """Unit direction of the last part of a path; zero if the path does not move.

    Args:
        position: Positions along the path [m].
    """
    way = position[-1] - position
    before = (way.norm(dim=-1) > NEAR).nonzero()[:, 0]
    chord = way[int(before[-1])] if len(before) else way[0]
    return chord / chord.norm().clamp(min=_SHORTEST)


def _unturned(path: Pose) -> Pose:
    """The path in float64, turned about the vertical so that the gripper closes along x at its
    end.
    """
    turn = turn_about_vertical(path.orientation[-1], gripper_down())
    back = quaternion.exp(torch.tensor([0.0, 0.0, -turn], dtype=torch.float64))
    orientation = quaternion.multiply(back, path.orientation.double())
    return Pose(quaternion.rotate(back, path.position.double()), orientation)


def _angle(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "3"]) -> Float[Tensor, "*batch"]:
    """Angle between unit vectors [rad], exact also where they are nearly parallel."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(dim=-1))
