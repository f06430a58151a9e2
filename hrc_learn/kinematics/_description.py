"""Content of a robot description file, independent of its format: a tree of links and joints.

All transforms are homogeneous, float64, with the numbers of the file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry.shapes import Colour

Transform = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A mesh, box, cylinder, sphere or capsule on a link."""

    pose: Transform
    """In the frame of the link; a cylinder or capsule lies along z, centred."""
    kind: str
    """"mesh", "box", "cylinder", "sphere" or "capsule"."""
    size: tuple[float, ...] = ()
    """Half edges of a box; radius and half length of other shapes [m]."""
    path: Path | None = None
    """File of a mesh."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Scale of a mesh along its axes."""
    colour: Colour | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid body."""

    name: str
    mass: float | None = None
    """[kg]"""
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """A joint; its child's frame is `origin`, then the motion about or along `axis`."""

    name: str
    kind: str
    """"revolute", "continuous", "prismatic", "fixed", or a name that is not supported."""
    parent: str
    child: str
    origin: Transform
    axis: Float[np.ndarray, "3"]
    """Unit vector."""
    lower: float | None = None
    """[rad] or [m]; None where the file has none."""
    upper: float | None = None
    velocity: float | None = None
    """[rad/s] or [m/s]"""
    effort: float | None = None
    """[N m] or [N]"""
    follows: tuple[str, float, float] | None = None
    """Joint that it mimics, with factor and offset."""


MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, kw_only=True, eq=False)
class Description:
    """A tree of links and joints."""

    name: str
    path: Path
    format: str
    """"urdf" or "mjcf"."""
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    home: dict[str, float] | None = None
    """Positions of joints by name [rad, m] of a posture that the file names, if it does."""

    def __post_init__(self):
        children: dict[str, list[Joint]] = defaultdict(list)
        for joint in self.joints:
            children[joint.parent].append(joint)
        object.__setattr__(self, "_below", dict(children))
        object.__setattr__(self, "_above", {joint.child: joint for joint in self.joints})

    def below(self, link: str) -> list[Joint]:
        """Joints whose parent a link is."""
        return self.__dict__["_below"].get(link, [])

    def above(self, link: str) -> Joint | None:
        """Joint that carries a link; None for the root."""
        return self.__dict__["_above"].get(link)

    @property
    def root(self) -> str:
        """The link that no joint carries, which most others hang on."""
        roots = [name for name in self.links if self.above(name) is None]
        return max(roots, key=lambda name: sum(1 for _ in self.subtree(name)))

    def subtree(self, link: str) -> Iterator[str]:
        """A link and all that it carries."""
        yield link
        for joint in self.below(link):
            yield from self.subtree(joint.child)

    def rigid_subtree(self, link: str) -> Iterator[tuple[str, Transform]]:
        """A link and all that is fixed to it, with poses in its frame."""
        yield link, np.eye(4)
        for joint in self.below(link):
            if joint.kind == "fixed":
                for name, pose in self.rigid_subtree(joint.child):
                    yield name, joint.origin @ pose

    def path_between(self, base: str | None, tip: str | None) -> tuple[str, str, list[Joint]]:
        """Joints from one link to another, with the names of both.

        Args:
            base: A link; None: the root.
            tip: A link; None: the one leaf that there is.

        Raises:
            ValueError: There is no such link, no way between them that moves, more than one
                leaf to choose from, or a joint of the way is of a kind that is not supported.
        """
        base = self.root if base is None else base
        for role, name in (("base", base), ("tip", tip)):
            if name is not None and name not in self.links:
                raise ValueError(
                    f"{self.path} has no link {name!r} to be the {role}; its links are "
                    f"{', '.join(self.links)}"
                )
        if tip is None:
            tip = self._only_tip(base)
        joints = []
        link = tip
        while link != base:
            joint = self.above(link)
            if joint is None:
                raise ValueError(
                    f"{self.path}: link {tip!r} does not hang on {base!r}, but on {link!r}: "
                    "name another base or tip (base=, tip=; --base, --tip)"
                )
            joints.append(joint)
            link = joint.parent
        joints.reverse()
        for joint in joints:
            if joint.kind not in (*MOVING, "fixed"):
                raise ValueError(
                    f"{self.path}: joint {joint.name} is {joint.kind}, which no serial "
                    f"chain has: name a base or a tip (base=, tip=; --base, --tip) so that it "
                    f"is outside (its parent is {joint.parent}, its child {joint.child})"
                )
            if joint.follows is not None:
                raise ValueError(
                    f"{self.path}: joint {joint.name} only follows {joint.follows[0]}, as the "
                    f"fingers of grippers do: end the chain before it (tip=, --tip), at "
                    f"{joint.parent!r}"
                )
        if not any(joint.kind in MOVING for joint in joints):
            raise ValueError(f"{self.path}: no joint moves between {base!r} and {tip!r}")
        return base, tip, joints

    def _only_tip(self, base: str) -> str:
        leaves = [name for name in self.subtree(base) if not self.below(name)]
        if len(leaves) == 1:
            return leaves[0]
        # Where the arm ends and its hand begins is where the tree first branches.
        link = base
        while len(self.below(link)) == 1:
            link = self.below(link)[0].child
        # Ends behind the most joints are the likeliest; those behind none are no tools.
        moved = {name: self._joints_above(name, base) for name in (link, *leaves)}
        ends = sorted((n for n in moved if moved[n]), key=moved.__getitem__, reverse=True)
        raise ValueError(
            f"{self.path} has several ends; say which is the tool (tip=, --tip), the likeliest "
            f"first: {', '.join(ends or leaves)}"
        )

    def _joints_above(self, link: str, base: str) -> int:
        """Number of joints between a link and the base."""
        count = 0
        while link != base and (joint := self.above(link)) is not None:
            count += joint.kind in MOVING
            link = joint.parent
        return count


def turn_to(axis: Float[np.ndarray, "3"]) -> Transform:
    """A rotation that takes z to a unit axis; exact for axes along a coordinate axis."""
    turn = np.eye(4)
    along = int(np.abs(axis).argmax())
    if abs(axis[along]) == 1.0:
        # Columns z, x, y in turn for z, x, y: no rounding. Half a turn for the other sense.
        turn[:3, :3] = np.roll(np.eye(3), along + 1, axis=0)
        if axis[along] < 0:
            turn[:3, :3] = turn[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        return turn
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.abs(axis).argmin())], z)
    x /= np.linalg.norm(x)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


def transform(R: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "3"]) -> Transform:
    """Homogeneous transform of a rotation and an origin [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T
