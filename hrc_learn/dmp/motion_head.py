"""The last layer of a network that plans motions: it maps parameters to trajectories.

A head needs no demonstration. Its parameters are whitened, so that networks and searches see
numbers of similar size. If the parameters are independent and unit normal, motions deviate by a
given amplitude from the straight minimum-jerk path to the goal. The deviations are sums of
orthogonal modes, ordered from smooth to rough. The motion is linear in all parameters except
duration and delay, so a Gaussian over parameters is a Gaussian over motions. Its density,
divergence and samples have closed forms (Li et al. 2023, "ProDMP: A unified perspective on
dynamic and probabilistic movement primitives").
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import LowRankMultivariateNormal, kl_divergence

from hrc_learn.dmp._arguments import (
    FLOATING,
    Points,
    Scalars,
    Times,
    Vectors,
    check_not_negative,
    checked_vector,
    finite,
    full_precision,
    positive,
    readable,
    seconds,
    to_tensor,
)
from hrc_learn.dmp.dynamics import GaussianBasis, SpringDamper, balanced_units
from hrc_learn.dmp.probabilistic_dmp import gaussian
from hrc_learn.dmp.ragged_times import spring_rows
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.trajectory import ContinuedTrajectory, output

SAMPLES_PER_FUNCTION = 20
"""Samples per basis function at which the modes of a motion are computed."""
ENCODING_NOISE = 1e-4
"""Noise of samples that `encode` assumes, relative to the amplitude: far below the differences
between motions."""


class MotionHead(nn.Module):
    """Map from network parameters to a motion of D columns from any initial state.

    The P parameters begin with N whitened weights and the goal of each of the D columns in
    turn. The timing parameters follow: the duration if it has a range, and the delay if a delay
    is allowed. If all parameters are zero, the motion is the minimum-jerk motion to the centre
    of the goals. Its duration is then the geometric mean of the shortest and the longest
    duration, and its delay is half the longest delay.

    The map is differentiable in all arguments and takes any number of leading batch axes.
    """

    amplitude: Tensor
    """Root mean square deviation of each column for unit normal parameters, and standard
    deviation of its goal, (D,)."""
    goal_centre: Tensor | None
    """Centre of the goals, (D,); None: the start."""
    modes: Tensor
    """Weights of the modes, (N, N): one column for each mode, the smoothest first."""

    def __init__(
        self,
        columns: int,
        n_basis: int = 10,
        *,
        duration: float | tuple[float, float] = 1.0,
        delay: float = 0.0,
        amplitude: Vectors | float = 1.0,
        goal_centre: Vectors | None = None,
    ):
        """Compute the modes.

        Args:
            columns: Number D of columns.
            n_basis: Number N of basis functions.
            duration: Duration [s], or the range (shortest, longest) from which a parameter
                selects, on a logarithmic scale.
            delay: Longest delay before a motion [s]; 0: no delay, and no parameter for it.
            amplitude: Amplitude in the units of the columns, (D,) or one for all. It is the
                root mean square deviation over a motion for unit normal weights, and the
                standard deviation of the goal for a unit normal parameter.
            goal_centre: Centre of the goals, (D,); None: the start of each motion.

        Raises:
            ValueError: A duration, delay or amplitude of wrong sign, a wrong number of values,
                or no column.
        """
        super().__init__()
        low, high = duration if isinstance(duration, tuple) else (duration, duration)
        if not (columns > 0 and 0 < low <= high < math.inf and 0 <= delay < math.inf):
            raise ValueError(
                "columns and duration must be positive, with an ordered range, and delay not "
                f"negative; got {columns}, {duration} and {delay}"
            )
        self.columns = columns
        self.shortest, self.longest, self.latest = low, high, delay
        self.response = response_of(SpringDamper(), GaussianBasis(count=n_basis), 1.0)
        self.register_buffer("amplitude", _each_column(amplitude, columns))
        if goal_centre is not None:
            goal_centre = checked_vector("goal_centre", goal_centre, self.amplitude)
        self.register_buffer("goal_centre", goal_centre)
        modes = _modes(self.response).to(self.amplitude)
        self.register_buffer("modes", modes, persistent=False)

    @property
    def n_linear(self) -> int:
        """D (N + 1), the number of parameters in which the motion is linear."""
        return self.columns * (self.modes.shape[0] + 1)

    @property
    def n_timing(self) -> int:
        """Number of parameters of duration and delay: 0, 1 or 2."""
        return (self.longest > self.shortest) + (self.latest > 0)

    @property
    def n_parameters(self) -> int:
        """P, the number of outputs of a network."""
        return self.n_linear + self.n_timing

    def forward(
        self,
        parameters: Float[Tensor, "*batch P"],
        time: Times,
        start: Vectors,
        start_velocity: Vectors | None = None,
        *,
        since: Scalars | None = None,
        origin: Vectors | None = None,
    ) -> "PlannedTrajectory":
        """Motion from a given state.

        To plan again during a motion, call the head with new parameters and the current state;
        a new motion then begins. If `since` is given too, the motion continues from this state
        at its current phase, and ends when the first motion would have ended.

        Args:
            parameters: Parameters from a network.
            time: Time since the start [s], (T,) or (*batch, T). During the delay, the motion
                rests at its start.
            start: Start, or current position, (*batch, D).
            start_velocity: Velocity at the start [1/s], (*batch, D); zero by default.
            since: Time [s] of the current state, (*batch); `time` must not be earlier.
            origin: Start of the path to the goal, (*batch, D), only with `since`; `start` by
                default.

        Raises:
            ValueError: A wrong number of parameters or columns, or bad times.
        """
        plan = self._plan(parameters, start, start_velocity, since, origin)
        s, waiting = self._normalised(time, plan)
        return PlannedTrajectory(plan, s, waiting, self.response)

    def distribution(
        self,
        parameters: Float[Tensor, "*batch P"],
        scale_tril: Float[Tensor, "*#batch L L"],
        start: Vectors,
        start_velocity: Vectors | None = None,
        *,
        since: Scalars | None = None,
        origin: Vectors | None = None,
    ) -> "MotionDistribution":
        """Gaussian over motions; arguments as in `forward`.

        Args:
            parameters: Mean of the parameters.
            scale_tril: Cholesky factor of the covariance of the first L = D (N + 1) parameters.
                Duration and delay are known exactly.
            start: Start or current position, (*batch, D), known exactly.
            start_velocity: Velocity at the start [1/s], (*batch, D), known exactly.
            since: Time of the current state [s], (*batch).
            origin: Start of the path to the goal, (*batch, D).

        Raises:
            ValueError: A factor of the wrong size.
        """
        if scale_tril.shape[-2:] != (self.n_linear, self.n_linear):
            raise ValueError(
                f"scale_tril must have shape (..., {self.n_linear}, {self.n_linear}), got "
                f"{tuple(scale_tril.shape)}"
            )
        self._plan(parameters, start, start_velocity, since, origin)  # raises for bad arguments
        state = {"start": start, "start_velocity": start_velocity}
        state |= {"since": since, "origin": origin}
        return MotionDistribution(self, parameters, scale_tril, state)

    def timing(
        self, duration: Scalars | None = None, delay: Scalars | None = None
    ) -> Float[Tensor, "*batch n"]:
        """Timing parameters for durations and delays [s] strictly within their ranges.

        Raises:
            ValueError: A value for a fixed duration or delay, a missing value, or a value that
                is not strictly within its range.
        """
        found = []
        for name, value, low, high in (
            ("duration", duration, self.shortest, self.longest),
            ("delay", delay, 0.0, self.latest),
        ):
            if (value is not None) != (high > low):
                if value is None:
                    raise ValueError(f"{name} has a range in this head: give a value")
                raise ValueError(f"{name} has no range in this head: leave it out")
            if value is None:
                continue
            x = to_tensor(value, self.amplitude.dtype, self.amplitude.device)
            if readable(x) and not ((x > low) & (x < high)).all():
                raise ValueError(
                    f"{name} must lie strictly between {low} and {high}: its parameter is "
                    "infinite at the ends. Move the value inwards, or widen the range."
                )
            fraction = (x / low).log() / math.log(high / low) if low else x / high
            found.append(fraction.logit())
        if not found:
            return self.amplitude.new_empty(0)
        return torch.stack(torch.broadcast_tensors(*found), -1)

    @full_precision
    def encode(
        self,
        time: Times,
        position: Points,
        start_velocity: Vectors | None = None,
        *,
        timing: Float[Tensor, "*batch n"] | None = None,
        noise: float = ENCODING_NOISE,
    ) -> Float[Tensor, "*batch P"]:
        """Most likely parameters of recorded motions, as targets of a regression.

        Args:
            time: Time since the start [s], (T,) or (*batch, T).
            position: Positions from the start on, (*batch, T, D).
            start_velocity: Velocity at the start [1/s], (*batch, D).
            timing: Timing parameters as from `timing`; zeros by default.
            noise: Standard deviation of the samples relative to the amplitude. Parameters that
                the samples do not determine stay zero, the mean of their prior.
        """
        y = to_tensor(position, self.amplitude.dtype, self.amplitude.device)
        zeros = y.new_zeros(*y.shape[:-2], self.n_parameters)
        if timing is not None:
            zeros = torch.cat(
                [zeros[..., : self.n_linear], timing.expand(*y.shape[:-2], -1)], -1
            )
        positive("noise", noise, y)
        plan = self._plan(zeros, y[..., 0, :], start_velocity, None, None)
        s, waiting = self._normalised(time, plan)
        missing = y - PlannedTrajectory(plan, s, waiting, self.response).position
        # Each column in units of its noise; the prior has unit covariance.
        rows = self._rows(s, plan)[..., None, :, :] / noise
        missing = missing.mT.double() / (noise * self.amplitude.double())[:, None]
        normal = rows.mT @ rows + torch.eye(rows.shape[-1]).to(rows)
        z = torch.linalg.solve(normal, rows.mT @ missing[..., None])[..., 0]
        return torch.cat([z.flatten(-2).to(y), zeros[..., self.n_linear :]], -1)

    @full_precision
    def _plan(
        self,
        parameters: Tensor,
        start: Vectors,
        start_velocity: Vectors | None,
        since: Scalars | None,
        origin: Vectors | None,
    ) -> "_Plan":
        if parameters.shape[-1] != self.n_parameters:
            raise ValueError(
                f"parameters must have shape (..., {self.n_parameters}), got "
                f"{tuple(parameters.shape)}"
            )
        # Networks under autocast return half precision, which visibly distorts paths.
        if parameters.dtype not in FLOATING:
            parameters = to_tensor(parameters, self.amplitude.dtype, parameters.device)
        finite("parameters", parameters)
        linear = parameters[..., : self.n_linear].unflatten(-1, (self.columns, -1))
        like = linear[..., 0]
        first = start = checked_vector("start", start, like)
        velocity = torch.zeros_like(start)
        duration, delay = self._timing(parameters)
        if start_velocity is not None:
            velocity = checked_vector("start_velocity", start_velocity, like)
        if origin is not None:
            if since is None:
                raise ValueError("origin belongs to a motion that continues: give since too")
            first = checked_vector("origin", origin, like)
        scaled = linear * self.amplitude.to(linear)[:, None]
        centre = first if self.goal_centre is None else self.goal_centre.to(linear)
        goal = centre + scaled[..., -1]
        weights = scaled[..., :-1] @ self.modes.to(linear).mT
        rate = velocity * duration[..., None]
        begun = rate if since is None else torch.zeros_like(rate)
        ends = torch.broadcast_tensors(begun, first, goal)
        weights = weights.expand(*ends[0].shape, -1)
        x = torch.cat([weights, torch.stack(ends, -1)], -1)
        if since is None:
            return _Plan(x, duration, delay, start, velocity)
        now = to_tensor(since, torch.float64, x.device)
        check_not_negative("since", now)
        s = ((now - delay.double()) / duration.double()).clamp(min=0)
        return _Plan(x, duration, delay, start, velocity, s)

    def _timing(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Duration and delay [s], without a batch axis if they are fixed."""
        fraction = parameters[..., self.n_linear :].sigmoid()
        duration, delay = parameters.new_tensor([self.shortest, 0.0]).unbind()
        if self.longest > self.shortest:
            ratio = math.log(self.longest / self.shortest)
            duration = self.shortest * (ratio * fraction[..., 0]).exp()
        if self.latest > 0:
            delay = self.latest * fraction[..., -1]
        return duration, delay

    def _normalised(self, time: Times, plan: "_Plan") -> tuple[Tensor, Tensor | None]:
        """Normalised times since the end of the delay, and a mask of times during the delay."""
        time = seconds(time, plan.duration.device)
        s = (time - plan.delay.double()[..., None]) / plan.duration.double()[..., None]
        waiting = s < 0 if self.latest > 0 else None
        s = s if waiting is None else s.clamp(min=0)
        since = plan.since
        if since is not None and readable(s, since) and (s < since[..., None] - 1e-9).any():
            raise ValueError("the motion continues at `since`: no time may be before it")
        return s, waiting

    def _rows(self, s: Tensor, plan: "_Plan") -> Float[Tensor, "*batch T M"]:
        """Motion per unit of each whitened parameter of a column at times `s` (float64)."""
        H = self._by_mode(self.response.evaluate(s)[..., 0, :])
        if plan.since is None:
            return H
        # The state is given, so no parameter changes position or velocity at `since`.
        there = self._by_mode(self.response.evaluate(plan.since)[..., :2, :])
        back = spring_rows(self.response, s - plan.since[..., None], 0)
        return H - back @ there

    def _by_mode(self, H: Tensor) -> Tensor:
        N = self.modes.shape[0]
        return torch.cat([H[..., :N] @ self.modes.to(H), H[..., -1:]], -1)


class _Plan(NamedTuple):
    """Motion determined by parameters and a state."""

    coordinates: Float[Tensor, "*batch D M"]
    duration: Float[Tensor, "*#batch"]
    delay: Float[Tensor, "*#batch"]
    position: Float[Tensor, "*#batch D"]
    velocity: Float[Tensor, "*#batch D"]
    """Velocity at this position [1/s]."""
    since: Float[Tensor, "*#batch"] | None = None
    """Normalised time of the state; None at the start."""


class PlannedTrajectory(ContinuedTrajectory):
    """Motion that may have a delay, or continue from the state of another motion."""

    def __init__(
        self,
        plan: _Plan,
        s: Float[Tensor, "*#batch T"],
        waiting: Tensor | None,
        response: Response,
    ):
        """Describe the motion of a plan, at rest while `waiting`."""
        motion = plan._asdict()
        self.delay: Tensor = motion.pop("delay")
        """Delay before the motion begins [s]."""
        super().__init__(s=s, response=response, **motion)
        self._waiting = waiting

    @output
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start [s]; times during the delay become the end of the delay."""
        time = self.s * self.duration[..., None] + self.delay[..., None]
        return time.to(self._coordinates.dtype).expand(*self._batch, -1)

    @full_precision
    def _derivative(self, order: int) -> Float[Tensor, "*batch T D"]:
        y = super()._derivative(order)
        if order and self._waiting is not None:
            y = torch.where(self._waiting[..., None], 0.0, y)
        return y


@dataclass(frozen=True, eq=False)
class MotionDistribution:
    """Gaussian over the motions of a head, for Gaussian parameters and a known state."""

    head: MotionHead
    parameters: Float[Tensor, "*batch P"]
    """Mean of the parameters."""
    scale_tril: Float[Tensor, "*#batch L L"]
    """Cholesky factor of the covariance of the linear parameters."""
    state: dict[str, Any]
    """State arguments of `MotionHead.forward`, by name."""

    def mean(self, time: Times) -> PlannedTrajectory:
        """Mean motion at times [s]."""
        return self.head(self.parameters, time, **self.state)

    def rsample(
        self, shape: tuple[int, ...] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape_batch P"]:
        """Random parameters for `MotionHead.forward`; differentiable in mean and factor."""
        batch = torch.broadcast_shapes(self.parameters.shape[:-1], self.scale_tril.shape[:-2])
        L, like = self.head.n_linear, self.parameters
        # Drawn on the device of the generator, which may differ from that of the network.
        device = like.device if generator is None else generator.device
        noise = torch.randn(
            *shape, *batch, L, 1, generator=generator, dtype=like.dtype, device=device
        )
        change = (self.scale_tril @ noise.to(like.device))[..., 0]
        return like + torch.nn.functional.pad(change, (0, self.head.n_timing))

    def log_prob(self, time: Times, position: Points, noise: float) -> Float[Tensor, "*batch"]:
        """Log density of the positions of one motion observed with noise.

        Args:
            time: Times of the positions [s], (T,) or (*batch, T).
            position: Observed positions, (*batch, T, D).
            noise: Standard deviation of the noise, which is independent for each value.
        """
        known = self._observed(time, noise)
        y = to_tensor(position, known.loc.dtype, known.loc.device)
        return known.log_prob(y.flatten(-2))

    def position(self, time: Times) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation at times [s], (*batch, T, D) each."""
        mean, root = self._moments(time)
        return mean, root.norm(dim=-1)

    def kl(
        self, other: "MotionDistribution", time: Times, noise: float = 1e-3
    ) -> Float[Tensor, "*batch"]:
        """KL divergence KL(self || other) of positions observed with noise.

        Start, velocity and timing have no uncertainty. Owing to the noise, the divergence is
        finite even if they differ.

        Args:
            other: Distribution of motions with as many columns.
            time: Times at which motions are compared [s], (T,).
            noise: Standard deviation of each position.
        """
        return kl_divergence(self._observed(time, noise), other._observed(time, noise))

    def _observed(self, time: Times, noise: float) -> LowRankMultivariateNormal:
        mean, root = self._moments(time)
        deviation = positive("noise", noise, mean)
        return gaussian(mean.flatten(-2), root.flatten(-3, -2), deviation)

    @full_precision
    def _moments(self, time: Times) -> tuple[Tensor, Tensor]:
        """Mean (*batch T D) and square root (*batch T D L) of the covariance of positions."""
        head = self.head
        plan = head._plan(self.parameters, **self.state)
        s, waiting = head._normalised(time, plan)
        mean = PlannedTrajectory(plan, s, waiting, head.response).position
        rows = head._rows(s, plan).to(mean)
        factor = self.scale_tril.unflatten(-2, (head.columns, -1))
        factor = head.amplitude.to(mean)[:, None, None] * factor
        return mean, torch.einsum("...tm,...dmr->...tdr", rows, factor)


def _each_column(amplitude: Any, columns: int) -> Float[Tensor, "D"]:
    """Positive amplitude of each column."""
    dtype = amplitude.dtype if isinstance(amplitude, Tensor) else torch.get_default_dtype()
    values = positive("amplitude", to_tensor(amplitude, dtype), torch.empty(0, dtype=dtype))
    if values.ndim > 1 or (values.ndim and len(values) != columns):
        raise ValueError(
            f"amplitude must be one number or {columns}, got {tuple(values.shape)}"
        )
    return values.expand(columns).clone()


def _modes(response: Response) -> Float[Tensor, "N N"]:
    """Weights of orthogonal motions, smoothest first, with a total mean square of one.

    The relative sizes of the modes are as if the forcing term were white noise.
    """
    N = response.basis.count
    s = torch.linspace(0, 1, SAMPLES_PER_FUNCTION * N + 1, dtype=torch.float64)
    H = response.evaluate(s)[:, 0]
    unit = balanced_units(response.basis, H, 0)
    _, sigma, Vh = torch.linalg.svd(H[:, :N] * unit, full_matrices=False)
    modes = unit[:, None] * Vh.mT * (len(s) / sigma.square().sum()).sqrt()
    # The sign of a mode is arbitrary: choose the sign with a positive mean motion.
    return modes * torch.where((H[:, :N] @ modes).sum(0) < 0, -1.0, 1.0)
