"""A goal that moves at constant velocity, for a motion with a given velocity at its end.

y'' = alpha (beta (g + (s - 1) v - y) + v - y') + f,   s = t / tau

This is the equation of Kober et al. 2010, "Movement templates for learning of hitting and
batting", but with the goal's velocity also in the damping term. Primes are derivatives with
respect to s. The goal passes g at s = 1 with the velocity v per duration. The motion relative
to this goal, x = y - (s - 1) v, obeys the equation with a goal at rest, so rollouts and steps
stay exact.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Vectors, checked_vector
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Boundary
from hrc_learn.dmp.motion_primitive import WrappedPrimitive
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.model_files import SavedModel


class MovingTrajectory(Trajectory):
    """Motion to a moving goal; each output is computed on first access."""

    def __init__(self, relative: Trajectory, velocity: Float[Tensor, "*#batch D"]):
        """Add the goal's motion at this velocity [1/s] to the motion relative to the goal."""
        super().__init__(
            coordinates=relative._given,
            s=relative.s,
            duration=relative.duration,
            response=relative._response,
        )
        self._goal_velocity = velocity[..., None, :]

    def _derivative(self, order: int) -> Float[Tensor, "*batch T D"]:
        y, v = super()._derivative(order), self._goal_velocity
        if order == 0:
            v = (self.s.to(v)[..., None] - 1) * self.duration[..., None, None] * v
        return y + v if order < 2 else y


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingGoalState:
    """State in closed loop of a primitive with a moving goal; a pytree."""

    motion: DMPState
    """State relative to the goal."""
    goal_velocity: Float[Tensor, "*batch D"]
    """Velocity of the goal if nothing slows the clock [1/s]."""

    @property
    def position(self) -> Float[Tensor, "*batch D"]:
        """Position in the units of the demonstration."""
        remaining = (self.motion.s - 1).to(self.goal_velocity) * self.motion.duration
        return self.motion.position + remaining[..., None] * self.goal_velocity

    @property
    def velocity(self) -> Float[Tensor, "*batch D"]:
        """Velocity, position units per second."""
        return self.motion.velocity + self.motion.pace[..., None] * self.goal_velocity


torch.export.register_dataclass(
    MovingGoalState, serialized_type_name="hrc_learn.dmp.MovingGoalState"
)


class MovingGoalDMP(WrappedPrimitive[Vectors, MovingTrajectory, MovingGoalState]):
    """Joint primitive that passes its goal with a given velocity.

    Values are (*batch, D) in the units of the demonstration; velocities are per second.
    `rollout` and `initial_state` meet the `end_velocity` exactly at the end of the duration;
    without it, the goal does not move. `goal` is the position of the moving goal at the end of
    the duration.
    """

    motion: JointDMP
    options: ClassVar[frozenset[str]] = frozenset({"end_velocity"})

    def __init__(self, motion: JointDMP):
        """Wrap a joint primitive.

        Raises:
            TypeError: Another kind of primitive.
            ValueError: Its scaling depends on start and goal, which the moving frame changes.
        """
        super().__init__()
        if not isinstance(motion, JointDMP):
            raise TypeError(f"a moving goal needs a JointDMP, got {type(motion).__name__}")
        if motion.forcing_scale.depends_on_boundary:
            raise ValueError("a moving goal needs a scaling independent of start and goal")
        self.motion = motion

    @property
    def start(self) -> Float[Tensor, "*batch D"]:
        """Start of the demonstration."""
        return self.motion.start

    @property
    def goal(self) -> Float[Tensor, "*batch D"]:
        """End of the demonstration."""
        return self.motion.goal

    def with_motion[S: "MovingGoalDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Primitive with another motion; the end velocity of that motion is the default."""
        return type(self)(motion)

    def state_of(self, columns: DMPState, frame: Tensor) -> MovingGoalState:
        """State relative to the goal, and the goal's velocity."""
        return MovingGoalState(motion=columns, goal_velocity=frame)

    def _columns(self, state: MovingGoalState) -> tuple[DMPState, Tensor]:
        return state.motion, state.goal_velocity

    def _boundary(
        self, given: Boundary, duration: Tensor, end_velocity: Vectors | None = None
    ) -> tuple[Boundary, Tensor]:
        """Boundary relative to the goal, and the goal velocity that causes `end_velocity`."""
        motion, end = self.motion, duration[..., None]
        start, goal, per_s = motion.resolve_boundary(given, duration)
        rate = per_s / end
        at_rest = motion.rollout_columns(Boundary(start, goal, rate), duration, end)
        at_rest = at_rest.velocity[..., 0, :]
        # In normalised time, a goal velocity of 1 shifts the start by 1 and the start velocity
        # by -1 (columns -2 and -3 of the response). It also adds 1 to the end velocity.
        at_end = motion.response.evaluate(torch.ones((), dtype=torch.float64))[1]
        gain = 1 + at_end[-2] - at_end[-3]
        # The end velocity is linear in v, so the difference gives v directly.
        wanted = at_rest
        if end_velocity is not None:
            wanted = checked_vector("end_velocity", end_velocity, at_rest)
        v = (wanted - at_rest) / gain.to(at_rest)
        return Boundary(start + v * end, goal, rate - v), v

    def _trajectory(self, columns: Trajectory, frame: Tensor) -> MovingTrajectory:
        return MovingTrajectory(columns, frame)

    @classmethod
    def restore[S: "MovingGoalDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls(JointDMP.restore(saved))
