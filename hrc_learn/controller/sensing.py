"""What of an observation can be trusted, and what stands in for the rest."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.goals import Goals
from hrc_learn.controller.interface import Observation


def trusted_position(
    observation: Observation, expected: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Joint position [rad]: measured, or the expected one where that is NaN or stale.

    Returns:
        The position, and where it is the expected one.
    """
    q = observation.joint_position
    stale = ~q.isfinite().all(-1)
    if observation.joint_state_stale is not None:
        stale = stale | observation.joint_state_stale
    return torch.where(stale.unsqueeze(-1), expected, q), stale


def effective_goals(
    observation: Observation, default: Goals
) -> tuple[Goals, Bool[Tensor, "*batch"] | bool]:
    """Goals of this step, and whether the target is known: one that is NaN is not."""
    goals = default if observation.goals is None else observation.goals
    target = observation.target
    if target is None:
        return goals, True
    known = target.isfinite().all(-1)
    target = torch.where(known.unsqueeze(-1), target, goals.vision.target)
    return goals.aimed_at(target), known


def either(
    a: Bool[Tensor, "*batch"] | None, b: Bool[Tensor, "*batch"] | None
) -> Bool[Tensor, "*batch"] | None:
    """Whether one of two optional conditions holds."""
    if a is None or b is None:
        return b if a is None else a
    return a | b
