"""Quality of a layout (places of table and cabinet) for an arm, from kinematics alone.

The arm follows the paths of the job without physics. The smallest margin to joint limits,
singularities and furniture is the quality of the starting posture. Above the table, the camera
must also see the marker on the gripper while the gripper turns through half a circle about the
vertical. Half a circle is enough, because after half a turn a parallel gripper grasps an object
in the same way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm, coarse_orientation
from hrc_learn.kinematics.collision import segment_distance
from hrc_learn.kinematics.inverse import follow_poses
from hrc_learn.sim.arm_model import Plate
from hrc_learn.vision import CameraModel

type Clearances = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Distance of an arm from the furniture and from itself at joint positions [m]."""

# Values that give quality 1. `_MARGIN`: distance from joint limits [rad]. `_SINGULAR`: smallest
# singular value [m/rad]. `_CLEAR`, `_APART`: distance of the arm from furniture and from itself
# [m]. `_SPEED`: largest joint speed, as a fraction of its limit.
_MARGIN, _SINGULAR, _CLEAR, _APART, _SPEED = 0.25, 0.08, 0.04, 0.01, 0.8
# A pose counts as not reached if its tracking error is at least this: distance [m] or angle
# [rad].
_LOST = 5e-3
# Numbers of samples: of a path to a shelf (`_STEPS`), of a path across the table (`_ACROSS`),
# and of half a turn of the gripper above the table.
_STEPS, _ACROSS, _HALF_TURN = 60, 8, 24
_DURATION = 14.0  # duration of the motion to a shelf [s]


def clearance_quality(
    clearances: Clearances, q: Float[Tensor, "*batch joints"], size: float = 1.0
) -> Float[Tensor, "*batch"]:
    """Margin to furniture and to the arm itself; 0: contact, 1 and more: ample.

    Args:
        clearances: Clearances of the arm.
        q: Joint positions [rad].
        size: Size of the hand relative to the Franka hand.
    """
    furniture, itself = clearances(q)
    return torch.minimum(furniture / _CLEAR, itself / _APART) / size


def _quality(
    robot: Arm,
    clearances: Clearances,
    q: Float[Tensor, "steps *rows joints"],
    error: Float[Tensor, "steps *rows"],
) -> Float[Tensor, "steps *rows"]:
    """Quality from 0 (pose not reached, or contact) to 1 (ample margins)."""
    margin = torch.minimum(q - robot.limits.lower, robot.limits.upper - q).amin(-1)
    smallest = torch.linalg.svdvals(robot.jacobian(q))[..., -1]
    clear = clearance_quality(clearances, q, robot.hand_size)
    ratios = torch.stack([margin / _MARGIN, smallest / (_SINGULAR * robot.hand_size), clear])
    return torch.where(error < _LOST, ratios.amin(0).clamp(0.0, 1.0), 0.0)


def path_quality(
    robot: Arm,
    clearances: Clearances,
    paths: Sequence[Float[Tensor, "points 3"]],
    level_at: float,
    start: Float[Tensor, "postures joints"],
) -> Float[Tensor, " postures"]:
    """Smallest quality along paths to shelves, with the tilt of `coarse_orientation`.

    Args:
        robot: The arm.
        clearances: Clearances of the arm.
        paths: Paths of the tool centre point, all from home [m].
        level_at: Distance to the right of the base at which the hand is level [m].
        start: Joint positions at the first point [rad].

    Returns:
        Quality from 0 (pose not reached, or contact) to 1 (ample margins).
    """
    # All paths are followed at once, which takes hardly longer than one.
    position = torch.stack([_sampled(points) for points in paths], dim=1)[:, :, None]
    path = Pose(position, coarse_orientation(position, level_at))
    q, error = follow_poses(robot, path, start.expand(len(paths), -1, -1))
    least = _quality(robot, clearances, q, error).amin(0)
    # The peak speed of a minimum-jerk motion is 1.875 times its mean speed.
    speed = (q[1:] - q[:-1]).abs() * 1.875 * _STEPS / _DURATION
    load = (speed / robot.limits.velocity).amax(-1).amax(0)
    return torch.where(load > _SPEED, least * (_SPEED / load), least).amin(0)


def _sampled(points: Float[Tensor, "points 3"]) -> Float[Tensor, "steps 3"]:
    """Points at equal distances along a path of straight lines [m]."""
    lengths = (points[1:] - points[:-1]).norm(dim=-1)
    ends = torch.cat([torch.zeros(1, dtype=torch.float64), lengths.cumsum(0)])
    at = torch.linspace(0.0, float(ends[-1]), _STEPS, dtype=torch.float64)
    columns = [np.interp(at.numpy(), ends.numpy(), column) for column in points.T.numpy()]
    return torch.from_numpy(np.stack(columns, axis=-1))


@dataclass(frozen=True, kw_only=True)
class MarkedTurns:
    """Turns that the gripper may make above the table, and the side of the hand that carries
    the marker.
    """

    plate: Plate
    """Plate that carries the marker."""
    turns: tuple[float, float]
    """Least and greatest turn about the vertical [rad], half a turn apart."""
    quality: float
    """Smallest quality in that range, from 0 to 1."""
    seen: float
    """Fraction of poses that are reached with the marker in view."""


def marked_turns(
    robot: Arm,
    clearances: Clearances,
    camera: CameraModel,
    plate: Plate,
    middle: Pose,
    reach: tuple[float, float],
    hover: Float[Tensor, " joints"],
) -> MarkedTurns:
    """Best side of the hand for the marker, and best half turn of the gripper above a table.

    Args:
        robot: The arm.
        clearances: Clearances of the arm.
        camera: Camera that must see the marker.
        plate: Plate with the marker, on one of its two possible sides.
        middle: Pose of the tool centre point above the middle of the table.
        reach: Largest distances from the middle, along x and y [m].
        hover: Joint positions at `middle` [rad].
    """
    q, error = _turned_above_table(robot, middle, reach, hover)
    reached = _quality(robot, clearances, q, error)
    best: tuple[tuple[float, float], MarkedTurns] | None = None
    for side in (plate, _other_side(plate)):
        good = (marker_seen(robot, camera, side, q) & (reached > 0)).double()
        for first in range(_HALF_TURN + 1):
            window = slice(first, first + _HALF_TURN + 1)
            seen, least = float(good[window].mean()), float(reached[window].amin())
            # The first criterion is the fraction of poses with a view, rounded to 1 %. The
            # second is the quality minus the distance of this half circle from the middle one.
            off_middle = abs(first - _HALF_TURN / 2) / _HALF_TURN
            score = (round(seen, 2), least - off_middle)
            if best is None or score > best[0]:
                turn = (first / _HALF_TURN - 1) * math.pi
                turns = (turn, turn + math.pi)
                best = score, MarkedTurns(plate=side, turns=turns, quality=least, seen=seen)
    assert best is not None
    return best[1]


def _turned_above_table(
    robot: Arm, middle: Pose, reach: tuple[float, float], hover: Float[Tensor, " joints"]
) -> tuple[Float[Tensor, "turns places joints"], Float[Tensor, "turns places"]]:
    """Joint positions above five places of the table, for turns of the gripper by -180 to 180
    degrees, and the tracking errors there.
    """
    corners = [[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]
    aside = torch.tensor(corners).double() * torch.tensor([*reach, 0.0]).double()
    fraction = torch.linspace(0.0, 1.0, _ACROSS, dtype=torch.float64)
    across = Pose(
        middle.position + fraction[:, None, None] * aside,
        middle.orientation.expand(_ACROSS, len(aside), 4),
    )
    q, _ = follow_poses(robot, across, hover.expand(len(aside), -1))
    # Half a turn either way, both at once.
    turns = torch.linspace(0.0, math.pi, _HALF_TURN + 1, dtype=torch.float64)[:, None]
    turns = turns * torch.tensor([-1.0, 1.0])
    about = quaternion.exp(torch.stack([0 * turns, 0 * turns, turns], dim=-1))
    orientation = quaternion.multiply(about, middle.orientation)[:, :, None]
    position = (middle.position + aside).expand(len(turns), 1, -1, -1)
    q, error = follow_poses(robot, Pose(position, orientation), q[-1].expand(2, -1, -1))
    q, error = (torch.cat([x[:, 0].flip(0), x[1:, 1]]) for x in (q, error))
    return q, error


def _other_side(plate: Plate) -> Plate:
    """The same plate on the other side of the hand: half a turn about the hand's axis."""
    x, y, z = plate.position
    half = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    turned = quaternion.multiply(half, torch.tensor(plate.orientation, dtype=torch.float64))
    w, i, j, k = turned.tolist()
    return replace(plate, position=(-x, -y, z), orientation=(w, i, j, k))


def marker_seen(
    robot: Arm, camera: CameraModel, plate: Plate, q: Float[Tensor, "*batch joints"]
) -> Bool[Tensor, "*batch"]:
    """True if a camera sees the whole plate on the gripper: the plate is inside the image, and
    no link hides it.

    Args:
        robot: The arm.
        camera: The camera.
        plate: Plate in the frame of the gripper.
        q: Joint positions [rad].
    """
    tool = robot.forward(q)
    # Transform from the gripper's frame, at the flange, to the frame of the tool.
    half = plate.marker.plate_size / 2
    corners = torch.tensor([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)]).double() * half
    turn = torch.tensor(plate.orientation, dtype=torch.float64)
    back = torch.tensor([0.0, 0.0, float(robot.tcp[:3, 3].norm())], dtype=torch.float64)
    centre = torch.tensor(plate.position, dtype=torch.float64) - back
    points = centre + quaternion.rotate(turn, corners)
    world = Pose(tool.position[..., None, :], tool.orientation[..., None, :]).apply(points)
    eye = torch.from_numpy(camera.pose[:3, 3].copy())
    rays = torch.stack([eye.expand_as(world), world], dim=-2)
    radii = torch.tensor([c.radius for c in robot.body.capsules], dtype=torch.float64)
    links = robot.body.segments(q)[..., None, :, :, :]
    free = (segment_distance(rays[..., None, :, :], links) > radii).all(-1).all(-1)
    return free & torch.from_numpy(camera.in_view(world.numpy())).all(-1)
