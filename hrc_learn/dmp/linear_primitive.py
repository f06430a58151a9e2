"""The linear implementation that all kinds of primitive share, in columns that add up.

Joints, the error of an orientation, positions, coordinates without bounds: a coordinate adapter
makes columns of them (`coordinate_adapter.py`), and from here on they are all alike.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import _closed_loop_step as closed_loop_step
from hrc_learn.dmp._arguments import (
    FitReport,
    Scalars,
    Times,
    Vectors,
    check_precision,
    fits_numpy,
    normalised_time,
    positive,
    to_tensor,
)
from hrc_learn.dmp._arguments import vector as checked_vector
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._serialization import TENSORS, basis_config, linear_arguments
from hrc_learn.dmp._system.bases import Basis
from hrc_learn.dmp._system.closed_forms import SpringDamper
from hrc_learn.dmp._system.response import Response, Trajectory, broadcast_shapes, response_of
from hrc_learn.dmp.forcing_scale import Demonstrated, NoScaling, Scaling, find_scaling
from hrc_learn.model_files import SavedModel


class Ends(NamedTuple):
    """Ends of a motion, in columns (*batch, D) or as a caller gives them.

    None: those of the demonstration.
    """

    start: Any = None
    goal: Any = None
    velocity: Any = None
    """At the start, per second."""


class LinearPrimitive(nn.Module):
    """D columns under one phase, whose motion is a linear map of weights and ends.

    y'' = alpha (beta (g - y) - y') + scale * sum_i phi_i(s) w_i,   s = t / duration

    (paper eqs. (eq_tf), (eq_cs)), primes by s. Left alone, the motion is a linear map of
    weights, start, start velocity and goal, computed exactly; see `Response`. Any number of
    leading batch dimensions: one primitive each.
    """

    weights: Tensor
    """A parameter, or a buffer where they were computed from what gradients flow to."""
    start: Tensor
    goal: Tensor
    start_velocity: Tensor
    duration: Tensor
    amplitude: Tensor
    timestamps: Tensor
    basis: Basis
    spring: SpringDamper
    response: Response
    forcing_scale: Scaling
    """What start and goal make of the forcing term."""
    joint_names: tuple[str, ...] | None
    """Names of the D columns."""
    units: str
    """Of the columns."""
    fit_report: FitReport | None
    """How well the fit reproduces its demonstrations."""

    def __init__(
        self,
        *,
        weights: Float[Tensor, "*batch D N"],
        start: Float[Tensor, "*batch D"],
        goal: Float[Tensor, "*batch D"],
        start_velocity: Float[Tensor, "*batch D"],
        duration: Float[Tensor, "*batch"],
        amplitude: Float[Tensor, "*batch D"],
        timestamps: Float[Tensor, "*#batch T"],
        basis: Basis,
        spring: SpringDamper,
        scaling: str | Scaling = "none",
        approach: float = 0.0,
        joint_names: Sequence[str] | None = None,
        units: str = "rad",
        fit_report: FitReport | None = None,
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            weights: Of the scaled forcing term.
            start: y_0, where the demonstration starts.
            goal: g, where it ends.
            start_velocity: Per second, at `duration`.
            duration: tau [s].
            amplitude: Range covered by each column.
            timestamps: Normalised times at which a rollout repeats the demonstration.
            basis: Shape of the forcing term.
            spring: The unforced dynamics.
            scaling: Of the forcing term; see `forcing_scale.py`.
            approach: Share of the motion along which a new goal is taken up; 0: at once.
            joint_names: D names.
            units: Of the columns.
            fit_report: Kept for the reader.
        """
        super().__init__()
        check_names(joint_names, weights.shape[-2])
        if weights.shape[-1] != basis.count:
            raise ValueError(f"{weights.shape[-1]} weights for {basis.count} basis functions")
        check_precision(weights.dtype)
        if isinstance(weights, nn.Parameter) or not weights.requires_grad:
            self.weights = (
                weights if isinstance(weights, nn.Parameter) else nn.Parameter(weights)
            )
        else:
            # A parameter is a leaf of its own, which no gradient passes.
            self.register_buffer("weights", weights)
        buffers = (start, goal, start_velocity, duration, amplitude, timestamps)
        for name, value in zip(TENSORS[1:], buffers, strict=True):
            self.register_buffer(name, value)
        self.basis = basis
        self.spring = spring
        self.forcing_scale = find_scaling(scaling)
        self.joint_names = None if joint_names is None else tuple(joint_names)
        self.units = units
        self.fit_report = fit_report
        self.response = response_of(spring, basis, approach)

    def extra_repr(self) -> str:
        """What it moves, for how long, of how many functions, and how well it fits."""
        *batch, D, N = self.weights.shape
        names = "" if self.joint_names is None else f" ({', '.join(self.joint_names)})"
        low, high = (f"{x.item():.4g}" for x in self.duration.detach().aminmax())
        parts = [
            *([f"batch {tuple(batch)}"] if batch else []),
            f"{D} columns [{self.units}]{names}",
            f"{N} functions of {type(self.basis).__name__}",
            f"{low} s" if low == high else f"{low} to {high} s",
            f"scaling {self.scaling!r}",
        ]
        if self.fit_report is not None:
            parts.append(f"NRMSE {self.fit_report.nrmse.max().item():.2g}")
        return ", ".join(parts)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        # Before anything is changed: what `half` has made of a module stays so.
        check_precision(fn(self.weights.detach().reshape(-1)[:1]).dtype)
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *arguments: Any) -> None:
        # As many samples as the other was fitted to; all else has to be alike.
        timestamps = state_dict.get(f"{prefix}timestamps")
        if timestamps is not None and timestamps.shape != self.timestamps.shape:
            self.timestamps = self.timestamps.new_empty(timestamps.shape)
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    @property
    def scaling(self) -> str:
        """Name of the scaling of the forcing term."""
        return self.forcing_scale.name

    def coordinates(self) -> Float[Tensor, "*batch D M"]:
        """What the response maps to the demonstrated motion: weights, dy/ds, start, goal.

        Weights are those of the scaled forcing term.
        """
        rate = self.start_velocity * self.duration[..., None]
        ends = torch.stack([rate, self.start, self.goal], dim=-1)
        return torch.cat([self.weights, ends], dim=-1)

    def with_coordinates[S: "LinearPrimitive"](
        self: S,
        coordinates: Float[Tensor, "*batch D M"],
        duration: Float[Tensor, "*#batch"] | None = None,
        *,
        amplitude: Float[Tensor, "*#batch D"] | None = None,
        timestamps: Float[Tensor, "*#batch T"] | None = None,
    ) -> S:
        """Primitives like this one that move otherwise; gradients flow to the arguments.

        Args:
            coordinates: As `coordinates` gives them; their batch is that of the result.
            duration: [s]; this one's, like all that follow, if None.
            amplitude: Range covered by each column.
            timestamps: Normalised times of a rollout without arguments.

        Returns:
            A primitive of its own memory, with the same parts and names and no fit report.
        """
        x = coordinates.to(self.weights)
        batch = x.shape[:-2]
        duration = self.duration if duration is None else duration
        amplitude = self.amplitude if amplitude is None else amplitude
        duration = duration.to(x).expand(batch).clone()
        return type(self)(
            weights=x[..., :-3].clone(),
            start_velocity=x[..., -3] / duration[..., None],
            start=x[..., -2].clone(),
            goal=x[..., -1].clone(),
            duration=duration,
            amplitude=amplitude.to(x).expand(*batch, -1).clone(),
            timestamps=(self.timestamps if timestamps is None else timestamps).clone(),
            basis=self.basis,
            spring=self.spring,
            scaling=self.forcing_scale,
            approach=self.response.approach,
            joint_names=self.joint_names,
            units=self.units,
        )

    def roll(
        self,
        ends: Ends,
        duration: Float[Tensor, "*#batch"],
        time: Times | None = None,
        forcing_gain: Scalars | None = None,
    ) -> Trajectory:
        """Motion of the columns between `ends`; without ends and times, the demonstrated one.

        Args:
            ends: Of the motion.
            duration: [s].
            time: Since the start [s], (T,) or (*batch, T).
            forcing_gain: Factor on the forcing term, (*batch).
        """
        x = None
        if forcing_gain is None and not torch.is_grad_enabled():
            x = self._coordinates_alone(ends, duration)
        if x is None:
            x = self._coordinates_between(ends, duration, forcing_gain)
        s = self.timestamps if time is None else normalised_time(time, duration)
        return Trajectory(coordinates=x, s=s, duration=duration, response=self.response)

    def _coordinates_between(
        self, ends: Ends, duration: Tensor, forcing_gain: Scalars | None
    ) -> Float[Tensor, "*batch D M"]:
        """What the response maps to the motion between `ends`."""
        start, goal, rate = self.boundary(ends, duration)
        weights = self._scaled_weights(start, goal)
        if forcing_gain is not None:
            weights = weights * self._as_tensor(forcing_gain)[..., None, None]
        shape = weights.shape[:-1]
        if not rate.shape == start.shape == goal.shape == shape or duration.shape != shape[:-1]:
            self._motion_shape(rate=rate, start=start, goal=goal, duration=duration)
            shape = broadcast_shapes(shape, rate.shape, start.shape, goal.shape)
            weights = weights.expand(*shape, -1)
            rate, start, goal = (x.expand(shape) for x in (rate, start, goal))
        return torch.cat([weights, torch.stack([rate, start, goal], dim=-1)], dim=-1)

    def _coordinates_alone(
        self, ends: Ends, duration: Tensor
    ) -> Float[np.ndarray, "D M"] | None:
        """`_coordinates_between` for one motion, in NumPy: a third of the time.

        Returns:
            None where it does not apply, or where an end is wrong, which is said elsewhere.
        """
        weights = self.weights
        if weights.ndim != 2 or duration.ndim or not isinstance(self.forcing_scale, NoScaling):
            return None
        # A module takes three times as long for attributes. None: it is a parameter by now.
        own: Any = self._buffers.get
        start, goal, velocity = ends
        dtype, device = weights.dtype, weights.device
        start = own("start") if start is None else to_tensor(start, dtype, device)
        goal = own("goal") if goal is None else to_tensor(goal, dtype, device)
        if velocity is None:
            velocity, lasting = own("start_velocity"), own("duration")
        else:
            velocity, lasting = to_tensor(velocity, dtype, device), duration
        if not fits_numpy(weights, start, goal, velocity, lasting):
            return None
        start, goal, velocity = start.numpy(), goal.numpy(), velocity.numpy()
        D, N = weights.shape
        if not start.shape == goal.shape == velocity.shape == (D,):
            return None
        x = np.empty((D, N + 3), start.dtype)
        x[:, :N] = weights.detach().numpy()
        np.multiply(velocity, lasting.item(), out=x[:, N])
        x[:, N + 1] = start
        x[:, N + 2] = goal
        for given, value in zip(ends, (start, goal, velocity), strict=True):
            # Of so few numbers Python's sum takes the least time.
            if given is not None and not math.isfinite(sum(value.tolist())):
                return None
        return x

    def begin(self, ends: Ends, duration: Float[Tensor, "*#batch"]) -> DMPState:
        """State at the start of a motion [s], for `advance`."""
        start, goal, rate = self.boundary(ends, duration)
        self._motion_shape(rate=rate, start=start, goal=goal, duration=duration)
        return closed_loop_step.begin(self.response, self.weights, start, goal, rate, duration)

    def advance(
        self,
        state: DMPState,
        dt: Scalars,
        *,
        goal: Vectors | None = None,
        goal_filter: float | None = None,
        external_acceleration: Vectors | None = None,
        phase_stopping: Scalars | None = None,
        forcing_gain: Scalars | None = None,
    ) -> DMPState:
        """Advance by `dt` [s], exactly for whatever is constant over the step.

        Arguments are those of `AdaptedPrimitive.step`, in columns: `external_acceleration` is
        added to the motion, per s^2, (*batch, D).
        """
        if (
            isinstance(dt, float)
            and goal is goal_filter is external_acceleration is None
            and phase_stopping is forcing_gain is None
            and isinstance(self.forcing_scale, NoScaling)
        ):
            alone = closed_loop_step.advance_alone(state, dt, self.response, self.weights)
            if alone is not None:
                return alone
        target = state.target
        if goal is not None:
            target = checked_vector("goal", goal, state.goal).expand_as(state.goal)
        # How long the motion takes at the pace of this step.
        duration, pace = state.duration, torch.ones_like(state.pace)
        if phase_stopping is not None:
            slower = 1 + self._as_tensor(phase_stopping)
            duration, pace = duration * slower, pace / slower
        push = None
        if external_acceleration is not None:
            # Second derivatives by s are tau^2 times those by t.
            push = self._as_tensor(external_acceleration) * state.duration[..., None] ** 2
        aim = target if goal_filter is None else state.goal
        return closed_loop_step.advance(
            state,
            self._step_length(dt, duration),
            response=self.response,
            weights=self.weights,
            scale=self._scale_between(state.start, aim, forcing_gain),
            target=target,
            goal_filter=goal_filter,
            push=push,
            pace=pace,
        )

    def boundary(
        self, ends: Ends, duration: Float[Tensor, "*#batch"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Start, goal and dy/ds at the start, of a motion that lasts `duration` [s]."""
        start, goal, velocity = ends
        start = self.start if start is None else checked_vector("start", start, self.start)
        goal = self.goal if goal is None else checked_vector("goal", goal, self.goal)
        if velocity is None:
            return start, goal, self.start_rate(start, goal)
        velocity = checked_vector("start_velocity", velocity, self.start_velocity)
        return start, goal, velocity * duration[..., None]

    def _motion_shape(self, **ends: Tensor) -> tuple[int, ...]:
        """Of (*batch, D), for primitives and ends together.

        Raises:
            ValueError: They do not go together; says which.
        """
        shapes = {
            name: (*x.shape, self.weights.shape[-2]) if name == "duration" else x.shape
            for name, x in ends.items()
        }
        try:
            return broadcast_shapes(self.weights.shape[:-1], *shapes.values())
        except (ValueError, RuntimeError):
            batches = ", ".join(f"{name} {tuple(x[:-1])}" for name, x in shapes.items())
            raise ValueError(
                f"batches must broadcast, but the primitive has {tuple(self.duration.shape)}, "
                f"{batches}"
            ) from None

    def curvature(self, state: DMPState) -> Float[Tensor, "*batch D"]:
        """d^2 y / ds^2 at a state that nothing couples to."""
        scale = self._scale_between(state.start, state.goal, None)
        return closed_loop_step.second_derivative(state, self.response, self.weights, scale)

    def start_rate(
        self, start: Float[Tensor, "*#batch D"], goal: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*#batch D"]:
        """Dy/ds that a motion between these starts with, unless told otherwise."""
        duration = self.duration
        rate = self.start_velocity * (duration[..., None] if duration.ndim else duration)
        if not self.forcing_scale.turns:
            return rate
        return self._scaled(rate[..., None, :], start, goal)[..., 0, :]

    def resting_point(
        self, state: DMPState, curvature: Float[Tensor, "*batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """The goal with which the state would have this d^2 y / ds^2 (unscaled forcing)."""
        return state.goal + (curvature - self.curvature(state)) / self.spring.stiffness

    def resolve_duration(self, duration: Scalars | None, speed: Scalars | None) -> Tensor:
        """Duration [s] that either argument of a rollout asks for."""
        if duration is not None and speed is not None:
            raise ValueError("give a duration or a speed, not both")
        if duration is not None:
            return positive("duration", duration, self.duration)
        if speed is not None:
            return self.duration / positive("speed", speed, self.duration)
        return self.duration

    def normalised_time(
        self, time: Times | None, duration: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch T"]:
        """Times [s] of a rollout over its duration; of None, the demonstration's timestamps."""
        if time is None:
            return self.timestamps
        return normalised_time(time, duration)

    def config(self) -> dict[str, Any]:
        """What a saved primitive needs besides its tensors, as JSON values."""
        return {
            "joint_names": self.joint_names,
            "units": {"coordinates": self.units, "time": "s"},
            "scaling": self.forcing_scale.name,
            "scaled_columns": self.forcing_scale.columns,
            "approach": self.response.approach,
            "spring": asdict(self.spring),
            "basis": basis_config(self.basis),
        }

    def tensors(self) -> dict[str, Tensor]:
        """Learned numbers and residuals, by the names they are saved under."""
        report = {} if self.fit_report is None else self.fit_report.tensors()
        return dict(self.state_dict()) | {f"fit_report.{k}": v for k, v in report.items()}

    @classmethod
    def restore[S: "LinearPrimitive"](cls: type[S], saved: SavedModel) -> S:
        """The primitive inside a saved one.

        Raises:
            ValueError: Names the file and the field that is wrong.
        """
        arguments = linear_arguments(saved)
        try:
            return cls(**arguments)
        except ValueError as error:
            raise saved.invalid(error) from None

    def _scale_between(
        self, start: Tensor, goal: Tensor, forcing_gain: Scalars | None
    ) -> Callable[[Tensor], Tensor]:
        """What becomes of (*batch, K, D) that the forcing term causes, between these ends."""

        def scale(values: Tensor) -> Tensor:
            values = self._scaled(values, start, goal)
            if forcing_gain is None:
                return values
            return values * self._as_tensor(forcing_gain)[..., None, None]

        return scale

    def _scaled(self, values: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        if isinstance(self.forcing_scale, NoScaling):
            return values  # before the look-ups, which take as long as a step's arithmetic
        shown = Demonstrated(start=self.start, goal=self.goal, amplitude=self.amplitude)
        return self.forcing_scale.scale(values, start, goal, shown)

    def _scaled_weights(self, start: Tensor, goal: Tensor) -> Tensor:
        if isinstance(self.forcing_scale, NoScaling):
            return self.weights
        return self._scaled(self.weights.mT, start, goal).mT

    def _step_length(self, dt: Scalars, duration: Tensor) -> Tensor | float:
        """Ds in float64; a number where it may be one, which takes a tenth of the time."""
        if isinstance(dt, float):
            (known,) = closed_loop_step.host_values(duration)
            if isinstance(known, float):
                return dt / known
        else:
            dt = to_tensor(dt, dtype=torch.float64, device=duration.device)
        return duration.double().reciprocal() * dt

    def _as_tensor(self, value: Scalars | Vectors) -> Tensor:
        return to_tensor(value, dtype=self.weights.dtype, device=self.weights.device)


def check_names(joint_names: Sequence[str] | None, D: int) -> None:
    """Raise ValueError unless there is a name for each of D columns, or none at all."""
    if joint_names is not None and len(joint_names) != D:
        raise ValueError(f"{len(joint_names)} joint names for {D} coordinates")
