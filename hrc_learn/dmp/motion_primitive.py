"""The interface of all movement primitives, and their one implementation.

Every kind of primitive is a coordinate adapter around a linear primitive. The linear primitive
moves columns; the adapter maps the values of a kind to columns and back: joints are columns
themselves, an orientation becomes its error to a reference, a pose is position, orientation
error and body, and a moving goal is the frame in which joints are seen.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    Points,
    Scalars,
    Times,
    Vectors,
    regular_times,
    seconds,
    to_tensor,
)
from hrc_learn.dmp.batching import select
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.fitting.samples import FitReport, check_samples
from hrc_learn.dmp.fitting.solvers import REGULARIZATION, fit_samples
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.via_points import ViaPoints, through_via_points
from hrc_learn.model_files import SavedModel, write_model

REFIT_SAMPLES = 20
"""Samples per basis function when a motion is fitted again: more do not change the result."""


class ColumnPoints(NamedTuple):
    """Columns at the times of via points, (*batch, n, D); NaN leaves a value free."""

    position: Tensor
    velocity: Tensor
    """Velocity, per second."""


class Retargeted(NamedTuple):
    """State of a motion that received a new goal under way."""

    columns: DMPState
    frame: Any
    target: Any = None
    """New goal in columns; None keeps that of `columns`."""


class CoordinateAdapter[Value, Path, State](ABC):
    """Map from values to columns and back.

    `Value` is the type of starts and goals, `Path` that of a rollout, `State` that of the
    closed loop. The frame is what columns are relative to and may differ between motions: the
    reference of an orientation error, the velocity of a moving goal; None where there is none.
    The argument `motion` is always the linear primitive that the columns belong to.
    """

    linear: ClassVar[bool] = True
    """True if the columns move as a linear primitive does."""
    error_columns: ClassVar[slice | None] = None
    """Columns with the error of an orientation, if any."""
    options: ClassVar[frozenset[str]] = frozenset()
    """Arguments of this kind beyond start, goal and start velocity."""

    @abstractmethod
    def boundary(
        self, motion: LinearPrimitive, given: Boundary, duration: Tensor, **options: Any
    ) -> tuple[Boundary, Any]:
        """Boundary of a motion in columns, and its frame.

        Args:
            motion: Supplies what is None.
            given: Start, goal and start velocity from the caller.
            duration: [s].
            options: Arguments of this kind.
        """

    @abstractmethod
    def trajectory(self, columns: Any, frame: Any) -> Path:
        """Result of a rollout."""

    @abstractmethod
    def state(self, columns: DMPState, frame: Any) -> State:
        """State in closed loop."""

    @abstractmethod
    def columns(self, state: State) -> tuple[DMPState, Any]:
        """Columns and frame of a state; the inverse of `state`."""

    @abstractmethod
    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Any,
        goal: Value | None,
        **options: Any,
    ) -> Retargeted:
        """Columns and frame with a new goal, for the same value and velocity.

        Args:
            motion: Linear primitive of the columns.
            columns: Current state.
            frame: Current frame.
            goal: New goal; None if only `options` are new.
            options: Goals of this kind.
        """

    @abstractmethod
    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Any,
        velocity: Any,
        **options: Any,
    ) -> ColumnPoints:
        """Via points as columns in the frame of the primitive.

        Args:
            motion: Linear primitive of the columns.
            now: Columns of the unchanged motion at these times.
            value: Values from the caller; None or NaN leaves them free.
            velocity: Velocities from the caller, per second; None or NaN leaves them free.
            options: Values of this kind.
        """

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Any, coupling: Any
    ) -> Any:
        """Second derivatives of the columns [1/s^2] for a coupling term."""
        return coupling

    def rollout(
        self,
        motion: LinearPrimitive,
        boundary: Boundary,
        duration: Tensor,
        time: Times | None,
        forcing_gain: Scalars | None,
    ) -> Any:
        """Motion of the columns."""
        return motion.rollout_columns(boundary, duration, time, forcing_gain)

    def step(
        self, motion: LinearPrimitive, columns: DMPState, dt: Scalars, **inputs: Any
    ) -> DMPState:
        """State of the columns after `dt` [s]; inputs as in `LinearPrimitive.step_columns`."""
        return motion.step_columns(columns, dt, **inputs)


class MotionPrimitive[Value, Path, State](nn.Module, ABC):
    """Learned motion that start, goal, duration and via points reshape.

    Kinds differ in their values: joints, a quaternion, a `Pose`. The class of each kind
    documents its values, velocities and couplings.
    """

    motion: LinearPrimitive
    """Linear primitive of the columns."""
    duration: Any
    """Duration of the demonstration [s], (*batch)."""

    @property
    @abstractmethod
    def adapter(self) -> CoordinateAdapter[Value, Path, State]:
        """Map from values to columns."""

    @abstractmethod
    def with_motion[S: "MotionPrimitive"](self: S, motion: Any, frame: Any = None) -> S:
        """Primitive of the same kind around another linear one.

        Args:
            motion: Replaces the linear primitive.
            frame: Frame of the columns; None keeps that of this primitive.
        """

    @classmethod
    @abstractmethod
    def _restored[S: "MotionPrimitive"](cls: type[S], saved: SavedModel) -> S:
        """Primitive from a saved model."""

    def _own_config(self) -> dict[str, Any]:
        """Contents of a saved primitive besides those of its motion, as JSON values."""
        return {}

    def _own_tensors(self) -> dict[str, Tensor]:
        """Tensors of a saved primitive besides those of its motion, by name."""
        return {}

    def __len__(self) -> int:
        """Number of primitives along the first batch axis.

        Raises:
            TypeError: The primitive is not a batch.
        """
        if not self.duration.ndim:
            raise TypeError("a single primitive has no length: it is not a batch")
        return self.duration.shape[0]

    def __bool__(self) -> bool:
        """Return True, also for an empty batch: a primitive is not a container of truth."""
        return True

    def __getitem__[S: "MotionPrimitive"](self: S, index: Any) -> S:
        """Part of a batch, indexed like the first axes of a tensor, with memory of its own."""
        if not self.duration.ndim:
            raise TypeError("a single primitive cannot be indexed: it is not a batch")
        return select(self, index)

    def rollout(
        self,
        time: Times | None = None,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        dt: float | int | None = None,
        forcing_gain: Scalars | None = None,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
        end_velocity: Vectors | None = None,
    ) -> Path:
        """Compute the whole motion from start to goal; by default, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them. Outputs of
        the result can be plotted as they are.

        Args:
            time: Time since the start of the motion [s], (T,) or (*batch, T), not negative; by
                default the timestamps of the demonstration, stretched to the duration. After
                the duration, the motion settles at its goal.
            start: (*batch).
            goal: (*batch).
            duration: [s], (*batch).
            start_velocity: Per second, (*batch). By default the demonstrated one, adapted to
                the duration so that the path stays the same, and turned and scaled with the
                displacement if the scaling is `"rotation"`.
            speed: Speed relative to the demonstration, instead of a duration.
            dt: Sampling interval [s], instead of times: from zero to the end of the longest
                motion, or the first sample past it.
            forcing_gain: Factor on the forcing term, (*batch): the amplitude of a rhythm.
            start_body: Body at the start, (*batch, K); poses only.
            goal_body: Body at the goal, (*batch, K); poses only.
            end_velocity: Velocity at the end [1/s], (*batch, D); moving goals only.
        """
        motion, adapter = self.motion, self.adapter
        given = Boundary(start, goal, start_velocity)
        options = {"start_body": start_body, "goal_body": goal_body}
        columns, tau, frame = self._boundary(
            given, duration, speed, **options, end_velocity=end_velocity
        )
        if dt is not None:
            if time is not None:
                raise ValueError("give times or an interval dt, not both")
            time = regular_times(dt, tau)
        motion_columns = adapter.rollout(motion, columns, tau, time, forcing_gain)
        return adapter.trajectory(motion_columns, frame)

    def initial_state(
        self,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
        end_velocity: Vectors | None = None,
    ) -> State:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        given = Boundary(start, goal, start_velocity)
        options = {"start_body": start_body, "goal_body": goal_body}
        boundary, tau, frame = self._boundary(
            given, duration, speed, **options, end_velocity=end_velocity
        )
        columns = self.motion.initial_columns(boundary, tau)
        if frame is not None:
            # A copy for each element: an export takes one tensor in two places for one input.
            frame = frame.expand(*columns.position.shape[:-1], frame.shape[-1]).clone()
        return self.adapter.state(columns, frame)

    def step(
        self,
        state: State,
        dt: Scalars,
        *,
        goal: Value | None = None,
        goal_filter: float | None = None,
        coupling: Any = None,
        phase_stopping: Scalars | None = None,
        forcing_gain: Scalars | None = None,
        goal_body: Vectors | None = None,
    ) -> State:
        """Advance by `dt`, exactly for terms that are constant over the step.

        Uncoupled steps of any length end where the rollout does. A coupling that depends on
        the state is evaluated at the start of the step, which is of first order in `dt`; so is
        a filtered goal with the scaling `"paper"`, whose forcing it scales. A new goal changes
        neither the current value nor its velocity.

        Args:
            state: From `initial_state` or the last step.
            dt: [s], (*batch).
            goal: New goal from now on, (*batch).
            goal_filter: Rate, per duration, at which the goal moves to the commanded one, which
                avoids a jump of the acceleration. None: it jumps.
            coupling: External acceleration added to the motion [1/s^2], (*batch).
            phase_stopping: The clock of the whole system, phase and spring, runs slower by the
                factor 1 + this, (*batch), >= 0. The motion slows down on its path.
            forcing_gain: Factor on the forcing term, (*batch).
            goal_body: New goal of the body, (*batch, K); poses only.
        """
        adapter = self.adapter
        columns, frame, target = self._retargeted(state, goal, goal_body)
        columns = adapter.step(
            self.motion,
            columns,
            dt,
            goal=target,
            goal_filter=goal_filter,
            external_acceleration=adapter.external_acceleration(
                self.motion, columns, frame, coupling
            ),
            phase_stopping=phase_stopping,
            forcing_gain=forcing_gain,
        )
        return adapter.state(columns, frame)

    def retarget(
        self, state: State, goal: Value | None = None, *, goal_body: Vectors | None = None
    ) -> State:
        """State with a new goal, and the same value, velocity and acceleration.

        The acceleration is continuous in the next steps if they have a `goal_filter`.

        Args:
            state: Current state.
            goal: (*batch).
            goal_body: Goal of the body, (*batch, K); poses only.
        """
        columns, frame, target = self._retargeted(state, goal, goal_body)
        if target is not None:
            target = to_tensor(target, columns.target.dtype, columns.target.device)
            columns = replace(columns, target=target.expand_as(columns.target))
        return self.adapter.state(columns, frame)

    def condition[S: "MotionPrimitive"](
        self: S,
        time: Times,
        value: Any = None,
        velocity: Points | None = None,
        *,
        body: Points | None = None,
        body_velocity: Points | None = None,
        within: tuple[float | int, float | int] | None = None,
    ) -> S:
        """Primitive that passes exactly through via points.

        Start and goal stay, with their velocities, and so does any column without a via point.
        With `within`, so does the motion outside of that time. Via points hold for the
        primitive's own start, goal and duration: set others before, with `with_boundary`.
        Gradients flow to times, values and velocities.

        Args:
            time: Times of the via points [s], (*batch, n).
            value: Values as for `via_points`, like all that follow; NaN leaves them free.
            velocity: Velocities. None or NaN keeps that of the motion if a value is given.
            body: Body of a pose.
            body_velocity: Velocity of the body of a pose.
            within: Times [s] between which the motion may change; None: from start to end.

        Raises:
            ValueError: Via points at one time or outside of the window, or too many for the
                basis.
        """
        via = self.via_points(time, value, velocity, body=body, body_velocity=body_velocity)
        return self.with_motion(through_via_points(self.linear_motion(), via, within))

    def via_points(
        self,
        time: Times,
        value: Any = None,
        velocity: Points | None = None,
        *,
        body: Points | None = None,
        body_velocity: Points | None = None,
    ) -> ViaPoints:
        """Via points as columns (float64).

        An orientation becomes the error on the branch nearest to the motion there, so that both
        signs mean the same. An angular velocity becomes the rate of the error at the given
        orientation, or at that of the motion.

        Args:
            time: [s], (*batch, n).
            value: Joints (*batch, n, D); unit quaternions (*batch, n, 4); or a `Pose` of
                (*batch, n). NaN leaves a coordinate free; in a quaternion, the orientation.
            velocity: Of joints (*batch, n, D); angular [rad/s], (*batch, n, 3); or a twist
                (*batch, n, 6). NaN leaves it free.
            body: Body of a pose, (*batch, n, K).
            body_velocity: Velocity of the body of a pose, (*batch, n, K).

        Raises:
            ValueError: Negative times, or shapes that do not fit.
        """
        motion, adapter = self.linear_motion(), self.adapter
        time = seconds(time, motion.start.device)
        options = _given(adapter, body=body, body_velocity=body_velocity)
        duration = motion.duration.double()[..., None]
        now = motion.rollout_columns(Boundary(), motion.duration, time.detach())
        now = ColumnPoints(*(x.detach().double() for x in (now.position, now.velocity)))
        via = adapter.via_points(motion, now, value, velocity, **options)
        rate = via.velocity * duration[..., None]
        return ViaPoints(s=time / duration, position=via.position, rate=rate)

    def with_boundary[S: "MotionPrimitive"](
        self: S,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        start_body: Vectors | None = None,
        goal_body: Vectors | None = None,
    ) -> S:
        """Primitive whose default motion has this boundary; arguments as in `rollout`.

        Raises:
            ValueError: The scaling depends on the boundary, so the weights would differ.
        """
        motion = self.linear_motion()
        if motion.forcing_scale.depends_on_boundary:
            raise ValueError(
                f"scaling {motion.scaling!r} depends on start and goal: fit with 'none'"
            )
        given = Boundary(start, goal, start_velocity)
        boundary, tau, frame = self._boundary(
            given, duration, speed, start_body=start_body, goal_body=goal_body
        )
        moved = motion.initial_columns(boundary, tau)
        ends = torch.stack([moved.rate, moved.position, moved.goal], dim=-1)
        weights = motion.weights.expand(*ends.shape[:-1], -1)
        x = torch.cat([weights, ends], dim=-1)
        return self.with_motion(motion.with_coordinates(x, moved.duration), frame)

    def reversed[S: "MotionPrimitive"](self: S) -> S:
        """Primitive that moves the same path backwards, from the goal to the start.

        Its motion is that of this primitive at duration - t, fitted with the same basis. It
        accepts new starts and goals like any other.

        Raises:
            ValueError: A rhythm, which has no end to start from.
        """
        motion = self.linear_motion()
        if motion.basis.periodic:
            raise ValueError("a rhythm cannot be reversed: it has no end to start from")
        s = torch.linspace(0, 1, REFIT_SAMPLES * motion.basis.count + 1, dtype=torch.float64)
        s = s.to(motion.start.device)
        with torch.no_grad():
            time = s * motion.duration[..., None]
            shown = motion.rollout_columns(Boundary(), motion.duration, time)
            samples = check_samples(s, shown.position.double().flip(-2))
            weights, rate = fit_samples("trajectory", motion.response, samples, REGULARIZATION)
            first, last = samples.first, samples.last
            amplitude = motion.amplitude.reshape(first.shape).double()
            backwards = Demonstrated(first, last, amplitude)
            weights = motion.forcing_scale.unscale(weights.mT, backwards).mT
            x = torch.cat([weights, torch.stack([rate, first, last], dim=-1)], dim=-1)
        x = x.view(*motion.weights.shape[:-1], -1)
        timestamps = 1 - motion.timestamps.flip(-1)
        return self.with_motion(motion.with_coordinates(x, timestamps=timestamps))

    def linear_motion(self) -> LinearPrimitive:
        """Linear primitive of the columns.

        Raises:
            ValueError: The columns do not move linearly, as in the formulation of Ude et al.
        """
        if not self.adapter.linear:
            raise ValueError(
                f"formulation {getattr(self, 'formulation', '?')!r} is not linear: fit with "
                f"'log' instead"
            )
        return self.motion

    def save(self, folder: str | FilePath) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        config = self.motion.config() | self._own_config()
        tensors = self._own_tensors() | self.motion.tensors()
        write_model(folder, type(self).__name__, config, tensors)

    @classmethod
    def load[S: "MotionPrimitive"](cls: type[S], folder: str | FilePath) -> S:
        """Read a primitive that `save` wrote.

        Raises:
            FileNotFoundError: The folder holds no saved primitive.
            ValueError: A wrong field; the message names the file and the field.
        """
        return cls._restored(SavedModel(folder, cls.__name__))

    def _boundary(
        self, given: Boundary, duration: Scalars | None, speed: Scalars | None, **options: Any
    ) -> tuple[Boundary, Tensor, Any]:
        """Boundary of a motion in columns, its duration [s], and its frame."""
        tau = self.motion.resolve_duration(duration, speed)
        options = _given(self.adapter, **options)
        columns, frame = self.adapter.boundary(self.motion, given, tau, **options)
        return columns, tau, frame

    def _retargeted(
        self, state: State, goal: Value | None, goal_body: Vectors | None
    ) -> Retargeted:
        columns, frame = self.adapter.columns(state)
        if goal is None and goal_body is None:
            return Retargeted(columns, frame)
        options = _given(self.adapter, goal_body=goal_body)
        return self.adapter.retarget(self.motion, columns, frame, goal, **options)


class WrappedPrimitive[Value, Path, State](MotionPrimitive[Value, Path, State]):
    """Primitive with a linear one as a module of its own."""

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Duration of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals of the columns."""
        return self.motion.fit_report


def _given(adapter: CoordinateAdapter, **options: Any) -> dict[str, Any]:
    """Arguments that are not None.

    Raises:
        ValueError: The kind of primitive does not have one of them.
    """
    options = {name: value for name, value in options.items() if value is not None}
    if unknown := options.keys() - adapter.options:
        raise ValueError(f"this kind of primitive has no {', '.join(sorted(unknown))}")
    return options
