"""A goal that moves at constant velocity, so that a motion ends as fast as is wanted.

y'' = alpha (beta (g + (s - 1) v - y) + v - y') + f,   s = t / tau

(Kober et al. 2010, "Movement templates for learning of hitting and batting", with the goal's
velocity in the damping term). The goal passes g at s = 1 with velocity v. Seen from it,
x = y - (s - 1) v, this is the equation of a goal at rest: rollouts and steps stay exact.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp._types import ArrayLike, to_tensor
from hrc_learn.dmp.closed_loop import DMPState
from hrc_learn.dmp.joint_dmp import JointDMP


class MovingTrajectory:
    """A motion to a moving goal, each output computed when first asked for."""

    def __init__(
        self,
        seen: Trajectory,
        s: Float[Tensor, "*#batch T"],
        velocity: Float[Tensor, "*#batch D"],
        duration: Float[Tensor, "*#batch"],
    ):
        """Add the motion of the goal (its `velocity` per second) to what is seen from it."""
        self._seen = seen
        self._s = s.to(velocity)
        self._velocity = velocity[..., None, :]
        self._duration = duration[..., None, None]

    @property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return self._seen.time

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration."""
        remaining = (self._s[..., None] - 1) * self._duration
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


class MovingGoal:
    """A joint primitive that passes its goal with a velocity of the caller's choice."""

    def __init__(self, dmp: JointDMP):
        """Take a primitive along.

        Raises:
            ValueError: Its forcing follows start and goal, which the moving frame changes.
        """
        if dmp.forcing_scale.follows_ends:
            raise ValueError("a moving goal needs a scaling that does not depend on start")
        self.dmp = dmp

    def rollout(
        self,
        end_velocity: ArrayLike,
        time: ArrayLike | None = None,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
    ) -> MovingTrajectory:
        """Motion that has `end_velocity` at the end of its duration, exactly.

        Args:
            end_velocity: Per second, (*batch, D).
            time: As in `JointDMP.rollout`, like all that follow.
            start: (*batch, D).
            goal: Where the moving goal is at the end, (*batch, D).
            duration: [s], (*batch).
            start_velocity: Per second, (*batch, D).
        """
        velocity, ends = self._seen(end_velocity, start, goal, duration, start_velocity)
        s = self.dmp.normalised_time(time, ends["duration"])
        return MovingTrajectory(self.dmp.rollout(time, **ends), s, velocity, ends["duration"])

    def initial_state(
        self,
        end_velocity: ArrayLike,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        duration: ArrayLike | None = None,
        start_velocity: ArrayLike | None = None,
    ) -> MovingGoalState:
        """State at the start of a motion; arguments as in `rollout`."""
        velocity, ends = self._seen(end_velocity, start, goal, duration, start_velocity)
        motion = self.dmp.initial_state(**ends)
        return MovingGoalState(
            motion=motion, goal_velocity=velocity.expand_as(motion.position).clone()
        )

    def step(
        self,
        state: MovingGoalState,
        dt: ArrayLike,
        *,
        goal: ArrayLike | None = None,
        goal_filter: float | None = None,
        coupling: ArrayLike | None = None,
        slowdown: ArrayLike | None = None,
    ) -> MovingGoalState:
        """Advance by `dt`; arguments as in `JointDMP.step`, the goal as at the end."""
        motion = self.dmp.step(
            state.motion,
            dt,
            goal=goal,
            goal_filter=goal_filter,
            coupling=coupling,
            slowdown=slowdown,
        )
        return MovingGoalState(motion=motion, goal_velocity=state.goal_velocity)

    def _seen(
        self,
        end_velocity: ArrayLike,
        start: ArrayLike | None,
        goal: ArrayLike | None,
        duration: ArrayLike | None,
        start_velocity: ArrayLike | None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Velocity of the goal, and the ends of the motion as seen from it."""
        dmp = self.dmp

        def given(value: ArrayLike | None, otherwise: Tensor) -> Tensor:
            if value is None:
                return otherwise
            return to_tensor(value, otherwise.dtype, otherwise.device)

        duration = dmp.resolve_duration(duration, None)
        demonstrated = dmp.start_velocity * (dmp.duration / duration)[..., None]
        start, goal = given(start, dmp.start), given(goal, dmp.goal)
        rate = given(start_velocity, demonstrated)
        end = duration[..., None]
        still = dmp.rollout(end, start, goal, duration, rate).velocity[..., 0, :]
        # Per unit of v the start is seen shifted by v, its rate by -v.
        at_end = dmp.response.evaluate(torch.ones((), dtype=torch.float64))[1]
        gain = 1 + at_end[-2] - at_end[-3]
        velocity = (given(end_velocity, still) - still) / gain.to(still)
        return velocity, {
            "start": start + velocity * duration[..., None],
            "goal": goal,
            "start_velocity": rate - velocity,
            "duration": duration,
        }
