"""Warnings about LeRobot recordings of an arm: late actions, limits, contacts, no motion."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection

from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState
from hrc_learn.teleoperation.recording_quality import RecordingQuality

logger = logging.getLogger(__name__)

LATE = 1.5
"""Periods after which an action is late: from here on the nearest frame is the next one."""
PAUSE = 2.0
"""Longer without an action is no late one but a pause [s], as between two episodes."""
TOLERATED = 0.02
"""Fraction of late actions that raises no warning."""
EPISODE = 1.0
"""Shorter stretches are no episodes [s], and need not show anything."""


class LoopWatch:
    """Judges what is recorded of an arm, and warns at the end of each stretch of actions.

    LeRobot stamps frames with their number over the rate, whenever they were recorded: in what
    is late the arm seems to have moved faster than it did. It tells a robot neither that it
    records nor when an episode ends, and keeps what is doubtful; so a stretch ends with a
    pause, with the robot's own next episode, or when it is disconnected.
    """

    def __init__(
        self,
        name: str,
        fps: float,
        clock: Callable[[], float] = time.perf_counter,
        chain: SerialChain | None = None,
        *,
        in_real_time: bool = True,
    ):
        """Begin with nothing.

        Args:
            name: Name of the robot, for the warning.
            fps: Actions a second that there should be.
            clock: Seconds.
            chain: Kinematics of the arm, for checking joint limits; None skips this check.
            in_real_time: True if the arm keeps moving while the loop is late.
        """
        self._name, self._clock, self._in_real_time = name, clock, in_real_time
        self._fps, self._quality = fps, RecordingQuality(fps, chain, LATE)

    def tick(self, state: ArmState | None = None, touching: Collection[str] = ()) -> None:
        """Note an action.

        Args:
            state: Last reading of the arm; None: it was not read.
            touching: Unexpected contacts of the arm, as text.
        """
        now = self._clock()
        if self._in_real_time and self._quality.ticks.gap(now) > PAUSE:
            self.end()
        if state is None:
            self._quality.ticks.tick(now)
        else:
            q, width = state.joint_position, state.gripper_width
            self._quality.add(now, state.time, q, width, touching)

    def end(self) -> None:
        """Warn of what is doubtful since the last end."""
        ticks = self._quality.ticks
        if self._in_real_time and ticks.late_ticks > TOLERATED * ticks.ticks:
            logger.warning(
                "%s: %d of %d actions came late, by %.0f ms at most: what was recorded lacks "
                "about %d frames, and moves faster there than the arm did. Record again with "
                "fewer or smaller images, a lower --dataset.fps, or nothing else to compute",
                self._name,
                ticks.late_ticks,
                ticks.ticks,
                1e3 * ticks.latest,
                ticks.lost,
            )
        doubts = self._quality.met()
        if len(self._quality.states) >= EPISODE * self._fps:
            doubts.insert(0, self._quality.worthless())
        for doubt in filter(None, doubts):
            logger.warning("%s: in what was recorded, %s", self._name, doubt)
        self._quality.clear()
