"""Poses of the task in the simulated scene: home, table and shelves, laid out for an arm.

No pose is stored per arm. Layouts with tables and cabinets at several distances are evaluated,
the usual ones first, until one suits the arm (`layout_quality`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import Constant, lasting
from hrc_learn.kinematics import Arm, UnreachableError, coarse_orientation, gripper_down
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.sim.layout_quality import (
    MarkedTurns,
    clearance_quality,
    marked_turns,
    path_quality,
)
from hrc_learn.sim.scene import HAND_MARKER, SceneConfig, marked_plate


def _vector(*values: float) -> Float[Tensor, " n"]:
    return torch.tensor(values, dtype=torch.float64)


# Posture with the upper arm forward: in this branch of the inverse kinematics, joint 1 stays
# away from both of its limits.
_LEANING_FORWARD = _vector(1.0, 0.3, -1.2, -1.8, 0.3, 1.9, -1.0)


# Distances of table and cabinet from the base, relative to the usual ones.
_SCALES = (1.0, 0.85, 0.7, 0.55)
# An arm of fewer than six joints keeps its tool in a plane through the axis of its first joint,
# and the wrists of some other arms turn little out of this plane. For such arms, the cabinet
# stands straight to the side of this axis, at the multiples `_BESIDE` of the scaled distance.
# Home lies on the way to the cabinet, at the fractions `_ON_THE_WAY` of the cabinet's distance.
# As the wrist is right above the tool, the arm works lower over the table (`_HOVER_BESIDE`),
# and the camera stands farther out (`_CAMERA_BESIDE`), so that it sees the marker from the far
# side.
_BESIDE, _ON_THE_WAY = (1.4, 1.6, 1.2), (0.55, 0.65)
_HOVER_BESIDE, _CAMERA_BESIDE = 0.85, 1.5
# Scales in the order of their evaluation; True: with the cabinet straight to the side.
_SCALED = (*((scale, False) for scale in _SCALES), (0.78, True), (0.7, True), (0.95, True))
# All lengths below are for the Franka hand; they scale with the size of the hand.
# Distances around the middle of the table that the arm must reach in view of the camera [m]:
# first with a margin, then only as far as objects are placed.
_REACHES = (0.14, 0.1)
# Shifts of the cabinet, along the base's x axis and upwards [m].
_ALONG, _HIGHER = (0.0, 0.1, -0.1), (0.0, -0.1, 0.1)
# Upward shift of the cabinet for short arms with thick wrists, negative because they reach down
# to their shelves [m].
_DOWN = -0.3
# Distances of objects behind the boards' front edge [m]: thick wrists stay outside.
_DEPTHS = (0.10, 0.05)
# A layout of at least this quality is used without evaluating others.
_ENOUGH = 0.3
_UNSEEN = 10.0  # loss of quality per fraction of poses without a view of the marker
# `_POSTURES`: number of postures considered at home, and above the table.
# `_TRIED`: number of the best home postures, which are combined with twice as many of the best
# postures above the table.
_POSTURES, _TRIED = 16, 6
# Point where the path descends to the board, as a fraction of the way from goal to front.
_INSIDE = 0.3

# `_HAND_HALF`: half the hand's thickness [m].
# `_OVER_BOARD`: gap between hand and board, for errors of base and encoders [m].
_HAND_HALF, _OVER_BOARD = 0.030, 0.006


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Poses of the task in a scene, in the base frame, for a gripper that closes along x."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    home_position: tuple[float, float, float] = (0.60, 0.0, 0.35)
    """Position of the end effector where a placing motion starts, between table and cabinet
    [m]."""
    home_q7: float = -1.0
    """Joint 7 of Franka's arms at home [rad]: the elbow leans to the left, away from the
    cabinet."""
    home_posture: tuple[float, ...] = ()
    """Joint positions of other arms at home, the initial guess of their inverse kinematics
    [rad]."""
    table_centre: tuple[float, float] = (0.24, 0.54)
    """Middle of the part of the table that the camera sees well [m]."""
    table_reach: tuple[float, float] = (0.14, 0.14)
    """Largest distance of object edges from `table_centre`, along x and y [m]."""
    hover_height: float = 0.17
    """Height of the tool centre point during visual servoing [m]."""
    hover_orientation: tuple[float, float, float, float] = tuple(gripper_down().tolist())
    """Orientation of the end effector above the table (wxyz)."""
    hover_q7: float = -0.1
    """Joint 7 of Franka's arms above the table [rad]."""
    hover_posture: tuple[float, ...] = ()
    """Joint positions of other arms above the table, the initial guess of their inverse
    kinematics [rad]."""
    fingertip: float = 0.012
    """Length of the fingers beyond the tool centre point, which is in the middle of the pads
    [m]."""
    palm: float = 0.0374
    """Distance of the palm behind the tool centre point [m]."""
    hover_turns: tuple[float, float] = (np.deg2rad(-60.0), np.deg2rad(120.0))
    """Least and greatest turn of the end effector about the vertical above the table [rad]:
    half a turn in which the forearm does not hide the marker. According to `marker_seen`, the
    forearm hides the marker from -80 degrees on; the margin allows for an elbow that a person
    has pushed aside."""
    shelf_x: float = 0.40
    """Position along the boards where objects are placed [m]."""
    shelf_depth: float = 0.10
    """Distance from the boards' front edge to the tool centre point [m]."""
    level_at: float = 0.6
    """Distance to the right of the base at which the end effector is level [m]."""
    clearance: float = 0.007
    """Gap left under an object when it is released on a board [m]."""
    approach: float = 0.16
    """Distance in front of the boards from which the end effector moves straight in [m]."""

    @classmethod
    def of(cls, robot: Arm) -> "Workplace":
        """The workplace of an arm, laid out for its reach.

        Args:
            robot: The arm.

        Raises:
            UnreachableError: The arm cannot do the work in any layout.
        """
        if not robot.is_franka:
            return layout_for(robot).workplace
        return cls(scene=SceneConfig(arm=replace(SceneConfig().arm, robot=robot)))

    @property
    def robot(self) -> Arm:
        """Arm of the workplace."""
        return self.scene.arm.robot

    @property
    def tool_marker(self) -> int:
        """ArUco number of the marker on the end effector."""
        return HAND_MARKER

    def home(self) -> Pose:
        """Pose of the end effector at home, pointing down if home is in front of the base."""
        position = _vector(*self.home_position)
        return Pose(position, coarse_orientation(position, self.level_at))

    def home_joints(
        self, offset: Float[Tensor, "3"] | None = None, q7_offset: float = 0.0
    ) -> Float[Tensor, " joints"]:
        """Joint positions at home.

        Args:
            offset: Offset of the end effector from home [m].
            q7_offset: Change of joint 7, which moves the elbow about the line to the wrist
                [rad].

        Raises:
            UnreachableError: If no joint positions reach this pose.
        """
        home = self.home()
        if offset is not None:
            home = Pose(home.position + offset, home.orientation)
        if self.robot.is_franka:
            return self.robot.inverse(home, self.home_q7 + q7_offset, near=_LEANING_FORWARD)
        return self.robot.inverse(home, near=_vector(*self.home_posture))

    def hover(self) -> Pose:
        """Pose of the end effector above the middle of the table."""
        position = _vector(*self.table_centre, self.hover_height)
        return Pose(position, _vector(*self.hover_orientation))

    def approached(self, approach: Approach | None) -> "Workplace":
        """The same workplace with the demonstrated orientation above the table, if any.

        An arm of fewer than six joints keeps pointing straight down, which it can do all over
        the table.
        """
        if approach is None or self.robot.task == "nearest pose":
            return self
        w, x, y, z = approach.orientation.tolist()
        return replace(self, hover_orientation=(w, x, y, z))

    def hover_joints(self) -> Float[Tensor, " joints"]:
        """Joint positions above the table, with the upper arm far from vertical.

        With the upper arm upright, the axes of joints 1 and 3 coincide and the elbow cannot be
        pulled.
        """
        if self.robot.is_franka:
            return self.robot.inverse(self.hover(), self.hover_q7, near=_LEANING_FORWARD)
        return self.robot.inverse(self.hover(), near=_vector(*self.hover_posture))

    def hover_postures(self) -> list[Float[Tensor, " joints"]]:
        """Joint positions above the table, the preferred ones first."""
        return [self.hover_joints(), *self.robot.postures(self.hover())]

    def object_region(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Box in which objects may be on the table: centre and half edges [m]."""
        highest = 2 * max(item.half_size[2] for item in self.scene.objects)
        half = _vector(*self.table_reach, highest / 2)
        return _vector(*self.table_centre, highest / 2), half

    def arm_clearance(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Smaller of the two `arm_clearances` [m].

        Args:
            q: Joint position [rad].
        """
        return torch.minimum(*self.arm_clearances(q))

    def arm_clearances(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Distance of the arm without its hand from the furniture, and of the arm from itself
        [m].

        Args:
            q: Joint position [rad].
        """
        centre, half_size = self._furniture.like(q).split(3, dim=-1)
        robot = self.robot
        frames = robot.link_frames(q)
        furniture = robot.body.box_distance(q, centre, half_size, frames)
        return furniture, robot.whole.self_distance(q, frames)

    @cached_property
    def _furniture(self) -> Constant:
        """Centre and half edges of the furniture's boxes [m]."""
        boxes = [(*box.centre, *box.half_size) for box in self.scene.boxes()]
        with lasting():
            return Constant(torch.tensor(boxes, dtype=torch.float64))

    def random_object_pose(
        self, reach: tuple[float, float, float], rng: np.random.Generator, yaw: float = 0.06
    ) -> Float[np.ndarray, "4 4"]:
        """Random pose of the scene's first object around the middle of the table.

        Args:
            reach: Largest distances from the middle, along x and y [m]; z is not used.
            rng: Source of position and yaw.
            yaw: Largest turn, either way [rad]; the default is for people who align objects
                with the table's edges.
        """
        turn = rng.uniform(-yaw, yaw)
        position = np.array(self.table_centre) + rng.uniform(-1, 1, 2) * reach[:2]
        return pose_on_table(position, turn, self.scene.objects[0].half_size[2])

    def scaled(self, lengths: tuple[float, float, float]) -> tuple[float, float, float]:
        """Lengths for the Franka hand, scaled to the size of this hand [m]."""
        x, y, z = (self.robot.hand_size * length for length in lengths)
        return x, y, z

    def shelf_names(self) -> tuple[str, ...]:
        """Names of the shelves, from bottom to top."""
        shelves = self.scene.cabinet.shelves
        return tuple(sorted(shelves, key=shelves.__getitem__))

    def shelf(self, name: str, half_size: tuple[float, float, float] | None = None) -> Pose:
        """Pose in which the end effector releases an object on a shelf: level, towards -y.

        Args:
            name: Name of the shelf.
            half_size: Half edges of the object [m]; None: the scene's first object.

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
        # An object that was grasped from above lies on its side when the end effector is level.
        height = cabinet.shelves[name] + b + self.clearance
        position = _vector(self.shelf_x, cabinet.front - self.shelf_depth, height)
        return Pose(position, coarse_orientation(position, self.level_at))

    def lowering(self, half_size: tuple[float, float, float]) -> float:
        """Distance by which an object can be lowered before the gripper comes near the board
        [m].

        Args:
            half_size: Half size of the object, which lies on its side [m].
        """
        spare = (_HAND_HALF + _OVER_BOARD) * self.robot.hand_size
        return max(half_size[1] + self.clearance - spare, 0.0)

    def path_to_shelf(self, name: str, lift: float = 0.03) -> Float[Tensor, "4 3"]:
        """Points of the end effector from home over the edge of a board to the goal on it [m].

        Args:
            name: Name of the shelf.
            lift: Height over the edge, for the Franka hand [m]. The gripper is not quite level
                there yet, so the object that it carries hangs a little lower.
        """
        goal = self.shelf(name).position
        front = goal.clone()
        front[1] = self.scene.cabinet.front + self.approach
        lifted = _vector(0.0, 0.0, self.robot.hand_size * lift)
        inside = goal + _INSIDE * (front - goal)
        return torch.stack([self.home().position, front + lifted, inside + lifted, goal])


def pose_on_table(
    position: Float[np.ndarray, "2"], yaw: float, height: float
) -> Float[np.ndarray, "4 4"]:
    """Pose at a place on the table, turned about the vertical [m, rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (*position, height)
    return pose


@dataclass(frozen=True, kw_only=True)
class CellLayout:
    """Layout of the work cell for one arm."""

    workplace: Workplace
    """Workplace with furniture, postures, side of the marker and turns above the table."""
    quality: float
    """Smallest margin along the paths, from 0 (failure) to 1 (ample)."""
    seen: float
    """Fraction of poses above the table, within `hover_turns`, that are reached with the marker
    in view.
    """

    @property
    def rank(self) -> float:
        """Quality, lowered if the marker is out of view in too many poses."""
        return _worth(self)


type _Above = list[tuple[Float[Tensor, " joints"], MarkedTurns]]


@cache
def layout_for(robot: Arm) -> CellLayout:
    """The first layout that is good enough for an arm, or else the best one.

    Raises:
        UnreachableError: No layout lets the arm reach the table and all shelves.
    """
    best: CellLayout | None = None
    for places, above in _candidates(robot):
        for workplace in places:
            layout = _evaluated(workplace, above)
            if layout is not None and (best is None or layout.rank > best.rank):
                best = layout
            if best is not None and best.rank >= _ENOUGH:
                return best
    if best is None:
        raise UnreachableError(
            f"the {robot.name} does not reach the table and all shelves from home, with "
            f"distances of {_SCALES[-1]:g} to {_SCALES[0]:g} times the usual ones: it is too "
            "small for this work cell, or its links obstruct each other."
        )
    return best


def _candidates(robot: Arm) -> Iterator[tuple[list[Workplace], _Above]]:
    """Workplaces that suit an arm, with postures above their table; the most promising ones
    first.
    """
    unlikely = []
    for reach in _REACHES:
        for scale, beside in _SCALED:
            if robot.task != "pose" and not beside:
                continue
            places = [
                replace(place, table_reach=(robot.hand_size * reach,) * 2)
                for place in _workplaces(robot, scale, beside)
            ]
            above = _above_table(places[0])
            # No layout is better than the best posture above its table.
            if any(_worth(marked) >= _ENOUGH for _, marked in above):
                yield places, above
            elif above:
                unlikely.append((places, above))
    yield from unlikely


def _worth(found: CellLayout | MarkedTurns) -> float:
    # A marker that is out of view for longer than a moment ends the servoing.
    return min(found.quality, 1.0 - _UNSEEN * (1.0 - found.seen))


def _workplaces(robot: Arm, scale: float, beside: bool) -> Iterator[Workplace]:
    """Layouts with the table at one distance and the cabinet in several places.

    Args:
        robot: The arm.
        scale: Distance of the table, relative to the usual one.
        beside: Put the cabinet straight to the side of the axis of the first joint.
    """
    usual = SceneConfig(arm=replace(SceneConfig().arm, robot=robot))
    if beside:
        # Begin with the longest way to the shelves: in short demonstrations, the tremor of the
        # person's hand dominates the motion.
        for home, far, higher in product(_ON_THE_WAY, _BESIDE, (*_HIGHER, _DOWN)):
            yield _beside(_placed(usual, scale, 0.0, higher, _DEPTHS[-1], far), home)
        return
    shifts = [(along, higher) for along in _ALONG for higher in _HIGHER]
    for along, higher in sorted(shifts, key=lambda shift: abs(shift[0]) + abs(shift[1])):
        for depth in _DEPTHS:
            yield _placed(usual, scale, along, higher, depth)


def _beside(place: Workplace, home: float) -> Workplace:
    """The workplace with cabinet and home in the plane in which an arm that is turned to the
    right moves its tool.

    Args:
        place: Workplace with the cabinet to the right.
        home: Distance of the home position, as a fraction of the distance of the shelves.
    """
    axis = float(place.robot.joint_origins(place.robot.ready)[0, 0])
    scene, (x, y), camera = place.scene, place.table_centre, place.scene.camera
    half = (scene.cabinet.right - scene.cabinet.left) / 2
    eye = camera.pose[:3, 3] * (_CAMERA_BESIDE, _CAMERA_BESIDE, 1.0)
    heights = [place.shelf(name).position[2] for name in place.shelf_names()]
    return replace(
        place,
        scene=replace(
            scene,
            cabinet=replace(scene.cabinet, left=axis - half, right=axis + half),
            camera=camera.look_at(eye, np.array([x, y, 0.0])),
        ),
        shelf_x=axis,
        hover_height=_HOVER_BESIDE * place.hover_height,
        home_position=(axis, -home * place.level_at, float(sum(heights)) / len(heights)),
    )


def _placed(
    usual: SceneConfig,
    scale: float,
    along: float,
    higher: float,
    depth: float,
    far: float = 1.0,
) -> Workplace:
    """The usual workplace with all distances times `scale`, and the cabinet's distance also
    times `far`.
    """
    place, cabinet, table = Workplace(), usual.cabinet, usual.table
    size = usual.arm.robot.hand_size
    scale, along, higher, depth = (size * x for x in (scale, along, higher, depth))
    level_at = far * scale * place.level_at
    left = scale * cabinet.left + along
    home_x, home_y, home_z = place.home_position
    moved = replace(
        cabinet,
        left=left,
        right=left + size * (cabinet.right - cabinet.left),
        depth=size * cabinet.depth,
        front=depth - level_at,
        shelves={name: scale * z + higher for name, z in cabinet.shelves.items()},
        top=size * cabinet.top + higher,
        # The door tests null-space motion of the elbow, which arms with six joints do not have.
        door_reach=scale * cabinet.door_reach * (usual.arm.robot.null_space != "none"),
    )
    (x, y, z), (a, b, c) = table.centre, table.half_size
    pose = usual.camera.pose.copy()
    pose[:2, 3] *= scale
    pose[2, 3] *= size
    scene = replace(
        usual,
        cabinet=moved,
        table=replace(
            table, centre=(scale * x, scale * y, z), half_size=(scale * a, scale * b, c)
        ),
        camera=replace(usual.camera, pose=pose),
        objects=tuple(item.scaled(size) for item in usual.objects),
    )
    return Workplace(
        scene=scene,
        home_position=(scale * home_x + along, home_y, scale * home_z + max(higher, 0.0)),
        table_centre=(scale * place.table_centre[0], scale * place.table_centre[1]),
        shelf_x=scale * place.shelf_x + along,
        hover_height=size * place.hover_height,
        fingertip=size * place.fingertip,
        palm=size * place.palm,
        clearance=size * place.clearance,
        approach=size * place.approach,
        shelf_depth=depth,
        level_at=level_at,
    )


def _above_table(workplace: Workplace) -> _Above:
    """Joint positions above the table, and the turns of the gripper there; the best first."""
    robot, scene = workplace.robot, workplace.scene
    try:
        postures = robot.postures(workplace.hover())[:_POSTURES]
    except UnreachableError:
        return []
    # The plate sticks out beyond the last two links.
    wrist = [c.radius for c in robot.body.capsules if c.link >= robot.joints - 1]
    turns = partial(
        marked_turns,
        robot,
        workplace.arm_clearances,
        scene.camera,
        marked_plate(robot.hand_size, max(wrist, default=0.0)),
        workplace.hover(),
        workplace.table_reach,
    )
    found = [(hover, turns(hover)) for hover in postures]
    found.sort(key=lambda pair: _worth(pair[1]), reverse=True)
    return found[: 2 * _TRIED]


def _evaluated(workplace: Workplace, above: _Above) -> CellLayout | None:
    """A workplace with the arm's best postures for it; None if the arm fails there."""
    robot, scene = workplace.robot, workplace.scene
    try:
        at_home = robot.postures(workplace.home())[:_POSTURES]
    except UnreachableError:
        return None
    clearances, level_at = workplace.arm_clearances, workplace.level_at
    paths = [workplace.path_to_shelf(name) for name in workplace.shelf_names()]
    to_shelves = path_quality(robot, clearances, paths, level_at, at_home)
    best: CellLayout | None = None
    for k in to_shelves.argsort(descending=True).tolist()[:_TRIED]:
        home, quality = at_home[k], float(to_shelves[k])
        # Of the postures above the table that are good enough, use the nearest to home.
        nearest = sorted(above, key=lambda pair: float((pair[0] - home).abs().max()))
        for hover, marked in nearest if quality > 0 else ():
            between = torch.lerp(home, hover, torch.linspace(0, 1, 25).double()[:, None])
            clear = float(clearance_quality(clearances, between, robot.hand_size).min())
            layout = CellLayout(
                workplace=replace(
                    workplace,
                    scene=replace(scene, arm=replace(scene.arm, marker=marked.plate)),
                    hover_turns=marked.turns,
                    home_posture=tuple(home.tolist()),
                    hover_posture=tuple(hover.tolist()),
                ),
                quality=min(quality, marked.quality, clear, 1.0),
                seen=marked.seen,
            )
            if clear > 0 and (best is None or min(layout.rank, _ENOUGH) > best.rank):
                best = layout
    return best
