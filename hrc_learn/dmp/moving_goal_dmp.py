"""A goal that moves at constant velocity, so that a motion ends as fast as is wanted.

y'' = alpha (beta (g + (s - 1) v - y) + v - y') + f,   s = t / tau

(Kober et al. 2010, "Movement templates for learning of hitting and batting", with the goal's
velocity in the damping term). The goal passes g at s = 1 with velocity v. Seen from it,
x = y - (s - 1) v, this is the equation of a goal at rest: rollouts and steps stay exact.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Times, Vectors, to_tensor
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._system.response import ArrayOutputs, Trajectory
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.joint_dmp import JointDMP, points_as_given
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import WrappedPrimitive
from hrc_learn.model_files import SavedModel


class MovingTrajectory(ArrayOutputs):
    """A motion to a moving goal, each output computed when first asked for."""

    outputs = Trajectory.outputs

    def __init__(self, seen: Trajectory, velocity: Float[Tensor, "*#batch D"]):
        """Add the motion of the goal (its `velocity` per second) to what is seen from it."""
        self._seen = seen
        self._velocity = velocity[..., None, :]

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._seen.time

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration."""
        s = self._seen.s.to(self._velocity)
        remaining = (s[..., None] - 1) * self._seen.duration[..., None, None]
        return self._seen.position + remaining * self._velocity

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """The same per second."""
        return self._seen.velocity + self._velocity

    @property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        return self._seen.acceleration


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingGoalState:
    """Where a primitive on its way to a moving goal is; a pytree."""

    motion: DMPState
    """Seen from the goal."""
    goal_velocity: Float[Tensor, "*batch D"]
    """Per second, when nothing slows the clock."""

    @property
    def position(self) -> Float[Tensor, "*batch D"]:
        """In the units of the demonstration."""
        remaining = (self.motion.s - 1).to(self.goal_velocity) * self.motion.duration
        return self.motion.position + remaining[..., None] * self.goal_velocity

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Per second."""
        return self.motion.velocity + self.motion.pace[..., None] * self.goal_velocity


torch.export.register_dataclass(
    MovingGoalState, serialized_type_name="hrc_learn.dmp.MovingGoalState"
)


@dataclass(frozen=True, eq=False)
class MovingGoalCoordinates(CoordinateAdapter[Vectors, MovingTrajectory, MovingGoalState]):
    """Joints as seen from the moving goal; the frame is the goal's velocity per second."""

    def ends(
        self,
        motion: LinearPrimitive,
        given: Ends,
        duration: Tensor,
        end_velocity: Vectors | None = None,
    ) -> tuple[Ends, Tensor]:
        """Start and rate as seen from a goal that moves so that `end_velocity` is met."""

        def known(value: Vectors | None, otherwise: Tensor) -> Tensor:
            if value is None:
                return otherwise
            return to_tensor(value, otherwise.dtype, otherwise.device)

        demonstrated = motion.start_velocity * (motion.duration / duration)[..., None]
        start, goal = known(given.start, motion.start), known(given.goal, motion.goal)
        rate = known(given.velocity, demonstrated)
        end = duration[..., None]
        still = motion.roll(Ends(start, goal, rate), duration, end).velocity[..., 0, :]
        # Per unit of v the start is seen shifted by v, its rate by -v.
        at_end = motion.response.evaluate(torch.ones((), dtype=torch.float64))[1]
        # Columns -2 and -3 of the response are the start and its rate; the goal's own is one.
        gain = 1 + at_end[-2] - at_end[-3]
        # Linear in v: one evaluation finds what makes up the difference.
        v = (known(end_velocity, still) - still) / gain.to(still)
        return Ends(start + v * end, goal, rate - v), v

    def trajectory(self, columns: Trajectory, frame: Tensor) -> MovingTrajectory:
        """What is seen from the goal, and the goal's motion."""
        return MovingTrajectory(columns, frame)

    def begin(self, columns: DMPState, frame: Tensor) -> tuple[DMPState, Tensor]:
        """A velocity of the goal for each of the batch."""
        return columns, frame.expand_as(columns.position).clone()

    def state(self, columns: DMPState, frame: Tensor) -> MovingGoalState:
        """The columns with the goal's velocity."""
        return MovingGoalState(motion=columns, goal_velocity=frame)

    def columns(self, state: MovingGoalState) -> tuple[DMPState, Tensor]:
        """The columns and the goal's velocity."""
        return state.motion, state.goal_velocity

    def retarget(
        self, motion: LinearPrimitive, columns: DMPState, frame: Tensor, goal: Vectors | None
    ) -> Retargeted:
        """A goal as it is at the end; its velocity stays."""
        return Retargeted(columns, frame, goal)

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Points | None,
        velocity: Points | None,
    ) -> ColumnPoints:
        """As given: with the demonstrated end velocity the goal is at rest."""
        return points_as_given(now, value, velocity)


class MovingGoalDMP(WrappedPrimitive[Vectors, MovingTrajectory, MovingGoalState]):
    """A joint primitive that passes its goal with a velocity of the caller's choice.

    Values are (*batch, D) in the units of the demonstration, velocities the same per second.
    `rollout` and `initial_state` take the wanted velocity at the end of the duration first,
    and meet it exactly; None is the demonstrated one. The goal is where the moving goal is at
    the end.
    """

    motion: JointDMP

    def __init__(self, motion: JointDMP):
        """Take a primitive along.

        Raises:
            ValueError: Its forcing follows start and goal, which the moving frame changes.
        """
        super().__init__()
        if motion.forcing_scale.follows_ends:
            raise ValueError("a moving goal needs a scaling that does not depend on start")
        self.motion = motion

    @classmethod
    def fit(
        cls,
        time: Times,
        position: Points,
        *arguments: Any,
        **options: Any,
    ) -> "MovingGoalDMP":
        """Learn one primitive from each demonstration; arguments as in `JointDMP.fit`."""
        return cls(JointDMP.fit(time, position, *arguments, **options))

    @property
    def adapter(self) -> MovingGoalCoordinates:
        """Joints as seen from the goal."""
        return MovingGoalCoordinates()

    @property
    def start(self) -> Float[Tensor, "*batch D"]:
        """Where the demonstration starts."""
        return self.motion.start

    @property
    def goal(self) -> Float[Tensor, "*batch D"]:
        """Where it ends."""
        return self.motion.goal

    def rollout(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        end_velocity: Vectors | None = None,
        time: Times | None = None,
        *arguments: Any,
        **ends: Any,
    ) -> MovingTrajectory:
        """Motion that has `end_velocity` at the end of its duration, exactly.

        Args:
            end_velocity: Per second, (*batch, D); None: the demonstrated one.
            time: As in `AdaptedPrimitive.rollout`, like all that follow.
            arguments: start, goal, duration, start_velocity.
            ends: By name.
        """
        return super().rollout(time, *arguments, end_velocity=end_velocity, **ends)

    def initial_state(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, end_velocity: Vectors | None = None, *arguments: Any, **ends: Any
    ) -> MovingGoalState:
        """State at the start of a motion; arguments as in `rollout`, without times."""
        return super().initial_state(*arguments, end_velocity=end_velocity, **ends)

    def with_motion[S: "MovingGoalDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Around another motion, whose own end velocity is the demonstrated one.

        Raises:
            ValueError: Ends with a velocity of their own, which only a rollout can have.
        """
        if frame is not None and (frame != 0).any():
            raise ValueError("an end velocity is given to rollout, not kept by a primitive")
        return type(self)(motion)

    @classmethod
    def _restored[S: "MovingGoalDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls(JointDMP.restore(saved))
