"""Robot descriptions: a tree of links and joints, checked once for all file formats.

Readers of URDF and MJCF turn a file into links and joints. `Description` refuses anything but a
tree of rigid bodies, separates the joints of a gripper from those of the arm, and finds the
tool frame. All transforms are homogeneous matrices in float64, so that the numbers of the file
are not rounded.
"""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.shapes import Colour

Transform = Float[np.ndarray, "4 4"]

MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*MOVING, "fixed", "floating", "planar", "ball", "free")
# Larger distances between parts are errors [m], for example lengths in millimetres.
_FURTHEST = 100.0

# `_GRIPPER_JOINT`, `_FINGER_LINK`: words in the names of a gripper's joints, and of the links
# that these joints move. `_ARM_JOINT`: words in the name of a joint that turns the whole
# gripper instead. `_FIXED_LINK`: words in the name of a link that is fixed to the arm.
_GRIPPER_JOINT = re.compile("gripper|jaw|finger|knuckle|thumb|claw")
_FINGER_LINK = re.compile("jaw|finger|knuckle|thumb|claw")
_ARM_JOINT = re.compile("wrist|elbow|shoulder|forearm|roll|pitch|yaw|rotat|swivel|turn")
_FIXED_LINK = re.compile("fixed|static")
# `_TOOL_FRAMES`: words in the names of tool frames, the likeliest first.
# `_NO_TOOL_FRAME`: words in the names of frames that are no tool frames.
_TOOL_FRAMES = (r"\btcp\b", r"tool", r"grasp|pinch", r"\bee|effector", r"gripper", r"hand|tip")
_NO_TOOL_FRAME = re.compile(
    r"camera|optical|depth|laser|lidar|sensor|accelerometer|marker|safety|motor|finger|knuckle"
    r"|\b(cam|imu|fts?|led|prop)\b"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A mesh, box, cylinder, sphere or capsule on a link."""

    pose: Transform
    """Pose in the frame of the link; cylinders and capsules lie along z, centred."""
    kind: str
    """"mesh", "box", "cylinder", "sphere" or "capsule"."""
    size: tuple[float, ...] = ()
    """Half edges of a box; radius and half length of other shapes [m]."""
    path: Path | None = None
    """File of a mesh."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Scale of a mesh along its axes."""
    colour: Colour | None = None


def pseudo_inertia(
    mass: float,
    centre: Sequence[float] | Float[np.ndarray, "3"],
    inertia: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "4 4"]:
    """Pseudo-inertia P = [[S, m c], [m c^T, m]], with second moments S about the origin.

    Pseudo-inertias of bodies that move together add up. In a frame in which the body's frame
    has the pose T, P becomes T P T^T (Wensing et al. 2018, "Linear matrix inequalities for
    physically consistent inertial parameter identification").

    Args:
        mass: Mass of the body [kg].
        centre: Centre of mass in the frame of the body [m].
        inertia: Inertia about the centre of mass, along the axes of this frame [kg m^2].
    """
    c = np.asarray(centre, dtype=float)
    found = np.empty((4, 4))
    found[:3, :3] = np.eye(3) * np.trace(inertia) / 2 - inertia + mass * np.outer(c, c)
    found[:3, 3] = found[3, :3] = mass * c
    found[3, 3] = mass
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid body."""

    name: str
    mass: float | None = None
    """Mass [kg]; None where the file gives no mass."""
    inertia: Float[np.ndarray, "4 4"] | None = None
    """Pseudo-inertia in the frame of the link."""
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """A joint. The child's pose in the parent's frame is `origin` times the joint's motion."""

    name: str
    kind: str
    """"revolute", "continuous", "prismatic", "fixed", or a kind that no serial arm has."""
    parent: str
    child: str
    origin: Transform
    axis: Float[np.ndarray, "3"]
    """Unit vector."""
    lower: float | None = None
    """Lower limit [rad or m]; None where the file gives no limit."""
    upper: float | None = None
    velocity: float | None = None
    """Velocity limit [rad/s or m/s]."""
    effort: float | None = None
    """Torque or force limit [N m or N]."""
    follows: tuple[str, float, float] | None = None
    """Mimicked joint, factor and offset; an empty name fixes the joint at the offset."""

    @property
    def is_finger(self) -> bool:
        """True if the joint belongs to a gripper by its name or the name of its child link."""
        name, child = self.name.lower(), self.child.lower()
        if _ARM_JOINT.search(name):
            return False
        moves_finger = _FINGER_LINK.search(child) and not _FIXED_LINK.search(child)
        return bool(_GRIPPER_JOINT.search(name) or moves_finger)


@dataclass(frozen=True)
class _End:
    """A rigid body at which an arm ends."""

    joints: int
    """Number of the arm's joints before this body."""
    frames: list[str]
    """Links that may be the tool frame."""


class Description:
    """A tree of links and joints.

    Attributes:
        path: File of the description.
        links: Links by name.
        joints: Joints, in the order of the file.
        home: Joint positions of the file's posture `home` by joint name [rad, m], or None.
    """

    def __init__(
        self,
        path: Path,
        links: Sequence[Link],
        joints: Sequence[Joint],
        home: dict[str, float] | None = None,
    ):
        """Check that the links and joints form trees.

        Raises:
            ValueError: A name is used twice, a joint names a link that does not exist, a link
                has two parents, joints form a cycle, joints mimic each other in a cycle, or
                parts are 100 m or more apart.
        """
        if not links:
            raise ValueError(f"{path} has no links: is it complete, and is its xacro expanded?")
        self.path, self.joints, self.home = path, tuple(joints), home
        self.links = {link.name: link for link in links}
        self._below: dict[str, list[Joint]] = defaultdict(list)
        self._above: dict[str, Joint] = {}
        self._check_names("links", [link.name for link in links])
        self._check_names("joints", [joint.name for joint in joints])
        for link in links:
            for shape in (*link.visuals, *link.collisions):
                self._check_lengths(f"a shape of link {link.name}", shape.pose)
        for joint in joints:
            self._check_joint(joint)
            self._below[joint.parent].append(joint)
            self._above[joint.child] = joint
        reached = {link for root in self.roots for link in self.subtree(root)}
        if cycle := [name for name in self.links if name not in reached]:
            raise ValueError(
                f"{path}: link {cycle[0]} is its own ancestor (joint "
                f"{self._above[cycle[0]].name}): the joints form a cycle, but a robot is a tree"
            )
        leaders = {joint.name: joint.follows[0] for joint in joints if joint.follows}
        for name in leaders:
            row = [name]
            while row[-1] in leaders and row[-1] not in row[:-1]:
                row.append(leaders[row[-1]])
            if row[-1] in row[:-1]:
                first, *others = row[row.index(row[-1]) :]
                raise ValueError(
                    f"{path}: joint {first} follows {', which follows '.join(others)}: let one "
                    "of them move by itself (remove its <mimic>, or the <equality>)"
                )

    def _check_names(self, what: str, names: Sequence[str]) -> None:
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"{self.path} has two {what} of the name {twice!r}: rename one")

    def _check_joint(self, joint: Joint) -> None:
        where = f"{self.path}: joint {joint.name}"
        if joint.kind not in _KINDS:
            raise ValueError(f"{where} has the unknown type {joint.kind!r}")
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in self.links:
                raise ValueError(f"{where} has the {role} {link!r}, but there is no such link")
        if before := self._above.get(joint.child):
            raise ValueError(
                f"{self.path}: link {joint.child} has two parents, by the joints {before.name} "
                f"and {joint.name}: a robot is a tree"
            )
        self._check_lengths(f"joint {joint.name}", joint.origin)

    def _check_lengths(self, what: str, pose: Transform) -> None:
        furthest = np.abs(pose[:3, 3]).max()
        if not furthest < _FURTHEST:
            text = f"{self.path}: {what} is {furthest:.3g} m from the frame that carries it:"
            raise ValueError(f"{text} lengths are in metres")

    @property
    def roots(self) -> list[str]:
        """Links that are the child of no joint."""
        return [name for name in self.links if name not in self._above]

    def below(self, link: str) -> Sequence[Joint]:
        """Joints that have a link as their parent."""
        return self._below.get(link, ())

    def subtree(self, link: str) -> list[str]:
        """A link and all links below it, parents first."""
        found = [link]
        for name in found:  # grows during the loop
            found += [joint.child for joint in self.below(name)]
        return found

    def rigid_subtree(self, link: str) -> dict[str, Transform]:
        """A link and all links fixed to it, with their poses in the frame of the given link."""
        found, ahead = {link: np.eye(4)}, [link]
        for name in ahead:
            for joint in self.below(name):
                if joint.kind == "fixed":
                    found[joint.child] = found[name] @ joint.origin
                    ahead.append(joint.child)
        return found

    def path_between(self, base: str | None, tip: str | None) -> tuple[str, str, list[Joint]]:
        """Names of base and tip, and the joints between them.

        Args:
            base: A link; None: the root.
            tip: A link; None: the tool frame, if the tree has only one end besides the fingers
                of a gripper. The gripper's joints are then left out, with a warning.

        Raises:
            ValueError: A link does not exist, no joint moves between base and tip, there are
                several roots or ends to choose from, or a joint is of a kind that no serial
                chain has.
        """
        for role, name in (("base", base), ("tip", tip)):
            if name is not None and name not in self.links:
                text = f"{self.path} has no link {name!r} to be the {role}; its links are"
                raise ValueError(f"{text} {', '.join(self.links)}")
        if base is None and len(self.roots) > 1:
            raise ValueError(
                f"{self.path} is in several pieces, since no joint carries the links "
                f"{', '.join(self.roots)}: add a joint, or say which is the base (base=, "
                "FILE:BASE:TIP)"
            )
        base = self.roots[0] if base is None else base
        ends, fingers = self._ends(base)
        if tip is None:
            tip = self._only_tip(base, ends, fingers)
        joints, link = [], tip
        while link != base:
            joint = self._above.get(link)
            if joint is None:
                raise ValueError(
                    f"{self.path}: link {tip!r} does not hang on {base!r}, but on {link!r}: "
                    "name another base or tip (base=, tip=; FILE:BASE:TIP)"
                )
            joints.insert(0, joint)
            link = joint.parent
        self._check_path(base, tip, joints)
        if wrong := [joint.name for joint in joints if joint in fingers]:
            warnings.warn(
                f"{self.path}: joint {wrong[0]} looks like a gripper's, but is used as the "
                f"arm's, since the tip {tip!r} lies beyond it",
                stacklevel=2,
            )
        return base, tip, joints

    def _check_path(self, base: str, tip: str, joints: Sequence[Joint]) -> None:
        for joint in joints:
            if joint.kind not in (*MOVING, "fixed"):
                raise ValueError(
                    f"{self.path}: joint {joint.name} is {joint.kind}, which no serial "
                    f"chain has: name a base or a tip (base=, tip=; FILE:BASE:TIP) so that it "
                    f"is outside (its parent is {joint.parent}, its child {joint.child})"
                )
            if joint.follows is not None:
                leader, _, offset = joint.follows
                raise ValueError(
                    f"{self.path}: joint {joint.name} "
                    + (f"only follows {leader}" if leader else f"is held at {offset:g}")
                    + f": end the chain before it (tip=, FILE:TIP), at {joint.parent!r}"
                )
        if not any(joint.kind in MOVING for joint in joints):
            raise ValueError(f"{self.path}: no joint moves between {base!r} and {tip!r}")

    def _only_tip(self, base: str, ends: Sequence[_End], fingers: Sequence[Joint]) -> str:
        ends = sorted(ends, key=lambda end: -end.joints)
        frames = [frame for end in ends for frame in sorted(end.frames, key=_unlikely)]
        if not frames:
            raise ValueError(f"{self.path}: no joint moves a link that hangs on {base!r}")
        if len(frames) > 1:
            text = f"{self.path} has several ends; say which is the tool (tip=, FILE:TIP), the"
            raise ValueError(f"{text} likeliest first: {', '.join(frames)}")
        if fingers:
            names = ", ".join(joint.name for joint in fingers)
            warnings.warn(
                f"{self.path}: the arm ends at {frames[0]!r}; joints of its gripper: {names}",
                stacklevel=3,
            )
        return frames[0]

    def _ends(self, base: str) -> tuple[list[_End], list[Joint]]:
        """Bodies at which an arm may end, and the first joints of grippers.

        A joint belongs to a gripper if its name says so. Joints also belong to grippers if
        several of them branch off at the end of the arm, each with a shorter chain than the
        arm.
        """
        height: dict[str, int] = {}  # largest number of successive joints beyond a link
        for link in reversed(self.subtree(base)):
            height[link] = max((_length(j, height) for j in self.below(link)), default=0)
        ends: list[_End] = []
        fingers: list[Joint] = []
        bodies = [(base, 0)]
        for root, count in bodies:  # grows during the loop
            body = self.rigid_subtree(root)
            moving = [j for link in body for j in self.below(link) if j.kind != "fixed"]
            spread = len(moving) > 1 and all(_length(j, height) < count for j in moving)
            gripping = [
                j for j in moving if spread or (j.is_finger and _length(j, height) <= count)
            ]
            fingers += gripping
            further = [joint for joint in moving if joint not in gripping]
            bodies += [(joint.child, count + 1) for joint in further]
            if count and not further:
                frames = [link for link in body if not _NO_TOOL_FRAME.search(_words(link))]
                leaves = [link for link in frames if not self.below(link)]
                hands = [joint.parent for joint in gripping[:1]]
                ends.append(_End(count, leaves or hands or frames[-1:] or [root]))
        return ends, fingers


def _length(joint: Joint, height: dict[str, int]) -> int:
    """Number of moving joints from a joint, including this joint, to the furthest leaf."""
    return height[joint.child] + (joint.kind != "fixed")


def _unlikely(frame: str) -> int:
    """Rank of a link among possible tool frames, by its name; 0 is the likeliest."""
    words = _words(frame)
    ranks = [rank for rank, word in enumerate(_TOOL_FRAMES) if re.search(word, words)]
    return min(ranks, default=len(_TOOL_FRAMES))


def _words(name: str) -> str:
    """A name as words in lower case, separated by spaces."""
    return re.sub("[^a-z]+", " ", name.lower())


def turn_to(axis: Float[np.ndarray, "3"]) -> Transform:
    """A rotation that takes z to a unit axis; exact for axes along a coordinate axis."""
    turn = np.eye(4)
    along = int(np.abs(axis).argmax())
    if abs(axis[along]) == 1.0:
        # Permuting the axes causes no rounding errors. Half a turn reverses the axis.
        turn[:3, :3] = np.roll(np.eye(3), along + 1, axis=0)
        if axis[along] < 0:
            turn[:3, :3] = turn[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        return turn
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.abs(axis).argmin())], z)
    x /= np.linalg.norm(x)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


def motion(kind: str, axis: Float[np.ndarray, "3"], value: float) -> Transform:
    """Motion of a joint along or about a unit axis by a value [m] or [rad] (Rodrigues)."""
    if kind == "prismatic":
        return transform(np.eye(3), value * axis)
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return transform(np.eye(3) + np.sin(value) * K + (1 - np.cos(value)) * K @ K, np.zeros(3))


def transform(R: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "3"]) -> Transform:
    """Homogeneous transform of a rotation and an origin [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T
