"""Errors of reproduced motions against their demonstrations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import PaddedDemonstrations
from hrc_learn.demos.quality.ranking import log_dimensionless_jerk
from hrc_learn.geometry import quaternion


@dataclass(frozen=True, kw_only=True, eq=False)
class ReproductionError:
    """Errors of each demonstration; None if a measure does not apply to the channel."""

    nrmse: Float[Tensor, " demos"] | None = None
    """Root mean square error divided by the largest range of any coordinate."""
    largest: Float[Tensor, " demos"] | None = None
    """Largest error of any coordinate [rad] or [m]."""
    goal_error: Float[Tensor, " demos"] | None = None
    """Distance between the last samples [rad] or [m]."""
    jerk: Float[Tensor, " demos"] | None = None
    """Dimensionless jerk divided by the jerk of the demonstration; below 1: smoother."""
    turn_rmse: Float[Tensor, " demos"] | None = None
    """Root mean square angle between orientations [deg]."""
    turn_at_goal: Float[Tensor, " demos"] | None = None
    """Angle between the last orientations [deg]."""

    def columns(self) -> dict[str, Float[Tensor, " demos"]]:
        """Measures that apply, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}

    def summary(self, prefix: str) -> dict[str, float]:
        """Median and maximum of each measure, by name."""
        figures = {}
        for name, values in self.columns().items():
            figures[f"{prefix}_{name}_median"] = float(values.quantile(0.5))
            figures[f"{prefix}_{name}_max"] = float(values.max())
        return figures


@torch.no_grad()
def reproduction_error(
    demos: PaddedDemonstrations, column: str, made: Any
) -> ReproductionError:
    """Errors of reproductions.

    Args:
        demos: Demonstrations.
        column: Field of `demos` whose joint positions or positions were reproduced.
        made: Reproductions at the time stamps of the demonstrations, with a `position`, an
            `orientation` or both.
    """
    measures: dict[str, Tensor] = {}
    mask, last = demos.mask, (demos.length - 1)[:, None]
    if hasattr(made, "position"):
        measures |= _linear(demos, getattr(demos, column), made.position)
    if hasattr(made, "orientation"):
        assert demos.orientation is not None
        angle = quaternion.angle(made.orientation, demos.orientation).rad2deg()
        square = torch.where(mask, angle, 0.0).square().sum(dim=-1)
        measures["turn_rmse"] = (square / mask.sum(dim=-1)).sqrt()
        measures["turn_at_goal"] = angle.take_along_dim(last, dim=1)[:, 0]
    return ReproductionError(**measures)


def _linear(demos: PaddedDemonstrations, shown: Tensor, made: Tensor) -> dict[str, Tensor]:
    mask, last = demos.mask, (demos.length - 1)[:, None, None]
    error = torch.where(mask[..., None], made - shown, 0.0)
    samples = mask.sum(dim=-1) * shown.shape[-1]
    low = torch.where(mask[..., None], shown, torch.inf).amin(dim=-2)
    high = torch.where(mask[..., None], shown, -torch.inf).amax(dim=-2)
    rmse = (error.square().sum(dim=(-2, -1)) / samples).sqrt()
    rougher = [
        log_dimensionless_jerk(time[:n], x[:n]) - log_dimensionless_jerk(time[:n], y[:n])
        for time, n, x, y in zip(
            demos.time.double().numpy(),
            demos.length.tolist(),
            made.double().numpy(),
            shown.double().numpy(),
            strict=True,
        )
    ]
    return {
        "nrmse": rmse / (high - low).amax(dim=-1).clamp_min(1e-12),
        "largest": error.abs().amax(dim=(-2, -1)),
        "goal_error": error.take_along_dim(last, dim=1)[:, 0].norm(dim=-1),
        "jerk": torch.tensor(np.exp(rougher)).to(made),
    }
