"""From demonstrations to movement primitives: of the joints, and of the hand if it is known."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..demos import DemonstrationSet, PaddedDemonstrations
from ..dmp import JointDMP, PoseDMP
from ..dmp.fitting.mean import mean_primitive
from ..geometry import quaternion
from ..kinematics import arm_angle, panda
from ..viz import FitRecording, JointLimits


@dataclass(frozen=True, kw_only=True)
class FittedPrimitives:
    """Primitives of one motion, one for each demonstration and their mean."""

    demonstrations: PaddedDemonstrations
    joint: JointDMP | None
    """One for each demonstration; None without joint positions."""
    pose: PoseDMP | None
    """The same for the hand, the arm angle as its body shape if the arm is a Panda."""

    def save(self, folder: Path) -> None:
        """Write the mean primitives into `folder/joint` and `folder/pose`."""
        if self.joint is not None:
            mean_primitive(self.joint).save(folder / "joint")
        if self.pose is not None:
            mean_primitive(self.pose).save(folder / "pose")

    def metrics(self) -> dict[str, float]:
        """How close the primitives come to their demonstrations.

        `nrmse` divides by the largest range of any coordinate. `mean_` is the mean primitive,
        given start, goal and duration of each demonstration.
        """
        values: dict[str, float] = {"demonstrations": float(len(self.demonstrations.length))}
        demos = self.demonstrations
        if self.joint is not None and demos.joint_position is not None:
            own = self.joint.rollout().position.detach()
            values |= _compare("joint", own, demos.joint_position, demos.mask)
            values |= _compare(
                "mean_joint", self._mean_joints(), demos.joint_position, demos.mask
            )
        if (
            self.pose is not None
            and demos.position is not None
            and demos.orientation is not None
        ):
            own = self.pose.rollout()
            values |= _compare("position", own.position.detach(), demos.position, demos.mask)
            turn = quaternion.angle(own.orientation.detach(), demos.orientation)[demos.mask]
            values["orientation_rmse_deg"] = float(turn.square().mean().sqrt().rad2deg())
        return values

    def _mean_joints(self) -> Tensor:
        assert self.joint is not None
        mean = mean_primitive(self.joint)
        return mean.rollout(
            self.joint.stamps * self.joint.duration[..., None],
            start=self.joint.start,
            goal=self.joint.goal,
            duration=self.joint.duration,
            start_velocity=self.joint.start_velocity,
        ).position.detach()


def fit_primitives(
    demos: DemonstrationSet, n_basis: int = 60, method: str = "trajectory"
) -> FittedPrimitives:
    """Fit one primitive to each demonstration.

    Joints need no robot model. Hand poses are taken as recorded, or computed if the joints are
    a Panda's. Pauses at either end are kept: they are part of what was shown.

    Args:
        demos: Demonstrations of one motion.
        n_basis: Number of basis functions.
        method: See `JointDMP.fit`.

    Raises:
        ValueError: If the demonstrations hold neither joint positions nor poses.
    """
    padded = demos.padded()
    is_panda = demos.joint_names == panda.joint_names
    if is_panda and padded.position is None and padded.joint_position is not None:
        hand = panda.forward(padded.joint_position)
        padded = _with_pose(padded, hand.position, hand.orientation)
    joint = pose = None
    if padded.joint_position is not None:
        joint = JointDMP.fit(
            padded.time,
            padded.joint_position,
            n_basis,
            mask=padded.mask,
            method=method,
            joint_names=demos.joint_names,
        )
    if padded.position is not None and padded.orientation is not None:
        pose = PoseDMP.fit(
            padded.time,
            padded.position,
            padded.orientation,
            n_basis,
            body=_body_shape(padded.joint_position) if is_panda else None,
            mask=padded.mask,
            method=method,
        )
    if joint is None and pose is None:
        raise ValueError(
            f"{demos.source}: the demonstrations hold neither joint positions nor end-effector "
            "poses, so there is no motion to learn. Look with datasets/check_dataset.py."
        )
    return FittedPrimitives(demonstrations=padded, joint=joint, pose=pose)


def _with_pose(
    padded: PaddedDemonstrations, position: Tensor, orientation: Tensor
) -> PaddedDemonstrations:
    return PaddedDemonstrations(
        **{**vars(padded), "position": position, "orientation": orientation}
    )


def _body_shape(joint_position: Tensor | None) -> Tensor | None:
    """Arm angle along each demonstration, continuous, and alike in turns at the start [rad]."""
    if joint_position is None:
        return None
    angle = np.unwrap(arm_angle(panda, joint_position).numpy(), axis=1)
    start = np.unwrap(angle[:, :1], axis=0) - angle[:, :1]
    return torch.from_numpy(angle + start)[..., None]


def _compare(name: str, got: Tensor, wanted: Tensor, mask: Tensor) -> dict[str, float]:
    error = torch.where(mask[..., None], got - wanted, 0.0)
    samples = mask.sum(dim=-1, keepdim=True) * wanted.shape[-1]
    rmse = (error.square().sum(dim=(-2, -1)) / samples.squeeze(-1)).sqrt()
    low = torch.where(mask[..., None], wanted, torch.inf).amin(dim=-2)
    high = torch.where(mask[..., None], wanted, -torch.inf).amax(dim=-2)
    nrmse = rmse / (high - low).amax(dim=-1).clamp(min=1e-12)
    return {
        f"{name}_nrmse_median": float(nrmse.median()),
        f"{name}_nrmse_max": float(nrmse.max()),
        f"{name}_error_max": float(error.abs().max()),
    }


def fit_recording(fitted: FittedPrimitives, title: str) -> FitRecording:
    """Joint demonstrations beside their reproductions, to be looked at.

    Raises:
        ValueError: If the demonstrations hold no joint positions.
    """
    demos, joint = fitted.demonstrations, fitted.joint
    if joint is None or demos.joint_position is None:
        raise ValueError(
            "there are no joint positions to show; pose primitives have no figure."
        )
    reproduced = joint.rollout().position.detach()
    lengths = demos.length.tolist()

    def cut(padded: Tensor) -> tuple[np.ndarray, ...]:
        return tuple(
            values[:n].double().numpy() for values, n in zip(padded, lengths, strict=True)
        )

    limits, demo_paths, reproduction_paths = None, (), ()
    if joint.joint_names == panda.joint_names:
        limits = JointLimits(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())
        demo_paths = cut(panda.forward(demos.joint_position.double()).position)
        reproduction_paths = cut(panda.forward(reproduced.double()).position)
    return FitRecording(
        title=title,
        joint_names=joint.joint_names or (),
        time=cut(demos.time),
        demos=cut(demos.joint_position),
        reproductions=cut(reproduced),
        joint_limits=limits,
        n_basis=joint.basis.count,
        demo_paths=demo_paths,
        reproduction_paths=reproduction_paths,
    )
