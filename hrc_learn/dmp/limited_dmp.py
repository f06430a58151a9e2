"""Movement primitive of joints that cannot leave their limits.

    q = lower + beta (softplus((x - lower) / beta) - softplus((x - upper) / beta))

q lies between its limits for every x. Far from them, beyond a few times the softness beta, q
is x; close to them it is logistic. The idea of driving a transformed state that cannot leave
the limits is that of Duan et al. 2018, "Constrained DMPs for feasible skill learning on
humanoid robots"; this transformation leaves the middle of the range as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.closed_loop import DMPState
from hrc_learn.dmp.fitting.motion_samples import FitReport, check_samples, demo_label
from hrc_learn.dmp.fitting.solvers import FitOptions
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.storage import SavedModel, write_model

CLOSEST = 1e-6
"""How close to a limit a joint comes, in units of the softness."""


@dataclass(frozen=True, eq=False)
class SoftLimits:
    """Limits of D joints, and how they are approached; all in the units of the joints."""

    lower: Float[Tensor, "D"]
    upper: Float[Tensor, "D"]
    softness: Float[Tensor, "D"]
    """Beta: a few of it from a limit, a motion begins to feel it."""

    def constrain(self, x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """Q of x."""
        lower, upper, beta = self._like(x)
        a, b = (x - lower) / beta, (x - upper) / beta
        # From the nearer limit: a difference of two large numbers would round past it.
        above = lower + beta * (_softplus(a) - _softplus(b))
        below = upper - beta * (_softplus(-b) - _softplus(-a))
        return self.clamp(torch.where(a + b < 0, above, below))

    def release(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """X of q, which lies between the limits: the inverse of `constrain`."""
        lower, upper, beta = self._like(q)
        a, b = (q - lower) / beta, (upper - q) / beta
        # log(expm1(a)) = a + log(1 - exp(-a)), and neither side overflows.
        return q + beta * (torch.log(-torch.expm1(-a)) - torch.log(-torch.expm1(-b)))

    def clamp(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """The nearest q that an x leads to: between the limits, in any precision."""
        lower, upper, beta = self._like(q)
        rounding = 4 * torch.finfo(q.dtype).eps * torch.maximum(lower.abs(), upper.abs())
        room = torch.maximum(CLOSEST * beta, rounding)
        return torch.minimum(torch.maximum(q, lower + room), upper - room)

    def contain(self, q: Float[Tensor, "*batch D"]) -> Bool[Tensor, "*batch D"]:
        """Whether q lies between its limits."""
        lower, upper, _ = self._like(q)
        return (q > lower) & (q < upper)

    def _like(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.lower.to(x), self.upper.to(x), self.softness.to(x)


def _softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)), to rounding on both sides; twice differentiable as it is written."""
    return torch.logaddexp(x, torch.zeros_like(x))


torch.export.register_dataclass(SoftLimits, serialized_type_name="hrc_learn.dmp.SoftLimits")


class LimitedTrajectory:
    """A motion between limits, each output computed when first asked for."""

    def __init__(self, free: Trajectory, limits: SoftLimits):
        """Constrain a motion without bounds."""
        self._free = free
        self._limits = limits

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._free.time

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration."""
        return self._limits.constrain(self._free.position)

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """The same per second."""
        return self._velocity(self._free.position, self._free.velocity)

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        x, rate, curvature = self._free.position, self._free.velocity, self._free.acceleration
        return torch.func.jvp(self._velocity, (x, rate), (rate, curvature))[1]

    def _velocity(self, x: Tensor, rate: Tensor) -> Tensor:
        return torch.func.jvp(self._limits.constrain, (x,), (rate,))[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedState:
    """Where a primitive between limits is while it is stepped; a pytree."""

    motion: DMPState
    """Of the coordinates without bounds."""
    limits: SoftLimits

    @property
    def position(self) -> Float[Tensor, "*batch D"]:
        """In the units of the demonstration, always between the limits."""
        return self.limits.constrain(self.motion.position)

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Per second."""
        motion = self.motion
        rate = motion.velocity
        return torch.func.jvp(self.limits.constrain, (motion.position,), (rate,))[1]


torch.export.register_dataclass(LimitedState, serialized_type_name="hrc_learn.dmp.LimitedState")


TENSORS = ("lower", "upper", "softness")


class LimitedDMP(nn.Module):
    """Movement primitive in coordinates that cannot leave the joint limits.

    A `JointDMP` moves x, and q = constrain(x) lies between its limits whatever x is: for any
    goal, push or step. See `SoftLimits`.
    """

    lower: Tensor
    upper: Tensor
    softness: Tensor
    fit_report: FitReport | None
    """How well the fit reproduces its demonstrations, in joints."""

    def __init__(
        self,
        motion: JointDMP,
        lower: Float[Tensor, "D"],
        upper: Float[Tensor, "D"],
        softness: Float[Tensor, "D"],
        fit_report: FitReport | None = None,
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of the coordinates x.
            lower: Limits, in the units of the joints.
            upper: Limits.
            softness: A few of it from a limit, a motion begins to feel it.
            fit_report: Kept for the reader.

        Raises:
            ValueError: Limits that are not apart.
        """
        super().__init__()
        if not (lower < upper).all() or not (softness > 0).all():
            raise ValueError(
                f"limits must be lower < upper, and softness positive, got lower "
                f"{lower.tolist()}, upper {upper.tolist()}, softness {softness.tolist()}"
            )
        self.motion = motion
        for name, value in zip(TENSORS, (lower, upper, softness), strict=True):
            self.register_buffer(name, value)
        self.fit_report = fit_report

    @classmethod
    def fit(
        cls,
        time: ArrayLike,
        position: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        n_basis: int = 50,
        mask: ArrayLike | None = None,
        *,
        softness: float = 0.02,
        joint_names: Sequence[str] | None = None,
        **options: Unpack[FitOptions],
    ) -> "LimitedDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Stamps [s], (T,) or (*B, T).
            position: (*B, T, D), all of it between the limits.
            lower: Limits of the joints, (D,), in their units.
            upper: (D,).
            n_basis: N.
            mask: (*B, T), false where a sample does not count.
            softness: Share of the range of each joint; about five times as far from a limit,
                a motion begins to be slowed.
            joint_names: D names, kept with the primitive.
            options: As for `JointDMP.fit`.

        Raises:
            ValueError: Bad samples or limits, or samples beyond them; says which.
        """
        samples = check_samples(time, position, mask=mask)
        q = samples.columns
        low, high = (_limit(x, q) for x in (lower, upper))
        limits = SoftLimits(low, high, softness * (high - low))
        valid = samples.mask.reshape(q.shape[:-1])
        outside = valid[..., None] & ~limits.contain(q)
        if outside.any():
            flat = outside.reshape(-1, *outside.shape[-2:])
            i, k, j = flat.nonzero()[0].tolist()
            name = f"column {j}" if joint_names is None else joint_names[j]
            raise ValueError(
                f"{demo_label(i, samples.batch)}position of {name} at sample {k} is "
                f"{q.reshape(flat.shape)[i, k, j].item():.4f}, not between its limits "
                f"{low[j].item():.4f} and {high[j].item():.4f}"
            )
        inside = torch.where(valid[..., None], q, (low + high) / 2)
        motion = JointDMP.fit(
            time,
            limits.release(limits.clamp(inside)),
            n_basis,
            mask=mask,
            joint_names=joint_names,
            **options,
        )
        dmp = cls(motion, low, high, limits.softness)
        with torch.no_grad():
            reproduction = dmp.rollout().position.mT.reshape(samples.position.shape)
        dmp.fit_report = samples.compare(reproduction)
        return dmp

    @property
    def limits(self) -> SoftLimits:
        """What the motion stays between."""
        return SoftLimits(self.lower, self.upper, self.softness)

    @property
    def start(self) -> Float[Tensor, "*batch D"]:
        """Where the demonstration starts."""
        return self.limits.constrain(self.motion.start)

    @property
    def goal(self) -> Float[Tensor, "*batch D"]:
        """Where it ends."""
        return self.limits.constrain(self.motion.goal)

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.motion.duration

    def rollout(
        self,
        time: ArrayLike | None = None,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> LimitedTrajectory:
        """Motion from start to goal, between the limits; arguments as in `JointDMP.rollout`.

        A goal beyond a limit is taken to the nearest place within.

        Raises:
            ValueError: A start that is not between the limits.
        """
        ends = self._ends(start, goal, start_velocity)
        free = self.motion.rollout(time, duration=duration, speed=speed, **ends)
        return LimitedTrajectory(free, self.limits)

    def initial_state(
        self,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> LimitedState:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        ends = self._ends(start, goal, start_velocity)
        motion = self.motion.initial_state(duration=duration, speed=speed, **ends)
        # Copies: an export takes a buffer of the module for no input.
        limits = SoftLimits(self.lower.clone(), self.upper.clone(), self.softness.clone())
        return LimitedState(motion=motion, limits=limits)

    def step(
        self,
        state: LimitedState,
        dt: ArrayLike,
        *,
        goal: ArrayLike | None = None,
        coupling: ArrayLike | None = None,
        **influences: Any,
    ) -> LimitedState:
        """Advance by `dt`; arguments as in `JointDMP.step`.

        A coupling acts on the coordinates without bounds: as it is in the middle of the
        range, fading towards the limits.
        """
        if goal is not None:
            goal = self.limits.release(self.limits.clamp(self._as_tensor(goal)))
        motion = self.motion.step(state.motion, dt, goal=goal, coupling=coupling, **influences)
        return replace(state, motion=motion)

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        own = {f"limits.{name}": getattr(self, name) for name in TENSORS}
        write_model(
            folder, "LimitedDMP", self.motion.config(), {**own, **self.motion.tensors()}
        )

    @classmethod
    def load(cls, folder: str | Path) -> "LimitedDMP":
        """Read what `save` wrote; complains as `JointDMP.load`."""
        saved = SavedModel(folder, "LimitedDMP")
        lower, upper, softness = (saved.tensor(f"limits.{name}") for name in TENSORS)
        try:
            return cls(JointDMP.restore(saved), lower, upper, softness)
        except ValueError as error:
            raise saved.invalid(error) from None

    def _ends(
        self, start: ArrayLike | None, goal: ArrayLike | None, velocity: ArrayLike | None
    ) -> dict[str, Tensor]:
        """Start, goal and start velocity of the coordinates without bounds."""
        limits, ends = self.limits, {}
        q = self.start if start is None else self._as_tensor(start)
        if start is not None:
            if not limits.contain(q).all():
                raise ValueError(f"start {q.tolist()} is not between the limits")
            ends["start"] = limits.release(limits.clamp(q))
        if goal is not None:
            ends["goal"] = limits.release(limits.clamp(self._as_tensor(goal)))
        if velocity is not None:
            q, rate = torch.broadcast_tensors(q, self._as_tensor(velocity))
            q = limits.clamp(q)
            ends["start_velocity"] = torch.func.jvp(limits.release, (q,), (rate,))[1]
        return ends

    def _as_tensor(self, value: ArrayLike) -> Tensor:
        return to_tensor(value, self.lower.dtype, self.lower.device)


def _limit(value: ArrayLike, like: Tensor) -> Tensor:
    """Of every joint, (D,)."""
    return to_tensor(value, like.dtype, like.device).expand(like.shape[-1]).clone()
