"""Conversion of a description's tree of links to the numbered links of a serial arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.shapes import Colour, MeshFile
from hrc_learn.kinematics._description import (
    MOVING,
    Description,
    Joint,
    Shape,
    Transform,
    transform,
    turn_to,
)
from hrc_learn.kinematics.chain import JointKind

_GREY: Colour = (0.7, 0.7, 0.72, 1.0)
# Number of finger positions, from closed to open, that the capsules contain.
_FINGER_POSTURES = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkVisual:
    """A mesh to be drawn on a link."""

    link: int
    """Link number as in `CapsuleArm`: 0 the base, i the link of joint i, then flange and tool.
    """
    mesh: MeshFile
    pose: Transform
    """In the frame of the link; of a finger with the gripper open."""
    colour: Colour = _GREY
    finger: str | None = None
    """Joint of the gripper that moves it, if one does."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FingerJoint:
    """A joint of a gripper, in the frame of the tool."""

    name: str
    kind: str
    """"revolute" or "prismatic"."""
    pose: Transform
    """Joint frame at position zero; the joint moves about or along z."""
    closed: float
    """[rad] or [m]"""
    opened: float
    """[rad] or [m]; the end of its range that is further from zero."""
    follows: tuple[str, float, float] | None = None
    """Joint whose position, times the factor and plus the offset, it takes."""


@dataclass(frozen=True, kw_only=True)
class GripperDescription:
    """The gripper that a description mounts on its arm."""

    joints: tuple[FingerJoint, ...]

    @property
    def driven(self) -> tuple[FingerJoint, ...]:
        """Joints that a drive moves: the others follow one of them."""
        return tuple(joint for joint in self.joints if joint.follows is None)

    @property
    def opening(self) -> tuple[float, float] | None:
        """Least and largest distance between fingers that slide [m]; None if they turn."""
        if any(joint.kind != "prismatic" for joint in self.joints):
            return None
        ends = [sorted((abs(joint.closed), abs(joint.opened))) for joint in self.joints]
        return sum(least for least, _ in ends), sum(most for _, most in ends)


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkShape:
    """A shape of a link that may touch something."""

    link: int
    shape: Shape
    pose: Transform
    """In the frame of the link."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Assembly:
    """Serial arm read from a description."""

    base: str
    tip: str
    moving: tuple[Joint, ...]
    kinds: tuple[JointKind, ...]
    mounts: Float[np.ndarray, "joints 4 4"]
    flange: Transform
    tcp: Transform
    visuals: tuple[LinkVisual, ...]
    shapes: tuple[LinkShape, ...]
    gripper: GripperDescription | None
    masses: tuple[float | None, ...]
    """Masses of base, links, flange and tool [kg]; None where the description has none."""


def assemble(
    description: Description,
    base: str | None,
    tip: str | None,
    tool: Float[Tensor, "4 4"] | None,
) -> Assembly:
    """Number the links between base and tip and what is fixed to them.

    What hangs on moving joints beyond the last joint of the chain is the gripper, and belongs
    to the tool; a hand that only carries the fingers belongs there as well. What hangs on
    moving joints before is left out.

    Raises:
        ValueError: See `Description.path_between`.
    """
    base, tip, path = description.path_between(base, tip)
    moving = [joint for joint in path if joint.kind in MOVING]
    places, mounts = _places(description, base, moving)
    last = len(moving)
    flange = places[tip][1]
    tcp = np.eye(4) if tool is None else tool.double().numpy()
    to_tool = np.linalg.inv(flange @ tcp)
    on_path = {joint.name for joint in path}
    roots = [
        joint
        for link, (number, _) in places.items()
        if number == last
        for joint in description.below(link)
        if joint.kind in MOVING and joint.name not in on_path
    ]
    for hand in {joint.parent for joint in roots} - {moving[-1].child}:
        pose = places[hand][1]
        for link, within in description.rigid_subtree(hand):
            places[link] = (last + 2, to_tool @ pose @ within)
    fingers: list[_Finger] = []
    for joint in roots:
        number, pose = places[joint.parent]
        fingers += _fingers(description, joint, pose if number > last else to_tool @ pose)
    visuals = [
        _visual(number, shape, pose)
        for link, (number, pose) in places.items()
        for shape in description.links[link].visuals
        if shape.kind == "mesh"
    ]
    shapes = [
        LinkShape(link=number, shape=shape, pose=pose @ shape.pose)
        for link, (number, pose) in places.items()
        for shape in _touching(description, link)
    ]
    for finger in fingers:
        for link, within in description.rigid_subtree(finger.child):
            visuals += [
                _visual(last + 2, shape, finger.opened @ within, finger.joint.name)
                for shape in description.links[link].visuals
                if shape.kind == "mesh"
            ]
            shapes += [
                LinkShape(link=last + 2, shape=shape, pose=at @ within @ shape.pose)
                for shape in _touching(description, link)
                for at in finger.postures
            ]
    kinds: list[JointKind] = [cast(JointKind, joint.kind) for joint in moving]
    return Assembly(
        base=base,
        tip=tip,
        moving=tuple(moving),
        kinds=tuple(kinds),
        mounts=np.stack(mounts),
        flange=flange,
        tcp=tcp,
        visuals=tuple(visuals),
        shapes=tuple(shapes),
        gripper=GripperDescription(joints=tuple(f.joint for f in fingers)) if fingers else None,
        masses=_masses(description, places, fingers, last),
    )


def _places(
    description: Description, base: str, moving: list[Joint]
) -> tuple[dict[str, tuple[int, Transform]], list[Transform]]:
    """Number of each link's frame and its pose there, and the mounts of the joints."""
    places = {name: (0, pose) for name, pose in description.rigid_subtree(base)}
    mounts = []
    for number, joint in enumerate(moving, start=1):
        turn = turn_to(joint.axis)
        mounts.append(places[joint.parent][1] @ joint.origin @ turn)
        for name, pose in description.rigid_subtree(joint.child):
            places[name] = (number, turn.T @ pose)
    return places, mounts


@dataclass(frozen=True, kw_only=True, eq=False)
class _Finger:
    joint: FingerJoint
    child: str
    postures: tuple[Transform, ...]
    """Poses of the child in the frame of the tool, from closed to opened."""

    @property
    def opened(self) -> Transform:
        return self.postures[-1]


def _fingers(description: Description, joint: Joint, parent: Transform) -> list[_Finger]:
    """A joint of the gripper and those that it carries, with the parent's pose on the tool."""
    lower, upper = joint.lower or 0.0, joint.upper or 0.0
    closed, opened = (lower, upper) if abs(upper) >= abs(lower) else (upper, lower)
    turn = turn_to(joint.axis)
    pose = parent @ joint.origin @ turn
    postures = tuple(
        pose @ _motion(joint.kind, value) @ turn.T
        for value in np.linspace(closed, opened, _FINGER_POSTURES).tolist()
    )
    finger = _Finger(
        joint=FingerJoint(
            name=joint.name,
            kind="prismatic" if joint.kind == "prismatic" else "revolute",
            pose=pose,
            closed=closed,
            opened=opened,
            follows=joint.follows,
        ),
        child=joint.child,
        postures=postures,
    )
    further = [
        part
        for link, within in description.rigid_subtree(joint.child)
        for below in description.below(link)
        if below.kind in MOVING
        for part in _fingers(description, below, finger.opened @ within)
    ]
    return [finger, *further]


def _motion(kind: str, value: float) -> Transform:
    if kind == "prismatic":
        return transform(np.eye(3), np.array([0.0, 0.0, value]))
    c, s = np.cos(value), np.sin(value)
    return transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.zeros(3))


def _visual(link: int, shape: Shape, pose: Transform, finger: str | None = None) -> LinkVisual:
    assert shape.path is not None
    return LinkVisual(
        link=link,
        mesh=MeshFile(path=shape.path, scale=shape.scale),
        pose=pose @ shape.pose,
        colour=shape.colour or _GREY,
        finger=finger,
    )


def _touching(description: Description, link: str) -> tuple[Shape, ...]:
    """Shapes of a link for contacts; those that are drawn where it has no others."""
    found = description.links[link]
    return found.collisions or found.visuals


def _masses(
    description: Description,
    places: dict[str, tuple[int, Transform]],
    fingers: list[_Finger],
    last: int,
) -> tuple[float | None, ...]:
    masses: list[float | None] = [None] * (last + 3)
    owners = {link: number for link, (number, _) in places.items()}
    for finger in fingers:
        owners |= {link: last + 2 for link, _ in description.rigid_subtree(finger.child)}
    for link, number in owners.items():
        if (mass := description.links[link].mass) is not None:
            masses[number] = (masses[number] or 0.0) + mass
    # Nothing is mounted on the flange's own frame; without a gripper, nor on the tool's.
    masses[last + 1] = 0.0
    if last + 2 not in owners.values():
        masses[last + 2] = 0.0
    return tuple(masses)
