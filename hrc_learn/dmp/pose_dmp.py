"""Movement primitive of a pose, and of the arm's body along with it."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import orientation_error as error_space
from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.closed_loop import DMPState
from hrc_learn.dmp.fitting.motion_samples import FitReport, check_samples
from hrc_learn.dmp.fitting.solvers import FitOptions
from hrc_learn.dmp.forcing_scale import find_scaling
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_dmp import OrientationState, OrientationTrajectory
from hrc_learn.dmp.orientation_error import (
    error_ends,
    error_rate,
    fitted_error,
    reference_of,
    to_orientation,
    unit_quaternion,
)
from hrc_learn.geometry import Pose
from hrc_learn.storage import SavedModel, write_model

POSITION, ERROR, BODY = slice(0, 3), slice(3, 6), slice(6, None)
"""Columns of the coordinates that move under one phase."""


def demonstrated_columns(
    time: ArrayLike,
    position: ArrayLike,
    error: Tensor,
    body: ArrayLike | None,
    mask: ArrayLike | None,
) -> Tensor:
    """Checked samples (*B, T, 6 + K), in the dtype of the position.

    Raises:
        ValueError: Bad samples; says which.
    """
    checked = check_samples(time, position, mask=mask)
    if checked.position.shape[-2] != 3:
        raise ValueError(f"position must have 3 columns, got {checked.position.shape[-2]}")
    columns = [checked.columns, error.to(checked.position)]
    if body is not None:
        columns.append(check_samples(time, body, mask=mask, name="body").columns)
    try:
        return torch.cat(columns, dim=-1)
    except RuntimeError:
        shapes = ", ".join(str(tuple(column.shape)) for column in columns)
        raise ValueError(f"position, orientation error and body differ: {shapes}") from None


def joined(position: Tensor, error: Tensor, body: ArrayLike, like: Tensor) -> Tensor:
    """The columns of a linear primitive, broadcast and side by side."""
    columns = [to_tensor(part, like.dtype, like.device) for part in (position, error, body)]
    batch = torch.broadcast_shapes(*(column.shape[:-1] for column in columns))
    return torch.cat([column.expand(*batch, -1) for column in columns], dim=-1)


def pose_push(coordinates: Tensor, coupling: ArrayLike) -> Tensor:
    """The coupling of the linear primitive for an acceleration of position or pose."""
    coupling = to_tensor(coupling, coordinates.dtype, coordinates.device)
    push = replaced(torch.zeros_like(coordinates), POSITION, coupling[..., :3])
    if coupling.shape[-1] == 3:
        return push
    # The second derivative of the error is linear in the angular acceleration.
    return replaced(push, ERROR, error_rate(coordinates[..., ERROR], coupling[..., 3:]))


def replaced(values: Tensor, columns: slice, new: ArrayLike) -> Tensor:
    """`values` with some columns exchanged; differentiable in both."""
    new = to_tensor(new, values.dtype, values.device)
    stop = values.shape[-1] if columns.stop is None else columns.stop
    new = new.expand(*values.shape[:-1], stop - columns.start)
    return torch.cat([values[..., : columns.start], new, values[..., stop:]], dim=-1)


class PoseTrajectory:
    """A pose over time, each output computed when first asked for."""

    def __init__(self, motion: Trajectory, reference: Float[Tensor, "*batch 4"]):
        self._motion = motion
        self._rotation = OrientationTrajectory(motion, reference, first=ERROR.start)

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._motion.time

    @property
    def position(self) -> Float[Tensor, "*batch T 3"]:
        """[m]."""
        return self._motion.position[..., POSITION]

    @property
    def orientation(self) -> Float[Tensor, "*batch T 4"]:
        """Unit quaternions (w, x, y, z), continuous in sign."""
        return self._rotation.orientation

    @property
    def pose(self) -> Pose:
        """Position and orientation, (*batch, T)."""
        return Pose(self.position, self.orientation)

    @property
    def velocity(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s]."""
        return self._motion.velocity[..., POSITION]

    @property
    def angular_velocity(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s]."""
        return self._rotation.angular_velocity

    @cached_property
    def twist(self) -> Float[Tensor, "*batch T 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        return torch.cat([self.velocity, self.angular_velocity], dim=-1)

    @property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Linear [m/s^2]."""
        return self._motion.acceleration[..., POSITION]

    @property
    def angular_acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """In the base frame [rad/s^2]."""
        return self._rotation.angular_acceleration

    @property
    def body(self) -> Float[Tensor, "*batch T K"]:
        """Coordinates learned along; K = 0 without any."""
        return self._motion.position[..., BODY]

    @property
    def body_velocity(self) -> Float[Tensor, "*batch T K"]:
        """The same per second."""
        return self._motion.velocity[..., BODY]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseState:
    """Where a pose primitive is while it is stepped."""

    motion: DMPState
    """Of position, error to the reference, and body."""
    reference: Float[Tensor, "*batch 4"]
    """The goal's orientation, unless the primitive says otherwise."""

    @property
    def pose(self) -> Pose:
        """Position [m] and orientation."""
        return Pose(self.motion.position[..., POSITION], self._rotation.orientation)

    @property
    def twist(self) -> Float[Tensor, "*batch 6"]:
        """(linear [m/s], angular [rad/s]) in the base frame."""
        linear = self.motion.velocity[..., POSITION]
        return torch.cat([linear, self._rotation.angular_velocity], dim=-1)

    @property
    def body(self) -> Float[Tensor, "*batch K"]:
        """Coordinates learned along."""
        return self.motion.position[..., BODY]

    @property
    def _rotation(self) -> OrientationState:
        columns = {
            name: getattr(self.motion, name)[..., ERROR]
            for name in ("position", "rate", "start", "goal", "way", "target", "forced")
        }
        return OrientationState(
            motion=replace(self.motion, **columns), reference=self.reference
        )


torch.export.register_dataclass(PoseState, serialized_type_name="hrc_learn.dmp.PoseState")


class PoseDMP(nn.Module):
    """Discrete movement primitive of a pose under one phase.

    Position, orientation error (see `orientation_error`) and, if given, K coordinates of the
    arm's body shape are columns of one linear primitive. The body, such as a redundant joint
    or an arm angle, keeps its demonstrated shape when the pose is sent to another goal.
    """

    goal_orientation: Tensor

    def __init__(self, motion: JointDMP, goal_orientation: Float[Tensor, "*batch 4"]):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of position (3), orientation error (3) and body (K).
            goal_orientation: Unit quaternion (w, x, y, z) at which it ends; the error is taken
                to a reference as in `OrientationDMP`.
        """
        super().__init__()
        self.motion = motion
        self.register_buffer("goal_orientation", goal_orientation)

    @classmethod
    def fit(
        cls,
        time: ArrayLike,
        position: ArrayLike,
        orientation: ArrayLike,
        n_basis: int = 50,
        body: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        *,
        scaling: str = "none",
        **options: Unpack[FitOptions],
    ) -> "PoseDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Stamps [s], (T,) or (*B, T).
            position: (*B, T, 3) [m]. Its floating dtype is the primitive's.
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4); signs may flip.
            n_basis: N, unless `basis` is given.
            body: Coordinates learned along, (*B, T, K), or (T,) for one.
            mask: (*B, T), false where a sample does not count.
            scaling: Of the forcing term of the position, as for `JointDMP.fit`; `"rotation"`
                turns and dilates its path with the way from start to goal.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or a scaling that the motion forbids.
        """
        error, goal = fitted_error(time, orientation, mask)
        coordinates = demonstrated_columns(time, position, error, body, mask)
        motion = JointDMP.fit(
            time,
            coordinates,
            n_basis,
            mask=mask,
            units="m, rad, body",
            scaling=find_scaling(scaling, columns=POSITION.stop),
            **options,
        )
        return cls(motion, goal.to(coordinates))

    @property
    def start(self) -> Pose:
        """Where the demonstration starts."""
        rotation = to_orientation(self.motion.start[..., ERROR], self.reference)
        return Pose(self.motion.start[..., POSITION], rotation)

    @property
    def goal(self) -> Pose:
        """Where the demonstration ends."""
        return Pose(self.motion.goal[..., POSITION], self.goal_orientation)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """What the orientation error is taken to."""
        return reference_of(self.motion.goal[..., ERROR], self.goal_orientation)

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals by column: position [m], orientation error [rad], body.

        Those of the error's components bound those of the angle. The largest range, which
        `nrmse` divides by, mixes units: prefer `select` and read one kind at a time.
        """
        return self.motion.fit_report

    def rollout(
        self,
        time: ArrayLike | None = None,
        start: Pose | None = None,
        goal: Pose | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
        start_body: ArrayLike | None = None,
        goal_body: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> PoseTrajectory:
        """Motion from start to goal; without arguments, the demonstrated one.

        All arguments broadcast over the batch, and gradients flow to each of them.

        Args:
            time: Since the start of the motion [s], (T,) or (*batch, T).
            start: New start, (*batch).
            goal: New goal, (*batch).
            duration: [s], (*batch).
            start_velocity: Twist (linear [m/s], angular [rad/s]), (*batch, 6).
            speed: Instead of a duration, how many times faster than the demonstration.
            start_body: (*batch, K).
            goal_body: (*batch, K).
            amplitude: Factor on the forcing term, (*batch): how wide a rhythm swings.
        """
        ends, reference = self._ends(
            start, goal, duration, start_velocity, speed, start_body, goal_body
        )
        return PoseTrajectory(self.motion.rollout(time, **ends, amplitude=amplitude), reference)

    def initial_state(
        self,
        start: Pose | None = None,
        goal: Pose | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
        *,
        speed: ArrayLike | None = None,
        start_body: ArrayLike | None = None,
        goal_body: ArrayLike | None = None,
    ) -> PoseState:
        """State at the start of a motion, for `step`; arguments as in `rollout`."""
        ends, reference = self._ends(
            start, goal, duration, start_velocity, speed, start_body, goal_body
        )
        motion = self.motion.initial_state(**ends)
        reference = reference.expand(*motion.position.shape[:-1], 4)
        return PoseState(motion=motion, reference=reference)

    def step(
        self,
        state: PoseState,
        dt: ArrayLike,
        *,
        goal: Pose | None = None,
        goal_body: ArrayLike | None = None,
        goal_filter: float | None = None,
        coupling: ArrayLike | None = None,
        slowdown: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> PoseState:
        """Advance by `dt`, as `JointDMP.step`.

        Args:
            state: From `initial_state` or the last step.
            dt: [s], (*batch).
            goal: New goal from here on; changes neither pose nor twist of the moment.
            goal_body: New goal of the body from here on, (*batch, K).
            goal_filter: Rate, per duration, at which goals move to where they were last told
                to be, so that no acceleration jumps; None: they are there at once.
            coupling: Acceleration added to the position [m/s^2], (*batch, 3), or to the pose,
                (*batch, 6), its angular part [rad/s^2] in the base frame.
            slowdown: The clock runs 1 + slowdown times slower, (*batch), >= 0.
            amplitude: Factor on the forcing term, (*batch).
        """
        if goal is not None:
            state = self.retarget(state, goal)
        motion = state.motion
        ends = motion.target
        if goal_body is not None:
            ends = replaced(ends, BODY, goal_body)
        if coupling is not None:
            coupling = pose_push(motion.position, coupling)
        motion = self.motion.step(
            motion,
            dt,
            goal=ends,
            goal_filter=goal_filter,
            coupling=coupling,
            slowdown=slowdown,
            amplitude=amplitude,
        )
        return PoseState(motion=motion, reference=state.reference)

    def retarget(self, state: PoseState, goal: Pose) -> PoseState:
        """The same pose, twist and acceleration, with a new goal to go to.

        The acceleration lasts if the next steps have a `goal_filter`.

        Args:
            state: Of a motion.
            goal: (*batch).
        """
        motion, old = state.motion, state.reference
        rotation = unit_quaternion(goal.orientation, old)
        new = reference_of(self.motion.goal[..., ERROR], rotation).expand_as(old)
        values = motion.position, motion.rate, self.motion.curvature(motion)
        error, error_rate, error_curvature = (x[..., ERROR] for x in values)
        turned = error_space.retarget(error, error_rate, error_curvature, old, new)
        position, rate, curvature = (
            replaced(x, ERROR, part) for x, part in zip(values, turned, strict=True)
        )
        target = replaced(motion.target, POSITION, goal.position)
        motion = replace(motion, position=position, rate=rate, target=target)
        motion = replace(motion, goal=self.motion.resting_point(motion, curvature))
        return PoseState(motion=motion, reference=new)

    def save(self, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        tensors = {"goal_orientation": self.goal_orientation, **self.motion.tensors()}
        write_model(folder, "PoseDMP", self.motion.config(), tensors)

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
    def load(cls, folder: str | Path) -> "PoseDMP":
        """Read what `save` wrote; complains as `JointDMP.load`."""
        saved = SavedModel(folder, "PoseDMP")
        return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"))

    def _ends(
        self,
        start: Pose | None,
        goal: Pose | None,
        duration: ArrayLike | None,
        velocity: ArrayLike | None,
        speed: ArrayLike | None,
        start_body: ArrayLike | None,
        goal_body: ArrayLike | None,
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Arguments for the linear primitive, and what the error is taken to."""
        like = self.motion.start
        duration = self.motion.resolve_duration(duration, speed)
        demonstrated = self.motion.start_velocity * (self.motion.duration / duration)[..., None]
        twist = None if velocity is None else to_tensor(velocity, like.dtype, like.device)
        error, rate, reference = error_ends(
            like[..., ERROR],
            demonstrated[..., ERROR],
            self.motion.goal[..., ERROR],
            self.goal_orientation,
            None if start is None else start.orientation,
            None if goal is None else goal.orientation,
            None if twist is None else twist[..., 3:],
        )
        start_columns = joined(
            like[..., POSITION] if start is None else start.position,
            error,
            like[..., BODY] if start_body is None else start_body,
            like,
        )
        goal_columns = joined(
            self.motion.goal[..., POSITION] if goal is None else goal.position,
            self.motion.goal[..., ERROR],
            self.motion.goal[..., BODY] if goal_body is None else goal_body,
            like,
        )
        if twist is None:
            # Turned and dilated with the way, if the scaling has it so.
            per_s = self.motion.start_rate(start_columns, goal_columns)
            linear = (per_s / duration[..., None])[..., POSITION]
        else:
            linear = twist[..., :3]
        return {
            "start": start_columns,
            "goal": goal_columns,
            "start_velocity": joined(linear, rate, demonstrated[..., BODY], like),
            "duration": duration,
        }, reference
