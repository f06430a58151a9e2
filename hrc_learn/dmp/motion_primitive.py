"""The interface of all movement primitives, and their common implementation.

A linear primitive describes the motion of columns. Each kind of primitive maps its values to
columns and back. Joints are columns themselves. An orientation becomes its error to a
reference, and a pose becomes position, orientation error and body. Joints with a moving goal
become positions relative to this goal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypedDict, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    Points,
    Scalars,
    Times,
    Vectors,
    broadcast_shapes,
    checked_vector,
    readable,
    regular_times,
    seconds,
    to_tensor,
)
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.linear_primitive import Boundary, LinearPrimitive
from hrc_learn.dmp.samples import FitReport
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.dmp.via_points import ViaPoints, through_via_points
from hrc_learn.geometry import Pose
from hrc_learn.model_files import StoredModel

REFIT_SAMPLES = 20
"""Samples per basis function when a motion is fitted again: more do not change the result."""


class EndOptions(TypedDict, total=False):
    """Arguments for start and goal that only some kinds of primitive accept."""

    start_body: Vectors | None
    """Body at the start, (*batch, K); poses only."""
    goal_body: Vectors | None
    """Body at the goal, (*batch, K); poses only."""
    end_velocity: Vectors | None
    """Velocity at the end [1/s], (*batch, D); moving goals only."""


class MotionPrimitive[Value, Path, State](nn.Module, StoredModel):
    """Learned motion that adapts to start, goal, duration and via points.

    Kinds differ in their values: joints, a quaternion, a `Pose`. The class of each kind
    documents its values, velocities and couplings.
    """

    motion: LinearPrimitive
    """Linear primitive of the columns."""
    duration: Any
    """Duration of the demonstration [s], (*batch)."""
    error_columns: ClassVar[slice | None] = None
    """Columns with the error of an orientation, if any."""
    options: ClassVar[frozenset[str]] = frozenset()
    """Arguments of this kind beyond start, goal and start velocity."""

    # Columns are relative to a frame, which may differ between motions: the reference of an
    # orientation error, or the velocity of a moving goal; None if there is no frame. The
    # following methods apply to values that are columns themselves; other kinds override them.

    def with_motion[S: "MotionPrimitive"](self: S, motion: Any, frame: Any = None) -> S:
        """Primitive of the same kind with another linear primitive.

        Args:
            motion: The new linear primitive.
            frame: Frame of the columns; None keeps that of this primitive.
        """
        return motion

    def state_of(self, columns: DMPState, frame: Any) -> Any:
        """State in closed loop from its columns and their frame."""
        return columns

    def _columns(self, state: Any) -> tuple[DMPState, Any]:
        """Columns and frame of a state; the inverse of `state_of`."""
        return state, None

    def _boundary(
        self, given: Boundary, duration: Tensor, **options: Any
    ) -> tuple[Boundary, Any]:
        """Boundary of a motion in columns, and its frame.

        Args:
            given: Start, goal and start velocity from the caller; None for a demonstrated
                value.
            duration: Duration of the motion [s].
            options: Arguments of this kind.
        """
        return given, None

    def _trajectory(self, columns: Trajectory, frame: Any) -> Any:
        """Result of a rollout."""
        return columns

    def _retarget(
        self, columns: DMPState, frame: Any, goal: Any, filtered: bool, **options: Any
    ) -> tuple[DMPState, Any, Any]:
        """Columns, frame and goal (as columns) for a new goal, at the same value and velocity.

        Args:
            columns: Current state.
            frame: Current frame.
            goal: New goal; None if only `options` are new.
            filtered: True to keep the acceleration, for a filtered goal.
            options: Goals of this kind.
        """
        return columns, frame, goal

    def _via(self, now: Tensor, value: Any, velocity: Any) -> tuple[Tensor, Tensor]:
        """Via points as columns and their velocities in the frame of the primitive.

        Args:
            now: Columns of the unchanged motion at these times, (*batch, n, D).
            value: Values from the caller; None or NaN leaves them free.
            velocity: Velocities from the caller, per second; None or NaN leaves them free.
        """
        return via_values(value, now), via_values(velocity, now, "velocity")

    def _acceleration(self, columns: DMPState, frame: Any, coupling: Any) -> Any:
        """Second derivatives of the columns [1/s^2] for a coupling term."""
        return coupling

    def config(self) -> dict[str, Any]:
        """Contents of a saved primitive besides its tensors, as JSON values."""
        return self.motion.config()

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the primitive, fit report included, by the names used in files."""
        return self.motion.tensors()

    def with_tensors[S: "MotionPrimitive"](self: S, tensors: Mapping[str, Tensor]) -> S:
        """The same primitive with other tensors, named as in `tensors`."""
        return self.with_motion(self.motion.with_tensors(tensors))

    def __len__(self) -> int:
        """Number of primitives along the first batch axis.

        Raises:
            TypeError: The primitive is not a batch.
        """
        if not self.duration.ndim:
            raise TypeError("a single primitive has no length: it is not a batch")
        return self.duration.shape[0]

    def __bool__(self) -> bool:
        """Return True, even for an empty batch, so that `if primitive` only tests for None."""
        return True

    def __getitem__[S: "MotionPrimitive"](self: S, index: Any) -> S:
        """Copy of a part of a batch, indexed like the first axes of a tensor.

        Gradients flow through weights that are a buffer; a parameter is copied.
        """
        if not self.duration.ndim:
            raise TypeError("a single primitive cannot be indexed: it is not a batch")
        shared = {"timestamps"} if self.motion.timestamps.ndim == 1 else set()
        tensors = self.tensors().items()
        return self.with_tensors(
            {name: (x if name in shared else x[index]).clone() for name, x in tensors}
        )

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
        **options: Unpack[EndOptions],
    ) -> Path:
        """Compute the whole motion from start to goal; by default, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them. Outputs of
        the result can be plotted as they are.

        Args:
            time: Time since the start of the motion [s], (T,) or (*batch, T), not negative; by
                default the timestamps of the demonstration, stretched to the duration. After
                the duration, the motion settles at its goal.
            start: Start, (*batch).
            goal: Goal, (*batch).
            duration: Duration [s], (*batch).
            start_velocity: Velocity at the start per second, (*batch). The default is the
                demonstrated velocity, adapted to the duration so that the path stays the same.
                The scaling `"rotation"` also turns and scales it with the displacement from
                start to goal.
            speed: Speed relative to the demonstration, instead of a duration.
            dt: Sampling interval [s], instead of `time`. The samples run from zero to the first
                sample at or after the end of the longest motion.
            forcing_gain: Factor on the forcing term, (*batch); it scales the amplitude of a
                rhythm.
            options: Further arguments of this kind of primitive.
        """
        given = Boundary(start, goal, start_velocity)
        boundary, tau, frame = self._resolved(given, duration, speed, **options)
        if dt is not None:
            if time is not None:
                raise ValueError("give times or an interval dt, not both")
            time = regular_times(dt, tau)
        columns = self.motion.rollout_columns(boundary, tau, time, forcing_gain)
        return self._trajectory(columns, frame)

    def initial_state(
        self,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        **options: Unpack[EndOptions],
    ) -> State:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        given = Boundary(start, goal, start_velocity)
        boundary, tau, frame = self._resolved(given, duration, speed, **options)
        columns = self.motion.initial_columns(boundary, tau)
        if frame is not None:
            # One copy per element: an export would treat one tensor in two places as one input.
            frame = frame.expand(*columns.position.shape[:-1], frame.shape[-1]).clone()
        return self.state_of(columns, frame)

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

        Uncoupled steps of any length reach the states of the rollout. A coupling that depends
        on the state is evaluated at the start of the step, which causes an error of first order
        in `dt`. The same holds for a filtered goal with the scalings `"paper"` and
        `"rotation"`, because the goal then scales the forcing. A new goal changes neither the
        current value nor the velocity.

        Args:
            state: From `initial_state` or the last step.
            dt: Time step [s], (*batch).
            goal: New goal from now on, (*batch).
            goal_filter: Rate, per duration, at which the goal approaches the commanded goal, to
                avoid a jump of the acceleration. None: the goal jumps.
            coupling: External acceleration added to the motion [1/s^2], (*batch).
            phase_stopping: Number p >= 0, (*batch). The clock of phase and spring runs slower
                by the factor 1 + p, so the motion slows down on its path.
            forcing_gain: Factor on the forcing term, (*batch).
            goal_body: New goal of the body, (*batch, K); poses only.
        """
        filtered = goal_filter is not None
        state = self.retarget(state, goal, goal_body=goal_body, filtered=filtered)
        columns, frame = self._columns(state)
        push = None if coupling is None else self._acceleration(columns, frame, coupling)
        columns = self.motion.step_columns(
            columns,
            dt,
            goal_filter=goal_filter,
            external_acceleration=push,
            phase_stopping=phase_stopping,
            forcing_gain=forcing_gain,
        )
        return self.state_of(columns, frame)

    def retarget(
        self,
        state: State,
        goal: Value | None = None,
        *,
        goal_body: Vectors | None = None,
        filtered: bool = True,
    ) -> State:
        """State with a new goal, and the same value and velocity.

        With `filtered`, the acceleration is the same too. It is then continuous in the next
        steps if they have a `goal_filter`.

        Args:
            state: Current state.
            goal: New goal, (*batch); None keeps the goal.
            goal_body: Goal of the body, (*batch, K); poses only.
            filtered: False if the next step has no `goal_filter`; this is faster for
                orientations.
        """
        if goal is None and goal_body is None:
            return state
        columns, frame = self._columns(state)
        given = self._given(goal_body=goal_body)
        columns, frame, target = self._retarget(columns, frame, goal, filtered, **given)
        if target is not columns.target:
            target = checked_vector("goal", target, columns.target).expand_as(columns.target)
            columns = replace(columns, target=target)
        return self.state_of(columns, frame)

    def condition[S: "MotionPrimitive"](
        self: S,
        time: Times,
        value: Any = None,
        velocity: Points | None = None,
        *,
        within: tuple[float | int, float | int] | None = None,
    ) -> S:
        """Primitive that passes exactly through via points.

        Start and goal keep their values and velocities, and columns without a via point do not
        change. With `within`, the motion outside of this interval does not change either. Via
        points refer to the start, goal and duration of this primitive; to use others, call
        `with_boundary` first. Gradients flow to times, values and velocities. Via points are
        too close together if the motion would change by more than 1.5 times the largest change
        that the via points require.

        Args:
            time: Times of the via points [s], (*batch, n).
            value: Values, as for `via_points`; NaN leaves a value free.
            velocity: Velocities, as for `via_points`. If a value is given, None or NaN keeps
                the velocity of the motion.
            within: Times [s] between which the motion may change; None: from start to end.

        Raises:
            ValueError: Two via points are at the same time, one is outside of `within`, or
                they are too many or too close together for the basis; the message names a
                sufficient distance.
        """
        via = self.via_points(time, value, velocity)
        return self.with_motion(through_via_points(self.motion, via, within))

    def via_points(
        self, time: Times, value: Any = None, velocity: Points | None = None
    ) -> ViaPoints:
        """Via points as columns (float64); the body of a pose stays free.

        An orientation becomes its error on the branch nearest to the motion, so both signs of a
        quaternion give the same result. An angular velocity becomes the rate of the error at
        the given orientation, or at the orientation of the motion if none is given.

        Args:
            time: Times of the via points [s], (*batch, n).
            value: Joints (*batch, n, D); unit quaternions (*batch, n, 4); or a `Pose` of
                (*batch, n). NaN leaves a coordinate free; a quaternion with a NaN leaves the
                orientation free.
            velocity: Joint velocities (*batch, n, D), angular velocities [rad/s] (*batch, n, 3)
                or twists (*batch, n, 6). NaN leaves a velocity free.

        Raises:
            ValueError: Negative times, or shapes that do not fit.
        """
        motion = self.motion
        time = seconds(time, motion.start.device)
        duration = motion.duration.double()[..., None]
        now = motion.rollout_columns(Boundary(), motion.duration, time.detach()).position
        position, per_s = self._via(now.detach().double(), value, velocity)
        rate = per_s * duration[..., None]
        return ViaPoints(s=time / duration, position=position, rate=rate)

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
        motion = self.motion
        if motion.forcing_scale.depends_on_boundary:
            raise ValueError(
                f"scaling {motion.scaling!r} depends on start and goal: fit with 'none'"
            )
        given = Boundary(start, goal, start_velocity)
        boundary, tau, frame = self._resolved(
            given, duration, speed, start_body=start_body, goal_body=goal_body
        )
        moved = motion.initial_columns(boundary, tau)
        ends = torch.stack([moved.rate, moved.position, moved.goal], dim=-1)
        weights = motion.weights.expand(*ends.shape[:-1], -1)
        x = torch.cat([weights, ends], dim=-1)
        return self.with_motion(motion.with_coordinates(x, moved.duration), frame)

    def reversed[S: "MotionPrimitive"](self: S) -> S:
        """Primitive that moves along the same path backwards, from the goal to the start.

        At time t, its motion has the position of this primitive at duration - t. The result is
        fitted with the same basis, and accepts new starts and goals.

        Raises:
            ValueError: A rhythm, which has no end to start from.
        """
        motion: Any = self.motion
        if motion.basis.periodic:
            raise ValueError("a rhythm cannot be reversed: it has no end to start from")
        s = torch.linspace(0, 1, REFIT_SAMPLES * motion.basis.count + 1, dtype=torch.float64)
        s = s.to(motion.start.device)
        with torch.no_grad():
            time = s * motion.duration[..., None]
            shown = motion.rollout_columns(Boundary(), motion.duration, time)
        back = motion.refit(s, shown.position.flip(-2), motion.forcing_scale)
        x, timestamps = back.coordinates().detach(), 1 - motion.timestamps.flip(-1)
        backwards = motion.with_coordinates(x, amplitude=back.amplitude, timestamps=timestamps)
        return self.with_motion(backwards)

    def _resolved(
        self, given: Boundary, duration: Scalars | None, speed: Scalars | None, **options: Any
    ) -> tuple[Boundary, Tensor, Any]:
        """Boundary of a motion in columns, its duration [s], and its frame."""
        tau = self.motion.resolve_duration(duration, speed)
        columns, frame = self._boundary(given, tau, **self._given(**options))
        return columns, tau, frame

    def _given(self, **options: Any) -> dict[str, Any]:
        """Arguments that are not None.

        Raises:
            ValueError: The kind of primitive does not have one of them.
        """
        options = {name: value for name, value in options.items() if value is not None}
        if unknown := [name for name in options if name not in self.options]:
            raise ValueError(f"this kind of primitive has no {', '.join(sorted(unknown))}")
        return options


class WrappedPrimitive[Value, Path, State](MotionPrimitive[Value, Path, State]):
    """Primitive that holds a linear primitive as a submodule."""

    motion: LinearPrimitive

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Duration of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals of the columns."""
        return self.motion.fit_report


def via_values(
    value: Any, like: Tensor, name: str = "value", columns: int | None = None
) -> Float[Tensor, "*batch n D"]:
    """Via values as a float64 tensor; NaN if None was given.

    Args:
        value: Values from the caller.
        like: Tensor with the expected shape.
        name: Name of the value in error messages.
        columns: Number of columns D, if not that of `like`.

    Raises:
        ValueError: Another shape, or a `Pose`.
    """
    if isinstance(value, Pose):
        raise ValueError(f"{name} of joints or an orientation must be an array, got a Pose")
    shape = (*like.shape[:-1], like.shape[-1] if columns is None else columns)
    if value is None:
        return torch.full(shape, torch.nan).to(like)
    tensor = to_tensor(value, torch.float64, like.device)
    if tensor.ndim < 2 or tensor.shape[-2:] != shape[-2:]:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    if readable(tensor) and tensor.isinf().any():
        raise ValueError(f"{name} must be finite, or NaN where it is free")
    return tensor.expand(broadcast_shapes(tensor.shape, shape))


def stack[P: MotionPrimitive](primitives: Sequence[P]) -> P:
    """Batch of primitives of one kind, basis and spring, along a new first axis.

    If timestamps differ, each primitive keeps its own, padded with its last timestamp.
    The result has a fit report if all primitives have one.

    Raises:
        ValueError: The list is empty, or the primitives differ; the message names the
            difference.
    """
    if not primitives:
        raise ValueError("there are no primitives to stack")
    first, *others = map(_described, primitives)
    for i, other in enumerate(others, start=1):
        if different := [name for name in first if other[name] != first[name]]:
            name = different[0]
            raise ValueError(
                f"primitives of one batch must be alike, but {name} is {other[name]} in "
                f"primitive {i} and {first[name]} in primitive 0"
            )
    tensors = [primitive.tensors() for primitive in primitives]
    # Some primitives may lack parts of the fit report.
    names = set.intersection(*map(set, tensors))
    columns = {name: [each[name] for each in tensors] for name in names}
    return primitives[0].with_tensors(
        {
            name: _padded(rows) if name == "timestamps" else torch.stack(rows)
            for name, rows in columns.items()
        }
    )


def _described(primitive: MotionPrimitive) -> dict[str, Any]:
    """Properties in which the primitives of a batch have to agree."""
    shape = tuple(primitive.motion.weights.shape)
    kind = {"kind": type(primitive).__name__}
    return kind | primitive.motion.config() | {"shape of the weights": shape}


def _padded(rows: list[Tensor]) -> Tensor:
    """One grid of timestamps if all are equal, else one padded row for each primitive."""
    if all(x.shape == rows[0].shape and torch.equal(x, rows[0]) for x in rows):
        return rows[0].clone()
    T = max(x.shape[-1] for x in rows)
    rows = [
        torch.cat([x, x[..., -1:].expand(*x.shape[:-1], T - x.shape[-1])], -1) for x in rows
    ]
    return torch.stack(torch.broadcast_tensors(*rows))
