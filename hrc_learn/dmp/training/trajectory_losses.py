"""What a motion can be asked to do, as functions of a trajectory that add up.

    loss = Tracking(path, task=tool) + 1e-4 * Jerk() + 10.0 * Clearance([ball], task=tool)

Each gives one number per motion, the mean over its samples. A `task` maps positions (*batch,
T, D) to what matters, (*batch, T, K): the tool's place by the forward kinematics of an arm,
(*batch, T, P, 3) for P points on it; None takes the positions themselves.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Vectors, to_tensor
from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.geometry.numerics import safe_norm


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A ball."""

    centre: tuple[float, float, float]
    """[m]."""
    radius: float
    """[m]."""

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """From its surface [m], negative inside."""
        centre = torch.tensor(self.centre, dtype=points.dtype, device=points.device)
        return safe_norm(points - centre) - self.radius


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box along the axes."""

    centre: tuple[float, float, float]
    """[m]."""
    half_size: tuple[float, float, float]
    """[m]."""

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """From its surface [m], negative inside."""
        centre, half = (
            torch.tensor(x, dtype=points.dtype, device=points.device)
            for x in (self.centre, self.half_size)
        )
        beyond = (points - centre).abs() - half
        # Outside, to the nearest corner, edge or face; inside, to the nearest face.
        return safe_norm(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)


type Obstacle = Sphere | Box


type Task = Callable[[Tensor], Tensor]
DERIVATIVES = ("position", "velocity", "acceleration")


class Loss(ABC):
    """A function of a trajectory; losses add up, and are multiplied by numbers."""

    @abstractmethod
    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """One number per motion, the smaller the better."""

    def __add__(self, other: "Loss") -> "Loss":
        return Sum((*_terms(self), *_terms(other)))

    def __rmul__(self, factor: float | int) -> "Loss":
        return Sum(tuple((factor * weight, term) for weight, term in _terms(self)))


@dataclass(frozen=True)
class Sum(Loss):
    """Weighted sum."""

    terms: tuple[tuple[float | int, Loss], ...]

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """The sum."""
        return sum(weight * term(motion) for weight, term in self.terms)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True, eq=False)
class Tracking(Loss):
    """Mean squared distance to a wanted path."""

    wanted: Points
    """(T, K) or (*batch, T, K), at the times of the rollout."""
    task: Task | None = None

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """In squared units of the path."""
        there = _apply(self.task, motion.position)
        wanted = _fixed(self.wanted, there)
        if wanted.shape[-2:] != there.shape[-2:]:
            raise ValueError(
                f"the wanted path has shape {tuple(wanted.shape)}, the rollout "
                f"{tuple(there.shape)}: one row is needed for each of its times"
            )
        return (there - wanted).square().sum(-1).mean(-1)


@dataclass(frozen=True, eq=False)
class Via(Loss):
    """Squared distance to a point at one time."""

    target: Vectors
    """(K,) or (*batch, K)."""
    time: float | int | None = None
    """[s], between samples by a straight line; None: the last of the rollout."""
    task: Task | None = None

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """In squared units of the target."""
        there = _apply(self.task, self._position(motion))[..., 0, :]
        return (there - _fixed(self.target, there)).square().sum(-1)

    def _position(self, motion: Trajectory) -> Float[Tensor, "*batch 1 D"]:
        if self.time is None:
            return motion.position[..., -1:, :]
        t = motion.time.detach().contiguous()
        at = torch.full_like(t[..., :1], self.time)
        if (at < t[..., :1]).any() or (at > t[..., -1:]).any():
            raise ValueError(
                f"a via point at {self.time} s is outside the rollout, which lasts from "
                f"{t.min().item():.3f} s to {t.max().item():.3f} s"
            )
        after = torch.searchsorted(t, at).clamp(1, t.shape[-1] - 1)
        before_t, after_t = t.gather(-1, after - 1), t.gather(-1, after)
        share = ((at - before_t) / (after_t - before_t))[..., None]
        columns = after[..., None].expand(*after.shape, motion.position.shape[-1])
        before, following = (motion.position.gather(-2, columns + k) for k in (-1, 0))
        return before + share * (following - before)


@dataclass(frozen=True)
class Jerk(Loss):
    """Mean squared third derivative."""

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """Per s^6 of the squared unit of the motion."""
        jerk = motion.acceleration.diff(dim=-2) / motion.time.diff(dim=-1)[..., None]
        return jerk.square().sum(-1).mean(-1)


@dataclass(frozen=True, eq=False)
class Bounds(Loss):
    """Mean squared excess over bounds, such as the limits of joints, in parts of their span."""

    lower: Vectors
    """(D,)."""
    upper: Vectors
    """(D,)."""
    margin: float = 0.0
    """How far inside the bounds the motion shall stay, as a share of their span."""
    of: str = "position"
    """What is bounded: `"position"`, `"velocity"` or `"acceleration"`."""

    def __post_init__(self):
        if self.of not in DERIVATIVES:
            raise ValueError(
                f"bounds are of {', '.join(DERIVATIVES)}, there is no {self.of!r} to bound"
            )

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """Without unit."""
        values = getattr(motion, self.of)
        lower, upper = _fixed(self.lower, values), _fixed(self.upper, values)
        share = (values - lower) / (upper - lower)
        excess = torch.maximum(self.margin - share, share - (1 - self.margin)).clamp_min(0)
        return excess.square().sum(-1).mean(-1)


@dataclass(frozen=True, eq=False)
class Clearance(Loss):
    """Mean squared depth of penetration into a margin around obstacles."""

    obstacles: Sequence[Obstacle]
    margin: float = 0.02
    """How far from their surfaces the motion shall stay [m]."""
    task: Task | None = None

    def __call__(self, motion: Trajectory) -> Float[Tensor, "*batch"]:
        """[m^2]."""
        points = _apply(self.task, motion.position)
        distance = torch.stack([o.distance(points) for o in self.obstacles], dim=-1)
        depth = (self.margin - distance).clamp_min(0).square()
        return depth.flatten(motion.time.ndim).sum(-1).mean(-1)


def _apply(task: Task | None, position: Tensor) -> Tensor:
    return position if task is None else task(position)


def _fixed(values: Points | Vectors, like: Tensor) -> Tensor:
    # Detached: it may come from a rollout, whose graph serves one step only.
    return to_tensor(values, like.dtype, like.device).detach()


def _terms(loss: Loss) -> tuple[tuple[float | int, Loss], ...]:
    return loss.terms if isinstance(loss, Sum) else ((1.0, loss),)
