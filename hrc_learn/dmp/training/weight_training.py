"""Gradient descent that knows when to stop, and the weights of a primitive trained by it."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.training.trajectory_losses import Loss

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
        # Anew from the best state: the moments of Adam belong to where it has been since.
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


LEARNABLE = ("weights", "goal")
SAMPLES_PER_FUNCTION = 4
"""Times at which acceleration is measured: two at least between neighbouring centres."""
NEGLIGIBLE = 1e-6
"""Directions that accelerate the motion by less than this, relative to the strongest, do not
count."""

type Arguments = Mapping[str, Any]
"""Of `rollout`."""
type Condition = Arguments | Callable[[torch.Generator], Arguments]
"""Fixed arguments of `rollout`, or new ones for every step."""


def train[P: nn.Module](
    dmp: P,
    loss: Loss | Callable[[Any], Tensor],
    config: DescentConfig | None = None,
    *,
    learn: Sequence[str] = ("weights",),
    condition: Condition | None = None,
    held_out: Sequence[Arguments] = (),
    hold_end: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> TrainingResult[P]:
    """Change the weights of a primitive until its motions have a small loss.

    The steps are taken in directions of equal mean squared acceleration (the metric of CHOMP,
    Zucker et al. 2013), relative to that of the demonstration: the path gives way as a whole
    and stays smooth. Start and start velocity stay as they are.

    Args:
        dmp: Joint, orientation or pose primitive, or a batch; left as it is.
        loss: Of a trajectory, one number per motion; see `trajectory_losses.py`.
        config: How far and how long.
        learn: `"weights"`, and `"goal"` of a joint primitive.
        condition: Arguments of `rollout` to train for, or what makes new ones of a generator
            for every step; None: the demonstrated motion.
        held_out: Conditions whose mean loss decides what is best and when to stop; without
            any, the training loss does.
        hold_end: Keep position and velocity at the end of the duration, exactly.
        seed: Of the generator.
        progress: Called after each step with its number and the best criterion.

    Raises:
        ValueError: Unknown names, nothing to learn, or a loss that is not finite.
    """
    config = config or DescentConfig()
    parts = _parts(dmp, learn, hold_end)
    rng = torch.Generator().manual_seed(seed)
    rolled = _Rollout(dmp)

    def mean_loss(arguments: Arguments) -> Tensor:
        tensors = {name: part() for name, part in parts.items()}
        motion = torch.func.functional_call(rolled, tensors, (), dict(arguments))
        return torch.as_tensor(loss(motion)).mean()

    def objective() -> tuple[Tensor, Tensor]:
        arguments = condition(rng) if callable(condition) else condition or {}
        value = mean_loss(arguments)
        if not held_out:
            return value, value
        with torch.no_grad():
            return value, torch.stack([mean_loss(x) for x in held_out]).mean()

    history = descend([part.shift for part in parts.values()], objective, config, progress)
    trained = _copy(dmp)
    tensors = dict(trained.named_parameters()) | dict(trained.named_buffers())
    with torch.no_grad():
        for name, part in parts.items():
            tensors[name.removeprefix("dmp.")].copy_(part())
    return TrainingResult(dmp=trained, history=history)


class _Rollout(nn.Module):
    """Makes `rollout` what `torch.func.functional_call` calls."""

    def __init__(self, dmp: nn.Module):
        super().__init__()
        self.dmp = dmp

    def forward(self, **arguments: Any) -> Any:
        return self.dmp.rollout(**arguments)  # pyright: ignore[reportCallIssue]


class _Shifted(nn.Module):
    """A tensor as it was, plus a shift along some directions."""

    def __init__(self, value: Float[Tensor, "*batch n"], directions: Float[Tensor, "k n"]):
        super().__init__()
        self.value, self.directions = value.detach(), directions.to(value)
        self.shift = nn.Parameter(self.value.new_zeros(*value.shape[:-1], len(directions)))

    def forward(self) -> Float[Tensor, "*batch n"]:
        return self.value + self.shift @ self.directions


def _parts(dmp: nn.Module, learn: Sequence[str], hold_end: bool) -> dict[str, _Shifted]:
    """What is learned, by its name in `_Rollout`."""
    check_learnable(learn, LEARNABLE)
    joint = isinstance(dmp, JointDMP)
    motion = dmp if joint else getattr(dmp, "motion", None)
    if not isinstance(motion, JointDMP):
        raise ValueError(f"{type(dmp).__name__} has no weights that could be trained")
    parts = {}
    if "weights" in learn:
        directions = weight_directions(motion, hold_end)
        parts["dmp.weights" if joint else "dmp.motion.weights"] = _Shifted(
            motion.weights, directions
        )
    if "goal" in learn:
        if not joint:
            raise ValueError("a goal can be learned of joint primitives only: it must add up")
        unit = motion.amplitude.amax() * torch.eye(motion.goal.shape[-1])
        parts["dmp.goal"] = _Shifted(motion.goal, unit)
    return parts


def check_learnable(learn: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError unless something is to be learned, and nothing unknown."""
    if set(learn) - set(known) or not learn:
        raise ValueError(
            f"learn must name some of {', '.join(known)}, got {', '.join(learn) or 'none'}"
        )


def weight_directions(motion: JointDMP, hold_end: bool) -> Float[Tensor, "K N"]:
    """Changes of the weights of a coordinate that accelerate it alike, independently.

    Each changes y'' by as much, in the mean square, as the demonstrated motion has most.

    Args:
        motion: Whose weights they are for.
        hold_end: Only those that leave y(1) and y'(1) as they are.
    """
    N, response = motion.basis.count, motion.response
    s = torch.linspace(0, 1, SAMPLES_PER_FUNCTION * N, dtype=torch.float64)
    H = response.evaluate(s)
    free = torch.eye(N, dtype=torch.float64)
    # Weights act through what fades them: late ones are the larger.
    unit = 1 / H[:, 2, :N].norm(dim=0)
    if hold_end:
        ends = H[-1, :2, :N] * unit
        free = torch.linalg.svd(ends).Vh[2:].mT
    _, sigma, Vh = torch.linalg.svd(H[:, 2, :N] * unit @ free, full_matrices=False)
    kept = sigma > NEGLIGIBLE * sigma[0]
    directions = (Vh[kept] / sigma[kept, None]) @ free.mT * unit * len(s) ** 0.5
    with torch.no_grad():
        acceleration = motion.rollout(s, duration=1.0).acceleration.double()
    strongest = acceleration.square().mean(-2).amax().sqrt()
    # A motion that rests sets no measure: one that moves on would accelerate by about 6.
    return directions * torch.where(strongest > 0, strongest, 6.0).item()


def _copy[P: nn.Module](dmp: P) -> P:
    """A primitive of its own, but for the response, which all alike share."""
    shared = {id(m.response): m.response for m in dmp.modules() if isinstance(m, JointDMP)}
    return copy.deepcopy(dmp, shared)
