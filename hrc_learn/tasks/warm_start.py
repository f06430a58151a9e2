"""What a learned image Jacobian is worth: closed loops that start from it, and from a guess."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..controller import ControllerConfig
from ..jacobian import (
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
)
from .closed_loops import ClosedLoops, turn_rows
from .initial_jacobian import guessed_network


class _Turned(KalmanEstimator):
    """Starts from a learned Jacobian, as seen by cameras that are turned.

    A learned Jacobian turns along exactly, as would one learned from the turned camera.
    """

    def __init__(self, network: RBFImageJacobian, roll: Float[Tensor, " starts"]):
        super().__init__(network)
        self._turn = turn_rows(roll)

    def initial_weight(self, *batch: int) -> Float[Tensor, "*batch 12 K"]:
        rows = super().initial_weight(*batch).unflatten(-2, (2, 6))
        return torch.einsum("nij,njck->nick", self._turn, rows).flatten(1, 2)


def compare_starts(
    network: RBFImageJacobian,
    loops: ClosedLoops,
    control: ControllerConfig | None = None,
    on_run: Callable[[str], None] = lambda name: None,
) -> dict[str, float]:
    """Time to bring the marker to its target [s], from what was learned and from a guess.

    Args:
        network: Learned from demonstrations of the camera.
        loops: What is run.
        control: Gains, the same for all.
        on_run: Told the name of each run as it begins.

    Returns:
        For `learned`, `guessed` (the paper's initial Jacobian, adapted alike) and `fixed`
        (the same, not adapted): median and 95th percentile of the time, and the share that
        got there. `speed_up_over_guessed` and `speed_up_over_fixed` are medians of the other
        time over that of the learned one, start by start; infinite where most of the others
        never get there.
    """
    guessed = guessed_network()
    estimators: dict[str, ImageJacobianEstimator] = {
        "learned": _Turned(network.double(), loops.camera.roll),
        "guessed": KalmanEstimator(guessed),
        "fixed": FixedEstimator(guessed),
    }
    times, figures = {}, {}
    for name, estimator in estimators.items():
        on_run(name)
        times[name] = loops.times(estimator, control)
        figures |= {f"{name}_{k}": v for k, v in summary(times[name]).items()}
    for name in ("guessed", "fixed"):
        # Where neither gets there, neither is faster.
        ratio = (times[name] / times["learned"]).nan_to_num(nan=1.0, posinf=math.inf)
        figures[f"speed_up_over_{name}"] = float(ratio.quantile(0.5, interpolation="lower"))
    return figures


def summary(times: Float[Tensor, " starts"]) -> dict[str, float]:
    """Quantiles where infinity, for never, is a time like any other."""
    return {
        "t50": float(times.quantile(0.5, interpolation="higher")),
        "t95": float(times.quantile(0.95, interpolation="higher")),
        "converged": float(times.isfinite().double().mean()),
    }
