"""The linear implementation behind all kinds of primitive.

Joints, orientation errors and positions are columns, which can be added and scaled. Each kind
of primitive converts its values to columns (see `motion_primitive.py`); this module knows
columns only.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from types import NoneType
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import closed_loop_step
from hrc_learn.dmp._arguments import (
    Scalars,
    Times,
    Vectors,
    broadcast_shapes,
    check_not_negative,
    checked_vector,
    finite,
    fits_numpy,
    full_precision,
    normalised_time,
    positive,
    to_tensor,
)
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.dynamics import Basis, SpringDamper, basis_config, restored_basis
from hrc_learn.dmp.forcing_scale import Demonstrated, Scaling, find_scaling
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.samples import FitReport, check_precision
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.model_files import SavedModel

TENSORS = ("weights", "start", "goal", "start_velocity", "duration", "amplitude", "timestamps")
REPORT = "fit_report."
"""Prefix of the tensors of the fit report."""


class Boundary(NamedTuple):
    """Boundary conditions of a motion, as columns (*batch, D) or as a caller gives them.

    None stands for the value of the demonstration.
    """

    start: Any = None
    goal: Any = None
    start_velocity: Any = None
    """Velocity at the start, per second."""


class LinearPrimitive(nn.Module):
    """D columns with one phase, whose motion is a linear map of weights and boundary.

    y'' = alpha (beta (g - y) - y') + scale * sum_i phi_i(s) w_i,   s = t / duration

    These are equations (eq_tf) and (eq_cs) of the paper (see `docs/concepts/paper.md`); primes
    are derivatives with respect to s. Without coupling, the motion is a linear map of weights,
    start, start velocity and goal, computed exactly; see `Response`. Each element of the
    leading batch dimensions is one primitive.
    """

    weights: Tensor
    """Weights of the forcing term: a parameter, or a buffer if gradients flow through them."""
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
    """Scaling of the forcing term with start and goal."""
    joint_names: tuple[str, ...] | None
    """Names of the D columns."""
    units: str
    """Units of the columns."""
    fit_report: FitReport | None
    """Residuals of the fit."""

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
        """Assemble a primitive; `fit` is the usual way to make one.

        Args:
            weights: Weights of the scaled forcing term.
            start: Start y_0 of the demonstration.
            goal: End g of the demonstration.
            start_velocity: Velocity at the start [1/s], for the given `duration`.
            duration: Duration tau [s].
            amplitude: Range of each column.
            timestamps: Normalised times of the default rollout.
            basis: Basis of the forcing term.
            spring: Gains of the unforced dynamics.
            scaling: Scaling of the forcing term; see `forcing_scale.py`.
            approach: Fraction of the motion over which it adapts to a new start and goal; 0:
                the spring alone adapts it.
            joint_names: Names of the D columns.
            units: Units of the columns.
            fit_report: Residuals of the fit.
        """
        super().__init__()
        check_names(joint_names, weights.shape[-2])
        if weights.shape[-1] != basis.count:
            raise ValueError(f"{weights.shape[-1]} weights for {basis.count} basis functions")
        check_precision(weights.dtype)
        if isinstance(weights, nn.Parameter):
            self.weights = weights
        elif not weights.requires_grad:
            self.weights = nn.Parameter(weights)
        else:
            # A buffer: a parameter is a leaf, so gradients would not flow through it.
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
        """Columns, basis, scaling and residual."""
        *batch, D, N = self.weights.shape
        names = "" if self.joint_names is None else f" ({', '.join(self.joint_names)})"
        error = "" if self.fit_report is None else f", NRMSE {self.fit_report.nrmse.max():.2g}"
        many = f"batch {tuple(batch)}, " if batch else ""
        return (
            f"{many}{D} columns [{self.units}]{names}, {N} functions of "
            f"{type(self.basis).__name__}, scaling {self.scaling!r}{error}"
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        # Check before any tensor changes, because `half` cannot be undone.
        check_precision(fn(self.weights.detach().reshape(-1)[:1]).dtype)
        return super()._apply(fn, recurse)

    @property
    def scaling(self) -> str:
        """Name of the scaling of the forcing term."""
        return self.forcing_scale.name

    def coordinates(self) -> Float[Tensor, "*batch D M"]:
        """Weights of the scaled forcing term, start velocity dy/ds, start and goal.

        The response maps them to the demonstrated motion.
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
        """Primitives with other coordinates; gradients flow to the arguments.

        Args:
            coordinates: As returned by `coordinates`; the result has their batch shape.
            duration: Duration [s]; None keeps the value of this primitive, here and below.
            amplitude: Range of each column.
            timestamps: Normalised times of the default rollout.

        Returns:
            A primitive with the same basis, spring, scaling and names. Its tensors are copies,
            and it has no fit report.
        """
        x = coordinates.to(self.weights)
        duration = self.duration if duration is None else duration
        amplitude = self.amplitude if amplitude is None else amplitude
        return type(self).from_coordinates(
            x,
            duration.to(x).expand(x.shape[:-2]),
            amplitude.to(x).expand(*x.shape[:-2], -1),
            (self.timestamps if timestamps is None else timestamps),
            self.response,
            scaling=self.forcing_scale,
            joint_names=self.joint_names,
            units=self.units,
        )

    @classmethod
    def from_coordinates[S: "LinearPrimitive"](
        cls: type[S],
        x: Float[Tensor, "*batch D M"],
        duration: Float[Tensor, "*batch"],
        amplitude: Float[Tensor, "*batch D"],
        timestamps: Float[Tensor, "*#batch T"],
        response: Response,
        **parts: Any,
    ) -> S:
        """Primitives from coordinates; the tensors are copied.

        Args:
            x: Weights, start velocity dy/ds, start and goal, as from `coordinates`.
            duration: Duration [s].
            amplitude: Range of each column.
            timestamps: Normalised times of the default rollout.
            response: Response of basis and spring.
            parts: Scaling, names and units.
        """
        return cls(
            weights=x[..., :-3].clone(),
            start_velocity=x[..., -3] / duration[..., None],
            start=x[..., -2].clone(),
            goal=x[..., -1].clone(),
            duration=duration.clone(),
            amplitude=amplitude.clone(),
            timestamps=timestamps.clone(),
            basis=response.basis,
            spring=response.spring,
            approach=response.approach,
            **parts,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the primitive, fit report included, by the names used in files.

        Gradients flow to weights that are a buffer.
        """
        own = {name: getattr(self, name) for name in TENSORS}
        if isinstance(self.weights, nn.Parameter):
            own["weights"] = self.weights.detach()
        report = {} if self.fit_report is None else self.fit_report.tensors()
        return own | {f"{REPORT}{name}": x for name, x in report.items()}

    def with_tensors[S: "LinearPrimitive"](self: S, tensors: Mapping[str, Tensor]) -> S:
        """The same primitive with other tensors, named as in `tensors`."""
        return type(self)(**self.arguments(tensors))

    def arguments(self, tensors: Mapping[str, Tensor] | None = None) -> dict[str, Any]:
        """Constructor arguments of this primitive, or of a copy with other tensors."""
        return _tensor_arguments(self.tensors() if tensors is None else tensors) | {
            "basis": self.basis,
            "spring": self.spring,
            "scaling": self.forcing_scale,
            "approach": self.response.approach,
            "joint_names": self.joint_names,
            "units": self.units,
        }

    def rollout_columns(
        self,
        boundary: Boundary,
        duration: Float[Tensor, "*#batch"],
        time: Times | None = None,
        forcing_gain: Scalars | None = None,
    ) -> Trajectory:
        """Motion of the columns; without boundary and times, the demonstrated motion.

        Args:
            boundary: Start, goal and start velocity, in columns.
            duration: Duration [s].
            time: Time since the start [s], (T,) or (*batch, T).
            forcing_gain: Factor on the forcing term, (*batch).
        """
        x = None
        if forcing_gain is None and not torch.is_grad_enabled():
            x = self._numpy_coordinates(boundary, duration)
        if x is None:
            x = self._motion_coordinates(boundary, duration, forcing_gain)
        s = self.timestamps if time is None else normalised_time(time, duration)
        return Trajectory(coordinates=x, s=s, duration=duration, response=self.response)

    def _motion_coordinates(
        self, boundary: Boundary, duration: Tensor, forcing_gain: Scalars | None
    ) -> Float[Tensor, "*batch D M"]:
        """Coordinates of the motion with this boundary."""
        start, goal, rate = self.resolve_boundary(boundary, duration)
        weights = self._scaled(self.weights.mT, start, goal).mT
        if forcing_gain is not None:
            gain = finite("forcing_gain", self._as_tensor(forcing_gain))
            weights = weights * gain[..., None, None]
        shape = weights.shape[:-1]
        if not rate.shape == start.shape == goal.shape == shape or duration.shape != shape[:-1]:
            self._check_batches(rate=rate, start=start, goal=goal, duration=duration[..., None])
            shape = broadcast_shapes(shape, rate.shape, start.shape, goal.shape)
            weights = weights.expand(*shape, -1)
            rate, start, goal = (x.expand(shape) for x in (rate, start, goal))
        return torch.cat([weights, torch.stack([rate, start, goal], dim=-1)], dim=-1)

    def _numpy_coordinates(
        self, boundary: Boundary, duration: Tensor
    ) -> Float[np.ndarray, "D M"] | None:
        """`_motion_coordinates` for one motion in NumPy, in a third of the time.

        Returns:
            Coordinates. None where NumPy does not apply, or if a value is wrong;
            `_motion_coordinates` then reports it.
        """
        weights = self.weights
        if weights.ndim != 2 or duration.ndim or self.scaling != "none":
            return None
        # Attribute access on a module would take three times as long.
        own: Any = self._buffers.get
        start, goal, velocity = boundary
        dtype, device = weights.dtype, weights.device
        start = own("start") if start is None else to_tensor(start, dtype, device)
        goal = own("goal") if goal is None else to_tensor(goal, dtype, device)
        if velocity is None:
            velocity, per = own("start_velocity"), own("duration")
        else:
            velocity, per = to_tensor(velocity, dtype, device), duration
        if not fits_numpy(weights, start, goal, velocity, per):
            return None
        start, goal, velocity = start.numpy(), goal.numpy(), velocity.numpy()
        D, N = weights.shape
        if not start.shape == goal.shape == velocity.shape == (D,):
            return None
        x = np.empty((D, N + 3), start.dtype)
        x[:, :N] = weights.detach().numpy()
        np.multiply(velocity, per.item(), out=x[:, N])
        x[:, N + 1] = start
        x[:, N + 2] = goal
        for given, value in zip(boundary, (start, goal, velocity), strict=True):
            # For so few numbers Python's sum is fastest.
            if given is not None and not math.isfinite(sum(value.tolist())):
                return None
        return x

    @full_precision
    def initial_columns(
        self, boundary: Boundary, duration: Float[Tensor, "*#batch"]
    ) -> DMPState:
        """State at the start of a motion with this duration [s], for `step_columns`."""
        start, goal, rate = self.resolve_boundary(boundary, duration)
        self._check_batches(rate=rate, start=start, goal=goal, duration=duration[..., None])
        ends = (x.shape[:-1] for x in (start, goal, rate))
        batch = broadcast_shapes(self.weights.shape[:-2], *ends, duration.shape)
        start, goal, rate = (x.expand(*batch, -1) for x in (start, goal, rate))
        duration = duration.expand(batch)
        s = torch.zeros_like(duration, dtype=torch.float64)
        forced = self.response.forced.to(s.device)(s).to(start)
        # Copies, because an export would treat one tensor in two fields as one input.
        return DMPState(
            position=start.clone(),
            rate=rate,
            start=start,
            goal=goal,
            displacement=goal - start,
            target=goal.clone(),
            duration=duration,
            pace=torch.ones_like(duration),
            s=s,
            forced=forced @ self.weights.mT,
        )

    @full_precision
    def step_columns(
        self,
        state: DMPState,
        dt: Scalars,
        *,
        goal_filter: float | None = None,
        external_acceleration: Vectors | None = None,
        phase_stopping: Scalars | None = None,
        forcing_gain: Scalars | None = None,
    ) -> DMPState:
        """Advance by `dt` [s], exactly for terms that are constant over the step.

        Arguments are as in `MotionPrimitive.step`, but in columns; `external_acceleration`
        [1/s^2], (*batch, D), takes the place of `coupling`.
        """
        if not isinstance(dt, float):
            dt = to_tensor(dt, torch.float64, state.duration.device)
        check_not_negative("dt", dt)
        if (
            isinstance(dt, float)
            and goal_filter is external_acceleration is None
            and phase_stopping is forcing_gain is None
            and self.scaling == "none"
        ):
            fast = closed_loop_step.uncoupled_step(state, dt, self.response, self.weights)
            if fast is not None:
                return fast
        # Duration of the motion at the pace of this step.
        duration, pace = state.duration, torch.ones_like(state.pace)
        if phase_stopping is not None:
            slower = self._as_tensor(phase_stopping)
            check_not_negative("phase_stopping", slower)
            slower = 1 + slower
            duration, pace = duration * slower, pace / slower
        push = None
        if external_acceleration is not None:
            # Second derivatives with respect to s are tau^2 times those with respect to t.
            push = finite("coupling", self._as_tensor(external_acceleration))
            if push.ndim and push.shape[-1] not in (1, self.weights.shape[-2]):
                raise ValueError(
                    f"coupling must have shape (..., {self.weights.shape[-2]}), got "
                    f"{tuple(push.shape)}"
                )
            push = push * state.duration[..., None] ** 2
        gain = None
        if forcing_gain is not None:
            gain = finite("forcing_gain", self._as_tensor(forcing_gain))[..., None, None]
        # A plain number if possible, which takes a tenth of the time.
        known = closed_loop_step.host_value(duration) if isinstance(dt, float) else None
        ds = dt / known if isinstance(known, float) else duration.double().reciprocal() * dt
        attractor = state.target if goal_filter is None else state.goal
        return closed_loop_step.step(
            state,
            ds,
            response=self.response,
            weights=self.weights,
            scale=partial(self._scaled, start=state.start, goal=attractor),
            gain=gain,
            goal_filter=goal_filter,
            push=push,
            pace=pace,
        )

    def resolve_boundary(
        self, boundary: Boundary, duration: Float[Tensor, "*#batch"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Start, goal and initial dy/ds of a motion with this duration [s]."""
        start, goal, velocity = boundary
        start = self.start if start is None else checked_vector("start", start, self.start)
        goal = self.goal if goal is None else checked_vector("goal", goal, self.goal)
        if velocity is None:
            return start, goal, self.start_rate(start, goal)
        velocity = checked_vector("start_velocity", velocity, self.start_velocity)
        return start, goal, velocity * duration[..., None]

    def _check_batches(self, **boundary: Tensor) -> None:
        """Raise ValueError unless the primitives and their boundary broadcast."""
        shapes = {name: x.shape for name, x in boundary.items()}
        try:
            broadcast_shapes(self.weights.shape[:-1], *shapes.values())
        except (ValueError, RuntimeError):
            shapes = {"the primitive has": self.weights.shape[:-1]} | shapes
            batches = ", ".join(f"{name} {tuple(x[:-1])}" for name, x in shapes.items())
            raise ValueError(f"batches must broadcast, but {batches}") from None

    @full_precision
    def second_derivative(self, state: DMPState) -> Float[Tensor, "*batch D"]:
        """Second derivative d^2 y / ds^2 at a state, without the effect of couplings."""
        response = self.response
        force = response.basis.forcing(state.s)[..., None, :].to(self.weights)
        force = self._scaled(force @ self.weights.mT, state.start, state.goal)[..., 0, :]
        if response.approach:
            curve = response.approach_force(state.s).to(force)[..., None]
            force = force + state.displacement * curve
        return self.spring.acceleration(state.position - state.goal, state.rate) + force

    def start_rate(
        self, start: Float[Tensor, "*#batch D"], goal: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*#batch D"]:
        """Default start velocity dy/ds of a motion from `start` to `goal`."""
        duration = self.duration
        rate = self.start_velocity * (duration[..., None] if duration.ndim else duration)
        if not self.forcing_scale.turns:
            return rate
        return self._scaled(rate[..., None, :], start, goal)[..., 0, :]

    def equilibrium_goal(
        self, state: DMPState, second_derivative: Float[Tensor, "*batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """Goal for which the state has this `second_derivative` (for unscaled forcing)."""
        change = second_derivative - self.second_derivative(state)
        return state.goal + change / self.spring.stiffness

    def resolve_duration(self, duration: Scalars | None, speed: Scalars | None) -> Tensor:
        """Duration [s] from the arguments of a rollout, of which at most one is given."""
        if duration is not None and speed is not None:
            raise ValueError("give a duration or a speed, not both")
        if duration is not None:
            return positive("duration", duration, self.duration)
        if speed is not None:
            return self.duration / positive("speed", speed, self.duration)
        return self.duration

    def config(self) -> dict[str, Any]:
        """Contents of a saved primitive besides its tensors, as JSON values."""
        return {
            "joint_names": self.joint_names,
            "units": {"coordinates": self.units, "time": "s"},
            "scaling": self.forcing_scale.name,
            "scaled_columns": self.forcing_scale.columns,
            "approach": self.response.approach,
            "spring": asdict(self.spring),
            "basis": basis_config(self.basis),
        }

    @classmethod
    def restore[S: "LinearPrimitive"](cls: type[S], saved: SavedModel) -> S:
        """Linear primitive from a saved model.

        Raises:
            ValueError: A wrong field; the message names the file and the field.
        """
        names = [*TENSORS, *(name for name in saved.tensors if name.startswith(REPORT))]
        arguments = _tensor_arguments({name: saved.tensor(name) for name in names})
        shape = tuple(arguments["weights"].shape)
        for name in TENSORS[1:-1]:
            found = tuple(arguments[name].shape)
            if len(shape) < 2 or found != shape[: -2 if name == "duration" else -1]:
                raise saved.invalid(
                    f"{name} has shape {found}, which does not fit weights {shape}"
                )
        known = "scaled_columns" in saved.config
        columns = saved.get("scaled_columns", int, NoneType) if known else None
        parts = {
            "spring": saved.part("spring", dict, lambda fields: SpringDamper(**fields)),
            "basis": saved.part("basis", dict, restored_basis),
            "scaling": saved.part("scaling", str, lambda name: find_scaling(name, columns)),
        }
        try:
            return cls(
                **arguments,
                **parts,
                approach=float(saved.get("approach", float, int)),
                joint_names=saved.get("joint_names", list, NoneType),
                units=saved.get("units", dict).get("coordinates", ""),
            )
        except ValueError as error:
            raise saved.invalid(error) from None

    def _scaled(self, values: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        if self.scaling == "none":
            return values  # before the attribute look-ups, which take as long as a step
        return self.forcing_scale.scale(values, start, goal, self.demonstrated())

    def demonstrated(self) -> Demonstrated:
        """Start, goal and range of the demonstration, as the scaling needs them."""
        return Demonstrated(start=self.start, goal=self.goal, amplitude=self.amplitude)

    def _as_tensor(self, value: Scalars | Vectors) -> Tensor:
        return to_tensor(value, dtype=self.weights.dtype, device=self.weights.device)


def check_names(joint_names: Sequence[str] | None, D: int) -> None:
    """Raise ValueError unless the names, if there are any, are D different names."""
    if isinstance(joint_names, str):
        raise ValueError(f"joint names must be a list of names, got {joint_names!r}")
    if joint_names is not None and len(joint_names) != D:
        raise ValueError(f"{len(joint_names)} joint names for {D} coordinates")
    if joint_names is not None and len({*joint_names}) != D:
        raise ValueError(f"joint names must differ, but are {', '.join(joint_names)}")


def _tensor_arguments(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Tensor arguments of a linear primitive, from tensors named as in files."""
    report = {n.removeprefix(REPORT): x for n, x in tensors.items() if n.startswith(REPORT)}
    known = {field.name for field in fields(FitReport)} & report.keys()
    found: dict[str, Any] = {name: tensors[name] for name in TENSORS}
    if {"rmse", "peak", "span"} <= known:
        found["fit_report"] = FitReport(**{name: report[name] for name in known})
    return found
