"""Forward kinematics and geometric Jacobians of a serial arm, in plain matrix form."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.geometry.constant import Constant
from hrc_learn.kinematics.unrolled import transform_and_jacobian
from hrc_learn.kinematics.limits import JointLimits


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
        frames = self._joint_frames(q)
        tips = [frames[-1] @ self._flange.like(q), frames[-1] @ self._tip.like(q)]
        return Pose.from_matrix(torch.stack([*frames, *tips], dim=-3))

    def joint_origins(
        self, q: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch joints 3"]:
        """Origins of the joint frames in the base frame [m]: `link_poses` without the turns.

        Args:
            q: Joint positions [rad].
        """
        return torch.stack([frame[..., 3] for frame in self._joint_frames(q)], dim=-2)

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
        frames = torch.stack(self._joint_frames(q)[:joint], dim=-3)
        origin = frames[..., -1:, :, 3]
        J = _screw_jacobian(frames[..., 2], frames[..., 3], origin)
        return torch.nn.functional.pad(J, (0, count - joint))

    def _joint_frames(self, q: Tensor) -> list[Tensor]:
        """(R | p) of each joint frame in the base frame, each (*batch, 3, 4)."""
        angle = q[..., None, None]
        steps = torch.addcmul(self._fixed.like(q), self._sine.like(q), torch.sin(angle))
        steps = torch.addcmul(steps, self._cosine.like(q), torch.cos(angle))
        first, *rest = steps.unbind(-3)
        frames = [first[..., :3, :]]
        for step in rest:
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
