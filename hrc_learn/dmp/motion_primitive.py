"""What every movement primitive can do, and the one implementation of it.

`MotionPrimitive` is what a caller may rely on, of joints, orientations, poses, rhythms, limited
joints, two arms and moving goals alike. `AdaptedPrimitive` does it for all of them: the linear
primitive moves columns, the adapter of a kind says what they mean.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import singledispatch
from pathlib import Path as FilePath
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    FitReport,
    Points,
    Scalars,
    Times,
    check_samples,
    regular_times,
    to_tensor,
)
from hrc_learn.dmp._fitting import REGULARIZATION, fit_samples
from hrc_learn.dmp._via_points import ViaPoints, through_via_points
from hrc_learn.dmp.batching import select
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter
from hrc_learn.dmp.forcing_scale import Demonstrated
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.model_files import SavedModel, write_model

FINE = 20
"""Samples for each basis function of a motion that is fitted anew: more change no digit."""


@runtime_checkable
class MotionPrimitive(Protocol):
    """A learned motion that start, goal, duration and via points reshape.

    Kinds differ in what a value is (joints, a quaternion, a `Pose`) and in the arguments they
    add; each documents its own.
    """

    @classmethod
    def fit(cls, time: Times, *demonstration: Any, **options: Any) -> Any:
        """Learn one primitive from each demonstration, (*B, T) samples each."""
        ...

    def rollout(self, time: Times | None = None, /) -> Any:
        """The whole motion; without arguments, the demonstrated one."""
        ...

    def initial_state(self) -> Any:
        """State at the start of a motion, a pytree, for `step`."""
        ...

    def step(self, state: Any, dt: Scalars) -> Any:
        """The state `dt` seconds later."""
        ...

    def condition(self, time: Times, value: Any = None, velocity: Any = None) -> Any:
        """The primitive, changed so that it passes via points exactly."""
        ...

    def save(self, folder: str | FilePath) -> None:
        """Write the primitive into a folder of its own."""
        ...

    @classmethod
    def load(cls, folder: str | FilePath) -> Any:
        """Read what `save` wrote."""
        ...

    def export(self, *, goal_filter: float | None = None) -> Any:
        """The step for other programs, as an `ExportedDMP`."""
        ...


@singledispatch
def export_primitive(primitive: Any, *, goal_filter: float | None = None) -> Any:
    """An `ExportedDMP` of a primitive. Exporters register for the types that they take."""
    raise TypeError(f"no exporter is registered for {type(primitive).__name__}")


class AdaptedPrimitive[Value, Path, State](nn.Module, ABC):
    """A linear primitive behind a coordinate adapter: all that kinds have in common."""

    motion: LinearPrimitive
    """Of the columns."""
    duration: Any
    """Of the demonstration [s], (*batch)."""

    @property
    @abstractmethod
    def adapter(self) -> CoordinateAdapter[Value, Path, State]:
        """What the columns mean."""

    @abstractmethod
    def with_motion[S: "AdaptedPrimitive"](self: S, motion: Any, frame: Any = None) -> S:
        """A primitive of the same kind around another linear one.

        Args:
            motion: Takes the place of its own.
            frame: What columns are now relative to; as in this one if None.
        """

    @classmethod
    @abstractmethod
    def _restored[S: "AdaptedPrimitive"](cls: type[S], saved: SavedModel) -> S:
        """The primitive that `save` wrote."""

    def _own_config(self) -> dict[str, Any]:
        """What a saved primitive needs besides that of its motion, as JSON values."""
        return {}

    def _own_tensors(self) -> dict[str, Tensor]:
        """Likewise, by the names they are saved under."""
        return {}

    def __len__(self) -> int:
        """Primitives along the first batch axis.

        Raises:
            TypeError: It is a single one.
        """
        if not self.duration.ndim:
            raise TypeError("a single primitive has no length: it is no batch")
        return self.duration.shape[0]

    def __bool__(self) -> bool:
        """There is one, or a batch: never what its length says."""
        return True

    def __getitem__[S: "AdaptedPrimitive"](self: S, index: Any) -> S:
        """Some of a batch, by what indexes a tensor's first axes; with memory of their own."""
        if not self.duration.ndim:
            raise TypeError("a single primitive cannot be indexed: it is no batch")
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
        **ends: Any,
    ) -> Path:
        """Motion from start to goal; without arguments, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them. What values
        and velocities are, and which `ends` there are besides, the kind says.

        Args:
            time: Since the start of the motion [s], (T,) or (*batch, T), not negative; by
                default the timestamps of the demonstration, stretched to the duration. After
                the duration the motion settles at its goal.
            start: (*batch).
            goal: (*batch).
            duration: [s], (*batch).
            start_velocity: Per second, (*batch). By default the demonstrated one, changed with
                the duration so that the path stays the same, and turned and dilated with the
                way if the scaling is `"rotation"`.
            speed: Instead of a duration, how many times faster than the demonstration.
            dt: Instead of times, the interval [s] from one to the next; they go from zero to
                the end of the longest motion, or the first one past it.
            forcing_gain: Factor on the forcing term, (*batch): how wide a rhythm swings.
            ends: Others that the kind has.
        """
        motion, adapter = self.motion, self.adapter
        given = Ends(start, goal, start_velocity)
        columns, tau, frame = self._columns(given, duration, speed, ends)
        if dt is not None:
            if time is not None:
                raise ValueError("give times or an interval dt, not both")
            time = regular_times(dt, tau)
        times = None if time is None else adapter.times(time)
        rolled = adapter.roll(motion, columns, tau, times, adapter.each(forcing_gain))
        return adapter.trajectory(rolled, frame)

    def initial_state(
        self,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        **ends: Any,
    ) -> State:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        given = Ends(start, goal, start_velocity)
        columns, tau, frame = self._columns(given, duration, speed, ends)
        begun = self.adapter.begin(self.motion.begin(columns, tau), frame)
        return self.adapter.state(*begun)

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
        **goals: Any,
    ) -> State:
        """Advance by `dt`, exactly for whatever is constant over the step.

        Uncoupled steps of any length end where the rollout does. A coupling that depends on
        the state is taken as it is at the start of the step: of first order in `dt`, and so
        is a filtered goal with the scaling `"paper"`, whose forcing it scales. A new goal
        changes neither values nor velocities of the moment.

        Args:
            state: From `initial_state` or the last step.
            dt: [s], (*batch).
            goal: New goal from here on, (*batch).
            goal_filter: Rate, per duration, at which the goal moves to where it was last
                told to be: the acceleration has no jump then. None: it is there at once.
            coupling: External acceleration added to the motion, per s^2, (*batch).
            phase_stopping: The clock of the whole system, phase and spring, runs 1 + this
                times slower, (*batch), >= 0. Slows along the path without leaving it.
            forcing_gain: Factor on the forcing term, (*batch).
            goals: Others that the kind has.
        """
        motion, adapter, target = self.motion, self.adapter, None
        columns, frame = adapter.columns(state)
        if goal is not None or goals:
            columns, frame, target = adapter.retarget(motion, columns, frame, goal, **goals)
        columns = adapter.advance(
            motion,
            columns,
            adapter.each(dt),
            goal=target,
            goal_filter=goal_filter,
            external_acceleration=adapter.external_acceleration(
                motion, columns, frame, coupling
            ),
            phase_stopping=adapter.each(phase_stopping),
            forcing_gain=adapter.each(forcing_gain),
        )
        return adapter.state(columns, frame)

    def retarget(self, state: State, goal: Value | None = None, **goals: Any) -> State:
        """The same values, velocities and accelerations, with a new goal to go to.

        The accelerations last if the next steps have a `goal_filter`.

        Args:
            state: Of a motion.
            goal: (*batch).
            goals: Others that the kind has.
        """
        columns, frame = self.adapter.columns(state)
        columns, frame, target = self.adapter.retarget(
            self.motion, columns, frame, goal, **goals
        )
        if target is not None:
            target = to_tensor(target, columns.target.dtype, columns.target.device)
            columns = replace(columns, target=target.expand_as(columns.target))
        return self.adapter.state(columns, frame)

    def condition[S: "AdaptedPrimitive"](
        self: S,
        time: Times,
        value: Any = None,
        velocity: Points | None = None,
        *,
        body: Points | None = None,
        body_velocity: Points | None = None,
        within: tuple[float | int, float | int] | None = None,
    ) -> S:
        """The primitive, changed so that it passes through via points exactly.

        Start and goal stay, with the velocities there; so does any column that no via point
        asks for, and with `within` all of the motion outside of that time. It holds for the
        primitive's own start, goal and duration: put others in beforehand, with `with_ends`.
        Gradients flow to times, values and velocities.

        Args:
            time: Of the via points [s], (*batch, n).
            value: As for `via_points`, like all that follow; NaN is free.
            velocity: There. None or NaN keeps the primitive's own where a value is given.
            body: Of a pose.
            body_velocity: Of a pose.
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
        """Via points as a caller gives them, as columns (float64).

        An orientation becomes the error on the branch nearest to the primitive's motion there,
        so that both signs mean the same. An angular velocity becomes the rate of the error at
        that orientation, or, where none is given, at the primitive's.

        Args:
            time: [s], (*batch, n).
            value: Joints (*batch, n, D); unit quaternions (*batch, n, 4); or a `Pose` of
                (*batch, n). NaN leaves a coordinate free, in a quaternion all of the
                orientation.
            velocity: Of joints (*batch, n, D); angular [rad/s], (*batch, n, 3); or a twist
                (*batch, n, 6). NaN as above.
            body: Of a pose, (*batch, n, K).
            body_velocity: Of a pose, (*batch, n, K).

        Raises:
            ValueError: Negative times, or shapes that do not fit.
        """
        motion, adapter = self.linear_motion(), self.adapter
        moment = to_tensor(time, torch.float64, motion.start.device)
        if moment.ndim == 0 or not (moment >= 0).all():
            raise ValueError(f"time must be (..., n) seconds, none negative, got {time}")
        moment = to_tensor(adapter.times(moment))
        others = {"body": body, "body_velocity": body_velocity}
        others = {name: x for name, x in others.items() if x is not None}
        if others and not adapter.has_body:
            raise ValueError("only a pose has a body")
        duration = motion.duration.double()[..., None]
        now = motion.roll(Ends(), motion.duration, moment.detach())
        now = ColumnPoints(*(x.detach().double() for x in (now.position, now.velocity)))
        via = adapter.via_points(motion, now, value, velocity, **others)
        rate = via.velocity * duration[..., None]
        return ViaPoints(s=moment / duration, position=via.position, rate=rate)

    def with_ends[S: "AdaptedPrimitive"](
        self: S,
        start: Value | None = None,
        goal: Value | None = None,
        duration: Scalars | None = None,
        start_velocity: Any = None,
        *,
        speed: Scalars | None = None,
        **ends: Any,
    ) -> S:
        """The primitive whose own motion has these ends; arguments as in `rollout`.

        Raises:
            ValueError: A scaling that means other weights for other ends.
        """
        motion = self.linear_motion()
        if motion.forcing_scale.follows_ends:
            raise ValueError(
                f"scaling {motion.scaling!r} changes with the ends: fit with 'none'"
            )
        given = Ends(start, goal, start_velocity)
        columns, tau, frame = self._columns(given, duration, speed, ends)
        moved = motion.begin(columns, tau)
        rest = torch.stack([moved.rate, moved.position, moved.goal], dim=-1)
        weights = motion.weights.expand(*rest.shape[:-1], -1)
        x = torch.cat([weights, rest], dim=-1)
        return self.with_motion(motion.with_coordinates(x, moved.duration), frame)

    def reversed[S: "AdaptedPrimitive"](self: S) -> S:
        """The primitive that goes the same way back, from the goal to the start.

        Its motion is this one's at duration - t, as closely as its functions can follow, and
        takes new starts and goals like any other.

        Raises:
            ValueError: A rhythm, which has no end to begin at.
        """
        motion = self.linear_motion()
        if motion.basis.periodic:
            raise ValueError("a rhythm goes on: it has no end from which to go back")
        s = torch.linspace(0, 1, FINE * motion.basis.count + 1, dtype=torch.float64)
        s = s.to(motion.start.device)
        with torch.no_grad():
            shown = motion.roll(Ends(), motion.duration, s * motion.duration[..., None])
            samples = check_samples(s, shown.position.double().flip(-2))
            weights, rate = fit_samples("trajectory", motion.response, samples, REGULARIZATION)
            first, last = samples.first, samples.last
            made = Demonstrated(first, last, motion.amplitude.reshape(first.shape).double())
            weights = motion.forcing_scale.unscale(weights.mT, made).mT
            x = torch.cat([weights, torch.stack([rate, first, last], dim=-1)], dim=-1)
        x = x.view(*motion.weights.shape[:-1], -1)
        back = 1 - motion.timestamps.flip(-1)
        return self.with_motion(motion.with_coordinates(x, timestamps=back))

    def linear_motion(self) -> LinearPrimitive:
        """The linear primitive inside.

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
    def load[S: "AdaptedPrimitive"](cls: type[S], folder: str | FilePath) -> S:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No saved primitive there.
            ValueError: Names the file and the field that is wrong.
        """
        return cls._restored(SavedModel(folder, cls.__name__))

    def export(self, *, goal_filter: float | None = None) -> Any:
        """An `ExportedDMP`: NumPy stepper, and the step as a `torch.export` program.

        Args:
            goal_filter: Of the program, as in `step`.

        Raises:
            ValueError: The primitive is a batch.
        """
        return export_primitive(self, goal_filter=goal_filter)

    def _columns(
        self, given: Ends, duration: Scalars | None, speed: Scalars | None, ends: dict[str, Any]
    ) -> tuple[Ends, Tensor, Any]:
        """Ends of a motion in columns, its duration, and their frame."""
        each = self.adapter.each
        tau = self.motion.resolve_duration(each(duration), each(speed))
        columns, frame = self.adapter.ends(self.motion, given, tau, **ends)
        return columns, tau, frame


class WrappedPrimitive[Value, Path, State](AdaptedPrimitive[Value, Path, State]):
    """A primitive around a linear one of its own."""

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals by column."""
        return self.motion.fit_report
