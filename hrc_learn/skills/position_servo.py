"""Position control of a velocity-controlled arm: how policies and teleoperators command."""

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

# Of Newton's method, which doubles the digits each time: from 1 cm to below 1e-9 m.
_ITERATIONS = 4


@dataclass(frozen=True, kw_only=True)
class PositionServoConfig:
    """How positions are tracked."""

    gain: float = 8.0
    """Decay rate of the tracking error [1/s]."""
    lag: float = 0.1
    """Largest tracking error of a joint; beyond, the motion restarts where the arm is [rad]."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """The safety filter, which has the last word."""

    def __post_init__(self) -> None:
        if not (self.gain > 0 and self.lag > 0):
            raise ValueError(
                f"gain and lag must be positive, but are {self.gain} and {self.lag}."
            )


class PositionServo:
    """Tracks joint positions, or poses of the end effector, by velocities within the limits.

    Positions that keep the limits are reached when the next one is due. The others are
    tracked as `ActionChunkFilter` does, so a target that jumps makes no jump of the arm.

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
        """Connect to the arm at rest.

        Args:
            chain: Its kinematics.
            arm: Its driver.
            dt: Time between targets [s].
            config: How they are tracked.

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
        self._smoother = ActionChunkFilter(_inner_limits(chain, 1.5 * config.safety.margin), dt)
        self.safety: SafetyState
        self._motion: ActionChunkState
        self.restart()

    def restart(self) -> None:
        """Restart where the arm is, at rest."""
        q = torch.from_numpy(self._arm.read().joint_position)
        self.safety = self._filter.initial_state(q)
        self._motion = self._smoother.initial_state(q)

    def follow(
        self, target: Float[np.ndarray, " joints"]
    ) -> tuple[ArmState, Float[np.ndarray, " joints"]]:
        """Command the velocity with which the target is reached, or neared, within dt.

        Args:
            target: Joint positions [rad]. NaN leaves a joint to its present motion.

        Returns:
            The reading of the arm it is based on, and the commanded positions [rad]. The
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
        """Joint positions, near the commanded ones, with the end effector at a pose [rad].

        Args:
            pose: Of the end effector. Out of reach: positions that come closer.
        """
        q = self._motion.position
        still = torch.zeros_like(q)
        for _ in range(_ITERATIONS):
            now, J = self._chain.forward_and_jacobian(q)
            q = q + resolved_rate(J, now.twist_to(pose), still)
        return q.numpy()


def _inner_limits(chain: SerialChain, margin: float) -> MotionLimits:
    """Limits of the joints within those of the safety filter, which then has nothing to do."""
    limits = chain.limits
    return MotionLimits(
        lower=limits.lower + margin,
        upper=limits.upper - margin,
        velocity=limits.velocity,
        acceleration=limits.acceleration,
        jerk=limits.jerk,
    )
