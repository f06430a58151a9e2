"""A robot arm: its kinematics, limits, shape, gripper and inverse kinematics in one object.

Link frames are those of `SerialChain`, with z along the joint axis. They may differ from the
frames of the description by a constant rotation, which is applied to all mounted parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import MeshFile, Pose, quaternion
from hrc_learn.geometry.numerics import ArrayLike, as_tensor
from hrc_learn.kinematics.capsule_fit import capsule_volume, fit_body
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm, LinkCapsule, link_capsules
from hrc_learn.kinematics.description import Shape
from hrc_learn.kinematics.inverse import (
    TaskSpace,
    best_postures,
    solutions_from,
    solve_inverse,
    unwound,
)

# Density of aluminium shells with motors and gears, a little above the density of water. It is
# a guess for links without a mass in the description: mass = density * volume of the capsules.
_DENSITY = 1200.0  # [kg/m^3]
_STARTS = 200  # random starts from which `postures` searches
_SCAN = 57  # positions of joint 7 among which `inverse` chooses
_POSTURE_SCAN = 29  # positions of joint 7 among which `postures` chooses
_MARGIN = 0.02  # distance of the scan from the limits of joint 7 [rad]
_FEWEST_JOINTS = 5  # needed for position, tilt and turn of a tool
_LARGEST_STEP = 0.5  # larger joint motion between poses of a path starts a wider search [rad]

TCP_OFFSET = 0.1034
"""Distance of the Franka hand's tool centre point from the flange, along z [m]."""

# Capsules of the Franka hand in the frame of the tool centre point. They contain the hand (a
# box of 60 x 200 x 66 mm) and the open fingers.
_HAND = (
    ((0.0, -0.08, -0.0704), (0.0, 0.08, -0.0704), 0.05),
    ((0.0, -0.035, -0.01), (0.0, 0.035, -0.01), 0.028),
)

type NullSpace = Literal["arm angle", "free", "none"]
"""Self-motion of the arm while the tool keeps its pose: "arm angle" (Franka's arms, see
`inverse.arm_angle`), "none" (arms with up to six joints), or "free" (all other arms)."""


class UnreachableError(ValueError):
    """No joint positions within the limits reach a pose."""


type ClosedForm = Callable[[SerialChain, Pose, Tensor | float], Tensor]
"""Function for the closed-form inverse of a seven-joint arm. It takes the chain, poses and the
position of joint 7 [rad], and returns all solutions within limits (*batch, 4, 7), followed by
rows of NaN."""


@dataclass(frozen=True, eq=False)
class FingerJoint:
    """A joint of a gripper."""

    name: str
    kind: str
    """Kind of the joint: "revolute" or "prismatic"."""
    closed: float
    """Position of the closed gripper [rad or m]."""
    opened: float
    """Position of the open gripper [rad or m]: the end of the joint's range that is further
    from zero."""
    follows: tuple[str, float, float] | None = None
    """Leading joint, factor and offset: position = factor * leading position + offset."""
    carrier: str | None = None
    """Joint of the gripper that carries this joint; None: the hand carries it."""
    mount: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Frame of the joint at position zero, in the frame of the carrier, or of the tool if there
    is no carrier."""
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector of the axis in the joint's frame."""
    meshes: tuple[MeshFile, ...] = ()
    """Meshes that the joint moves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmShape:
    """Appearance, collision shapes, gripper and masses of an arm."""

    meshes: Mapping[str, tuple[MeshFile, ...]] = field(default_factory=dict)
    """Meshes by the name of their link (link0, link1, ...), without the gripper's meshes."""
    gripper: tuple[FingerJoint, ...] = ()
    """Joints of the gripper in the description, carriers first; empty if the description ends
    at the flange."""
    hand: tuple[MeshFile, ...] = ()
    """Meshes of the hand that carries the fingers, in the frame of the tool."""
    shapes: tuple[tuple[int, Shape], ...] = ()
    """Collision shapes, each with the number of its link's frame. The arm's capsules contain
    these shapes."""
    masses: tuple[float | None, ...] = ()
    """Masses of base, links, flange and tool [kg]; None where the description gives no mass."""
    inertia: tuple[Float[np.ndarray, "4 4"] | None, ...] = ()
    """Pseudo-inertias of the bodies of `masses` (`description.pseudo_inertia`), each in the
    frame of its body."""


class Arm(SerialChain):
    """A serial arm: kinematics, limits, shape, gripper and inverse kinematics.

    `arm("ur5e")` and `arm("robot.urdf", tip="tcp")` return arms; `panda` and `fr3` are
    ready-made.

    Attributes:
        name: Registered name, or the stem of the description's file.
        description: File of the description; None for arms written in this package.
        base: Link of the file that is the base.
        tip: Link of the file that is the flange.
        hand_size: Scale of the hand and of the objects that it handles; 1 for the Franka hand.
        task: Constrained part of the tool's pose in inverse kinematics: "pose", or "nearest
            pose" for an arm with fewer than six joints that `with_hand` returned.
    """

    def __init__(
        self,
        *,
        name: str,
        chain: SerialChain,
        shape: ArmShape | None = None,
        capsules: Sequence[LinkCapsule] | None = None,
        overlapping: Sequence[tuple[int, int]] = (),
        closed_form: ClosedForm | None = None,
        description: Path | None = None,
        base: str | None = None,
        tip: str | None = None,
        hand_size: float = 1.0,
        task: TaskSpace = "pose",
    ):
        """Add a shape and inverse kinematics to a chain.

        Args:
            name: Name of the arm.
            chain: Kinematics from the base to the tool centre point, limits, ready posture.
            shape: Appearance, collision shapes, gripper and masses.
            capsules: Capsules of links and gripper; None fits them to the shapes on first use.
            overlapping: Pairs of links that overlap by design, besides neighbours.
            closed_form: Closed-form inverse; None solves numerically.
            description: File that the arm was read from.
            base: Link of the file that is the base.
            tip: Link of the file that is the flange.
            hand_size: Size of the hand on the flange relative to the Franka hand.
            task: Constrained part of the tool's pose.
        """
        super().__init__(**chain.description_of_chain())
        self.name = name
        self.description, self.base, self.tip = description, base, tip
        self.shape = shape or ArmShape()
        self.hand_size = hand_size
        self.task: TaskSpace = task
        self._capsules, self._overlapping = capsules, tuple(overlapping)
        self._closed_form = closed_form

    def __repr__(self) -> str:
        return f"Arm({self.name})"

    @property
    def chain(self) -> Arm:
        """The arm itself: an arm is a serial chain."""
        return self

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def frame_names(self) -> dict[str, str]:
        """Names of the two frames of recorded poses: "base", and "ee" for the end effector."""
        return {"base": f"{self.name} base", "ee": f"{self.name} tool centre point"}

    @property
    def is_franka(self) -> bool:
        """True for Franka's arms, which have a closed-form inverse."""
        return self._closed_form is not None

    @property
    def null_space(self) -> NullSpace:
        """Self-motion of the joints while the tool keeps its pose."""
        if self.is_franka:
            return "arm angle"
        return "none" if self.joints <= 6 else "free"

    # Shape

    @cached_property
    def whole(self) -> CapsuleArm:
        """Capsules that contain all links and the gripper, and pairs of links to ignore.

        If no capsules were given, they are fitted on first use, which takes a few seconds.
        """
        if self._capsules is not None:
            return CapsuleArm(self, self._capsules, self._overlapping)
        return fit_body(self, self.shape.shapes)

    @cached_property
    def body(self) -> CapsuleArm:
        """Capsules of the links without the gripper, which tasks move close to objects."""
        links = [capsule for capsule in self.whole.capsules if capsule.link <= self.joints]
        return CapsuleArm(self, links, self.whole.overlapping)

    @cached_property
    def masses(self) -> tuple[float, ...]:
        """Masses of base, links, flange and tool [kg].

        A missing mass is estimated as 1200 kg/m^3 times the volume of the link's capsules.
        """
        count = self.joints + 3
        given = self.shape.masses or (None,) * count
        if all(mass is not None for mass in given):
            return tuple(mass or 0.0 for mass in given)
        estimated = [0.0] * count
        for capsule in self.whole.capsules:
            start, end = np.array([capsule.start, capsule.end])
            volume = capsule_volume((start, end, capsule.radius))
            estimated[capsule.link] += _DENSITY * volume
        return tuple(
            guess if mass is None else mass
            for mass, guess in zip(given, estimated, strict=True)
        )

    # Inverse kinematics

    def inverse(
        self,
        pose: Pose,
        q7: ArrayLike | None = None,
        near: ArrayLike | None = None,
        *,
        task: TaskSpace | None = None,
        samples: int = _SCAN,
    ) -> Float[Tensor, "*batch joints"]:
        """Joint positions within the limits that bring the tool centre point to poses [rad].

        Without `near`, the last batch dimension is a path. The first solution is the closest to
        the ready posture; each later solution is the closest to the solution before it.
        Neighbouring poses therefore have neighbouring solutions. With `near`, each pose is
        solved by itself. The method is not differentiable.

        Args:
            pose: Poses of the tool centre point in the base frame.
            q7: Position of joint 7 [rad], for arms with a closed-form inverse (Franka's); None
                leaves it free. The closed-form inverse never returns the elbow branch with
                q4 > -0.467 rad.
            near: Configuration to stay close to [rad], one for all poses or one for each.
            task: Constrained part of the pose; None: the arm's `task`. An arm with five joints
                reaches few full poses.
            samples: Number of positions of joint 7 to try, for a closed-form inverse.

        Raises:
            UnreachableError: A pose has no solution; the message names the first such pose.
            ValueError: `q7` was given to an arm without a closed-form inverse, or for a task
                other than the arm's `task`.
        """
        task = task or self.task
        if q7 is not None and (self._closed_form is None or task != self.task):
            text = f"{self.name} has no closed-form inverse for the task {task!r}, so q7 does"
            raise ValueError(f"{text} not apply: pass near= to choose among its solutions.")
        shapes = [pose.position.shape[:-1], pose.orientation.shape[:-1]]
        batch = np.broadcast_shapes(*shapes, () if q7 is None else as_tensor(q7).shape)
        if near is None and batch and math.prod(batch):
            q, missing = self._path(pose, q7, batch, task, samples)
        else:
            near = self.ready if near is None else near
            near = self.joint_positions(as_tensor(near, pose.position))
            q, missing = self._nearest(pose, q7, near, task, samples)
        if bool(missing.any()):
            raise UnreachableError(_explain(self.name, pose, q7, missing))
        return q

    def solutions(
        self,
        pose: Pose,
        q7: ArrayLike | None = None,
        *,
        near: ArrayLike | None = None,
        samples: int = _SCAN,
    ) -> Float[Tensor, "*batch solutions joints"]:
        """Joint positions by the closed-form inverse [rad]; rows without a solution are NaN.

        Args:
            pose: Poses of the tool centre point in the base frame.
            q7: Position of joint 7 [rad]; None scans its range.
            near: Configuration whose position of joint 7 is added to the scan [rad]; the ready
                posture if None.
            samples: Number of positions of joint 7 in the scan.

        Raises:
            ValueError: The arm has no closed-form inverse.
        """
        if self._closed_form is None:
            raise ValueError(f"{self.name} has no closed-form inverse: use `postures`.")
        near = self.ready if near is None else as_tensor(near)
        if q7 is not None:
            return self._closed_form(self, pose, as_tensor(q7))
        lower, upper = float(self.limits.lower[6]), float(self.limits.upper[6])
        batch = np.broadcast_shapes(pose.position.shape[:-1], near.shape[:-1])
        # The scan keeps a margin from the limits, so that joint 7 can still move both ways.
        scan = torch.linspace(
            lower + _MARGIN, upper - _MARGIN, samples, dtype=torch.float64, device=near.device
        )
        scan = torch.cat([near[..., 6:7].expand(*batch, 1), scan.expand(*batch, samples)], -1)
        return self._closed_form(self, _repeated(pose, scan.shape), scan).flatten(-3, -2)

    def postures(self, pose: Pose) -> Float[Tensor, "postures joints"]:
        """Distinct joint positions for one pose, the most comfortable first [rad].

        Comfortable postures are far from singularities and from joint limits.

        Args:
            pose: Pose of the tool centre point, without batch dimensions.

        Raises:
            UnreachableError: No joint positions within the limits reach the pose.
        """
        limits = self.limits
        if self._closed_form is None:
            # Each call has the same starts, so that only the arguments determine the result.
            rng = torch.Generator().manual_seed(0)
            # A joint that turns by more than one revolution repeats its poses.
            low, high = limits.lower.clamp(min=-math.pi), limits.upper.clamp(max=math.pi)
            random = torch.rand(_STARTS, self.joints, generator=rng, dtype=torch.float64)
            starts = torch.cat([self.ready[None].double(), low + (high - low) * random])
            found = solutions_from(self, pose, starts, task=self.task)
            found = unwound(self, found, self.ready)
        else:
            lower, upper = float(limits.lower[6]), float(limits.upper[6])
            scan = torch.linspace(lower, upper, _POSTURE_SCAN, dtype=torch.float64)
            many = _repeated(pose, scan.shape)
            found = self._closed_form(self, many, scan).flatten(0, 1)
        found = found[found.isfinite().all(-1)]
        if len(found) == 0:
            raise UnreachableError(_explain(self.name, pose, None, torch.tensor(True)))
        return best_postures(self, found).to(pose.position)

    def _path(
        self,
        pose: Pose,
        q7: ArrayLike | None,
        batch: tuple[int, ...],
        task: TaskSpace,
        samples: int,
    ) -> tuple[Float[Tensor, "*batch joints"], Bool[Tensor, "*batch"]]:
        """Solutions along a path, each close to the previous one, and a mask of poses without
        a solution.
        """
        pose = Pose(pose.position.expand(*batch, 3), pose.orientation.expand(*batch, 4))
        angles = None if q7 is None else as_tensor(q7, pose.position).expand(batch)
        before, path, missing = self.ready.to(pose.position), [], []
        for k in range(batch[-1]):
            here, angle = pose[..., k], None if angles is None else angles[..., k]
            q, lost = before.new_full((1,), torch.nan), torch.zeros(batch[:-1]).bool()
            if self._closed_form is None:
                start = before.double().unsqueeze(-2)
                q = solutions_from(self, here, start, task=task).squeeze(-2).to(before)
            # A comparison with NaN is false, so poses that were not reached are searched, too.
            if not bool(((q - before).abs().amax(-1) < _LARGEST_STEP).all()):
                q, lost = self._nearest(here, angle, before, task, samples)
            path.append(q)
            missing.append(lost)
            before = torch.where(q.isnan(), before, q)
        return torch.stack(path, dim=-2), torch.stack(missing, dim=-1)

    def _nearest(
        self, pose: Pose, q7: ArrayLike | None, near: Tensor, task: TaskSpace, samples: int
    ) -> tuple[Float[Tensor, "*batch joints"], Bool[Tensor, "*batch"]]:
        """Solution closest to a configuration, for each pose, and a mask of poses without a
        solution.
        """
        if self._closed_form is None or task != self.task:
            solution = solve_inverse(self, pose, near, task=task)
            return solution.position, ~solution.found
        found = self.solutions(pose, q7, near=near, samples=samples)
        distance = (found - near.to(found).unsqueeze(-2)).norm(dim=-1)
        least = torch.where(distance.isnan(), torch.inf, distance).min(-1)
        indices = least.indices[..., None, None]
        return torch.take_along_dim(found, indices, dim=-2).squeeze(-2), least.values.isinf()

    def with_hand(self, size: float = 1.0, mount: Float[Tensor, "4 4"] | None = None) -> Arm:
        """The same arm with the Franka hand in place of its gripper.

        With fewer than six joints, the task of the new arm is "nearest pose".

        Args:
            size: Size of the hand relative to the Franka hand.
            mount: Frame of the hand in the frame of the flange, with z in the direction of
                approach; None: at the flange, in the direction of the arm's own tool.

        Raises:
            ValueError: The arm has fewer than five joints.
        """
        n = self.joints
        if n < _FEWEST_JOINTS:
            text = f"{self.name} has {n} joints, but grasping and placing need position, tilt"
            raise ValueError(f"{text} and turn of the tool: at least {_FEWEST_JOINTS} joints.")
        flange, tcp = self.flange, self.tcp.clone()
        links = [capsule for capsule in self.whole.capsules if capsule.link <= n]
        if mount is not None:
            flange, tcp = flange @ mount.to(flange), torch.eye(4, dtype=flange.dtype)
            # Parts ahead of the hand's base are cut off, such as a fixed jaw. They belong to
            # the gripper that the hand replaces.
            last = [_behind(capsule, flange) for capsule in links if capsule.link == n]
            links = [*(c for c in links if c.link < n), *(c for c in last if c is not None)]
        # The tool centre point lies along the arm's own direction of approach, which may differ
        # from the flange's z axis.
        tcp[:3, 3] = size * TCP_OFFSET * tcp[:3, 2]
        return Arm(
            name=self.name,
            chain=self.with_tool(tcp, flange),
            shape=ArmShape(
                meshes=self.shape.meshes,
                masses=(*self.masses[:-1], None),
                inertia=(*self.shape.inertia[:-1], None) if self.shape.inertia else (),
                shapes=self.shape.shapes,
            ),
            capsules=(*links, *hand_capsules(n + 2, size)),
            overlapping=(*self.whole.overlapping, (n - 1, n + 2), (n, n + 2)),
            description=self.description,
            base=self.base,
            tip=self.tip,
            hand_size=size,
            task="nearest pose" if n < 6 else "pose",
        )


def _behind(capsule: LinkCapsule, hand: Float[Tensor, "4 4"]) -> LinkCapsule | None:
    """Part of a capsule behind the base of a hand, in the link's frame; None: no part."""
    axis, origin = hand[:3, 2], hand[:3, 3]
    ends = torch.tensor([capsule.start, capsule.end], dtype=hand.dtype)
    ahead = (ends - origin) @ axis
    if bool((ahead > 0).all()):
        return None
    back = torch.where(ahead > 0, ahead + capsule.radius, 0.0)
    start, end = (ends - back[:, None] * axis).tolist()
    return replace(capsule, start=tuple(start), end=tuple(end))


def hand_capsules(link: int, size: float = 1.0) -> tuple[LinkCapsule, ...]:
    """Capsules of the Franka hand and its fingers, mounted on the frame of the tool.

    Args:
        link: Number of the tool's frame.
        size: Size relative to the Franka hand.
    """
    return link_capsules(
        (link, *np.multiply(size, (start, end)).tolist(), size * radius)
        for start, end, radius in _HAND
    )


def comfortable_posture(arm: Arm, pose: Pose) -> Float[Tensor, " joints"]:
    """Inverse-kinematics solution furthest from singularities and joint limits [rad].

    An arm that servoes around a pose hardly changes its posture. The posture on arrival
    therefore decides whether the arm meets a limit there.

    Args:
        arm: The arm.
        pose: Pose of the tool centre point, without batch dimensions.

    Raises:
        UnreachableError: No joint positions within the limits reach the pose.
    """
    return arm.postures(pose)[0]


def _repeated(pose: Pose, shape: Sequence[int]) -> Pose:
    """Poses expanded to `shape`, in float64; the last dimension of `shape` is new."""
    return Pose(
        pose.position.double().unsqueeze(-2).expand(*shape, 3),
        pose.orientation.double().unsqueeze(-2).expand(*shape, 4),
    )


def _explain(
    name: str, pose: Pose, q7: ArrayLike | None, missing: Bool[Tensor, "*batch"]
) -> str:
    """Text of the error for the first pose that was not reached."""
    shape = missing.shape
    first = tuple(missing.nonzero()[0].tolist()) if shape else ()
    position = pose.position.expand(*shape, 3)[first].tolist()
    orientation = quaternion.normalize(pose.orientation).expand(*shape, 4)[first].tolist()
    which = f"pose {list(first)} of {list(shape)}" if shape else "the pose"
    where = ", ".join(f"{value:.3f}" for value in position)
    turned = ", ".join(f"{value:.3f}" for value in orientation)
    fixed, advice = "", "move the pose towards the base, or turn it"
    if q7 is not None:
        angle = as_tensor(q7).expand(shape)[first].item()
        fixed = f" with joint 7 at {angle:.4f} rad"
        advice = "try other values of q7, leave it out, or move the pose towards the base"
    return (
        f"{which}, position ({where}) m, quaternion wxyz ({turned}), has no solution within "
        f"the joint limits of {name}{fixed}: {advice}."
    )
