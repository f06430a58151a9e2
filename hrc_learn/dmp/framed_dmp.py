"""Motions learned relative to the frames of objects, and adapted to new frames.

Each demonstration is expressed in every frame, and a Gaussian is fitted in each frame. While a
frame determines the motion, the demonstrations agree in that frame. For new frames, the
Gaussians are transformed to the base frame and multiplied, as in task-parameterised models
(Calinon 2016, "A tutorial on task-parameterized movement learning and retrieval", eqs. 5 and
6). There, each Gaussian describes a single time. Here, each Gaussian describes the coordinates
of a primitive, and thereby whole motions: a motion that deviates at its start continues to
deviate. The result is an ordinary primitive.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Points, Times, check_not_negative, finite
from hrc_learn.dmp.joint_dmp import FitOptions, JointDMP
from hrc_learn.dmp.motion_primitive import REFIT_SAMPLES
from hrc_learn.dmp.probabilistic_dmp import mean_primitive, on_device
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.model_files import SavedModel, StoredModel

PERSISTENCE = 0.3
"""Correlation length of the assumed smooth deviations, as a fraction of the motion; with 0.1,
the error on synthetic motions is twice as large (benchmarks/bench_frames.py)."""
MODES = 12
"""Number of modes of the assumed smooth deviations; the next mode has 1e-6 of the variance."""
FREEDOM = 1e-3
"""Standard deviation added independently to each coordinate, relative to the RMS deviation of
this coordinate over all frames. It makes the covariance invertible and hardly changes
motions."""


@dataclass(frozen=True, eq=False)
class Frames:
    """F frames of a motion, y = A y_in_frame + b.

    A is any invertible matrix. A coordinate that is not spatial, such as a gripper opening, has
    a one on the diagonal of A and a zero in b.
    """

    A: Float[Tensor, "*batch F D D"]
    b: Float[Tensor, "*batch F D"]

    def __post_init__(self):
        finite("A of frames", self.A)
        finite("b of frames", self.b)
        if self.A.shape != (*self.b.shape, self.b.shape[-1]) or self.b.ndim < 2:
            raise ValueError(
                f"frames must have A (..., F, D, D) and b (..., F, D), got "
                f"{tuple(self.A.shape)} and {tuple(self.b.shape)}"
            )
        finite("inverse of A of frames", torch.linalg.inv_ex(self.A.double()).inverse)

    @staticmethod
    def of(*poses: Pose) -> "Frames":
        """Frames for positions in space, from one pose (*batch) for each frame."""
        A = torch.stack([quaternion.to_matrix(pose.orientation) for pose in poses], dim=-3)
        return Frames(A, torch.stack([pose.position for pose in poses], dim=-2))

    def inwards(self, x: Float[Tensor, "*batch D M"]) -> Float[Tensor, "*batch F D M"]:
        """Convert coordinates of primitives from the base frame to each frame."""
        x = x[..., None, :, :].to(self.A)
        return torch.linalg.solve(self.A, x - self._offset(x.shape[-1]))

    def outwards(self, x: Float[Tensor, "F D M"]) -> Float[Tensor, "*batch F D M"]:
        """Convert coordinates of primitives from each frame to the base frame."""
        return self.A @ x + self._offset(x.shape[-1])

    def _offset(self, M: int) -> Float[Tensor, "*batch F D M"]:
        """Offset b for start and goal, the last two coordinates; zero for the others."""
        return torch.nn.functional.pad(self.b[..., None].expand(*self.b.shape, 2), (M - 2, 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class FramedDMP(StoredModel):
    """Gaussians over the coordinates of a primitive relative to each of F frames (float64).

    The coordinates are x = (weights, start velocity, start, goal) as in `ProbabilisticDMP`, M
    numbers for each of D columns. The covariance of the n demonstrations is extended by smooth
    deviations in all directions. The smooth deviations are as large as the observed deviations
    and count as one additional demonstration.
    """

    primitive: JointDMP
    """Primitive with the common spring, basis, duration and names."""
    mean: Float[Tensor, "F D M"]
    precision: Float[Tensor, "F DM DM"]
    """Inverse covariance."""

    @classmethod
    def fit(
        cls,
        time: Times | Sequence[Times],
        position: Points | Sequence[Points],
        frames: Frames,
        n_basis: int | None = None,
        mask: Mask | None = None,
        *,
        tolerance: float | None = None,
        joint_names: Sequence[str] | None = None,
        units: str = "m",
        **options: Unpack[FitOptions],
    ) -> "FramedDMP":
        """Learn from demonstrations whose frames differ.

        Args:
            time: Timestamps [s], (T,), (n, T) or a list of (T_i,).
            position: Positions, (n, T, D) or a list of (T_i, D).
            frames: Frames of each demonstration, (n, F).
            n_basis: Number N of basis functions, as in `JointDMP.fit`.
            mask: Mask (n, T), false at samples to ignore.
            tolerance: Smallest standard deviation of the demonstrations in every frame, in the
                units of the motion. None: 0.1 % of the largest range.
            joint_names: Names of the D coordinates.
            units: Units of the coordinates.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Fewer than two demonstrations, or frames of a wrong number or size.
        """
        dmps = JointDMP.fit(
            time, position, n_basis, mask=mask, joint_names=joint_names, units=units, **options
        )
        return cls.of(dmps, frames, tolerance)

    @classmethod
    def of(cls, dmps: JointDMP, frames: Frames, tolerance: float | None = None) -> "FramedDMP":
        """Learn from a batch of n primitives, one per demonstration; arguments as for `fit`."""
        x = dmps.coordinates().detach().double()
        if x.ndim != 3 or len(x) < 2:
            raise ValueError("frames need a batch of 2 demonstrations or more")
        if dmps.basis.periodic:
            raise ValueError("a rhythm has no start and goal: frames are for discrete motions")
        n, D, _ = x.shape
        if frames.b.ndim != 3 or frames.b.shape[::2] != (n, D):
            raise ValueError(
                f"{n} demonstrations of {D} coordinates need frames ({n}, F) of {D}, got "
                f"{tuple(frames.b.shape[:-1])} of {frames.b.shape[-1]}"
            )
        seen = Frames(frames.A.detach().double(), frames.b.detach().double()).inwards(x)
        mean = seen.mean(0)
        off = seen - mean
        smooth = _smooth_deviations(dmps, off, tolerance)
        # The smooth deviations have the weight of one more demonstration.
        shown = off.permute(1, 2, 3, 0) * math.sqrt(n / (n + 1) / (n - 1))
        precision = _precision(torch.cat([shown, smooth], dim=-1))
        return cls(primitive=mean_primitive(dmps), mean=mean, precision=precision)

    def to(self, device: torch.device | str) -> "FramedDMP":
        """The same model on another device."""
        return on_device(self, device)

    def config(self) -> dict[str, Any]:
        """Config of the primitive."""
        return self.primitive.config()

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the primitive and of the Gaussians."""
        own = {"gaussian.mean": self.mean, "gaussian.precision": self.precision}
        return self.primitive.tensors() | own

    @classmethod
    def restore[S: "FramedDMP"](cls: type[S], saved: SavedModel) -> S:
        mean, precision = saved.tensor("gaussian.mean"), saved.tensor("gaussian.precision")
        return cls(primitive=JointDMP.restore(saved), mean=mean, precision=precision)

    def rollout(self, frames: Frames, *arguments: Any, **options: Any) -> Trajectory:
        """Most likely motion for frames (*batch, F); other arguments as for a `JointDMP`."""
        return self.at(frames).rollout(*arguments, **options)

    def at(self, frames: Frames) -> JointDMP:
        """Most likely primitive for frames, (*batch, F); gradients flow to them.

        Raises:
            ValueError: Frames of a wrong number or size.
        """
        F, D, M = self.mean.shape
        if frames.b.shape[-2:] != (F, D):
            raise ValueError(
                f"the motion has {F} frames of {D} coordinates, got "
                f"{frames.b.shape[-2]} of {frames.b.shape[-1]}"
            )
        frames = Frames(frames.A.to(self.mean), frames.b.to(self.mean))
        back = torch.linalg.inv(frames.A)
        precision = self.precision.view(F, D, M, D, M)
        precision = torch.einsum("...fba,fbmcn,...fcd->...famdn", back, precision, back)
        precision = precision.flatten(-4, -3).flatten(-2)
        x = frames.outwards(self.mean).flatten(-2)[..., None]
        # Mean of the product of all Gaussians.
        factor = torch.linalg.cholesky(precision.sum(-3))
        mean = torch.cholesky_solve((precision @ x).sum(-3), factor)
        return self.primitive.with_coordinates(mean[..., 0].unflatten(-1, (D, M)))


def _precision(root: Float[Tensor, "F D M columns"]) -> Float[Tensor, "F DM DM"]:
    """Inverse covariance from a square root of the covariance, with `FREEDOM` added."""
    D = root.shape[1]
    # One unit for all D columns of a weight, start or goal, because rotations mix columns.
    unit = root.square().sum(-1).mean((0, 1)).sqrt()
    root = (root / unit[:, None]).flatten(1, 2)
    eye = torch.eye(root.shape[1]).to(root)
    unit = unit.repeat(D)
    return torch.linalg.inv(root @ root.mT + FREEDOM**2 * eye) / unit / unit[:, None]


def _smooth_deviations(
    dmps: JointDMP, off: Float[Tensor, "n F D M"], least: float | None
) -> Float[Tensor, "F D M columns"]:
    """Square root of the covariance of smooth deviations, equal in all directions.

    Args:
        dmps: Primitives of the demonstrations.
        off: Deviations of their coordinates from the mean in each frame.
        least: Smallest standard deviation of a motion at any time; None: 0.1 % of the largest
            range.
    """
    n, F, D, _ = off.shape
    s = torch.linspace(0, 1, REFIT_SAMPLES * dmps.basis.count + 1).to(off)
    rows = dmps.response.evaluate(s)[:, 0]
    if least is None:
        shown = dmps.coordinates().detach().double() @ rows.mT
        least = float((shown.amax(-1) - shown.amin(-1)).max()) / 1000 or 1e-3
    check_not_negative("tolerance", least)
    # Variance along the motion, averaged over all directions.
    variance = (off @ rows.mT).square().sum(0).mean(-2) / (n - 1)
    size = (variance / (n + 1) + least**2).sqrt()
    # Modes of a Gaussian process with squared exponential covariance.
    kernel = torch.exp(-((s[:, None] - s) / PERSISTENCE).square() / 2)
    values, vectors = torch.linalg.eigh(kernel)
    modes = vectors[:, -MODES:] * values[-MODES:].clamp(min=0).sqrt()
    motions = (size[:, :, None] * modes).mT.reshape(-1, len(s), 1)
    x = dmps.refit(s, motions).coordinates().detach().view(F, MODES, -1)
    return torch.einsum("frm,de->fdmre", x, torch.eye(D).to(x)).flatten(-2)
