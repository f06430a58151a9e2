"""The last layer of a network that plans motions: parameters in, trajectories out.

A head needs no demonstration. Its parameters are whitened: of independent unit normal ones,
motions deviate by a stated amount from the straight minimum-jerk way to the goal, in smooth
modes in front and finer ones behind, so that networks and searches see alike-sized numbers. The
motion is linear in all of them but duration and delay. So a Gaussian over parameters is a
Gaussian over motions: its density, divergence and samples are closed form (Li et al. 2023,
"ProDMP: A unified perspective on dynamic and probabilistic movement primitives").
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    Points,
    Scalars,
    Times,
    Vectors,
    finite,
    positive,
    readable,
    to_tensor,
)
from hrc_learn.dmp._arguments import vector as checked_vector
from hrc_learn.dmp._system.bases import Basis, GaussianBasis, balanced_units
from hrc_learn.dmp._system.closed_forms import SpringDamper
from hrc_learn.dmp._system.own_times import spring_rows
from hrc_learn.dmp._system.response import Response, Trajectory, response_of
from hrc_learn.dmp.joint_dmp import JointDMP

WATCHED = 20
"""Samples a basis function at which the modes of a motion are told apart."""
NOISE = 1e-4
"""Of samples that are encoded, as a share of the amplitude: far below what motions differ."""


class MotionHead(nn.Module):
    """Parameters of a network to a motion of D columns, from any state that it starts in.

    Of P = D (N + 1) + timing parameters, the first are those of each column in turn: N whitened
    weights and the goal. Those of timing follow: the duration if it has a range, the delay if
    there may be one. All zero, they mean the minimum-jerk motion to the centre of the goals, of
    the geometric mean of durations.

    Differentiable in everything it is called with; any number of leading batch axes.
    """

    amplitude: Tensor
    """Root mean square by which unit normal parameters move each column, (D,)."""
    goal_scale: Tensor
    """Standard deviation of the goals likewise, (D,)."""
    goal_centre: Tensor | None
    """Of the goals, (D,); None: the start."""
    modes: Tensor
    """Weights of the motions that the whitened ones stand for, smoothest first, (N, N)."""

    def __init__(
        self,
        columns: int,
        n_basis: int = 10,
        *,
        duration: float | tuple[float, float] = 1.0,
        delay: float = 0.0,
        amplitude: Vectors | float = 1.0,
        goal_scale: Vectors | float | None = None,
        goal_centre: Vectors | None = None,
        smoothness: float = 1.0,
        approach: float = 1.0,
        basis: Basis | None = None,
        spring: SpringDamper | None = None,
    ):
        """Prepare the modes.

        Args:
            columns: D, of the motion.
            n_basis: N, unless `basis` is given.
            duration: Of motions [s]; of a range, the network says which, in ratios.
            delay: The longest wait before a motion [s]; 0: there is none to choose.
            amplitude: Deviation, root mean square over a motion, that unit normal weights
                make, in the units of the columns; (D,) or one for all.
            goal_scale: Standard deviation of the goal that a unit normal parameter makes;
                `amplitude` if None.
            goal_centre: What goals lie around, (D,); None: the start of each motion.
            smoothness: Exponent of the singular values of the modes: 1, finer ones are as small
                as white forcing makes them; 0, all of one size, which a regression learns at
                one rate and a search makes rough.
            approach: Share of the motion along which the goal is taken up, smoothly.
            basis: Of the forcing term, not periodic.
            spring: Gains.

        Raises:
            ValueError: Numbers of the wrong sign or count, or a periodic basis.
        """
        super().__init__()
        basis = basis or GaussianBasis(count=n_basis)
        if basis.periodic:
            raise ValueError("a rhythm has no goal: a head needs a basis that is not periodic")
        low, high = duration if isinstance(duration, tuple) else (duration, duration)
        if not (0 < low <= high < math.inf and 0 <= delay < math.inf):
            raise ValueError(
                "duration must be positive, its range in order, and delay not negative; got "
                f"{duration} and {delay}"
            )
        self.columns = columns
        self.shortest, self.longest, self.latest = low, high, delay
        self.response = response_of(spring or SpringDamper(), basis, float(approach))
        self.register_buffer("amplitude", _each_column("amplitude", amplitude, columns))
        goal_scale = self.amplitude if goal_scale is None else goal_scale
        self.register_buffer("goal_scale", _each_column("goal_scale", goal_scale, columns))
        centre = (
            None
            if goal_centre is None
            else checked_vector("goal_centre", goal_centre, self.amplitude)
        )
        self.register_buffer("goal_centre", centre)
        modes = _modes(self.response, smoothness).to(self.amplitude)
        self.register_buffer("modes", modes, persistent=False)

    def extra_repr(self) -> str:
        """Columns, functions, and what the parameters are."""
        return (
            f"{self.columns} columns, {self.modes.shape[0]} functions, "
            f"{self.n_parameters} parameters, of which {self.n_timing} of timing"
        )

    @property
    def n_linear(self) -> int:
        """D (N + 1): parameters that the motion is linear in."""
        return self.columns * (self.modes.shape[0] + 1)

    @property
    def n_timing(self) -> int:
        """Parameters of duration and delay: 0, 1 or 2."""
        return (self.longest > self.shortest) + (self.latest > 0)

    @property
    def n_parameters(self) -> int:
        """P: what a network has to put out."""
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
        """The motion from a state; positions, velocities and so on when asked for.

        To plan again in the middle of a motion, call it with new parameters and the state that
        has been reached: a new motion begins. Or with `since` as well: then the motion goes on
        from there, at the phase that it has reached, to end when the first one would have.

        Args:
            parameters: Of a network.
            time: [s] since the start of the motion, (T,) or (*batch, T). Until the delay has
                passed, the motion stands at its start.
            start: Where it starts, or has got to, (*batch, D).
            start_velocity: Per second, (*batch, D); none unless given.
            since: Time [s] at which the motion is in that state, (*batch); times are not before
                it.
            origin: Where the way to the goal started, (*batch, D); `start` if None. Only with
                `since`.

        Raises:
            ValueError: Another number of parameters or columns, or bad times.
        """
        plan = self._plan(parameters, start, start_velocity, since, origin)
        s, waiting = self._normalised(time, plan)
        return PlannedTrajectory(plan, s, waiting, self.response)

    def primitive(
        self,
        parameters: Float[Tensor, "*batch P"],
        start: Vectors,
        start_velocity: Vectors | None = None,
        *,
        samples: int = 101,
    ) -> JointDMP:
        """The motion after its delay as a primitive: for steps, via points, files and export.

        Args:
            parameters: Of a network.
            start: (*batch, D).
            start_velocity: Per second, (*batch, D).
            samples: Of its rollout without times.
        """
        plan = self._plan(parameters, start, start_velocity, None, None)
        x, batch = plan.coordinates, plan.coordinates.shape[:-2]
        duration = plan.duration.expand(batch)
        return JointDMP(
            weights=x[..., :-3],
            start_velocity=x[..., -3] / duration[..., None],
            start=x[..., -2],
            goal=x[..., -1],
            duration=duration,
            amplitude=self.amplitude.to(x).expand(*batch, -1),
            timestamps=torch.linspace(0, 1, samples).to(x),
            basis=self.response.basis,
            spring=self.response.spring,
            approach=self.response.approach,
        )

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
            parameters: The mean.
            scale_tril: Cholesky factor of the covariance of the first L = D (N + 1) parameters.
                Duration and delay are certain.
            start: (*batch, D), certain too.
            start_velocity: Per second, (*batch, D).
            since: Time [s], (*batch).
            origin: (*batch, D).

        Raises:
            ValueError: A factor of another size.
        """
        if scale_tril.shape[-2:] != (self.n_linear, self.n_linear):
            raise ValueError(
                f"scale_tril must have shape (..., {self.n_linear}, {self.n_linear}), got "
                f"{tuple(scale_tril.shape)}"
            )
        self._plan(parameters, start, start_velocity, since, origin)  # refuses what is wrong
        state = {"start": start, "start_velocity": start_velocity}
        state |= {"since": since, "origin": origin}
        return MotionDistribution(self, parameters, scale_tril, state)

    def timing(
        self, duration: Scalars | None = None, delay: Scalars | None = None
    ) -> Float[Tensor, "*batch n"]:
        """The timing parameters of durations and delays [s], which lie within their ranges.

        Raises:
            ValueError: One that was not asked for, or is missing or out of its range.
        """
        found = []
        for name, value, low, high in (
            ("duration", duration, self.shortest, self.longest),
            ("delay", delay, 0.0, self.latest),
        ):
            if (value is not None) != (high > low):
                there = "no range" if value is not None else "a range"
                raise ValueError(f"{name} has {there} in this head")
            if value is None:
                continue
            x = to_tensor(value, self.amplitude.dtype, self.amplitude.device)
            if readable(x) and not ((x > low) & (x < high)).all():
                raise ValueError(f"{name} must lie between {low} and {high}")
            share = (x / low).log() / math.log(high / low) if low else x / high
            found.append(share.logit())
        if not found:
            return self.amplitude.new_empty(0)
        return torch.stack(torch.broadcast_tensors(*found), -1)

    def encode(
        self,
        time: Times,
        position: Points,
        start_velocity: Vectors | None = None,
        *,
        timing: Float[Tensor, "*batch n"] | None = None,
        noise: float = NOISE,
    ) -> Float[Tensor, "*batch P"]:
        """The most likely parameters of recorded motions, as targets of a regression.

        Args:
            time: [s] since the start, (T,) or (*batch, T).
            position: (*batch, T, D); the first one is the start.
            start_velocity: Per second, (*batch, D).
            timing: As `timing` gives it; zeros if None.
            noise: Standard deviation of the samples over the amplitude. Parameters that they
                tell nothing of stay zero, as unit normal ones do.
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
        rows = self._rows(s, plan)[..., None, :, :] * self._scales()[:, None, :].double()
        # Of each column in units of its own noise; the prior is of unit covariance.
        rows = rows / (noise * self.amplitude.double())[:, None, None]
        missing = missing.mT.double() / (noise * self.amplitude.double())[:, None]
        normal = rows.mT @ rows + torch.eye(rows.shape[-1]).to(rows)
        z = torch.linalg.solve(normal, rows.mT @ missing[..., None])[..., 0]
        return torch.cat([z.flatten(-2).to(y), zeros[..., self.n_linear :]], -1)

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
        finite("parameters", parameters)
        linear = parameters[..., : self.n_linear].unflatten(-1, (self.columns, -1))
        like = linear[..., 0]
        start = checked_vector("start", start, like)
        rate = torch.zeros_like(start)
        duration, delay = self._timing(parameters)
        if start_velocity is not None:
            velocity = checked_vector("start_velocity", start_velocity, like)
            rate = velocity * duration[..., None]
        first = start
        if origin is not None:
            if since is None:
                raise ValueError("an origin is of a motion that goes on: give since")
            first = checked_vector("origin", origin, like)
        scaled = linear * self._scales().to(linear)
        centre = first if self.goal_centre is None else self.goal_centre.to(linear)
        goal = centre + scaled[..., -1]
        weights = scaled[..., :-1] @ self.modes.to(linear).mT
        begun = rate if since is None else torch.zeros_like(rate)
        ends = torch.broadcast_tensors(begun, first, goal)
        weights = weights.expand(*ends[0].shape, -1)
        x = torch.cat([weights, torch.stack(ends, -1)], -1)
        if since is None:
            return _Plan(x, duration, delay)
        now = to_tensor(since, torch.float64, x.device)
        if readable(now) and not ((now >= 0) & (now < math.inf)).all():
            raise ValueError("since must be seconds since the start, none negative")
        s = ((now - delay.double()) / duration.double()).clamp(min=0)
        reached = Trajectory(
            coordinates=x, s=s[..., None], duration=duration, response=self.response
        )
        off = start - reached.position[..., 0, :]
        off_rate = rate - reached.velocity[..., 0, :] * duration[..., None]
        return _Plan(x, duration, delay, s, torch.stack([off, off_rate], -1))

    def _timing(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Duration and delay [s], of the batch or without an axis where they are fixed."""
        share = parameters[..., self.n_linear :].sigmoid()
        duration = delay = None
        if self.longest > self.shortest:
            ratio = math.log(self.longest / self.shortest)
            duration = self.shortest * (ratio * share[..., 0]).exp()
        if self.latest > 0:
            delay = self.latest * share[..., -1]
        fixed = parameters.new_tensor([self.shortest, 0.0])
        return fixed[0] if duration is None else duration, fixed[1] if delay is None else delay

    def _scales(self) -> Float[Tensor, "D M"]:
        """What whitened weights and goal of each column are multiplied by."""
        N = self.modes.shape[0]
        weights = self.amplitude[:, None].expand(-1, N)
        return torch.cat([weights, self.goal_scale[:, None]], -1)

    def _normalised(self, time: Times, plan: "_Plan") -> tuple[Tensor, Tensor | None]:
        """Times over the duration, from the end of the delay; and where it has not passed."""
        time = to_tensor(time, torch.float64, plan.duration.device)
        if time.ndim == 0 or (readable(time) and not ((time >= 0) & (time < math.inf)).all()):
            raise ValueError("time must be an array of seconds since the start, none negative")
        s = (time - plan.delay.double()[..., None]) / plan.duration.double()[..., None]
        waiting = s < 0 if self.latest > 0 else None
        s = s if waiting is None else s.clamp(min=0)
        since = plan.since
        if since is not None and readable(s, since) and (s < since[..., None] - 1e-9).any():
            raise ValueError("the motion goes on at `since`: no time may be before it")
        return s, waiting

    def _rows(self, s: Tensor, plan: "_Plan") -> Float[Tensor, "*batch T M"]:
        """What each whitened parameter of a column does to it at times `s` (float64)."""
        H = self._by_mode(self.response.evaluate(s)[..., 0, :])
        if plan.since is None:
            return H
        # From a state that is certain the motions of all parameters start at rest.
        there = self._by_mode(self.response.evaluate(plan.since)[..., :2, :])
        back = spring_rows(self.response, s - plan.since[..., None], 0)
        return H - back @ there

    def _by_mode(self, H: Tensor) -> Tensor:
        N = self.modes.shape[0]
        return torch.cat([H[..., :N] @ self.modes.to(H), H[..., -1:]], -1)


@dataclass(frozen=True, eq=False)
class _Plan:
    """What parameters and a state come to."""

    coordinates: Float[Tensor, "*batch D M"]
    duration: Float[Tensor, "*#batch"]
    delay: Float[Tensor, "*#batch"]
    since: Float[Tensor, "*#batch"] | None = None
    """Normalised time of the state."""
    deviation: Float[Tensor, "*batch D 2"] | None = None
    """There, from the motion of the coordinates: in y and dy/ds."""


class PlannedTrajectory(Trajectory):
    """A motion that may wait before it begins, or begin where another one has got to."""

    def __init__(
        self,
        plan: _Plan,
        s: Float[Tensor, "*#batch T"],
        waiting: Tensor | None,
        response: Response,
    ):
        """Describe the motion of a plan, at rest where it waits."""
        super().__init__(
            coordinates=plan.coordinates, s=s, duration=plan.duration, response=response
        )
        self.delay = plan.delay
        """Before the motion begins [s]."""
        self._plan, self._waiting = plan, waiting

    @property
    def time(self) -> Float[Tensor, "*batch T"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Since the start [s]; where the motion waits, the end of its delay."""
        time = self.s * self.duration[..., None] + self.delay[..., None]
        return time.to(self._coordinates.dtype).expand(*self._batch, -1)

    def _output(self, order: int) -> Float[Tensor, "*batch T D"]:
        y = super()._output(order)
        plan = self._plan
        if plan.deviation is not None:
            assert plan.since is not None
            back = spring_rows(self._response, self.s - plan.since[..., None], order)
            tau = self.duration[..., None, None] ** order
            y = y + back.to(y) @ (plan.deviation / tau).mT
        if order and self._waiting is not None:
            y = torch.where(self._waiting[..., None], 0.0, y)
        return y


@dataclass(frozen=True, eq=False)
class MotionDistribution:
    """Gaussian over the motions of a head: its parameters are Gaussian, the state certain."""

    head: MotionHead
    parameters: Float[Tensor, "*batch P"]
    """The mean."""
    scale_tril: Float[Tensor, "*#batch L L"]
    """Of the linear parameters."""
    state: dict[str, Any]
    """Start, its velocity, since when, and origin, as in `MotionHead.forward`."""

    def mean(self, time: Times) -> PlannedTrajectory:
        """The mean motion at times [s]."""
        return self.head(self.parameters, time, **self.state)

    def rsample(
        self, shape: tuple[int, ...] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape_batch P"]:
        """Parameters drawn at random, for `MotionHead.forward`; differentiable in both."""
        batch = torch.broadcast_shapes(self.parameters.shape[:-1], self.scale_tril.shape[:-2])
        L, like = self.head.n_linear, self.parameters
        # Drawn where the generator is: a network may be elsewhere.
        device = like.device if generator is None else generator.device
        noise = torch.randn(
            *shape, *batch, L, 1, generator=generator, dtype=like.dtype, device=device
        )
        change = (self.scale_tril @ noise.to(like.device))[..., 0]
        return like + torch.nn.functional.pad(change, (0, self.head.n_timing))

    def parameter_log_prob(
        self, parameters: Float[Tensor, "*other P"]
    ) -> Float[Tensor, "*other"]:
        """Log density of linear parameters, as of an action."""
        L = self.head.n_linear
        off = (parameters - self.parameters)[..., :L, None]
        factor = self.scale_tril.expand(*off.shape[:-2], L, L)
        z = torch.linalg.solve_triangular(factor, off, upper=False)[..., 0]
        size = L * math.log(2 * math.pi) + z.square().sum(-1)
        return -size / 2 - _log_diagonal(self.scale_tril)

    def log_prob(self, time: Times, position: Points, noise: float) -> Float[Tensor, "*batch"]:
        """Log density of positions at times [s], of one motion seen with noise.

        Args:
            time: (T,) or (*batch, T).
            position: (*batch, T, D).
            noise: Standard deviation of each, independent of the others.
        """
        mean, root = self._moments(time)
        y = to_tensor(position, mean.dtype, mean.device)
        deviation = positive("noise", noise, mean)
        # By Woodbury in the whitened parameters, in units of the noise.
        z = (y - mean).flatten(-2)[..., None] / deviation
        root = root.flatten(-3, -2) / deviation
        factor = torch.linalg.cholesky(root.mT @ root + torch.eye(root.shape[-1]).to(root))
        part = torch.linalg.solve_triangular(factor, root.mT @ z, upper=False)
        square = z.square().sum((-2, -1)) - part.square().sum((-2, -1))
        size = z.shape[-2] * (deviation.log() + math.log(2 * math.pi) / 2)
        return -square / 2 - size - _log_diagonal(factor)

    def position(self, time: Times) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation at times [s], (*batch, T, D) each."""
        mean, root = self._moments(time)
        return mean, root.norm(dim=-1)

    def kl(self, other: "MotionDistribution") -> Float[Tensor, "*batch"]:
        """KL(self || other) of motions from one state, of one timing.

        Motions are an injective linear map of the linear parameters, so it is that of those.
        """
        L = self.head.n_linear
        off = (other.parameters - self.parameters)[..., :L, None]
        ratio = torch.linalg.solve_triangular(
            *torch.broadcast_tensors(other.scale_tril, self.scale_tril), upper=False
        )
        batch = torch.broadcast_shapes(off.shape[:-2], other.scale_tril.shape[:-2])
        factor = other.scale_tril.expand(*batch, L, L)
        moved = torch.linalg.solve_triangular(factor, off.expand(*batch, L, 1), upper=False)
        size = ratio.square().sum((-2, -1)) + moved.square().sum((-2, -1)) - L
        return size / 2 + _log_diagonal(other.scale_tril) - _log_diagonal(self.scale_tril)

    def _moments(self, time: Times) -> tuple[Tensor, Tensor]:
        """Mean (*batch T D) and a root (*batch T D L) of the covariance of positions."""
        head = self.head
        plan = head._plan(self.parameters, **self.state)
        s, waiting = head._normalised(time, plan)
        mean = PlannedTrajectory(plan, s, waiting, head.response).position
        rows = head._rows(s, plan).to(mean)
        factor = self.scale_tril.unflatten(-2, (head.columns, -1))
        factor = head._scales().to(mean)[..., None] * factor
        return mean, torch.einsum("...tm,...dmr->...tdr", rows, factor)


def _log_diagonal(factor: Float[Tensor, "*batch L L"]) -> Float[Tensor, "*batch"]:
    return factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _each_column(name: str, value: Any, columns: int) -> Float[Tensor, "D"]:
    """A positive number for each column."""
    dtype = value.dtype if isinstance(value, Tensor) else torch.get_default_dtype()
    values = positive(name, to_tensor(value, dtype), torch.empty(0, dtype=dtype))
    if values.ndim > 1 or (values.ndim and len(values) != columns):
        raise ValueError(f"{name} must be one number or {columns}, got {tuple(values.shape)}")
    return values.expand(columns).clone()


def _modes(response: Response, smoothness: float) -> Float[Tensor, "N N"]:
    """Weights of orthogonal motions, smoothest first, whose squares add up to a mean of one."""
    N = response.basis.count
    s = torch.linspace(0, 1, WATCHED * N + 1, dtype=torch.float64)
    H = response.evaluate(s)[:, 0]
    unit = balanced_units(response.basis, H, 0)
    _, sigma, Vh = torch.linalg.svd(H[:, :N] * unit, full_matrices=False)
    size = (sigma / sigma[0]) ** smoothness
    size = size * (len(s) / size.square().sum()).sqrt()
    modes = unit[:, None] * Vh.mT * (size / sigma)
    # A mode and its negative are one: take that which sets off upwards.
    return modes * torch.where((H[:, :N] @ modes).sum(0) < 0, -1.0, 1.0)
