"""Movement primitive of joints that cannot leave their limits.

    q = lower + beta (softplus((x - lower) / beta) - softplus((x - upper) / beta))

q lies between its limits for every x. Far from them, beyond a few times the softness beta, q
is x; close to them it is logistic. The idea of driving a transformed state that cannot leave
the limits is that of Duan et al. 2018, "Constrained DMPs for feasible skill learning on
humanoid robots"; this transformation leaves the middle of the range as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp._arguments import (
    FitReport,
    Mask,
    Points,
    Scalars,
    Times,
    Vectors,
    check_samples,
    demo_label,
    finite,
    to_tensor,
)
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import FitOptions
from hrc_learn.dmp._system.response import ArrayOutputs, Trajectory
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.joint_dmp import JointDMP, points_as_given
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.model_files import SavedModel

TENSORS = ("lower", "upper", "softness")
CLOSEST = 1e-6
"""How close to a limit a joint comes, in units of the softness: 14 of it in coordinates without
bounds, from where a goal still pulls back within the motion."""


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

    def constrain_rate(
        self, x: Float[Tensor, "*#batch D"], rate: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """Rate of q, from x and its rate."""
        return torch.func.jvp(self.constrain, (x,), (rate,))[1]

    def release(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """X of q, which lies between the limits: the inverse of `constrain`."""
        lower, upper, beta = self._like(q)
        a, b = (q - lower) / beta, (upper - q) / beta
        # log(expm1(a)) = a + log(1 - exp(-a)), and neither side overflows.
        return q + beta * (torch.log(-torch.expm1(-a)) - torch.log(-torch.expm1(-b)))

    def clamp(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D"]:
        """The nearest q that an x leads to: between the limits, in any precision."""
        lower, upper, beta = self._like(q)
        # A few roundings of the limits: nearer, q could not be told from them.
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


class LimitedTrajectory(ArrayOutputs):
    """A motion between limits, each output computed when first asked for."""

    outputs = Trajectory.outputs

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
        return self._limits.constrain_rate(self._free.position, self._free.velocity)

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        x, rate, curvature = self._free.position, self._free.velocity, self._free.acceleration
        return torch.func.jvp(self._limits.constrain_rate, (x, rate), (rate, curvature))[1]


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
        return self.limits.constrain_rate(self.motion.position, self.motion.velocity)


torch.export.register_dataclass(LimitedState, serialized_type_name="hrc_learn.dmp.LimitedState")


@dataclass(frozen=True, eq=False)
class LimitedCoordinates(CoordinateAdapter[Vectors, LimitedTrajectory, LimitedState]):
    """Coordinates without bounds for joints that have them; the frame are the limits."""

    limits: SoftLimits

    def ends(
        self, motion: LinearPrimitive, given: Ends, duration: Tensor
    ) -> tuple[Ends, SoftLimits]:
        """Released from the limits; a goal beyond one is taken to the nearest place within.

        Raises:
            ValueError: A start that is not between the limits.
        """
        limits, (start, goal, velocity) = self.limits, given
        q = limits.constrain(motion.start) if start is None else self._as_tensor(start)
        x = None
        if start is not None:
            if not limits.contain(q).all():
                raise ValueError(f"start {q.tolist()} is not between the limits")
            x = limits.release(limits.clamp(q))
        rate = None
        if velocity is not None:
            q, joint_rate = torch.broadcast_tensors(q, self._as_tensor(velocity))
            rate = torch.func.jvp(limits.release, (limits.clamp(q),), (joint_rate,))[1]
        return Ends(x, None if goal is None else self._released(goal), rate), limits

    def trajectory(self, columns: Trajectory, frame: SoftLimits) -> LimitedTrajectory:
        """Joints along the columns."""
        return LimitedTrajectory(columns, frame)

    def begin(self, columns: DMPState, frame: SoftLimits) -> tuple[DMPState, SoftLimits]:
        """Copies of the limits: an export takes a buffer of the module for no input."""
        copies = (x.clone() for x in (frame.lower, frame.upper, frame.softness))
        return columns, SoftLimits(*copies)

    def state(self, columns: DMPState, frame: SoftLimits) -> LimitedState:
        """The columns with the limits."""
        return LimitedState(motion=columns, limits=frame)

    def columns(self, state: LimitedState) -> tuple[DMPState, SoftLimits]:
        """The columns and the limits."""
        return state.motion, state.limits

    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: SoftLimits,
        goal: Vectors | None,
    ) -> Retargeted:
        """The goal, or the nearest place within the limits."""
        return Retargeted(columns, frame, None if goal is None else self._released(goal))

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Points | None,
        velocity: Points | None,
    ) -> ColumnPoints:
        """Released from the limits, which via points have to lie between."""
        limits, (q, joint_rate) = self.limits, points_as_given(now, value, velocity)
        if (q.isfinite() & ~limits.contain(q)).any():
            raise ValueError(f"via point {q.tolist()} is not between the limits")
        there = limits.clamp(torch.where(q.isnan(), limits.constrain(now.position), q))
        released = torch.func.jvp(limits.release, (there,), (joint_rate.nan_to_num(),))
        return ColumnPoints(
            released[0].masked_fill(q.isnan(), torch.nan),
            released[1].masked_fill(joint_rate.isnan(), torch.nan),
        )

    def _released(self, goal: Vectors) -> Tensor:
        return self.limits.release(self.limits.clamp(finite("goal", self._as_tensor(goal))))

    def _as_tensor(self, value: Vectors) -> Tensor:
        return to_tensor(value, self.limits.lower.dtype, self.limits.lower.device)


class LimitedDMP(AdaptedPrimitive[Vectors, LimitedTrajectory, LimitedState]):
    """Movement primitive in coordinates that cannot leave the joint limits.

    A `JointDMP` moves x, and q = constrain(x) lies between its limits whatever x is: for any
    goal, push or step. See `SoftLimits`. Values are joints (*batch, D), velocities the same
    per second; a goal beyond a limit is taken to the nearest place within. A coupling acts on
    the coordinates without bounds: as it is in the middle of the range, fading towards the
    limits.
    """

    lower: Tensor
    upper: Tensor
    softness: Tensor
    motion: JointDMP
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
        time: Times,
        position: Points,
        lower: Vectors | Scalars,
        upper: Vectors | Scalars,
        n_basis: int | None = None,
        mask: Mask | None = None,
        *,
        softness: float = 0.02,
        joint_names: Sequence[str] | None = None,
        **options: Unpack[FitOptions],
    ) -> "LimitedDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
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

    @property
    def adapter(self) -> LimitedCoordinates:
        """Coordinates without bounds."""
        return LimitedCoordinates(self.limits)

    def with_motion[S: "LimitedDMP"](
        self: S, motion: JointDMP, frame: SoftLimits | None = None
    ) -> S:
        """Around another motion of the coordinates, within the same limits."""
        return type(self)(motion, self.lower, self.upper, self.softness)

    def _own_tensors(self) -> dict[str, Tensor]:
        return {f"limits.{name}": getattr(self, name) for name in TENSORS}

    @classmethod
    def _restored[S: "LimitedDMP"](cls: type[S], saved: SavedModel) -> S:
        lower, upper, softness = (saved.tensor(f"limits.{name}") for name in TENSORS)
        try:
            return cls(JointDMP.restore(saved), lower, upper, softness)
        except ValueError as error:
            raise saved.invalid(error) from None


def _limit(value: Vectors | Scalars, like: Tensor) -> Tensor:
    """Of every joint, (D,)."""
    return to_tensor(value, like.dtype, like.device).expand(like.shape[-1]).clone()
