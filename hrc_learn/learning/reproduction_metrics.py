"""How far motions are from demonstrations, in the measures of the field."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.learning.channels import CHANNELS, Motions, Reproduction


@dataclass(frozen=True, kw_only=True, eq=False)
class ReproductionError:
    """One row a demonstration; None where a channel of motion has no such measure."""

    nrmse: Float[Tensor, " demos"] | None = None
    """Root mean square error over the largest range of any coordinate."""
    largest: Float[Tensor, " demos"] | None = None
    """Largest error of any coordinate [rad] or [m]."""
    goal_error: Float[Tensor, " demos"] | None = None
    """Distance of the last samples [rad] or [m]."""
    jerk: Float[Tensor, " demos"] | None = None
    """Dimensionless jerk of the motion over that of the demonstration (see
    `dimensionless_jerk`): below one, it is smoother."""
    turn_rmse: Float[Tensor, " demos"] | None = None
    """Root mean square angle between orientations [deg]."""
    turn_at_goal: Float[Tensor, " demos"] | None = None
    """Angle between the last orientations [deg]."""

    def columns(self) -> dict[str, Float[Tensor, " demos"]]:
        """The measures there are, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}

    def summary(self, prefix: str) -> dict[str, float]:
        """Median and maximum of each, by name."""
        figures = {}
        for name, values in self.columns().items():
            figures[f"{prefix}_{name}_median"] = float(values.quantile(0.5))
            figures[f"{prefix}_{name}_max"] = float(values.max())
        return figures


def reproduction_error(channel: str, motions: Motions, made: Reproduction) -> ReproductionError:
    """Compare motions with the demonstrations they are of.

    Args:
        channel: What they are motions of.
        motions: The demonstrations.
        made: At their stamps.
    """
    measures: dict[str, Tensor] = {}
    mask, last = motions.demos.mask, (motions.demos.length - 1)[:, None]
    if made.position is not None:
        measures |= _linear(motions, motions.column(CHANNELS[channel][0]), made.position)
    if made.orientation is not None:
        shown = motions.column("orientation")
        angle = quaternion.angle(made.orientation, shown).rad2deg()
        square = torch.where(mask, angle, 0.0).square().sum(dim=-1)
        measures["turn_rmse"] = (square / mask.sum(dim=-1)).sqrt()
        measures["turn_at_goal"] = angle.take_along_dim(last, dim=1)[:, 0]
    return ReproductionError(**measures)


def _linear(motions: Motions, shown: Tensor, made: Tensor) -> dict[str, Tensor]:
    mask, length = motions.demos.mask, motions.demos.length
    error = torch.where(mask[..., None], made - shown, 0.0)
    samples = mask.sum(dim=-1) * shown.shape[-1]
    low = torch.where(mask[..., None], shown, torch.inf).amin(dim=-2)
    high = torch.where(mask[..., None], shown, -torch.inf).amax(dim=-2)
    rmse = (error.square().sum(dim=(-2, -1)) / samples).sqrt()
    time = motions.demos.time
    jerk = [
        dimensionless_jerk(time[i, :n], made[i, :n])
        / dimensionless_jerk(time[i, :n], shown[i, :n])
        for i, n in enumerate(length.tolist())
    ]
    return {
        "nrmse": rmse / (high - low).amax(dim=-1).clamp_min(1e-12),
        "largest": error.abs().amax(dim=(-2, -1)),
        "goal_error": error.take_along_dim((length - 1)[:, None, None], dim=1)[:, 0].norm(
            dim=-1
        ),
        "jerk": torch.stack(jerk),
    }


def dimensionless_jerk(
    time: Float[Tensor, "T"], position: Float[Tensor, "T D"]
) -> Float[Tensor, ""]:
    """Integral of the squared jerk, times duration^5 / length^2 of the path.

    Neither units, nor speed, nor size change it (Hogan and Sternad 2009, "Sensitivity of
    smoothness measures to movement duration, amplitude, and arrests"). By differences of
    samples, so noise counts.
    """
    values = position
    for _ in range(3):
        values = torch.gradient(values, spacing=(time,), dim=0)[0]
    duration = time[-1] - time[0]
    length = position.diff(dim=0).norm(dim=-1).sum().clamp_min(1e-12)
    square = torch.trapezoid(values.square().sum(dim=-1), time)
    return square * duration**5 / length**2
