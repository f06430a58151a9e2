"""Where things happen in the simulated workplace: home, table, shelves."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import (
    UnreachableError,
    coarse_orientation,
    comfortable_postures,
    gripper_down,
    panda,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.sim.scene import ObjectConfig, SceneConfig


def _vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Poses of the task in a scene. All in the base frame, gripper closing along x."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    home_position: tuple[float, float, float] = (0.60, 0.0, 0.35)
    """Hand between table and cabinet, where a placing motion starts [m]."""
    home_q7: float = -1.0
    """Joint 7 at home [rad]: the elbow leans to the left, away from the cabinet."""
    table_centre: tuple[float, float] = (0.24, 0.54)
    """Middle of the part of the table that the camera sees well [m]."""
    table_reach: tuple[float, float] = (0.14, 0.14)
    """How far from there the edges of things may be, along x and y [m]."""
    hover_height: float = 0.17
    """Of the tool centre point while it aims at an object [m]."""
    hover_orientation: tuple[float, float, float, float] = tuple(gripper_down().tolist())
    """Of the hand above the table (wxyz)."""
    hover_q7: float = -0.1
    """Joint 7 above the table [rad]."""
    shelf_x: float = 0.40
    """Where along the boards things are put [m]."""
    shelf_depth: float = 0.10
    """From the boards' front edge to the tool centre point [m]."""
    clearance: float = 0.007
    """Gap left under a thing when it is let go on a board [m]."""
    approach: float = 0.16
    """Distance in front of the boards from which the hand moves straight in [m]."""

    def home(self) -> Pose:
        """Hand at home, pointing down."""
        return Pose(_vector(*self.home_position), gripper_down())

    def home_joints(self, offset: torch.Tensor | None = None) -> torch.Tensor:
        """Joint positions with the hand at home, or at an offset from it [m]."""
        home = self.home()
        if offset is not None:
            home = Pose(home.position + offset, home.orientation)
        return panda.inverse(home, self.home_q7, near=_LEANING_FORWARD)

    def hover(self) -> Pose:
        """Hand above the middle of the table."""
        position = _vector(*self.table_centre, self.hover_height)
        return Pose(position, _vector(*self.hover_orientation))

    def approached(self, approach: Approach | None) -> "Workplace":
        """The same where the hand comes to objects as was shown; None: as it is."""
        if approach is None:
            return self
        w, x, y, z = approach.orientation.tolist()
        return replace(self, hover_orientation=(w, x, y, z))

    def hover_joints(self) -> torch.Tensor:
        """Joint positions with the hand above the table, the upper arm well off the vertical.

        Where it stands upright, joints 1 and 3 are in line, and nobody can pull the elbow.
        """
        return panda.inverse(self.hover(), self.hover_q7, near=_LEANING_FORWARD)

    def hover_postures(self) -> list[torch.Tensor]:
        """Joint positions with the hand above the table, the preferred ones first."""
        return [self.hover_joints(), *comfortable_postures(panda, self.hover())]

    def things(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Where things may lie on the table: centre and half edges of a box [m]."""
        highest = 2 * max(item.half_size[2] for item in self.scene.objects)
        half = _vector(*self.table_reach, highest / 2)
        return _vector(*self.table_centre, highest / 2), half

    def random_object_pose(
        self, reach: tuple[float, float, float], rng: np.random.Generator
    ) -> Float[np.ndarray, "4 4"]:
        """Pose of the scene's first object, lying at random about the middle of the table.

        Args:
            reach: How far from the middle, along x and y [m]; its height is the table's.
            rng: Source of place and turn.
        """
        turn = rng.uniform(-0.06, 0.06)
        c, s = np.cos(turn), np.sin(turn)
        pose = np.eye(4)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:2, 3] = np.array(self.table_centre) + rng.uniform(-1, 1, 2) * reach[:2]
        pose[2, 3] = self.scene.objects[0].half_size[2]
        return pose

    def shelf_names(self) -> tuple[str, ...]:
        """From bottom to top."""
        shelves = self.scene.cabinet.shelves
        return tuple(sorted(shelves, key=shelves.__getitem__))

    def shelf(self, name: str, item: ObjectConfig | None = None) -> Pose:
        """Hand where it lets go of a thing on a shelf, pointing level into the cabinet.

        Args:
            name: Of the shelf.
            item: What is put down; the scene's first object when None.

        Raises:
            ValueError: If there is no such shelf, or the place is not on its board.
        """
        cabinet = self.scene.cabinet
        if name not in cabinet.shelves:
            raise ValueError(
                f"no shelf named {name!r}: this cabinet has {', '.join(self.shelf_names())}."
            )
        item = item or self.scene.objects[0]
        self._check_place_on_board(item)
        # Held from above, a thing lies on its side once the hand points level.
        height = cabinet.shelves[name] + item.half_size[1] + self.clearance
        position = _vector(self.shelf_x, cabinet.front - self.shelf_depth, height)
        return Pose(position, coarse_orientation(position))

    def _check_place_on_board(self, item: ObjectConfig) -> None:
        cabinet, half_size = self.scene.cabinet, item.half_size
        left, right = cabinet.left + half_size[0], cabinet.right - half_size[0]
        front, back = half_size[2], cabinet.depth - half_size[2]
        if not (left <= self.shelf_x <= right and front <= self.shelf_depth <= back):
            raise ValueError(
                f"shelf_x {self.shelf_x:g} m and shelf_depth {self.shelf_depth:g} m are not on "
                f"the boards: {item.name!r} stands on them for x from {left:g} to {right:g} m "
                f"and depths from {front:g} to {back:g} m."
            )

    def mouth(self, name: str, item: ObjectConfig | None = None) -> Pose:
        """Hand in front of a shelf, level with where it will let go."""
        goal = self.shelf(name, item)
        position = goal.position.clone()
        position[1] = self.scene.cabinet.front + self.approach
        return Pose(position, coarse_orientation(position))


# Upper arm forward: the branch in which joint 1 keeps clear of its limits on both sides.
_LEANING_FORWARD = _vector(1.0, 0.3, -1.2, -1.8, 0.3, 1.9, -1.0)


def nearest_configuration(goal: Pose, near: torch.Tensor, samples: int = 57) -> torch.Tensor:
    """Joint positions that reach a pose, as near as can be to given ones.

    Scans joint 7, the redundant one, and keeps the best of the analytic solutions.

    Args:
        goal: Pose of the tool centre point.
        near: Joint positions [rad], shape (7,).
        samples: Values of joint 7 tried between its limits.

    Raises:
        UnreachableError: If no value of joint 7 reaches the pose within the limits.
    """
    lower, upper = float(panda.limits.lower[6]), float(panda.limits.upper[6])
    candidates = torch.linspace(lower + 0.02, upper - 0.02, samples, dtype=torch.float64)
    candidates = torch.cat([near[6:7], candidates])
    best, distance = None, math.inf
    for q7 in candidates:
        try:
            q = panda.inverse(goal, q7, near=near)
        except UnreachableError:
            continue
        if (d := float((q - near).norm())) < distance:
            best, distance = q, d
    if best is None:
        x, y, z = goal.position.tolist()
        w = [round(v, 3) for v in quaternion.normalize(goal.orientation).tolist()]
        raise UnreachableError(
            f"no joint positions within the limits reach position ({x:.3f}, {y:.3f}, {z:.3f}) "
            f"m with orientation {w} (wxyz): move the goal towards the robot or turn it."
        )
    return best
