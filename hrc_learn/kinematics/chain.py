"""Serial arms: forward kinematics and geometric Jacobians.

There are two implementations. One uses matrix products, which are fast in eager mode. The other
is for compilers: the same kinematics are written out number by number. Products with the zeros
and ones of the arm's description are omitted, and each number is a tensor over the batch alone.
The compiler therefore fuses everything into one loop over the batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import ArrayLike, Constant, as_tensor
from hrc_learn.kinematics.limits import JointLimits

type JointKind = Literal["revolute", "continuous", "prismatic"]
"""Kind of a joint; a continuous joint rotates without limits."""

type _Row = list[Tensor]

_NO_TOOL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def transform_and_jacobian(
    q: Float[Tensor, "*batch joints"],
    mounts: Sequence[Sequence[Sequence[float]]],
    tip: Sequence[Sequence[float]],
    sliding: Sequence[bool] = (),
) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 6 joints"]]:
    """Transform (R | p) of the tool centre point and its geometric Jacobian, written out.

    Args:
        q: Joint positions [rad, or m for sliding joints].
        mounts: Frame of each joint at zero, in the frame of the previous joint (or the base).
        tip: Tool centre point in the frame of the last joint.
        sliding: Mask of joints that move along their z axis. All other joints turn about their
            z axis; by default, all joints do.

    Returns:
        Transform and Jacobian, with the batch dimensions last in memory.
    """
    zero, one = torch.zeros_like(q[..., 0]), torch.ones_like(q[..., 0])
    frame = [[one if i == j else zero for j in range(4)] for i in range(3)]
    axes, origins = [], []
    slides = sliding or (False,) * len(mounts)
    for value, mount, slide in zip(q.unbind(-1), mounts, slides, strict=True):
        frame = _product(frame, mount)
        if slide:
            frame = [[x, y, z, p + z * value] for x, y, z, p in frame]
        else:
            frame = _turned(frame, torch.cos(value), torch.sin(value))
        axes.append([row[2] for row in frame])
        origins.append([row[3] for row in frame])
    frame = _product(frame, tip)
    point = [row[3] for row in frame]
    linear = [
        axis if slide else _cross(axis, [x - y for x, y in zip(point, o, strict=True)])
        for axis, o, slide in zip(axes, origins, slides, strict=True)
    ]
    angular = [[zero] * 3 if s else axis for axis, s in zip(axes, slides, strict=True)]
    rows = [[column[k] for column in part] for part in (linear, angular) for k in range(3)]
    return _matrix(frame), _matrix(rows)


def _product(frame: list[_Row], constant: Sequence[Sequence[float]]) -> list[_Row]:
    """Product of a frame (R | p) and a constant homogeneous transform."""
    return [
        [
            _combination([constant[k][j] for k in range(3)] + [float(j == 3)], row)
            for j in range(4)
        ]
        for row in frame
    ]


def _combination(factors: Sequence[float], terms: _Row) -> Tensor:
    """Sum of factors times terms; products with zeros and ones are not computed."""
    products = [
        term if factor == 1 else factor * term
        for factor, term in zip(factors, terms, strict=True)
        if factor != 0
    ]
    total = products[0]
    for product in products[1:]:
        total = total + product
    return total


def _turned(frame: list[_Row], cosine: Tensor, sine: Tensor) -> list[_Row]:
    """A frame turned about its own z axis."""
    return [[x * cosine + y * sine, y * cosine - x * sine, z, p] for x, y, z, p in frame]


def _cross(a: _Row, b: _Row) -> _Row:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _matrix(rows: list[_Row]) -> Tensor:
    batch = list(range(-rows[0][0].ndim, 0))
    flat = torch.stack([entry for row in rows for entry in row])
    return flat.unflatten(0, (len(rows), -1)).movedim(batch, list(range(len(batch))))


class SerialChain:
    """A chain of joints that turn about, or slide along, the z axis of their own frame.

    A joint with an axis in another direction gets a rotated mount (`described_arm` does this
    for arms from files). The transform from one joint to the next is linear in 1, sin q and
    cos q, and in q for a sliding joint. Two or three fused multiply-adds therefore compute all
    these transforms, and one matrix product per joint chains them. Transforms are kept as their
    upper three rows (R | p).

    Joint positions are in radians, those of sliding joints in metres. Methods take tensors,
    NumPy arrays or lists with any number of leading batch dimensions, and follow the dtype and
    device of a tensor. A wrong number of joints raises a ValueError.
    """

    def __init__(
        self,
        *,
        joint_names: Sequence[str],
        mounts: Float[Tensor, "joints 4 4"],
        flange: Float[Tensor, "4 4"],
        tcp: Float[Tensor, "4 4"],
        limits: JointLimits,
        ready: Float[Tensor, " joints"],
        kinds: Sequence[JointKind] | None = None,
    ):
        """Describe the chain.

        Args:
            joint_names: Names, from the base to the tip.
            mounts: Frame of each joint at zero, in the frame of the previous joint or the base.
            flange: Flange in the frame of the last joint.
            tcp: Tool centre point in the frame of the flange.
            limits: Joint limits, in the same order.
            ready: A comfortable posture [rad], away from limits and singularities.
            kinds: Kind of each joint; all are revolute if None.

        Raises:
            ValueError: Numbers of names, mounts, limits, kinds and joints of `ready` differ.
        """
        kinds = kinds or ("revolute",) * len(joint_names)
        counts = [len(joint_names), len(mounts), len(limits.lower), len(ready), len(kinds)]
        if len(set(counts)) > 1:
            raise ValueError(
                "each joint needs a name, a mount, limits, a ready angle and a kind, but there "
                "are {} names, {} mounts, {} limits, {} ready angles and {} kinds.".format(
                    *counts
                )
            )
        self.joint_names = tuple(joint_names)
        self.limits = limits
        self.ready = ready
        self.kinds = tuple(kinds)
        self.mounts, self.flange, self.tcp = mounts.double(), flange.double(), tcp.double()
        self._slides = tuple(kind == "prismatic" for kind in kinds)
        slides = torch.tensor(self._slides)[:, None, None]
        x, y, z, _ = self.mounts.unbind(-1)
        zero = torch.zeros_like(x)
        # mount Rz(q) = fixed + cosine cos(q) + sine sin(q), column by column; for a sliding
        # joint, mount Tz(q) = fixed + slide q.
        turned = torch.stack([x, y, zero, zero], dim=-1).masked_fill(slides, 0.0)
        self._cosine = Constant(turned)
        self._sine = Constant(torch.stack([turned[..., 1], -turned[..., 0], zero, zero], -1))
        self._fixed = Constant(self.mounts - turned)
        slide = torch.stack([zero, zero, zero, z], dim=-1)
        self._slide = Constant(slide.masked_fill(~slides, 0.0)) if any(self._slides) else None
        self._turning = Constant((~slides[..., 0]).double()) if any(self._slides) else None
        self._mount_entries = self.mounts.tolist()
        self._tip_entries = (self.flange @ self.tcp).tolist()
        self._flange = Constant(self.flange)
        self._tip = Constant(self.flange @ self.tcp)

    def __repr__(self) -> str:
        return f"SerialChain({self.joint_names[0]} ... {self.joint_names[-1]})"

    def with_tool(
        self, tcp: Float[Tensor, "4 4"], flange: Float[Tensor, "4 4"] | None = None
    ) -> SerialChain:
        """The same chain with another tool centre point.

        Args:
            tcp: Tool centre point in the frame of the flange.
            flange: Another flange, in the frame of the last joint; None: the same flange.
        """
        new: dict[str, Any] = {"tcp": tcp, "flange": self.flange if flange is None else flange}
        return SerialChain(**self.description_of_chain() | new)

    def description_of_chain(self) -> dict[str, Any]:
        """Constructor arguments for the same chain; its motion depends on nothing else."""
        names = "joint_names", "mounts", "flange", "tcp", "limits", "ready", "kinds"
        return {name: getattr(self, name) for name in names}

    def with_limits(self, limits: JointLimits) -> SerialChain:
        """The same arm with other joint limits."""
        limited = copy(self)
        limited.limits = limits
        return limited

    @property
    def elbow(self) -> int:
        """Number of the elbow's joint, from 1: the middle joint, or the first of two middle
        joints.
        """
        return (len(self.joint_names) + 1) // 2

    def joint_positions(self, q: ArrayLike) -> Float[Tensor, "*batch joints"]:
        """Convert joint positions to a tensor and check their number.

        Args:
            q: Joint positions [rad].

        Raises:
            ValueError: The last dimension differs from the number of joints.
        """
        q = as_tensor(q)
        count = len(self.joint_names)
        if q.ndim == 0 or q.shape[-1] != count:
            raise ValueError(
                f"{self!r} has {count} joints ({', '.join(self.joint_names)}), but the joint "
                f"positions have shape {tuple(q.shape)}: the last dimension must be {count}."
            )
        return q

    def forward(self, q: ArrayLike) -> Pose:
        """Pose of the tool centre point in the base frame.

        Args:
            q: Joint positions [rad].
        """
        q = self.joint_positions(q)
        if torch.compiler.is_compiling():
            return Pose.from_matrix(self.transform_and_jacobian(q)[0])  # compilers omit J
        return Pose.from_matrix(self._joint_frames(q)[-1] @ self._tip.like(q))

    def link_poses(self, q: ArrayLike) -> Pose:
        """Poses of the joint frames, the flange and the tool centre point, in this order.

        Args:
            q: Joint positions [rad].

        Returns:
            Pose with batch shape (*batch, joints + 2); index it as `poses[..., i]`.
        """
        return Pose.from_matrix(self.link_frames(q))

    def link_frames(self, q: ArrayLike) -> Float[Tensor, "*batch links 3 4"]:
        """`link_poses` as matrices (R | p), without conversion to quaternions.

        Args:
            q: Joint positions [rad].
        """
        q = self.joint_positions(q)
        frames = self._joint_frames(q)
        tips = [frames[-1] @ self._flange.like(q), frames[-1] @ self._tip.like(q)]
        return torch.stack([*frames, *tips], dim=-3)

    def joint_origins(self, q: ArrayLike) -> Float[Tensor, "*batch joints 3"]:
        """Origins of the joint frames in the base frame [m], without their orientations.

        Args:
            q: Joint positions [rad].
        """
        frames = self._joint_frames(self.joint_positions(q))
        return torch.stack([frame[..., 3] for frame in frames], dim=-2)

    def joint_origins_and_jacobian(
        self, q: ArrayLike
    ) -> tuple[Float[Tensor, "*batch joints 3"], Float[Tensor, "*batch 6 joints"]]:
        """`joint_origins` and `jacobian`, for little more than the time of one of them."""
        q = self.joint_positions(q)
        frames = self._joint_frames(q)
        tip, frames = frames[-1] @ self._tip.like(q), torch.stack(frames, dim=-3)
        return frames[..., 3], self._screw_jacobian(frames, tip)

    def jacobian(self, q: ArrayLike) -> Float[Tensor, "*batch 6 joints"]:
        """Geometric Jacobian of the tool centre point.

        Args:
            q: Joint positions [rad].

        Returns:
            J with twist = J q_dot: linear [m/rad] above angular [rad/rad], in the base frame.
        """
        return self.transform_and_jacobian(q)[1]

    def forward_and_jacobian(
        self, q: ArrayLike
    ) -> tuple[Pose, Float[Tensor, "*batch 6 joints"]]:
        """`forward` and `jacobian`, for little more than the time of one of them."""
        tip, J = self.transform_and_jacobian(q)
        return Pose.from_matrix(tip), J

    def transform_and_jacobian(
        self, q: ArrayLike
    ) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 6 joints"]]:
        """`forward_and_jacobian` with the pose as a matrix (R | p) instead of a quaternion."""
        q = self.joint_positions(q)
        if torch.compiler.is_compiling():
            return transform_and_jacobian(
                q, self._mount_entries, self._tip_entries, self._slides
            )
        frames = self._joint_frames(q)
        tip, frames = frames[-1] @ self._tip.like(q), torch.stack(frames, dim=-3)
        return tip, self._screw_jacobian(frames, tip)

    def joint_jacobian(self, q: ArrayLike, joint: int) -> Float[Tensor, "*batch 6 joints"]:
        """Geometric Jacobian of the frame of one joint, for example to pull the elbow.

        Args:
            q: Joint positions [rad].
            joint: Number of the joint, from 1. Columns of later joints are zero.

        Raises:
            ValueError: There is no such joint.
        """
        count = len(self.joint_names)
        if not 1 <= joint <= count:
            raise ValueError(f"joint must be 1 to {count}, counted from the base, not {joint}.")
        q = self.joint_positions(q)
        if torch.compiler.is_compiling():
            mounts, slides = self._mount_entries[:joint], self._slides[:joint]
            _, J = transform_and_jacobian(q[..., :joint], mounts, _NO_TOOL, slides)
        else:
            frames = torch.stack(self._joint_frames(q, joint), dim=-3)
            J = self._screw_jacobian(frames, frames[..., -1, :, :])
        return torch.nn.functional.pad(J, (0, count - joint))

    def _joint_frames(self, q: Tensor, count: int | None = None) -> list[Tensor]:
        """(R | p) of the first joint frames in the base frame, each (*batch, 3, 4)."""
        angle = q[..., None, None]
        steps = torch.addcmul(self._fixed.like(q), self._sine.like(q), torch.sin(angle))
        steps = torch.addcmul(steps, self._cosine.like(q), torch.cos(angle))
        if self._slide is not None:
            steps = torch.addcmul(steps, self._slide.like(q), angle)
        first, *rest = steps.unbind(-3)
        frames = [first[..., :3, :]]
        for step in rest[: None if count is None else count - 1]:
            frames.append(frames[-1] @ step)
        return frames

    def _screw_jacobian(
        self, frames: Float[Tensor, "*batch some 3 4"], tip: Float[Tensor, "*batch 3 4"]
    ) -> Float[Tensor, "*batch 6 some"]:
        """Jacobian of a tip: column i is the twist of the tip at unit speed of joint i.

        Args:
            frames: Frames (R | p) of the first joints in the base frame.
            tip: Frame of the tip in the base frame.
        """
        axis, origin = frames[..., 2], frames[..., 3]
        linear, angular = torch.linalg.cross(axis, tip[..., None, :, 3] - origin), axis
        if self._turning is not None:
            turning = self._turning.like(axis)[: axis.shape[-2]]
            linear, angular = torch.lerp(axis, linear, turning), turning * axis
        return torch.cat([linear.mT, angular.mT], dim=-2)
