"""An arm with the hand that it works with: what a work cell and its skills need of any arm.

The hand is the same for all: two parallel fingers on a palm, of the Franka hand's size, bolted
to the flange. An arm differs from another by its chain, its shape and its inverse.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import MeshFile, Pose, quaternion
from hrc_learn.kinematics.arm import Arm
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm, LinkCapsule
from hrc_learn.kinematics.franka import (
    HAND_CAPSULES,
    LINK_CAPSULES,
    LINK_MASSES,
    OVERLAPPING,
    FrankaChain,
    UnreachableError,
    fr3,
    panda,
)
from hrc_learn.kinematics.inverse import solutions_from, unwound
from hrc_learn.kinematics.redundancy import best_postures, comfortable_postures

type NullSpace = Literal["arm angle", "free", "none"]
"""What a full pose of the tool leaves to the joints: one arm angle, of a shoulder, an elbow and
a wrist whose axes meet; another self-motion; or nothing, as of six joints."""


class WorkArm(ABC):
    """An arm, its hand and its inverse.

    Attributes:
        name: By which commands know it.
        chain: From the base to the tool centre point, between the fingertips.
        body: Capsules of the links, without the hand.
        whole: With the hand.
        masses: Of the moving links [kg].
        meshes: What its links look like, by their names: link0, link1, ...
    """

    name: str
    chain: SerialChain
    body: CapsuleArm
    whole: CapsuleArm
    masses: tuple[float, ...]
    meshes: Mapping[str, tuple[MeshFile, ...]]

    @property
    def joints(self) -> int:
        """How many joints it has."""
        return len(self.chain.joint_names)

    @property
    @abstractmethod
    def null_space(self) -> NullSpace:
        """What a full pose of the tool leaves to the joints."""

    @abstractmethod
    def nearest(
        self, pose: Pose, near: Float[Tensor, "*#batch joints"], samples: int = 57
    ) -> Float[Tensor, "*batch joints"]:
        """Joint positions that reach poses, as near as can be to given ones [rad].

        Args:
            pose: Of the tool centre point, in any batch shape.
            near: Joint positions [rad].
            samples: Solutions sought among, where there are any number of them.

        Raises:
            UnreachableError: None reaches a pose within the limits; names the first such pose.
        """

    @abstractmethod
    def postures(self, pose: Pose) -> Float[Tensor, "postures joints"]:
        """Joint positions that reach a pose and differ, the most comfortable ones first [rad].

        Raises:
            UnreachableError: None reaches the pose within the limits.
        """


class FrankaWorkArm(WorkArm):
    """A Franka arm with its own hand, and its inverse in closed form."""

    chain: FrankaChain

    def __init__(self, chain: FrankaChain):
        """Of an arm whose links have the published shape."""
        self.name, self.chain = chain.name, chain
        self.body = CapsuleArm(chain, LINK_CAPSULES, OVERLAPPING)
        self.whole = CapsuleArm(chain, LINK_CAPSULES + HAND_CAPSULES, OVERLAPPING)
        self.masses = LINK_MASSES
        self.meshes = {}

    @property
    def null_space(self) -> NullSpace:
        """Their arm angle."""
        return "arm angle"

    def nearest(
        self, pose: Pose, near: Float[Tensor, "*#batch joints"], samples: int = 57
    ) -> Float[Tensor, "*batch joints"]:
        """Scans joint 7, the redundant one, and keeps the best of the analytic solutions."""
        lower, upper = float(self.chain.limits.lower[6]), float(self.chain.limits.upper[6])
        batch = torch.broadcast_shapes(pose.position.shape[:-1], near.shape[:-1])
        # A little inside the limits, where the arm can still be corrected.
        candidates = torch.linspace(
            lower + 0.02, upper - 0.02, samples, dtype=torch.float64, device=near.device
        )
        candidates = torch.cat(
            [near[..., 6:7].expand(*batch, 1), candidates.expand(*batch, samples)], dim=-1
        )
        many = Pose(
            pose.position.double().unsqueeze(-2).expand(*candidates.shape, 3),
            pose.orientation.double().unsqueeze(-2).expand(*candidates.shape, 4),
        )
        found = self.chain.inverse_all(many, candidates).flatten(-3, -2)
        return _nearest_of(found, pose, near)

    def postures(self, pose: Pose) -> Float[Tensor, "postures joints"]:
        """By scanning joint 7."""
        return comfortable_postures(self.chain, pose)


_TCP = 0.1034
"""Fingertips of the hand, along z of the flange [m]."""


class EquippedArm(WorkArm):
    """Any arm with six or more joints, our hand at its flange, and a numerical inverse."""

    def __init__(self, arm: Arm):
        """Take off what its description mounts on the flange, and bolt our hand to it.

        Args:
            arm: Whose flange has its z axis pointing away from the arm.

        Raises:
            ValueError: It has too few joints for a full pose of its tool.
        """
        old, n = arm.chain, len(arm.chain.joint_names)
        if n < 6:
            raise ValueError(
                f"{arm.name} has {n} joints, but grasping and placing need the full pose of "
                "the tool, for which it takes six: with fewer it servoes by position and axis "
                "(`hrc sweep --only near`, docs/controller.md)."
            )
        tcp = torch.eye(4, dtype=torch.float64)
        tcp[2, 3] = _TCP
        self.name = arm.name
        self.chain = SerialChain(
            joint_names=old.joint_names,
            mounts=old.mounts,
            flange=old.flange,
            tcp=tcp,
            limits=old.limits,
            ready=old.ready,
            kinds=old.kinds,
        )
        links = tuple(c for c in arm.body.capsules if c.link <= n)
        hand = tuple(
            LinkCapsule(link=n + 2, start=c.start, end=c.end, radius=c.radius)
            for c in HAND_CAPSULES
        )
        apart = (*arm.body.overlapping, (n - 1, n + 2), (n, n + 2))
        self.body = CapsuleArm(self.chain, links, apart)
        self.whole = CapsuleArm(self.chain, (*links, *hand), apart)
        self.masses = tuple(arm.masses[1 : n + 1])
        self.meshes = _meshes(arm, old.flange.numpy())

    @property
    def null_space(self) -> NullSpace:
        """None of six joints; of more, whatever their axes leave."""
        return "none" if self.joints == 6 else "free"

    def nearest(
        self, pose: Pose, near: Float[Tensor, "*#batch joints"], samples: int = 57
    ) -> Float[Tensor, "*batch joints"]:
        """From there and from starts all over, by damped least squares."""
        return _nearest_of(self._solutions(pose, samples, near), pose, near)

    def postures(self, pose: Pose) -> Float[Tensor, "postures joints"]:
        """From starts all over the joints' ranges."""
        found = self._solutions(pose, _STARTS, self.chain.ready)
        found = found[found.isfinite().all(-1)]
        if len(found) == 0:
            raise UnreachableError(_unreachable(pose))
        return best_postures(self.chain, found)

    def _solutions(
        self, pose: Pose, samples: int, near: Float[Tensor, "*#batch joints"]
    ) -> Float[Tensor, "*batch solutions joints"]:
        """From the wish itself and from random starts; NaN where they do not lead there."""
        limits = self.chain.limits
        # Drawn alike each time: an answer depends on what is asked for alone.
        rng = torch.Generator().manual_seed(0)
        # A joint that turns further than once around has the same poses again.
        low, high = limits.lower.clamp(min=-math.pi), limits.upper.clamp(max=math.pi)
        some = torch.rand(samples, self.joints, generator=rng, dtype=torch.float64)
        wish = near.double().unsqueeze(-2)
        all_over = (low + (high - low) * some).expand(*near.shape[:-1], -1, -1)
        found = solutions_from(self.chain, pose, torch.cat([wish, all_over], dim=-2))
        return unwound(self.chain, found, wish)


_STARTS = 200
"""From which postures are sought."""


def _nearest_of(
    found: Float[Tensor, "*batch solutions joints"],
    pose: Pose,
    near: Float[Tensor, "*#batch joints"],
) -> Float[Tensor, "*batch joints"]:
    """Of the solutions of each pose, or NaN, the one nearest to given joint positions.

    Raises:
        UnreachableError: There is none of a pose; names the first.
    """
    distance = (found - near.unsqueeze(-2)).norm(dim=-1)
    least = torch.where(distance.isnan(), torch.inf, distance).min(-1)
    missing = least.values.isinf()
    if bool(missing.any()):
        first = tuple(missing.nonzero()[0].tolist())
        position = pose.position.expand(*missing.shape, 3)[first]
        orientation = pose.orientation.expand(*missing.shape, 4)[first]
        raise UnreachableError(_unreachable(Pose(position, orientation)))
    return torch.take_along_dim(found, least.indices[..., None, None], dim=-2).squeeze(-2)


def _meshes(arm: Arm, flange: Float[np.ndarray, "4 4"]) -> dict[str, tuple[MeshFile, ...]]:
    """What links and hand look like; nothing if the description has no meshes."""
    n = len(arm.chain.joint_names)
    meshes: dict[str, tuple[MeshFile, ...]] = {}
    for visual in arm.visuals:
        if visual.link > n + 1 or visual.finger is not None:
            continue
        pose = flange @ visual.pose if visual.link == n + 1 else visual.pose
        turn = quaternion.from_matrix(torch.from_numpy(pose[:3, :3].copy())).tolist()
        name = f"link{min(visual.link, n)}"
        mesh = MeshFile(
            path=visual.mesh.path,
            position=tuple(pose[:3, 3].tolist()),
            orientation=tuple(turn),
            scale=visual.mesh.scale,
            colour=visual.colour,
        )
        meshes[name] = (*meshes.get(name, ()), mesh)
    return meshes


def _unreachable(pose: Pose) -> str:
    x, y, z = pose.position.tolist()
    w = [round(v, 3) for v in quaternion.normalize(pose.orientation).tolist()]
    return (
        f"no joint positions within the limits reach position ({x:.3f}, {y:.3f}, {z:.3f}) "
        f"m with orientation {w} (wxyz): move the goal towards the robot or turn it."
    )


PANDA = FrankaWorkArm(panda)
"""The Panda, which everything is about where no other arm is named."""


@dataclass(frozen=True)
class ArmChoice:
    """Which arm is meant, in words: kept in configurations, opened where it is needed."""

    name: str = "panda"
    """Registered name, or a URDF or MJCF file."""
    base: str = ""
    """Link of a file that is the base; empty: its root."""
    tip: str = ""
    """Link of a file that is the flange; empty: the only end it has."""

    def work_arm(self) -> WorkArm:
        """The arm with our hand on it.

        Raises:
            ValueError: There is no such arm, or it cannot do the work.
        """
        return _opened(self)


@cache
def _opened(choice: ArmChoice) -> WorkArm:
    # Only here: descriptions are read when one is asked for.
    from hrc_learn.kinematics.registry import arm

    franka = {"panda": PANDA, "fr3": FR3}
    if choice.name in franka and not choice.base and not choice.tip:
        return franka[choice.name]
    return EquippedArm(arm(choice.name, base=choice.base or None, tip=choice.tip or None))


FR3 = FrankaWorkArm(fr3)
"""The Research 3, with the same hand."""
