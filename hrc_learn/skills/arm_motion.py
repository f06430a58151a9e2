"""Motions of an arm: straight lines, goals in joint space, and tracking of joint positions."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import SafetyConfig, SafetyFilter, SafetyState
from hrc_learn.controller.motion_filter import MotionFilter, MotionState
from hrc_learn.controller.resolved_rate import task_rate
from hrc_learn.controller.task_pace import capped_scale
from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import Arm, ArmState
from hrc_learn.skills.person_watch import PersonWatch

# Mean angular speed on a straight line, if the rotation takes longer than the translation
# [rad/s].
_TURNING_SPEED = 0.6
# Steps of Newton's method. Each step doubles the number of correct digits. Four steps reduce an
# error of 1 cm to below 1e-9 m.
_ITERATIONS = 4


class StraightLine:
    """A motion of the end effector on a straight line, from rest to rest.

    Attributes:
        duration: Duration of the motion [s].
    """

    def __init__(self, start: Pose, goal: Pose, speed: float):
        """Plan the motion.

        Args:
            start: First pose.
            goal: Last pose.
            speed: Mean speed of the end effector [m/s].
        """
        self._start, self._twist = start, start.twist_to(goal)
        distance, turn = float(self._twist[:3].norm()), float(self._twist[3:].norm())
        # A duration below 0.3 s would need accelerations beyond the safety filter's limits.
        self.duration = max(distance / speed, turn / _TURNING_SPEED, 0.3)

    def at(self, time: float) -> tuple[Pose, Float[Tensor, "6"]]:
        """Pose and twist (linear [m/s], angular [rad/s]) at a time after the start [s]."""
        s, slope = minimum_jerk(time / self.duration)
        turned = quaternion.multiply(
            quaternion.exp(s * self._twist[3:]), self._start.orientation
        )
        pose = Pose(self._start.position + s * self._twist[:3], turned)
        return pose, self._twist * (slope / self.duration)


def joint_line(
    start: Float[Tensor, " joints"], goal: Float[Tensor, " joints"], speed: float, dt: float
) -> Float[Tensor, "steps joints"]:
    """Joint positions on a straight line in joint space, from rest to rest.

    Args:
        start: First joint positions [rad].
        goal: Last joint positions [rad].
        speed: Largest speed of any joint [rad/s].
        dt: Time between samples [s].
    """
    # A minimum jerk motion peaks at 1.875 times its mean speed.
    duration = max(1.875 * float((goal - start).abs().max()) / speed, dt)
    steps = round(duration / dt) + 1
    progress = [minimum_jerk(k * dt / duration)[0] for k in range(steps + 1)]
    return torch.lerp(start, goal, torch.tensor(progress, dtype=start.dtype)[:, None])


def joints_near(
    chain: SerialChain, pose: Pose, near: Float[Tensor, " joints"]
) -> Float[Tensor, " joints"]:
    """Joint positions, close to `near`, that bring the end effector to a pose [rad].

    Args:
        chain: Kinematics of the arm.
        pose: Pose of the end effector. If it is out of reach, the joint positions only bring
            the end effector closer to it.
        near: Joint positions that place the end effector about a centimetre from the pose
            [rad].
    """
    q = near
    for _ in range(_ITERATIONS):
        now, J = chain.forward_and_jacobian(q)
        q = q + task_rate(J, now.twist_to(pose))
    return q


@dataclass(frozen=True, kw_only=True)
class PositionServoConfig:
    """Settings of position tracking."""

    gain: float = 8.0
    """Decay rate of the tracking error [1/s]."""
    lag: float = 0.1
    """Largest tracking error of a joint [rad]. If the error is larger, the motion restarts from
    the arm's present position."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Safety filter applied to every velocity."""

    def __post_init__(self) -> None:
        check_settings(self, positive=("gain", "lag"))


class PositionServo:
    """Tracks joint positions by joint velocities within the limits of the arm.

    A target that keeps the limits is reached by the time of the next target. Other targets are
    smoothed by `MotionFilter`, so that the arm does not jump when the target does.

    Attributes:
        config: Settings of the tracking.
        safety: State of the safety filter, with its counts of interventions.
        limits: Limits that targets have to keep to be reached in time.
    """

    def __init__(
        self,
        chain: SerialChain,
        arm: Arm,
        dt: float,
        config: PositionServoConfig | None = None,
        watch: PersonWatch | None = None,
    ):
        """Connect to an arm at rest.

        Args:
            chain: Kinematics of the arm.
            arm: Driver of the arm.
            dt: Time between targets [s].
            config: Settings of the tracking.
            watch: Source of the distances from tracked people; the arm slows down or waits near
                people. None: people are not tracked.

        Raises:
            ValueError: dt is longer than the longest step for which the safety filter
                guarantees its limits.
        """
        self._chain, self._arm, self._dt = chain, arm, dt
        self.config = config = config or PositionServoConfig()
        self._watch = watch
        safety = config.safety if watch is None else watch.watchful(config.safety)
        self._filter = SafetyFilter(chain, safety)
        if not 0 < dt <= config.safety.longest_step:
            raise ValueError(
                f"targets must come within {config.safety.longest_step:g} s of each other, but "
                f"dt is {dt:g} s: raise the frame rate."
            )
        # These limits are tighter than the safety filter's, so the filter need not intervene.
        limits, margin = chain.limits, 1.5 * config.safety.margin
        self.limits = replace(
            limits,
            lower=limits.lower + margin,
            upper=limits.upper - margin,
            acceleration=self._filter.barrier.acceleration,
            jerk=self._filter.barrier.jerk,
        )
        names = ("velocity", "acceleration", "jerk", "lower", "upper")
        limits = {name: getattr(self.limits, name).numpy() for name in names}
        self._smoother = MotionFilter(dt, **limits)
        self.safety: SafetyState
        self._motion: MotionState
        self.restart()

    def restart(self) -> None:
        """Restart from the measured motion of the arm."""
        state = self._arm.read()
        q, v = state.joint_position, state.joint_velocity
        self.safety = self._filter.initial_state(torch.from_numpy(q), torch.from_numpy(v))
        self._motion = MotionState.moving(q, v)

    def follow(
        self, target: Float[np.ndarray, " joints"]
    ) -> tuple[ArmState, Float[np.ndarray, " joints"]]:
        """Command a velocity that reaches the target within dt, if the limits allow it.

        The caller lets dt pass before the next call.

        Args:
            target: Joint positions [rad]. A joint with NaN keeps its present motion.

        Returns:
            The reading of the arm that was used, and the commanded joint positions [rad].
        """
        state, before = self._arm.read(), self._motion
        here, q = state.joint_position, torch.from_numpy(state.joint_position)
        self._motion = self._smoother.step(before, np.asarray(target, dtype=float))
        wanted = self._motion.velocity + self.config.gain * (before.position - here)
        distances, J = None, self._chain.jacobian(q)
        if self._watch is not None:
            watched = self._watch.look(state.time, q)
            distances, u = watched.distances, torch.from_numpy(wanted)
            scale = capped_scale(self._chain, q, J, u, watched.speed_cap)
            wanted = float(torch.minimum(watched.speed_scale, scale)) * wanted
        filtered, self.safety, _ = self._filter.step(
            self.safety,
            q,
            torch.from_numpy(wanted),
            self._dt,
            jacobian=J,
            distances=distances,
        )
        velocity = filtered.numpy()
        self._arm.command(velocity)
        if np.abs(before.position - here).max() > self.config.lag:
            self._motion = MotionState.moving(here + velocity * self._dt, velocity)
        return state, self._motion.position

    def joints_at(self, pose: Pose) -> Float[np.ndarray, " joints"]:
        """Joint positions, near the commanded ones, that bring the end effector to a pose
        [rad].

        Args:
            pose: Pose of the end effector. If it is out of reach, the joint positions only
                bring the end effector closer to it.
        """
        return joints_near(self._chain, pose, torch.from_numpy(self._motion.position)).numpy()
