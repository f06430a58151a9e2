"""Movement primitive of joints, or of any coordinates that add up like them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._system.bases import Basis
from hrc_learn.dmp._system.response import Trajectory, response_of
from hrc_learn.dmp._system.spring import SpringDamper
from hrc_learn.dmp._types import ArrayLike, normalised_time, positive, to_tensor, vector
from hrc_learn.dmp.closed_loop import DMPState, advance, begin, second_derivative
from hrc_learn.dmp.fitting.motion_samples import FitReport, check_samples
from hrc_learn.dmp.fitting.solvers import FitOptions, fit_motion
from hrc_learn.dmp.forcing_scale import Demonstrated, NoScaling, Scaling, find_scaling
from hrc_learn.dmp.serialization import TENSORS, SavedJoint, saved_arguments
from hrc_learn.storage import SavedModel


class JointDMP(SavedJoint):
    """Discrete movement primitive of D coordinates under one phase.

    y'' = alpha (beta (g - y) - y') + scale * sum_i phi_i(s) w_i,   s = t / duration

    (paper eqs. (eq_tf), (eq_cs)), primes by s. Left alone, the motion is a linear map of
    weights, start, start velocity and goal, computed exactly; see `Response`. Any number of
    leading batch dimensions: one primitive each.
    """

    def __init__(
        self,
        *,
        weights: Float[Tensor, "*batch D N"],
        start: Float[Tensor, "*batch D"],
        goal: Float[Tensor, "*batch D"],
        start_velocity: Float[Tensor, "*batch D"],
        duration: Float[Tensor, "*batch"],
        amplitude: Float[Tensor, "*batch D"],
        stamps: Float[Tensor, "*#batch T"],
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
            amplitude: Range covered by each coordinate.
            stamps: Normalised times at which a rollout repeats the demonstration.
            basis: Shape of the forcing term.
            spring: The unforced dynamics.
            scaling: Of the forcing term; see `scaling.py`.
            approach: Share of the motion along which a new goal is taken up; 0: at once.
            joint_names: D names.
            units: Of the coordinates.
            fit_report: Kept for the reader.
        """
        super().__init__()
        _check_names(joint_names, weights.shape[-2])
        if weights.shape[-1] != basis.count:
            raise ValueError(f"{weights.shape[-1]} weights for {basis.count} basis functions")
        if weights.grad_fn is None:
            self.weights = nn.Parameter(weights)
        else:
            # A parameter is a leaf, which no gradient passes.
            self.register_buffer("weights", weights)
        buffers = (start, goal, start_velocity, duration, amplitude, stamps)
        for name, value in zip(TENSORS[1:], buffers, strict=True):
            self.register_buffer(name, value)
        self.basis = basis
        self.spring = spring
        self.forcing_scale = find_scaling(scaling)
        self.joint_names = None if joint_names is None else tuple(joint_names)
        self.units = units
        self.fit_report = fit_report
        self.response = response_of(spring, basis, approach)

    @classmethod
    def fit(
        cls,
        time: ArrayLike,
        position: ArrayLike,
        n_basis: int = 50,
        velocity: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        *,
        scaling: str | Scaling = "none",
        joint_names: Sequence[str] | None = None,
        units: str = "rad",
        **options: Unpack[FitOptions],
    ) -> "JointDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Stamps [s], (T,) or (*B, T); any origin, any spacing.
            position: (T, D) or (*B, T, D); of the shape of `time`, it is taken as D = 1. Its
                floating dtype is the primitive's; the fit itself runs in float64.
            n_basis: N, unless `basis` is given.
            velocity: Recorded velocity per second, like `position`. Without it, the default
                method fits the start velocity along and the others differentiate positions.
            mask: (*B, T), false where a sample does not count (padding, dropouts).
            scaling: Of the forcing term: `"none"`, `"paper"`, `"amplitude"` or `"rotation"`.
            joint_names: D names, kept with the primitive.
            units: Of the coordinates.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or a scaling that the motion forbids.
        """
        scaling = find_scaling(scaling)
        recorded = check_samples(time, position, velocity, mask)
        _check_names(joint_names, recorded.position.shape[1])
        fit = fit_motion(recorded, n_basis, **options)
        arguments = fit.arguments(scaling, joint_names)
        dmp = cls(**arguments, joint_names=joint_names, units=units)
        with torch.no_grad():
            dmp.fit_report = fit.report(dmp.rollout().position)
        return dmp

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

    def with_coordinates(
        self,
        coordinates: Float[Tensor, "*batch D M"],
        duration: Float[Tensor, "*#batch"] | None = None,
        *,
        amplitude: Float[Tensor, "*#batch D"] | None = None,
        stamps: Float[Tensor, "*#batch T"] | None = None,
    ) -> "JointDMP":
        """Primitives like this one that move otherwise; gradients flow to the arguments.

        Args:
            coordinates: As `coordinates` gives them; their batch is that of the result.
            duration: [s]; this one's, like all that follow, if None.
            amplitude: Range covered by each coordinate.
            stamps: Normalised times of a rollout without arguments.

        Returns:
            A primitive of its own memory, with the same parts and names and no fit report.
        """
        x = coordinates.to(self.weights)
        batch = x.shape[:-2]
        duration = self.duration if duration is None else duration
        amplitude = self.amplitude if amplitude is None else amplitude
        duration = duration.to(x).expand(batch).clone()
        return JointDMP(
            weights=x[..., :-3].clone(),
            start_velocity=x[..., -3] / duration[..., None],
            start=x[..., -2].clone(),
            goal=x[..., -1].clone(),
            duration=duration,
            amplitude=amplitude.to(x).expand(*batch, -1).clone(),
            stamps=(self.stamps if stamps is None else stamps).clone(),
            basis=self.basis,
            spring=self.spring,
            scaling=self.forcing_scale,
            approach=self.response.approach,
            joint_names=self.joint_names,
            units=self.units,
        )

    def rollout(
        self,
        time: ArrayLike | None = None,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> Trajectory:
        """Motion from start to goal; without arguments, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them.

        Args:
            time: Since the start of the motion [s], (T,) or (*batch, T), not negative; by
                default the stamps of the demonstration, stretched to the duration. After the
                duration the motion settles at its goal.
            start: (*batch, D).
            goal: (*batch, D).
            duration: [s], (*batch).
            start_velocity: Per second, (*batch, D). By default the demonstrated one, changed
                with the duration so that the path stays the same, and turned and dilated with
                the way if the scaling is `"rotation"`.
            speed: Instead of a duration, how many times faster than the demonstration.
            amplitude: Factor on the forcing term, (*batch): how wide a rhythm swings.
        """
        start, goal, rate, duration = self._boundary(
            start, goal, duration, start_velocity, speed
        )
        weights, ends = self._scaled_weights(start, goal), (rate, start, goal)
        if amplitude is not None:
            weights = weights * self._as_tensor(amplitude)[..., None, None]
        shape = weights.shape[:-1]
        if not rate.shape == start.shape == goal.shape == shape:
            shape = torch.broadcast_shapes(shape, *(x.shape for x in ends))
            weights, ends = weights.expand(*shape, -1), [x.expand(shape) for x in ends]
        return Trajectory(
            coordinates=torch.cat([weights, torch.stack(ends, dim=-1)], dim=-1),
            s=self.normalised_time(time, duration),
            duration=duration,
            response=self.response,
        )

    def initial_state(
        self,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
    ) -> DMPState:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        start, goal, rate, duration = self._boundary(
            start, goal, duration, start_velocity, speed
        )
        return begin(self.response, self.weights, start, goal, rate, duration)

    def step(
        self,
        state: DMPState,
        dt: ArrayLike,
        *,
        goal: ArrayLike | None = None,
        goal_filter: float | None = None,
        coupling: ArrayLike | None = None,
        slowdown: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> DMPState:
        """Advance by `dt`, exactly for whatever is constant over the step.

        Uncoupled steps of any length end where the rollout does. A coupling that depends on
        the state is taken as it is at the start of the step: of first order in `dt`, and so
        is a filtered goal with the scaling `"paper"`, whose forcing it scales.

        Args:
            state: From `initial_state` or the last step.
            dt: [s], (*batch).
            goal: New goal from here on, (*batch, D).
            goal_filter: Rate, per duration, at which the goal moves to where it was last
                told to be: the acceleration has no jump then. None: it is there at once.
            coupling: Acceleration added to the motion, per s^2, (*batch, D).
            slowdown: The clock of the whole system, phase and spring, runs 1 + slowdown
                times slower, (*batch), >= 0. Slows along the path without leaving it.
            amplitude: Factor on the forcing term, (*batch).
        """
        target = state.target if goal is None else self._as_tensor(goal).expand_as(state.goal)
        # How long the motion takes at the pace of this step.
        duration, pace = state.duration, torch.ones_like(state.pace)
        if slowdown is not None:
            slower = 1 + self._as_tensor(slowdown)
            duration, pace = duration * slower, pace / slower
        push = None
        if coupling is not None:
            push = self._as_tensor(coupling) * state.duration[..., None] ** 2
        aim = target if goal_filter is None else state.goal

        def scale(values: Tensor) -> Tensor:
            values = self._scaled(values, state.start, aim)
            if amplitude is None:
                return values
            return values * self._as_tensor(amplitude)[..., None, None]

        return advance(
            state,
            self._step_length(dt, duration),
            response=self.response,
            weights=self.weights,
            scale=scale,
            target=target,
            goal_filter=goal_filter,
            push=push,
            pace=pace,
        )

    def curvature(self, state: DMPState) -> Float[Tensor, "*batch D"]:
        """d^2 y / ds^2 at a state that nothing couples to."""

        def scale(values: Tensor) -> Tensor:
            return self._scaled(values, state.start, state.goal)

        return second_derivative(state, self.response, self.weights, scale)

    def start_rate(
        self, start: Float[Tensor, "*#batch D"], goal: Float[Tensor, "*#batch D"]
    ) -> Float[Tensor, "*#batch D"]:
        """Dy/ds that a motion between these starts with, unless told otherwise."""
        rate = self.start_velocity * self.duration[..., None]
        if not self.forcing_scale.turns:
            return rate
        return self._scaled(rate[..., None, :], start, goal)[..., 0, :]

    def resting_point(
        self, state: DMPState, curvature: Float[Tensor, "*batch D"]
    ) -> Float[Tensor, "*batch D"]:
        """The goal with which the state would have this d^2 y / ds^2 (unscaled forcing)."""
        return state.goal + (curvature - self.curvature(state)) / self.spring.stiffness

    def resolve_duration(self, duration: ArrayLike | None, speed: ArrayLike | None) -> Tensor:
        """Duration [s] that either argument of a rollout asks for."""
        if duration is not None and speed is not None:
            raise ValueError("give a duration or a speed, not both")
        if duration is not None:
            return positive("duration", duration, self.duration)
        if speed is not None:
            return self.duration / positive("speed", speed, self.duration)
        return self.duration

    def normalised_time(
        self, time: ArrayLike | None, duration: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch T"]:
        """Times [s] of a rollout over its duration; of None, the demonstration's stamps."""
        if time is None:
            return self.stamps
        return normalised_time(time, duration)

    def export(self, *, goal_filter: float | None = None) -> Any:
        """An `ExportedDMP`: NumPy stepper, and the step as a `torch.export` program.

        Args:
            goal_filter: Of the program, as in `step`.

        Raises:
            ValueError: The primitive is a batch.
        """
        from hrc_learn.dmp.exported_dmp import export_dmp

        return export_dmp(self, goal_filter=goal_filter)

    @classmethod
    def load(cls, folder: str | Path) -> "JointDMP":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No saved primitive there.
            ValueError: Names the file and the field that is wrong.
        """
        return cls.restore(SavedModel(folder, cls.__name__))

    @classmethod
    def restore(cls, saved: SavedModel) -> "JointDMP":
        """The primitive inside a saved one."""
        arguments = saved_arguments(saved)
        try:
            return cls(**arguments)
        except ValueError as error:
            raise saved.invalid(error) from None

    def _boundary(
        self,
        start: ArrayLike | None,
        goal: ArrayLike | None,
        duration: ArrayLike | None,
        start_velocity: ArrayLike | None,
        speed: ArrayLike | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Start, goal, dy/ds at the start, and duration."""
        start = self.start if start is None else vector("start", start, self.start)
        goal = self.goal if goal is None else vector("goal", goal, self.goal)
        duration = self.resolve_duration(duration, speed)
        if start_velocity is None:
            return start, goal, self.start_rate(start, goal), duration
        velocity = vector("start_velocity", start_velocity, self.start_velocity)
        return start, goal, velocity * duration[..., None], duration

    def _scaled(self, values: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """What (*batch, K, D) of the forcing term becomes between these ends."""
        if isinstance(self.forcing_scale, NoScaling):
            return values  # before the look-ups, which take as long as a step's arithmetic
        shown = Demonstrated(start=self.start, goal=self.goal, amplitude=self.amplitude)
        return self.forcing_scale.scale(values, start, goal, shown)

    def _scaled_weights(self, start: Tensor, goal: Tensor) -> Tensor:
        if isinstance(self.forcing_scale, NoScaling):
            return self.weights
        return self._scaled(self.weights.mT, start, goal).mT

    def _step_length(self, dt: ArrayLike, duration: Tensor) -> Tensor:
        """Ds in float64. A number is multiplied as it is: to divide it takes a tensor."""
        if not isinstance(dt, float):
            dt = to_tensor(dt, dtype=torch.float64, device=duration.device)
        return duration.double().reciprocal() * dt

    def _as_tensor(self, value: ArrayLike) -> Tensor:
        return to_tensor(value, dtype=self.weights.dtype, device=self.weights.device)


def _check_names(joint_names: Sequence[str] | None, D: int) -> None:
    if joint_names is not None and len(joint_names) != D:
        raise ValueError(f"{len(joint_names)} joint names for {D} coordinates")
