"""An arm that takes velocities, led by positions: how policies and teleoperators command."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import (
    ActionChunkFilter,
    ActionChunkState,
    SafetyConfig,
    SafetyFilter,
    SafetyState,
)
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import MotionLimits, SerialChain
from hrc_learn.protocols import Arm, ArmState
from hrc_learn.skills.cartesian_motion import resolved_rate


@dataclass(frozen=True, kw_only=True)
class PositionServoConfig:
    """How positions are followed."""

    gain: float = 8.0
    """How fast the arm is brought back to where it should be [1/s]."""
    lag: float = 0.1
    """How far a joint may be from there; farther, the motion begins anew where it is [rad]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """The safety filter, which has the last word."""

    def __post_init__(self) -> None:
        if not (self.gain > 0 and self.lag > 0):
            raise ValueError(
                f"gain and lag must be positive, but are {self.gain} and {self.lag}."
            )


class PositionServo:
    """Follows joint positions, or poses of the hand, by velocities within the arm's limits.

    Positions that keep the limits are reached when the next one is due. The others are
    followed as `ActionChunkFilter` does, so a target that jumps makes no jump of the arm.

    Attributes:
        safety: State of the safety filter, with its counts of interventions.
    """

    def __init__(
        self,
        chain: SerialChain,
        arm: Arm,
        dt: float,
        config: PositionServoConfig | None = None,
    ):
        """Take hold of the arm at rest.

        Args:
            chain: Its kinematics.
            arm: Its driver.
            dt: Time between targets [s].
            config: How they are followed.

        Raises:
            ValueError: dt is longer than the safety filter can guarantee its limits for.
        """
        self._chain, self._arm, self._dt = chain, arm, dt
        self._config = config = config or PositionServoConfig()
        self._filter = SafetyFilter(chain.limits, config.safety)
        if not 0 < dt <= 1 / config.safety.rate:
            raise ValueError(
                f"targets must come within {1 / config.safety.rate:g} s of each other, but dt "
                f"is {dt:g} s: raise the rate of frames."
            )
        self._smoother = ActionChunkFilter(_inner(chain, 1.5 * config.safety.margin), dt)
        self.safety: SafetyState
        self._motion: ActionChunkState
        self.restart()

    def restart(self) -> None:
        """Begin anew where the arm is, at rest."""
        q = torch.from_numpy(self._arm.read().joint_position)
        self.safety = self._filter.initial_state(q)
        self._motion = self._smoother.initial_state(q)

    def follow(
        self, target: Float[np.ndarray, " joints"]
    ) -> tuple[ArmState, Float[np.ndarray, " joints"]]:
        """Command the velocity with which the target is reached, or neared, within dt.

        Args:
            target: Joint positions [rad]. What is no number leaves its joint to its course.

        Returns:
            The reading of the arm it is based on, and where the joints are sent [rad]. The
            caller lets dt pass.
        """
        state = self._arm.read()
        q, before = torch.from_numpy(state.joint_position), self._motion
        _, self._motion, _ = self._smoother(
            torch.from_numpy(np.asarray(target, dtype=float))[None], before
        )
        wanted = self._motion.velocity + self._config.gain * (before.position - q)
        velocity, self.safety, _ = self._filter.step(
            self.safety, q, wanted, self._dt, jacobian=self._chain.jacobian(q)
        )
        self._arm.command(velocity.numpy())
        if float((before.position - q).abs().max()) > self._config.lag:
            self._motion = self._smoother.initial_state(q + velocity * self._dt, velocity)
        return state, self._motion.position.numpy()

    def joints_at(self, pose: Pose) -> Float[np.ndarray, " joints"]:
        """Joint positions, near those the arm is sent to, with the hand at a pose [rad].

        Args:
            pose: Of the hand. Out of reach: positions that come closer.
        """
        q = self._motion.position
        still = torch.zeros_like(q)
        for _ in range(_ITERATIONS):
            now, J = self._chain.forward_and_jacobian(q)
            q = q + resolved_rate(J, now.twist_to(pose), still)
        return q.numpy()


_ITERATIONS = 4
"""Of Newton's method, which doubles the digits from each to the next."""


def _inner(chain: SerialChain, margin: float) -> MotionLimits:
    """Limits of the joints within those of the safety filter, which then has nothing to do."""
    limits = chain.limits
    return MotionLimits(
        lower=limits.lower + margin,
        upper=limits.upper - margin,
        velocity=limits.velocity,
        acceleration=limits.acceleration,
        jerk=limits.jerk,
    )
