"""Poses of the task in the simulated scene: home, table, shelves."""

import math
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import Constant
from hrc_learn.kinematics import (
    PANDA,
    UnreachableError,
    WorkArm,
    coarse_orientation,
    gripper_down,
    panda,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.sim.scene import HAND_MARKER, SceneConfig


def _vector(*values: float) -> Float[Tensor, " n"]:
    return torch.tensor(values, dtype=torch.float64)


# Upper arm forward: the branch in which joint 1 keeps clear of its limits on both sides.
_LEANING_FORWARD = _vector(1.0, 0.3, -1.2, -1.8, 0.3, 1.9, -1.0)


# Postures at home that are looked at, and what an awkward one costs [rad of motion].
_POSTURES, _PENALTY = 12, 4.0
_TRIED = 8  # starts from which a posture near another one is sought

# Half the hand's thickness, and what is left under it for errors of base and encoders [m].
_HAND_HALF, _OVER_BOARD = 0.030, 0.006


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Poses of the task in a scene. All in the base frame, gripper closing along x."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    home_position: tuple[float, float, float] = (0.60, 0.0, 0.35)
    """End effector between table and cabinet, where a placing motion starts [m]."""
    home_q7: float = -1.0
    """Joint 7 at home [rad]: the elbow leans to the left, away from the cabinet."""
    table_centre: tuple[float, float] = (0.24, 0.54)
    """Middle of the part of the table that the camera sees well [m]."""
    table_reach: tuple[float, float] = (0.14, 0.14)
    """How far from there the edges of objects may be, along x and y [m]."""
    hover_height: float = 0.17
    """Of the tool centre point while it servoes to an object [m]."""
    hover_orientation: tuple[float, float, float, float] = tuple(gripper_down().tolist())
    """Of the end effector above the table (wxyz)."""
    hover_q7: float = -0.1
    """Joint 7 above the table [rad]."""
    fingertip: float = 0.012
    """How far the fingers reach beyond the tool centre point, in the middle of the pads [m]."""
    palm: float = 0.0374
    """How far the palm stands back from it [m]."""
    hover_turns: tuple[float, float] = (np.deg2rad(-75.0), np.deg2rad(105.0))
    """Least and greatest turn of the end effector about the vertical there [rad]: half a turn,
    in which the forearm does not come between its marker and the camera."""
    shelf_x: float = 0.40
    """Where along the boards objects are put [m]."""
    shelf_depth: float = 0.10
    """From the boards' front edge to the tool centre point [m]."""
    clearance: float = 0.007
    """Gap left under an object when it is released on a board [m]."""
    approach: float = 0.16
    """Distance in front of the boards from which the end effector moves straight in [m]."""

    @classmethod
    def of(cls, robot: WorkArm, **options: Any) -> "Workplace":
        """The same place with another arm in it.

        Args:
            robot: The arm.
            options: The remaining fields.
        """
        scene = SceneConfig()
        scene = replace(scene, arm=replace(scene.arm, robot=robot))
        return cls(scene=scene, **options)

    @property
    def robot(self) -> WorkArm:
        """The arm that works there."""
        return self.scene.arm.robot

    @property
    def tool_marker(self) -> int:
        """ArUco number of the marker on the end effector."""
        return HAND_MARKER

    def home(self) -> Pose:
        """End effector at home, pointing down."""
        return Pose(_vector(*self.home_position), gripper_down())

    def home_joints(
        self, offset: Float[Tensor, "3"] | None = None, q7_offset: float = 0.0
    ) -> Float[Tensor, " joints"]:
        """Joint positions at home.

        Args:
            offset: Of the end effector from home [m].
            q7_offset: Change of joint 7, which moves the elbow about the line to the wrist
                [rad].

        Raises:
            UnreachableError: If no joint positions reach it.
        """
        home = self.home()
        if offset is not None:
            home = Pose(home.position + offset, home.orientation)
        if self.robot is PANDA:
            return panda.inverse(home, self.home_q7 + q7_offset, near=_LEANING_FORWARD)
        return self.robot.nearest(home, near=self._home_posture)

    def hover(self) -> Pose:
        """End effector above the middle of the table."""
        position = _vector(*self.table_centre, self.hover_height)
        return Pose(position, _vector(*self.hover_orientation))

    def approached(self, approach: Approach | None) -> "Workplace":
        """The same with the demonstrated orientation above the table; None: as it is."""
        if approach is None:
            return self
        w, x, y, z = approach.orientation.tolist()
        return replace(self, hover_orientation=(w, x, y, z))

    def hover_joints(self) -> Float[Tensor, " joints"]:
        """Joint positions above the table, with the upper arm well off the vertical.

        Where it is upright, the axes of joints 1 and 3 coincide, and nobody can pull the elbow.
        """
        if self.robot is PANDA:
            return panda.inverse(self.hover(), self.hover_q7, near=_LEANING_FORWARD)
        return self.robot.nearest(self.hover(), near=self._home_posture)

    @property
    def _home_posture(self) -> Float[Tensor, " joints"]:
        """Near which the arm works."""
        return _working_posture(
            self.robot,
            ("home_position", self.home_position),
            ("table_centre", self.table_centre),
            ("hover_height", self.hover_height),
            ("shelf_x", self.shelf_x),
            ("shelf_depth", self.shelf_depth),
        )

    def _awkwardness(self, q: Float[Tensor, " joints"]) -> float:
        """How near a posture is to furniture, limits and singularities; 0: far from all."""
        limits, chain = self.robot.chain.limits, self.robot.chain
        room = float(torch.minimum(q - limits.lower, limits.upper - q).min())
        smallest = float(torch.linalg.svdvals(chain.jacobian(q))[-1])
        near = float(self.arm_clearance(q))
        wanted = ((room, 0.3), (smallest, 0.15), (near, 0.05))  # [rad], [m/rad], [m]
        return sum(_PENALTY * max(0.0, 1.0 - value / good) for value, good in wanted)

    def hover_postures(self) -> list[Float[Tensor, " joints"]]:
        """Joint positions above the table, the preferred ones first."""
        return [self.hover_joints(), *self.robot.postures(self.hover())]

    def object_region(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Box in which objects may be on the table: centre and half edges [m]."""
        highest = 2 * max(item.half_size[2] for item in self.scene.objects)
        half = _vector(*self.table_reach, highest / 2)
        return _vector(*self.table_centre, highest / 2), half

    def arm_clearance(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance of the arm from the furniture, its hand apart, and from itself [m].

        Args:
            q: Joint position [rad].
        """
        centre, half_size = self._furniture.like(q).split(3, dim=-1)
        robot = self.robot
        frames = robot.chain.link_frames(q)
        furniture = robot.body.box_distance(q, centre, half_size, frames)
        return torch.minimum(furniture, robot.whole.self_distance(q, frames))

    @cached_property
    def _furniture(self) -> Constant:
        """Centre and half edges of the boxes that stand around [m]."""
        boxes = [(*box.centre, *box.half_size) for box in self.scene.boxes()]
        # Once kept, it must serve autograd as well.
        with torch.inference_mode(False):
            return Constant(torch.tensor(boxes, dtype=torch.float64))

    def random_object_pose(
        self, reach: tuple[float, float, float], rng: np.random.Generator, yaw: float = 0.06
    ) -> Float[np.ndarray, "4 4"]:
        """Random pose of the scene's first object around the middle of the table.

        Args:
            reach: Largest distances from the middle, along x and y [m]; z is not used.
            rng: Source of position and yaw.
            yaw: Largest turn, either way [rad]; by default as people lay things down along
                the table's edges.
        """
        turn = rng.uniform(-yaw, yaw)
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

    def shelf(self, name: str, half_size: tuple[float, float, float] | None = None) -> Pose:
        """End effector where it releases an object on a shelf, level and into the cabinet.

        Args:
            name: Of the shelf.
            half_size: Of the object [m]; that of the scene's first object when None.

        Raises:
            ValueError: If there is no such shelf, or the place is not on its board.
        """
        cabinet = self.scene.cabinet
        if name not in cabinet.shelves:
            raise ValueError(
                f"no shelf named {name!r}: this cabinet has {', '.join(self.shelf_names())}."
            )
        a, b, c = half_size or self.scene.objects[0].half_size
        left, right = cabinet.left + a, cabinet.right - a
        front, back = c, cabinet.depth - c
        if not (left <= self.shelf_x <= right and front <= self.shelf_depth <= back):
            raise ValueError(
                f"shelf_x {self.shelf_x:g} m and shelf_depth {self.shelf_depth:g} m are not on "
                f"the boards: an object of {2 * a:g} x {2 * c:g} m stands on them for x from "
                f"{left:g} to {right:g} m and depths from {front:g} to {back:g} m."
            )
        # Grasped from above, an object lies on its side once the end effector is level.
        height = cabinet.shelves[name] + b + self.clearance
        position = _vector(self.shelf_x, cabinet.front - self.shelf_depth, height)
        return Pose(position, coarse_orientation(position))

    def lowering(self, half_size: tuple[float, float, float]) -> float:
        """How far an object may be let down until the hand itself would be near the board [m].

        Args:
            half_size: Of the object, which lies on its side [m].
        """
        return max(half_size[1] + self.clearance - _HAND_HALF - _OVER_BOARD, 0.0)

    def shelf_front(self, name: str) -> Pose:
        """End effector in front of a shelf, at the height of the release."""
        position = self.shelf(name).position.clone()
        position[1] = self.scene.cabinet.front + self.approach
        return Pose(position, coarse_orientation(position))


@cache
def _working_posture(
    robot: WorkArm, *places: tuple[str, float | tuple[float, ...]]
) -> Float[Tensor, " joints"]:
    """Of an arm's postures at home, the one from which it gets on with its work best.

    It has postures above the table and at each shelf that are all near to one another, clear of
    the furniture and away from limits and singularities.

    Args:
        robot: The arm.
        places: Fields of its workplace; the furniture is the ordinary one.

    Raises:
        UnreachableError: No posture at home is one for all of these places.
    """
    workplace = Workplace.of(robot, **dict(places))
    names = workplace.shelf_names()
    goals = [workplace.hover(), *map(workplace.shelf_front, names)]
    goals += map(workplace.shelf, names)
    best, least = None, math.inf
    for posture in robot.postures(workplace.home())[:_POSTURES]:
        cost = workplace._awkwardness(posture)
        for goal in goals:
            if cost > least:
                break
            try:
                there = robot.nearest(goal, near=posture, samples=_TRIED)
            except UnreachableError:
                cost = math.inf
                break
            cost += float((there - posture).abs().max()) + workplace._awkwardness(there)
        if cost < least:
            best, least = posture, cost
    if best is None:
        raise UnreachableError(
            f"the {robot.name} does not reach home, table and shelves in one posture: "
            f"move them towards it ({', '.join(name for name, _ in places)})."
        )
    return best
