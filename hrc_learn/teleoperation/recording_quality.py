"""Quality checks of a demonstration while it is recorded.

The page asks the person to confirm before it saves a doubtful demonstration. lerobot-record
cannot ask, so its robots only warn at the end of an episode.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState
from hrc_learn.skills.person_feedback import contact_force

STILL = 0.005
"""Motion of a joint [rad], or of the gripper [m], below which a person has not begun yet."""
_REST = (0.3, 0.7)
"""Rest that is kept before and after the motion [s]: primitives smooth, and have to arrive."""
_SHORTEST = 0.5
"""Shortest demonstration [s]: a mouse click on a link moves the arm for less."""
_MOST_LOST, _LONGEST_GAP = 0.05, 0.2
"""Fraction of lost frames, and longest gap [s], from which a demonstration is doubted. At 0.5
m/s the end effector moves 10 cm during such a gap.
"""
_AT_LIMIT = 0.03
"""Distance from a joint's limit that counts as being there [rad]: the safety filter stops the
joint 0.02 before it."""
_LONGEST_AT_LIMIT = 0.5
"""Time at a limit from which a demonstration is doubted [s]: a joint that touches it in passing
does what the person asks for."""
_PRESSES = 60.0
"""Force at the end effector that is a collision [N]: the simulated arm's friction feels like
17 N, a gripper that sets something down presses with 20 to 40 N."""


@dataclass
class LateTicks:
    """Counts the frames that came late."""

    period: float
    """Between two frames [s]."""
    late: float
    """Periods after which a frame is late."""
    ticks: int = 0
    late_ticks: int = 0
    lost: int = 0
    """Frames that there should have been meanwhile."""
    latest: float = 0.0
    """Largest delay [s]."""
    first: float | None = None
    """Time of the first frame [s]."""
    last: float | None = None
    """Time of the last frame [s]."""

    def gap(self, now: float) -> float:
        """Time since the last frame [s]; 0 before the first."""
        return 0.0 if self.last is None else now - self.last

    def tick(self, now: float) -> None:
        """Note a frame that comes now [s]."""
        gap = self.gap(now)
        self.first, self.last = now if self.first is None else self.first, now
        self.ticks += 1
        if gap > self.late * self.period:
            self.late_ticks += 1
            self.lost += round(gap / self.period) - 1
            self.latest = max(self.latest, gap - self.period)


class RecordingQuality:
    """Statistics of the frames since the start of the demonstration.

    Attributes:
        ticks: Time of each frame.
        states: Joint positions [rad] and gripper width [m] of each frame.
    """

    def __init__(self, fps: float, chain: SerialChain | None = None, late: float = 2.0):
        """Begin with nothing.

        Args:
            fps: Frames a second that there should be.
            chain: Kinematics of the arm, for checking joint limits; None skips this check.
            late: Periods after which a frame is late.
        """
        self._period, self._late, self._chain = 1 / fps, late, chain
        if chain is not None:
            limits = chain.limits
            self._lower, self._upper = limits.lower.numpy(), limits.upper.numpy()
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self.ticks = LateTicks(self._period, self._late)
        self._stamps: list[float] = []
        self.states: list[np.ndarray] = []
        self._at_limit: Counter[str] = Counter()
        self._touched: Counter[str] = Counter()

    def add(
        self,
        now: float,
        stamp: float,
        joint_position: Float[np.ndarray, " joints"],
        gripper: float = 0.0,
        touching: Collection[str] = (),
    ) -> None:
        """Note a frame.

        Args:
            now: Arrival time [s].
            stamp: Time of the reading, by the arm's clock [s].
            joint_position: Joint positions [rad].
            gripper: Opening [m].
            touching: Unexpected contacts of the arm, as text.
        """
        self.ticks.tick(now)
        self._stamps.append(stamp)
        self.states.append(np.append(joint_position, gripper))
        self._touched.update({*touching})
        chain = self._chain
        if chain is not None and len(joint_position) == len(self._lower):
            margin = np.minimum(joint_position - self._lower, self._upper - joint_position)
            self._at_limit.update(
                chain.joint_names[k] for k in np.flatnonzero(margin < _AT_LIMIT)
            )

    @property
    def pace(self) -> float:
        """Time that passed for the arm, by that which passed for the person.

        A simulation slower than real time makes the recorded motion faster than the
        demonstrated one.
        """
        first, last = self.ticks.first, self.ticks.last
        if first is None or last is None or last == first:
            return 1.0
        return (self._stamps[-1] - self._stamps[0]) / (last - first)

    def worthless(self) -> str:
        """Why the frames show nothing at all; empty if they show something."""
        if not self._stamps:
            return "the demonstration has no frames"
        time, state = np.array(self._stamps), np.stack(self.states)
        part = moving_part(time, state)
        if part is None:
            return "the arm has not moved"
        if (seconds := float(time[part][-1] - time[part][0])) < _SHORTEST:
            return f"the arm has moved for {seconds:.1f} s only"
        return ""

    def lost(self) -> str:
        """Description of missing frames found from the stamps; empty if there are none."""
        gaps = np.diff(self._stamps)
        if not len(gaps):
            return ""
        missing = float((np.rint(gaps / self._period) - 1).clip(0).sum())
        fraction = missing / (missing + len(self._stamps))
        if fraction > _MOST_LOST or gaps.max() - self._period > _LONGEST_GAP:
            return (
                f"{100 * fraction:.0f} % of its frames are lost, "
                f"up to {gaps.max():.2f} s in a row"
            )
        return ""

    def met(self) -> list[str]:
        """Limits and contacts that a demonstration is doubted for, in words."""
        stood = {k: n * self._period for k, n in self._at_limit.items()}
        doubts = [
            f"{joint} was at its limit for {seconds:.1f} s"
            for joint, seconds in stood.items()
            if seconds > _LONGEST_AT_LIMIT
        ]
        return doubts + [
            f"{name} for {frames * self._period:.2f} s"
            for name, frames in self._touched.most_common(_NAMED)
        ]


_NAMED = 3
"""Contacts that are named: a hand in a shelf meets many parts of it."""


def pressed(chain: SerialChain, state: ArmState) -> tuple[str, ...]:
    """Unexpected contact, detected from external torques."""
    if state.external_torque is None:
        return ()
    jacobian = chain.jacobian(torch.from_numpy(state.joint_position))
    force = contact_force(jacobian, state)
    if force is None or float(np.linalg.norm(force)) < _PRESSES:
        return ()
    return (f"the arm pressed against something with more than {_PRESSES:.0f} N",)


def moving_part(
    time: Float[np.ndarray, " frames"], state: Float[np.ndarray, "frames n"]
) -> slice | None:
    """Frames from shortly before an arm begins to move until shortly after it has stopped.

    Args:
        time: Time of each frame [s].
        state: Joints [rad] and gripper [m].

    Returns:
        None where nothing moves.
    """
    away = np.flatnonzero((np.abs(state - state[0]) > STILL).any(axis=1))
    not_there = np.flatnonzero((np.abs(state - state[-1]) > STILL).any(axis=1))
    if not len(away):
        return None
    first, end = np.searchsorted(time, time[away[0]] - _REST[0]), len(time)
    if len(not_there):
        end = np.searchsorted(time, time[not_there[-1]] + _REST[1], side="right")
    return slice(int(first), int(end))
