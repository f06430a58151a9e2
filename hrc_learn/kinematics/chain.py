"""Serial arms: limits of the joints, forward kinematics and geometric Jacobians.

The kinematics are there twice: as matrix products, which is fast when run eagerly, and for
compilers written out number by number. There, products with the zeros and ones of which an
arm's description mostly consists are left out, and each number is a tensor over the batch
alone, so that a compiler makes one loop over the batch of it. Run eagerly, those thousand
operations take far longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import Constant


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of each joint's motion, float64; velocities and up are symmetric.

    Of whatever else is moved as well, in its own unit in place of radians.

    Some arms lower their velocity limits towards the limits of position, to be able to stop:
    there `velocity_offset` and `deceleration` are given, both or neither, and
    `velocity_bounds` is what holds. Without them it is `velocity` everywhere.
    """

    lower: Float[Tensor, " joints"]
    """Smallest position [rad]."""
    upper: Float[Tensor, " joints"]
    """Largest position [rad]."""
    velocity: Float[Tensor, " joints"]
    """[rad/s]"""
    acceleration: Float[Tensor, " joints"]
    """[rad/s^2]"""
    jerk: Float[Tensor, " joints"]
    """[rad/s^3]"""
    velocity_offset: Float[Tensor, " joints"] | None = None
    """o of `velocity_bounds` [rad/s]; None: the limits of velocity are the same everywhere."""
    deceleration: Float[Tensor, " joints"] | None = None
    """d of `velocity_bounds` [rad/s^2]."""

    def __post_init__(self):
        if (self.velocity_offset is None) != (self.deceleration is None):
            raise ValueError(
                "velocity_offset and deceleration together tell how velocity limits depend on "
                "the position: give both, or neither"
            )

    def slowed[Limits: MotionLimits](self: Limits, fraction: float) -> Limits:
        """The same limits with velocities of at most a fraction of theirs, at each position."""
        o, d = self.velocity_offset, self.deceleration
        return replace(
            self,
            velocity=fraction * self.velocity,
            velocity_offset=None if o is None else fraction * o,
            deceleration=None if d is None else fraction**2 * d,
        )

    def velocity_bounds(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Float[Tensor, "*batch joints"], Float[Tensor, "*batch joints"]]:
        """Lowest and highest velocity [rad/s] allowed at a position.

        With the distance x to the limit of position ahead it is

            min(velocity, max(0, sqrt(2 d max(0, x)) - o)),

        Franka's formula for the Research 3 ("Robot and interface specifications"): the speed
        from which a joint stops before the limit with the deceleration d, less an offset. Zero
        from o^2/(2 d) before the limit. Differentiable; at a limit the slope is zero, not
        infinite.

        Args:
            q: Joint positions [rad].
        """
        velocity = self.velocity.to(q)
        if self.velocity_offset is None or self.deceleration is None:
            return (-velocity).expand(q.shape), velocity.expand(q.shape)
        o, d = self.velocity_offset.to(q), self.deceleration.to(q)
        ahead = torch.stack([q - self.lower.to(q), self.upper.to(q) - q])
        # Nearer than that nothing is left, and the root has no slope at zero.
        speed = (2 * d * ahead).maximum(o * o).sqrt() - o
        lower, upper = speed.minimum(velocity)
        return -lower, upper


@dataclass(frozen=True, kw_only=True)
class JointLimits(MotionLimits):
    """Limits of each joint of an arm."""

    torque: Float[Tensor, " joints"]
    """[N m]"""
    vintage: str
    """Who published these numbers, and when: manufacturers revise them."""

    @property
    def middle(self) -> Float[Tensor, " joints"]:
        """Centre of the range of each joint [rad]."""
        return (self.lower + self.upper) / 2

    def contain(self, q: Float[Tensor, "*batch joints"]) -> Bool[Tensor, "*batch"]:
        """Whether all joints are within their range, limits included."""
        lower, upper = self.lower.to(q), self.upper.to(q)
        return torch.all((q >= lower) & (q <= upper), dim=-1)


type _Row = list[Tensor]


def transform_and_jacobian(
    q: Float[Tensor, "*batch joints"],
    mounts: Sequence[Sequence[Sequence[float]]],
    tip: Sequence[Sequence[float]],
) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 6 joints"]]:
    """Transform (R | p) of the tool centre point and its geometric Jacobian, written out.

    Args:
        q: Joint positions [rad].
        mounts: Frame of each joint at zero in the frame of the joint before (the base).
        tip: Tool centre point in the frame of the last joint.

    Returns:
        Both with the batch last in memory.
    """
    zero, one = torch.zeros_like(q[..., 0]), torch.ones_like(q[..., 0])
    frame = [[one if i == j else zero for j in range(4)] for i in range(3)]
    axes, origins = [], []
    for angle, mount in zip(q.unbind(-1), mounts, strict=True):
        frame = _turned(_product(frame, mount), torch.cos(angle), torch.sin(angle))
        axes.append([row[2] for row in frame])
        origins.append([row[3] for row in frame])
    frame = _product(frame, tip)
    point = [row[3] for row in frame]
    linear = [_cross(axis, _minus(point, o)) for axis, o in zip(axes, origins, strict=True)]
    rows = [[column[k] for column in part] for part in (linear, axes) for k in range(3)]
    return _matrix(frame), _matrix(rows)


def _product(frame: list[_Row], constant: Sequence[Sequence[float]]) -> list[_Row]:
    """(R | p) times a homogeneous transform."""
    return [
        [
            _combination([constant[k][j] for k in range(3)] + [float(j == 3)], row)
            for j in range(4)
        ]
        for row in frame
    ]


def _combination(factors: Sequence[float], terms: _Row) -> Tensor:
    """Sum of factor times term, without those that are zero or one."""
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


def _minus(a: _Row, b: _Row) -> _Row:
    return [x - y for x, y in zip(a, b, strict=True)]


def _cross(a: _Row, b: _Row) -> _Row:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def _matrix(rows: list[_Row]) -> Tensor:
    batch = list(range(-rows[0][0].ndim, 0))
    flat = torch.stack([entry for row in rows for entry in row])
    return flat.unflatten(0, (len(rows), -1)).movedim(batch, list(range(len(batch))))


class SerialChain:
    """An arm of revolute joints, each turning about the z axis of its own frame.

    The transform from one joint to the next is linear in 1, sin q and cos q, so all of them
    come from two fused multiply-adds; what remains is one matrix product a joint. Transforms
    are kept as their upper three rows (R | p): the last row is known.

    Methods take any number of leading batch dimensions and follow dtype and device of q.
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
    ):
        """Describe an arm.

        Args:
            joint_names: From the base to the tip.
            mounts: Frame of each joint at zero in the frame of the joint before (the base).
            flange: Flange in the frame of the last joint.
            tcp: Tool centre point in the frame of the flange.
            limits: Of the joints, in the same order.
            ready: A comfortable posture [rad], away from limits and singularities.

        Raises:
            ValueError: The number of names, mounts, limits and joints of `ready` differ.
        """
        counts = [len(joint_names), len(mounts), len(limits.lower), len(ready)]
        if len(set(counts)) > 1:
            raise ValueError(
                "each joint needs a name, a mount, limits and a ready angle, but there are "
                "{} names, {} mounts, {} limits and {} ready angles.".format(*counts)
            )
        self.joint_names = tuple(joint_names)
        self.limits = limits
        self.ready = ready
        self.mounts, self.flange, self.tcp = mounts.double(), flange.double(), tcp.double()
        x, y = self.mounts[:, :, 0], self.mounts[:, :, 1]
        zero = torch.zeros_like(x)
        # mount Rz(q) = fixed + cosine cos(q) + sine sin(q), column by column.
        self._fixed = Constant(
            torch.stack([zero, zero, self.mounts[:, :, 2], self.mounts[:, :, 3]], dim=-1)
        )
        self._cosine = Constant(torch.stack([x, y, zero, zero], dim=-1))
        self._sine = Constant(torch.stack([y, -x, zero, zero], dim=-1))
        self._mount_entries = self.mounts.tolist()
        self._tip_entries = (self.flange @ self.tcp).tolist()
        self._flange = Constant(self.flange)
        self._tip = Constant(self.flange @ self.tcp)

    def __repr__(self) -> str:
        return f"SerialChain({self.joint_names[0]} ... {self.joint_names[-1]})"

    def forward(self, q: Float[Tensor, "*batch joints"]) -> Pose:
        """Pose of the tool centre point in the base frame.

        Args:
            q: Joint positions [rad].
        """
        if torch.compiler.is_compiling():
            return Pose.from_matrix(self.transform_and_jacobian(q)[0])  # J is never computed
        return Pose.from_matrix(self._joint_frames(q)[-1] @ self._tip.like(q))

    def link_poses(self, q: Float[Tensor, "*batch joints"]) -> Pose:
        """Poses of the joint frames, the flange and the tool centre point, in this order.

        Args:
            q: Joint positions [rad].

        Returns:
            Pose with batch shape (*batch, joints + 2); index it as `poses[..., i]`.
        """
        return Pose.from_matrix(self.link_frames(q))

    def link_frames(
        self, q: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch links 3 4"]:
        """`link_poses` left as matrices (R | p): no quaternion made.

        Args:
            q: Joint positions [rad].
        """
        frames = self._joint_frames(q)
        tips = [frames[-1] @ self._flange.like(q), frames[-1] @ self._tip.like(q)]
        return torch.stack([*frames, *tips], dim=-3)

    def joint_origins(
        self, q: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch joints 3"]:
        """Origins of the joint frames in the base frame [m]: `link_poses` without the turns.

        Args:
            q: Joint positions [rad].
        """
        return torch.stack([frame[..., 3] for frame in self._joint_frames(q)], dim=-2)

    def joint_origin(
        self, q: Float[Tensor, "*batch joints"], joint: int
    ) -> Float[Tensor, "*batch 3"]:
        """Origin of the frame of one joint in the base frame [m].

        Args:
            q: Joint positions [rad].
            joint: Number of the joint, from 1.
        """
        return self._joint_frames(q, joint)[-1][..., 3]

    def joint_origins_and_jacobian(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Float[Tensor, "*batch joints 3"], Float[Tensor, "*batch 6 joints"]]:
        """`joint_origins` and `jacobian` for little more than the price of one."""
        frames = self._joint_frames(q)
        tip = frames[-1] @ self._tip.like(q)
        frames = torch.stack(frames, dim=-3)
        axis, origin = frames[..., 2], frames[..., 3]
        return origin, _screw_jacobian(axis, origin, tip[..., None, :, 3])

    def jacobian(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch 6 joints"]:
        """Geometric Jacobian of the tool centre point.

        Args:
            q: Joint positions [rad].

        Returns:
            J with twist = J q_dot: linear [m/rad] above angular [rad/rad], in the base frame.
        """
        return self.transform_and_jacobian(q)[1]

    def forward_and_jacobian(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Pose, Float[Tensor, "*batch 6 joints"]]:
        """`forward` and `jacobian` for little more than the price of one."""
        tip, J = self.transform_and_jacobian(q)
        return Pose.from_matrix(tip), J

    def transform_and_jacobian(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 6 joints"]]:
        """`forward_and_jacobian` with the pose left as a matrix (R | p): no quaternion made."""
        if torch.compiler.is_compiling():
            return transform_and_jacobian(q, self._mount_entries, self._tip_entries)
        frames = self._joint_frames(q)
        tip = frames[-1] @ self._tip.like(q)
        frames = torch.stack(frames, dim=-3)
        return tip, _screw_jacobian(frames[..., 2], frames[..., 3], tip[..., None, :, 3])

    def joint_jacobian(
        self, q: Float[Tensor, "*batch joints"], joint: int
    ) -> Float[Tensor, "*batch 6 joints"]:
        """Geometric Jacobian of the frame of one joint, to pull the arm there.

        Args:
            q: Joint positions [rad].
            joint: Number of the joint, from 1. Columns of later joints are zero.

        Raises:
            ValueError: There is no such joint.
        """
        count = len(self.joint_names)
        if not 1 <= joint <= count:
            raise ValueError(f"joint must be 1 to {count}, counted from the base, not {joint}.")
        frames = torch.stack(self._joint_frames(q, joint), dim=-3)
        origin = frames[..., -1:, :, 3]
        J = _screw_jacobian(frames[..., 2], frames[..., 3], origin)
        return torch.nn.functional.pad(J, (0, count - joint))

    def _joint_frames(self, q: Tensor, count: int | None = None) -> list[Tensor]:
        """(R | p) of the first joint frames in the base frame, each (*batch, 3, 4)."""
        angle = q[..., None, None]
        steps = torch.addcmul(self._fixed.like(q), self._sine.like(q), torch.sin(angle))
        steps = torch.addcmul(steps, self._cosine.like(q), torch.cos(angle))
        first, *rest = steps.unbind(-3)
        frames = [first[..., :3, :]]
        for step in rest[: None if count is None else count - 1]:
            frames.append(frames[-1] @ step)
        return frames


def _screw_jacobian(
    axis: Float[Tensor, "*batch joints 3"],
    origin: Float[Tensor, "*batch joints 3"],
    point: Float[Tensor, "*batch 1 3"],
) -> Float[Tensor, "*batch 6 joints"]:
    """Twist of a frame at `point` for unit speed about each axis."""
    linear = torch.linalg.cross(axis, point - origin)
    return torch.cat([linear.mT, axis.mT], dim=-2)
