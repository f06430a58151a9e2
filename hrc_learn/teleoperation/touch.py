"""Detect touches of the arm itself, from estimated external torques of its joints.

A push at the elbow moves the arm in the null space, a push at the end effector pauses the task,
and a sudden contact stops the arm. This needs no device, only estimates of external torques.

A wrench W at the end effector causes joint torques J^T W (J: Jacobian of the end effector),
which have no null-space component. Torques in the null space therefore come from further up the
arm: from the person, regardless of what the gripper holds, lifts or puts down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry.numerics import check_positive
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput

Place = Literal["nothing", "elbow", "hand"]
"""Place of a touch; the elbow stands for all links above the wrist."""

# Joint whose origin is the elbow, counted from 1: forces there do not load later joints.
_ELBOW = 4
# Correlation time of torque errors, which come from filter lag and settling servos [s].
_CORRELATED = 0.1
# Velocity scale of dry friction [rad/s]: at much higher velocities, friction has its full size.
_SLIDES = 0.02


@dataclass(frozen=True, kw_only=True)
class TouchConfig:
    """Thresholds of a touch, and its effects.

    Values are for the nominal imperfections of the simulated arm
    (docs/concepts/experiments.md); `tests/teleoperation/test_touch.py` checks them.
    """

    elbow_force: float = 7.0
    """Force above which a touch of the elbow begins [N]. The touch ends below half of this
    force, and has its full effect above twice this force."""
    gain: float = 2.0
    """Null-space input per null-space torque. With a damping of 3 N m s/rad, 20 N at an elbow
    that moves by 0.1 m per radian cause 0.13 m/s."""
    evidence: float = 16.0
    """Threshold of the log evidence for a touch minus the log evidence for no touch. Friction
    reached 15 in undisturbed jobs; a touch of 20 N gives 25 to 600.
    """
    hand_force: float = 10.0
    """Force at the end effector above which the task pauses [N]. The touch ends below half of
    this force."""
    released: float = 0.4
    """Time without a push at the end effector until the task resumes [s]."""
    collision_rise: float = 30.0
    """Change of force within `collision_time` that is too large for a push by hand [N]."""
    collision_time: float = 0.04
    """Interval over which `collision_rise` counts [s]."""
    collision_force: float = 110.0
    """Force that stops the arm however slowly it rises [N]: the smallest quasi-static limit of
    ISO 10218-2:2025, Annex M (ISO/TS 15066:2016, table A.2), except for face and head."""
    torque_deviation: float = 0.3
    """Standard deviation of the part of each joint's torque that no bias explains [N m]."""
    smoothing: float = 0.03
    """Time constant of the filter of the torques from which a touch is detected [s]."""
    longest_touch: float = 20.0
    """Duration after which a touch counts as a load [s]."""
    gripper_settles: float = 0.5
    """Duration after a finger motion in which contact with the object is expected [s]."""

    __post_init__ = check_positive


class TorqueBias:
    """Bias of the external torques of an untouched arm, estimated online.

    The torques are tau = -J_z^T w + o - F tanh(dq / v), with joint velocities dq and a small
    velocity v. J_z is the Jacobian's row of vertical motion, and w is the weight of a load at
    the end effector. o is an offset of each joint, due to errors of the gravity model. F is dry
    friction, which changes sign with the direction of motion. A Kalman filter estimates w, o
    and F, each a random walk.
    """

    # `_FIRST`: initial standard deviations of w [N], o and F [N m], for a load of 0.5 kg.
    # `_FRICTION`: initial F [N m]; Gaz et al. (2019) identified 0.3 to 1.3 N m.
    _FIRST = (5.0, 1.0, 0.5)
    _FRICTION = 0.8
    # Standard deviations of the changes of w [N], o and F [N m] within a second: loads are
    # picked up, and the error of the gravity model changes with the posture.
    _DRIFT = (0.3, 0.1, 0.03)
    # Standard deviation of the friction of a joint at rest, relative to F: friction may then
    # take any value up to F, in either direction.
    _STICKS = 0.7

    def __init__(self, joints: int, deviation: float):
        """Start with typical values.

        Args:
            joints: Number of joints of the arm.
            deviation: Standard deviation of torque noise [N m].
        """
        self._joints, self._deviation = joints, deviation
        first, self._drift = (
            np.repeat(sizes, (1, joints, joints)) for sizes in (self._FIRST, self._DRIFT)
        )
        self.state = np.zeros(1 + 2 * joints)
        self.state[1 + joints :] = self._FRICTION
        self._covariance = np.diag(first**2)

    def expected(
        self, jacobian: Float[np.ndarray, "6 joints"], velocity: Float[np.ndarray, " joints"]
    ) -> tuple[Float[np.ndarray, " joints"], Float[np.ndarray, "joints joints"]]:
        """Expected torques of an untouched arm [N m], and their covariance [N^2 m^2].

        Args:
            jacobian: Jacobian of the end effector.
            velocity: Joint velocities [rad/s].
        """
        H = self._rows(jacobian, velocity)
        return H @ self.state, H @ self._covariance @ H.T + np.diag(self._unknown(velocity))

    def _unknown(self, velocity: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        """Variances of the torques that no bias explains, such as friction at rest."""
        friction = self.state[1 + self._joints :] / np.cosh(velocity / _SLIDES)
        return self._deviation**2 + (self._STICKS * friction) ** 2

    def follow(
        self,
        jacobian: Float[np.ndarray, "6 joints"],
        velocity: Float[np.ndarray, " joints"],
        torque: Float[np.ndarray, " joints"],
        dt: float,
    ) -> None:
        """Update the bias with a reading.

        Args:
            jacobian: Jacobian of the end effector.
            velocity: Joint velocities [rad/s].
            torque: External torques of the untouched arm [N m].
            dt: Time since the last reading [s].
        """
        H = self._rows(jacobian, velocity)
        self._covariance += np.diag(self._drift**2 * dt)
        # Errors of successive readings are correlated.
        noise = np.diag(self._unknown(velocity)) * max(_CORRELATED / dt, 1.0)
        PH = self._covariance @ H.T
        K = np.linalg.solve(H @ PH + noise, PH.T).T
        self.state = self.state + K @ (torque - H @ self.state)
        self._covariance = self._covariance - K @ PH.T
        self._covariance = 0.5 * (self._covariance + self._covariance.T)

    def _rows(
        self, jacobian: Float[np.ndarray, "6 joints"], velocity: Float[np.ndarray, " joints"]
    ) -> Float[np.ndarray, "joints unknowns"]:
        slides = np.diag(-np.tanh(velocity / _SLIDES))
        weight = -jacobian[2, :, None]
        return np.concatenate([weight, np.eye(self._joints), slides], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Explanation:
    """Force at one place that best explains the torques, and its evidence."""

    force: Float[np.ndarray, "3"]
    """Most likely force, in the base frame [N]."""
    evidence: float
    """Logarithm of the torques' probability density for an unknown force at this place."""

    @property
    def size(self) -> float:
        """Magnitude of the force [N]."""
        return float(np.linalg.norm(self.force))

    def __lt__(self, other: Explanation) -> bool:
        return self.evidence < other.evidence


def explain(
    torque: Float[np.ndarray, " joints"],
    rows: Float[np.ndarray, "joints loads"],
    spread: Float[np.ndarray, " loads"],
    unknown: Float[np.ndarray, "joints joints"],
) -> Explanation:
    """Explain torques by loads at a place, with a Gaussian prior on the loads.

    Args:
        torque: External torques without their bias [N m].
        rows: Transposed Jacobian of the place: its first three loads are a force.
        spread: Prior standard deviation of each load [N, N m].
        unknown: Covariance of the torques of an untouched arm [N^2 m^2].
    """
    loaded = rows * spread
    covariance = loaded @ loaded.T + unknown
    loads = spread * (loaded.T @ np.linalg.solve(covariance, torque))
    return Explanation(force=loads[:3], evidence=log_density(torque, covariance))


def log_density(
    torque: Float[np.ndarray, " joints"], covariance: Float[np.ndarray, "joints joints"]
) -> float:
    """Logarithm of the normal density of torques [N m], without its constant term."""
    _, size = np.linalg.slogdet(covariance)
    return -0.5 * float(torque @ np.linalg.solve(covariance, torque) + size)


# Standard deviations of a person's force [N] and of its moment about the tool centre point
# [N m]: a hand may push the gripper up to 10 cm off its centre.
_PUSHES, _MOMENTS = 25.0, 2.5
# Margin of the log evidence above which a push counts as a push at the end effector: a wrong
# guess would pause the task for nothing.
_SURE = 2.0
# Margin of the log evidence at which a push changes its place: while a force rises, friction
# hides where the force acts. In simulation, the evidence for the end effector minus the
# evidence for the elbow is at most 2 during a push at the elbow. During a push at the end
# effector, the difference soon is 10 to 400.
_CHANGES = 8.0
# Standard deviations of the loads when the task itself makes contact: force, moment [N, N m].
_MET = np.array([60.0] * 3 + [10.0] * 3)


# Change of the gripper's opening between two readings above which the fingers count as moving
# [m]: 10 mm/s at 100 Hz, half the slowest speed of a gripper.
_FINGERS_MOVE = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class _Posture:
    """Jacobians and null space at a posture, for explaining torques."""

    jacobian: Float[np.ndarray, "6 joints"]
    """Jacobian of the end effector."""
    elbow: Float[np.ndarray, "3 joints"]
    """Jacobian of the elbow's position; its columns of later joints are zero."""
    null: Float[np.ndarray, "joints redundant"]
    """Orthonormal basis of the null space."""

    @classmethod
    def of(
        cls, origins: Float[np.ndarray, "joints 3"], jacobian: Float[np.ndarray, "6 joints"]
    ) -> _Posture:
        """Build from the joints' origins [m] and the Jacobian of the end effector."""
        elbow, axes = np.zeros_like(jacobian[:3]), jacobian[3:, :_ELBOW].T
        elbow[:, :_ELBOW] = np.cross(axes, origins[_ELBOW - 1] - origins[:_ELBOW]).T
        _, _, basis = np.linalg.svd(jacobian)
        return cls(jacobian=jacobian, elbow=elbow, null=basis[len(jacobian) :].T)

    def explained(
        self, torque: Float[np.ndarray, " joints"], unknown: Float[np.ndarray, "joints joints"]
    ) -> tuple[Explanation, Explanation]:
        """Explain torques [N m] by a force at the elbow, and by a load of the end effector."""
        forces, moments = np.full(3, _PUSHES), np.full(3, _MOMENTS)
        return (
            explain(torque, self.elbow.T, forces, unknown),
            explain(torque, self.jacobian.T, np.concatenate([forces, moments]), unknown),
        )


def touched_place(
    before: Place, above: Explanation, hand: Explanation, none: float, config: TouchConfig
) -> Place:
    """Place that is touched, judged by the evidence for each place.

    Args:
        before: Place that was touched last.
        above: Force at the elbow that explains the torques best.
        hand: Force at the end effector that explains the torques best.
        none: Log evidence that nothing is touched.
        config: Thresholds.
    """
    likelier = hand.evidence - above.evidence
    evidence = max(above, hand).evidence - none
    # A touch continues down to half of the threshold force, as long as there is evidence for a
    # touch and the other place is not far likelier.
    stays = {
        "nothing": False,
        "elbow": likelier < _CHANGES and above.size > 0.5 * config.elbow_force,
        "hand": likelier > -_CHANGES and hand.size > 0.5 * config.hand_force,
    }
    sure = evidence > config.evidence
    if evidence > 0 and stays[before]:
        return before
    if sure and likelier < 0 and above.size > config.elbow_force:
        return "elbow"
    return "hand" if sure and likelier > _SURE and hand.size > config.hand_force else "nothing"


class Touch(Human):
    """Person that pushes the arm itself.

    Attributes:
        place: Place that is touched now.
        force: Estimated force, in the base frame [N].
    """

    def __init__(self, chain: SerialChain, config: TouchConfig | None = None):
        """Start with an untouched arm.

        Args:
            chain: Kinematics of the arm.
            config: Thresholds of a touch.
        """
        self._chain, self._config = chain, config or TouchConfig()
        self._restart()

    def _restart(self) -> None:
        joints = len(self._chain.joint_names)
        self._bias = TorqueBias(joints, self._config.torque_deviation)
        self.place: Place = "nothing"
        self.force = np.zeros(3)
        self._felt = np.zeros(joints)
        self._time, self._width = -math.inf, math.nan
        # Raw torques and their times, for as long as a collision takes to rise.
        self._lately: list[tuple[float, np.ndarray]] = []
        self._fingers_moved = self._pushed = self._collided = self._let_go = -math.inf
        self._alone = 0.0
        self._expected, self._why = False, ""

    def tell(self, feedback: Feedback) -> None:
        """Note whether the task expects contact."""
        self._expected = feedback.contact_expected

    def read(self, state: ArmState) -> HumanInput:
        """Input derived from touch; no input for an arm without torque estimates."""
        still = np.zeros(len(state.joint_position))
        if state.external_torque is None:
            return HumanInput(nullspace_input=still)
        dt = state.time - self._time
        if dt < 0:  # the simulation was restarted
            self._restart()
        if not 0 <= dt < math.inf:
            dt = self._config.smoothing
        config, q = self._config, torch.from_numpy(state.joint_position)
        origins, jacobian = self._chain.joint_origins_and_jacobian(q)
        arm = _Posture.of(origins.numpy(), jacobian.numpy())
        bias, unknown = self._bias.expected(arm.jacobian, state.joint_velocity)
        free = state.external_torque - bias
        self._felt += min(dt / config.smoothing, 1.0) * (free - self._felt)
        self._time, meets = state.time, self._meets_objects(state)
        if meets:  # loads of the end effector say nothing about the elbow
            unknown = unknown + arm.jacobian.T @ np.diag(_MET**2) @ arm.jacobian
        above, hand = arm.explained(self._felt, unknown)
        none = log_density(self._felt, unknown)
        self.place = touched_place(self.place, above, hand, none, config)
        self.force = {"elbow": above.force, "hand": hand.force}.get(self.place, np.zeros(3))
        self._watch_for_collision(arm, free, unknown, max(above, hand), meets)
        if self.place == "hand" and not meets:
            self._pushed = self._time
        if self._nobody_touches() and dt > 0:  # dt is zero if a reading is repeated
            self._bias.follow(arm.jacobian, state.joint_velocity, state.external_torque, dt)
        return HumanInput(
            nullspace_input=self._nullspace_input(arm) if self.place == "elbow" else still,
            pause=self._time - self._pushed < config.released,
            stop=self._why,
        )

    def _nobody_touches(self) -> bool:
        """True if the bias may be updated: the arm has been untouched for long enough, or
        touched for so long that the touch must be a load.
        """
        if self.place != "nothing":
            self._let_go = self._time
        # When a hand has stopped the arm, friction may hide the hand for a while.
        if self._time - self._let_go > self._config.released:
            self._alone = self._time
        since = self._time - self._alone
        return since == 0 or since > self._config.longest_touch

    def _meets_objects(self, state: ArmState) -> bool:
        """True if the gripper may be in contact with its object."""
        if abs(state.gripper_width - self._width) > _FINGERS_MOVE:
            self._fingers_moved = state.time
        self._width = state.gripper_width
        since = state.time - self._fingers_moved
        return self._expected or since < self._config.gripper_settles

    def _nullspace_input(self, arm: _Posture) -> Float[np.ndarray, " joints"]:
        """Null-space input [N m]: zero up to `elbow_force`, full from twice this force on."""
        beyond = float(np.linalg.norm(self.force)) / self._config.elbow_force - 1.0
        gain = self._config.gain * min(max(beyond, 0.0), 1.0)
        return gain * (arm.null @ (arm.null.T @ self._felt))

    def _watch_for_collision(
        self,
        arm: _Posture,
        torque: Float[np.ndarray, " joints"],
        unknown: Float[np.ndarray, "joints joints"],
        now: Explanation,
        meets: bool,
    ) -> None:
        """Detect contacts that are too sudden or too hard for a push by hand."""
        config, time = self._config, self._time
        self._lately = [old for old in self._lately if old[0] > time - config.collision_time]
        rise = torque - self._lately[0][1] if self._lately else np.zeros_like(torque)
        self._lately.append((time, torque))
        found = max(arm.explained(rise, unknown))
        sure = found.evidence - log_density(rise, unknown) > config.evidence
        sudden = found.size if sure else 0.0
        if now.size > config.collision_force:
            self._why = f"something holds the arm with {now.size:.0f} N"
            self._collided = time
        elif sudden > config.collision_rise and not meets:
            self._why = f"something has hit the arm, with {sudden:.0f} N at once"
            self._collided = time
        elif self.place == "nothing" and time - self._collided > config.released:
            self._why = ""
