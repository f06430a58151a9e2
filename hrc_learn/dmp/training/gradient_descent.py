"""Gradient descent that keeps its best state and knows when to stop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

type Progress = Callable[[int, float], None]
"""Called after each step with its number, from 0, and the best criterion so far."""


@dataclass(frozen=True, kw_only=True)
class DescentConfig:
    """When to go how far, and when to stop."""

    steps: int = 500
    """At most."""
    learning_rate: float = 0.03
    """Of Adam, at first."""
    patience: int = 25
    """Steps without progress after which the rate is halved, from the best state on."""
    halvings: int = 4
    """So many; the next time there is no progress, training stops."""
    tolerance: float = 1e-3
    """Share of the criterion that counts as progress."""

    def __post_init__(self):
        if self.steps < 1 or self.patience < 1 or self.halvings < 0:
            raise ValueError(
                f"needs steps and patience of 1 or more and halvings of 0 or more, got "
                f"{self.steps}, {self.patience}, {self.halvings}"
            )
        if not self.learning_rate > 0 or not 0 <= self.tolerance < 1:
            raise ValueError(
                f"needs a positive learning_rate and a tolerance from 0 to 1, got "
                f"{self.learning_rate}, {self.tolerance}"
            )


@dataclass
class History:
    """What happened, step by step."""

    loss: list[float] = field(default_factory=list)
    criterion: list[float] = field(default_factory=list)
    """What decides: the loss, or what was held out."""
    learning_rate: list[float] = field(default_factory=list)
    best_step: int = 0
    """Whose state was kept."""
    converged: bool = False
    """Whether progress had ended, and not the steps."""

    @property
    def best(self) -> float:
        """Smallest criterion."""
        return self.criterion[self.best_step]


def descend(
    parameters: Sequence[Float[Tensor, "..."]],
    objective: Callable[[], tuple[Tensor, Tensor]],
    config: DescentConfig,
    progress: Progress | None = None,
) -> History:
    """Minimise by Adam, halving its rate on every plateau, and leave the best state behind.

    Args:
        parameters: Leaves that are changed in place.
        objective: Loss to go down, and criterion to judge by, of the parameters as they are.
        config: How far and how long.
        progress: Told about every step.

    Raises:
        ValueError: The loss is not finite at the start.
    """
    history = History()
    best, since, halvings = [p.detach().clone() for p in parameters], 0, 0
    optimizer = torch.optim.Adam(parameters, config.learning_rate)
    for step in range(config.steps):
        optimizer.zero_grad()
        loss, criterion = objective()
        history.loss.append(loss.item())
        history.criterion.append(criterion.item())
        history.learning_rate.append(optimizer.param_groups[0]["lr"])
        if step == 0 and not loss.isfinite():
            raise ValueError(f"the loss is {loss.item()} before anything was learned")
        # A comparison with NaN is false: a step too far is no progress either.
        if step == 0 or criterion.item() < (1 - config.tolerance) * history.best:
            history.best_step, since = step, 0
            best = [p.detach().clone() for p in parameters]
        else:
            since += 1
        if progress is not None:
            progress(step, history.best)
        if since < config.patience and loss.isfinite():
            loss.backward()
            optimizer.step()
            continue
        if halvings == config.halvings:
            history.converged = True
            break
        halvings, since = halvings + 1, 0
        _put(parameters, best)
        optimizer = torch.optim.Adam(parameters, optimizer.param_groups[0]["lr"] / 2)
    _put(parameters, best)
    return history


def _put(parameters: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    with torch.no_grad():
        for parameter, value in zip(parameters, values, strict=True):
            parameter.copy_(value)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingResult[Primitive]:
    """A trained primitive and how it came about."""

    dmp: Primitive
    """The best one; the primitive it was made from is as it was."""
    history: History
