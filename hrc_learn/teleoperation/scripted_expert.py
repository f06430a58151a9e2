"""Simulate people by scripts: a person that pulls the arm at given times, and an expert that
guides the end effector along way points.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, minimum_jerk
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.teleoperation.hand_guiding import TINY, force_to_nullspace_input


@dataclass(frozen=True, kw_only=True)
class ScriptedForce:
    """A pull at a joint towards a point during an interval, with soft start and end."""

    start: float
    """Start of the pull [s]."""
    duration: float
    """Duration of the pull [s]."""
    towards: tuple[float, float, float]
    """Position of the person's hand, in the base frame [m]."""
    stiffness: float = 100.0
    """Force per distance between the joint and the person's hand [N/m]."""
    max_force: float = 25.0
    """Largest force [N]."""
    joint: int = 4
    """Index of the pulled joint, counted from 1."""
    ramp: float = 0.4
    """Time to rise to full strength, and to fall from it [s]."""

    @property
    def end(self) -> float:
        """End of the pull [s]."""
        return self.start + self.duration

    def strength(self, time: float) -> float:
        """Fraction of full strength at a time, 0 to 1."""
        edge = min(time - self.start, self.end - time) / self.ramp
        s = min(max(edge, 0.0), 1.0)
        # Smoothstep: the force starts and ends without a jump of its rate.
        return s * s * (3.0 - 2.0 * s)

    def force(self, time: float, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Force on the joint at a time [N]; `origin` is the joint's present position [m]."""
        pull = self.stiffness * (np.array(self.towards) - origin)
        size = float(np.linalg.norm(pull))
        return pull * self.strength(time) * min(1.0, self.max_force / max(size, TINY))


_PAUSE, _DURATION = (1.0, 6.0), (2.0, 4.5)
"""Ranges of the pause between two pulls and of the duration of a pull [s]. The paper's drags of
joint 4 last 4 to 7 s."""
_FAR_AWAY = 10.0
"""Distance of the point that a pull is directed to [m]: so large that the direction hardly
changes while the arm moves."""
_SLOPE = math.radians(30.0)
"""Largest angle of a pull to the horizontal [rad]: people pull an elbow aside."""
_FORCE = 60.0
"""Largest force [N], as in the scripted interaction of a collaboration trial."""


def random_pulls(
    rng: np.random.Generator, duration: float = 600.0
) -> tuple[ScriptedForce, ...]:
    """Pulls at random times, each in a random direction.

    Args:
        rng: Source of times, durations and directions.
        duration: Time within which pulls begin [s].
    """
    pulls, time = [], float(rng.uniform(0.0, _PAUSE[1]))
    while time < duration:
        heading, slope = rng.uniform(-np.pi, np.pi), rng.uniform(-_SLOPE, _SLOPE)
        along = _FAR_AWAY * math.cos(slope)
        towards = (
            along * math.cos(heading),
            along * math.sin(heading),
            _FAR_AWAY * math.sin(slope),
        )
        length = float(rng.uniform(*_DURATION))
        pulls.append(
            ScriptedForce(start=time, duration=length, towards=towards, max_force=_FORCE)
        )
        time += length + float(rng.uniform(*_PAUSE))
    return tuple(pulls)


class ScriptedPerturbation(Human):
    """Person that only pulls the arm, at given times."""

    def __init__(
        self, chain: SerialChain, forces: Sequence[ScriptedForce], begin: float | None = 0.0
    ):
        """Prepare the script.

        Args:
            chain: The arm.
            forces: Pulls to exert.
            begin: Time at which the script starts [s]; None: it starts when `begin` is called.
        """
        self._chain = chain
        self.forces = tuple(forces)
        self._begin = begin

    def begin(self, time: float) -> None:
        """Start the script at this time [s]."""
        self._begin = time

    def read(self, state: ArmState) -> HumanInput:
        """The null-space input of all forces that act now."""
        d = np.zeros(len(self._chain.joint_names))
        if self._begin is None:
            return HumanInput(nullspace_input=d)
        q, time = state.joint_position, state.time - self._begin
        for scripted in self.forces:
            if scripted.start < time < scripted.end:
                origins = self._chain.joint_origins(torch.from_numpy(q))
                origin = origins[scripted.joint - 1].numpy()
                d += force_to_nullspace_input(
                    self._chain, q, scripted.joint, scripted.force(time, origin)
                )
        return HumanInput(nullspace_input=d)


class GuidedPath:
    """A smooth path through way points, traversed once from rest to rest."""

    def __init__(
        self, waypoints: Float[np.ndarray, "points 3"], duration: float, start: float = 0.0
    ):
        """Fix the path.

        Args:
            waypoints: Positions to pass [m]; successive positions must differ.
            duration: Time from the first to the last way point [s].
            start: Time at the first way point [s].
        """
        chords = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        from scipy.interpolate import PchipInterpolator  # takes a quarter of a second

        length = np.concatenate([[0.0], np.cumsum(chords)])
        # The curve is monotone between way points: an overshoot would hit the shelves' boards.
        self._curve = PchipInterpolator(length / length[-1], waypoints)
        self._slope = self._curve.derivative()
        self._start, self.duration = start, duration

    @property
    def end(self) -> float:
        """Time at the last way point [s]."""
        return self._start + self.duration

    def position(self, time: float) -> Float[np.ndarray, "3"]:
        """Position at a time [m]."""
        s, _ = self._progress(time)
        return self._curve(s)

    def velocity(self, time: float) -> Float[np.ndarray, "3"]:
        """Velocity at a time [m/s]."""
        s, rate = self._progress(time)
        return self._slope(s) * rate

    def _progress(self, time: float) -> tuple[float, float]:
        """Fraction of the path covered, and its rate [1/s]."""
        s, slope = minimum_jerk((time - self._start) / self.duration)
        return s, slope / self.duration


class Tremor:
    """Shaking of a hand: a slow random drift and a tremor of 8 Hz."""

    def __init__(self, amplitude: float, rng: np.random.Generator):
        """Draw the phases.

        Args:
            amplitude: Amplitude of the tremor [m]; the drift has three times this amplitude.
            rng: Source of the phases.
        """
        # Two frequencies of tremor (Elble and Koller 1990: 8 to 12 Hz) and two of drift.
        self._omega = 2 * np.pi * np.array([8.0, 7.2, 0.35, 0.22])
        self._amplitude = amplitude * np.array([1.0, 0.7, 3.0, 3.0])
        self._phase = rng.uniform(0, 2 * np.pi, size=(3, 4))

    def velocity(self, time: float) -> Float[np.ndarray, "3"]:
        """Velocity at a time [m/s]."""
        return (self._amplitude * self._omega * np.cos(self._omega * time + self._phase)).sum(
            axis=1
        )


# Gain with which the expert corrects an error of the pose by eye [1/s].
_GAIN = 4.0

Orientation = Callable[[Float[torch.Tensor, "3"], float], Float[torch.Tensor, "4"]]
"""Rule that gives the wanted orientation of the end effector (wxyz), from its position [m] and
the time [s]."""


class ScriptedExpert(Human):
    """Guides the end effector with an unsteady hand.

    Position follows a guided path, corrected by eye; orientation follows a rule.
    """

    def __init__(
        self, chain: SerialChain, path: GuidedPath, orientation: Orientation, tremor: Tremor
    ):
        """Prepare the script.

        Args:
            chain: The arm.
            path: Path of the end effector.
            orientation: Rule for the orientation, such as `coarse_orientation`.
            tremor: Unsteadiness of the end effector.
        """
        self.path, self.orientation = path, orientation
        self._chain, self._tremor = chain, tremor

    def read(self, state: ArmState) -> HumanInput:
        """Motion of the end effector at the state's time."""
        pose = self._chain.forward(torch.from_numpy(state.joint_position))
        wanted = torch.from_numpy(self.path.position(state.time))
        # The rule gives the orientation at the actual position, not at the wanted position.
        goal = Pose(wanted, self.orientation(pose.position, state.time))
        twist = _GAIN * pose.twist_to(goal).numpy()
        twist[:3] += self.path.velocity(state.time)
        if state.time < self.path.end:
            twist[:3] += self._tremor.velocity(state.time)
        return HumanInput(twist=twist)
