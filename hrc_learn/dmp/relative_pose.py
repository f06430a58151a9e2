"""How each of two hands moves as seen from the other, and what it is off by."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion


def relation(pose: Pose, twist: Tensor) -> tuple[Pose, Float[Tensor, "*batch 2 6"]]:
    """Pose and twist of each hand in the frame of the other.

    Args:
        pose: Of both hands, (*batch, 2).
        twist: (linear [m/s], angular [rad/s]) in the base frame, (*batch, 2, 6).
    """
    other, other_twist = _flipped(pose), twist.flip(-2)
    offset = pose.position - other.position
    linear, angular = (twist - other_twist).split(3, dim=-1)
    linear = linear - torch.linalg.cross(other_twist[..., 3:], offset)
    inverse = quaternion.conjugate(other.orientation)
    seen = [quaternion.rotate(inverse, part) for part in (linear, angular)]
    return other.inverse() @ pose, torch.cat(seen, dim=-1)


def relative_pose_error(
    pose: Pose, twist: Tensor, wanted: Pose, wanted_twist: Tensor
) -> tuple[Float[Tensor, "*batch 2 6"], Float[Tensor, "*batch 2 6"]]:
    """Motion (linear [m], angular [rad]) of each hand to its place beside the other; its rate.

    Args:
        pose: Of both hands, (*batch, 2).
        twist: In the base frame.
        wanted: Of each hand in the frame of the other, as `relation` gives it.
        wanted_twist: Of that.
    """
    other, other_twist = _flipped(pose), twist.flip(-2)
    place = other @ wanted
    linear, angular = (
        quaternion.rotate(other.orientation, part) for part in wanted_twist.split(3, dim=-1)
    )
    turning = other_twist[..., 3:]
    swung = torch.linalg.cross(turning, place.position - other.position)
    carried = torch.cat([other_twist[..., :3] + swung + linear, turning + angular], dim=-1)
    return pose.twist_to(place), carried - twist


def _flipped(pose: Pose) -> Pose:
    return Pose(pose.position.flip(-2), pose.orientation.flip(-2))
