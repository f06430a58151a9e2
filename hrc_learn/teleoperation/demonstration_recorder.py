"""Record demonstrations on request (start, stop, save or discard), with quality checks.

The page asks the person to confirm before it saves a doubtful demonstration. lerobot-record
cannot ask, so its robots only warn at the end of an episode.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import DatasetError, DatasetWriter
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import ArmState, Request
from hrc_learn.skills.step_report import contact_force
from hrc_learn.teleoperation.hand_guiding import Frame

STILL = 0.005
"""Motion of a joint [rad] or the gripper [m] above which the demonstration has begun."""
_REST = (0.3, 0.7)
"""Rest kept before and after the motion [s]: movement primitives smooth motions, and need time
to reach the goal."""
_SHORTEST = 0.5
"""Shortest demonstration [s]: a mouse click on a link moves the arm for a shorter time."""
_MOST_LOST, _LONGEST_GAP = 0.05, 0.2
"""A demonstration is doubted above these values. `_MOST_LOST`: fraction of lost frames.
`_LONGEST_GAP`: gap [s]; at 0.5 m/s, the end effector moves by 10 cm in such a gap.
"""
_AT_LIMIT = 0.03
"""Distance from its limit up to which a joint counts as being at the limit [rad]. The safety
filter stops the joint 0.02 rad before the limit."""
_LONGEST_AT_LIMIT = 0.5
"""Time at a limit above which a demonstration is doubted [s]: a joint may touch its limit
briefly."""
_NAMED = 3
"""Largest number of contacts that a doubt names: an end effector inside a shelf may touch many
parts of the shelf."""
_PRESSES = 60.0
"""Force at the end effector above which a contact is unexpected [N]: the simulated arm's
friction looks like 17 N, and a gripper that puts something down presses with 20 to 40 N."""


class RecordingQuality:
    """Statistics of the frames since the start of the demonstration.

    Attributes:
        arrivals: Time at which each frame arrived [s].
        states: Joint positions [rad] and gripper width [m] of each frame.
    """

    def __init__(self, fps: float, chain: SerialChain | None = None):
        """Start without frames.

        Args:
            fps: Nominal number of frames per second.
            chain: Kinematics of the arm, for checking joint limits; None skips this check.
        """
        self._period, self._chain = 1 / fps, chain
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self.arrivals: list[float] = []
        self._stamps: list[float] = []
        self.states: list[np.ndarray] = []
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
            gripper: Opening of the gripper [m].
            touching: Unexpected contacts of the arm, as text.
        """
        self.arrivals.append(now)
        self._stamps.append(stamp)
        self.states.append(np.append(joint_position, gripper))
        self._touched.update({*touching})

    @property
    def seconds(self) -> float:
        """Duration by the arm's clock [s]."""
        return self._stamps[-1] - self._stamps[0] if self._stamps else 0.0

    @property
    def pace(self) -> float:
        """Elapsed time of the arm's clock divided by elapsed time of the person's clock.

        A simulation slower than real time makes the recorded motion faster than the
        demonstrated motion.
        """
        passed = self.arrivals[-1] - self.arrivals[0]
        return self.seconds / passed if passed else 1.0

    def late(self, periods: float) -> Float[np.ndarray, " late"]:
        """Gaps between frames that are longer than a number of periods [s]."""
        gaps = np.diff(self.arrivals)
        return gaps[gaps > periods * self._period]

    def moving(self) -> slice | None:
        """Frames from shortly before the arm begins to move until shortly after it has stopped;
        None: it does not move.
        """
        time, state = np.array(self._stamps), np.stack(self.states)
        away = np.flatnonzero((np.abs(state - state[0]) > STILL).any(axis=1))
        not_there = np.flatnonzero((np.abs(state - state[-1]) > STILL).any(axis=1))
        if not len(away):
            return None
        first, end = np.searchsorted(time, time[away[0]] - _REST[0]), len(time)
        if len(not_there):
            end = np.searchsorted(time, time[not_there[-1]] + _REST[1], side="right")
        return slice(int(first), int(end))

    def worthless(self) -> str:
        """Reason why the frames show no demonstration; empty if they show a demonstration."""
        if not self._stamps:
            return "the demonstration has no frames"
        if (part := self.moving()) is None:
            return "the arm has not moved"
        shown = self._stamps[part]
        if (seconds := shown[-1] - shown[0]) < _SHORTEST:
            return f"the arm has moved for {seconds:.1f} s only"
        return ""

    def lost(self) -> str:
        """Description of missing frames, found from time stamps; empty if none is missing."""
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
        """Joint limits and contacts that make a demonstration doubtful, as text."""
        doubts, chain = [], self._chain
        if chain is not None and self.states:
            q, limits = np.stack(self.states)[:, :-1], chain.limits
            margin = np.minimum(q - limits.lower.numpy(), limits.upper.numpy() - q)
            stood = (margin < _AT_LIMIT).sum(axis=0) * self._period
            doubts = [
                f"{joint} was at its limit for {seconds:.1f} s"
                for joint, seconds in zip(chain.joint_names, stood, strict=True)
                if seconds > _LONGEST_AT_LIMIT
            ]
        return doubts + [
            f"{name} for {frames * self._period:.2f} s"
            for name, frames in self._touched.most_common(_NAMED)
        ]


def pressed(chain: SerialChain, state: ArmState) -> tuple[str, ...]:
    """Unexpected contact, estimated from external torques, as text; empty if there is none."""
    if state.external_torque is None:
        return ()
    jacobian = chain.jacobian(torch.from_numpy(state.joint_position))
    force = contact_force(jacobian, state)
    if force is None or float(np.linalg.norm(force)) < _PRESSES:
        return ()
    return (f"the arm pressed against something with more than {_PRESSES:.0f} N",)


RecorderState = Literal["ready", "recording", "stopped"]
"""State of a recorder. "stopped": a demonstration waits to be saved or discarded."""

_LATE, _MOST_LATE = 2.0, 0.2
"""`_LATE`: gap before a frame above which the frame counts as late [frame periods].
`_MOST_LATE`: fraction of late frames above which a demonstration is doubted; one in five, so
that a briefly busy machine raises no warning.
"""
_SLOWEST = 0.8
"""Pace of a simulated arm (`RecordingQuality.pace`) below which a demonstration is doubted. At
this pace, the motion in the dataset is a quarter faster than demonstrated; even faster motions
would reach limits."""
_DRAFT_EVERY = 2.0
"""Shortest period of drafts of the open demonstration [s]."""

UNNAMED = "not named"
"""Task of a draft, or of a demonstration that was open when the program ended, if the person
has not named the task."""


@dataclass(frozen=True, kw_only=True)
class RecorderStatus:
    """Recording status shown to the person."""

    state: RecorderState = "ready"
    seconds: float = 0.0
    """Duration of the current demonstration [s]."""
    saved: int = 0
    """Demonstrations saved so far."""
    note: str = ""
    """Outcome of the last request."""


class DemonstrationRecorder:
    """Records one demonstration at a time, and writes each demonstration worth saving.

    A person needs seconds to go from the button to the arm and back. The recorder leaves out
    most of this rest before and after the motion.

    A thread writes the episodes, so that the control loop never waits for the disk. The dataset
    is complete when the `with` block has ended; without an episode, no dataset is written. A
    demonstration that is open when the block ends is saved, even after a signal or an error.
    During recording, a draft is written every `_DRAFT_EVERY` seconds, less often for a long
    demonstration. After a power cut, `recover_dataset` turns the draft into an episode.

    Attributes:
        state: State of the current demonstration.
    """

    def __init__(
        self,
        writer: DatasetWriter,
        task: Callable[[], str],
        clock: Callable[[], float] = time.monotonic,
        chain: SerialChain | None = None,
    ):
        """Prepare the recorder.

        Args:
            writer: Dataset writer, not used elsewhere.
            task: Description of the task, read when a demonstration is saved.
            clock: Wall clock of the person [s].
            chain: Kinematics of the arm, for checking joint limits; None skips this check.
        """
        self._writer, self._task, self._clock = writer, task, clock
        self._frames: list[Frame] = []
        self._quality = RecordingQuality(writer.fps, chain)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._writing: list[Future[int]] = []
        self._draft: Future[None] = self._thread.submit(lambda: None)
        self._draft_due = 0.0
        self.state: RecorderState = "ready"
        self._note, self._insists = "", False

    def __enter__(self) -> "DemonstrationRecorder":
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self.finish()
        self._thread.shutdown(wait=True)
        if isinstance(error, SystemExit | KeyboardInterrupt):  # a request to end, not a failure
            kind = error = trace = None
        empty = contextlib.nullcontext()
        if error is None and not self._writer.episodes:
            empty = contextlib.suppress(DatasetError)
        with empty:
            self._writer.__exit__(kind, error, trace)

    def finish(self) -> None:
        """Save an open demonstration if it has a motion, and wait until all is on disk."""
        if self.state != "ready":  # as after a signal: do not lose the motion
            self._insists = True
            self._save(task=self._task().strip() or UNNAMED)
        wait(self._writing)

    @property
    def status(self) -> RecorderStatus:
        """Current recording status."""
        saved = sum(w.done() and w.exception() is None for w in self._writing)
        failed = next((w.exception() for w in self._writing[::-1] if w.done()), None)
        note = self._note if failed is None else f"not saved: {failed}"
        return RecorderStatus(
            state=self.state, seconds=self._quality.seconds, saved=saved, note=note
        )

    def handle(self, request: Request) -> None:
        """Handle a request; a request that makes no sense now only leaves a note."""
        match request, self.state:
            case "start", "ready" | "stopped":
                # Starting over is the quickest way to discard.
                self._forget()
                self.state, self._note = "recording", ""
                self._draft_due = self._clock() + _DRAFT_EVERY
            case "stop", "recording":
                self.state, self._note = "stopped", ""
            case "save", "recording" | "stopped":
                self._save(self._task())
            case "discard", "recording" | "stopped":
                self._forget()
                self._note = "discarded"
            case (("stop" | "save" | "discard"), _):
                self._note = f"nothing to {request}: start a demonstration first"

    def add(self, frame: Frame, touching: Collection[str] = ()) -> None:
        """Keep a frame while recording.

        Args:
            frame: Columns of the frame.
            touching: Unexpected contacts of the arm, as text.
        """
        if self.state != "recording":
            return
        now = self._clock()
        self._frames.append(frame)
        self._quality.add(
            now,
            float(frame["time"]),
            np.asarray(frame["joint_position"]),
            float(frame.get("gripper", 0.0)),
            touching,
        )
        if now >= self._draft_due and self._draft.done():
            # Long demonstrations take longer to write, so their drafts become rarer.
            self._draft_due = now + max(_DRAFT_EVERY, self._quality.seconds / 10)
            if not self._quality.worthless():
                frames, task = self._frames[:], self._task().strip() or UNNAMED
                self._draft = self._thread.submit(self._write_draft, frames, task)

    def _forget(self) -> None:
        """Discard the current demonstration and its draft."""
        self._clear()
        self._thread.submit(self._writer.discard_draft)

    def _clear(self) -> None:
        self._frames, self.state, self._insists = [], "ready", False
        self._quality.clear()

    def _save(self, task: str) -> None:
        if not task.strip():
            self.state = "stopped"
            self._note = "not saved yet: say in Task what is demonstrated"
            return
        if why := self._quality.worthless():
            self._forget()
            self._note = f"nothing to save: {why}"
            return
        if not self._insists and (doubt := self._doubt()):
            self.state, self._insists = "stopped", True
            self._note = f"not saved yet: {doubt}. Save again to keep it all the same"
            return
        frames = self._frames[self._quality.moving() or slice(None)]
        self._clear()
        self._note = "saved"
        self._writing.append(self._thread.submit(self._write, frames, task))

    def _doubt(self) -> str:
        """Reason to repeat the demonstration; empty if it is good."""
        if lost := self._quality.lost():
            return lost
        late, frames = len(self._quality.late(_LATE)), len(self._frames)
        if late > _MOST_LATE * (frames - 1):
            return f"the loop was late at {late} of {frames} frames: this machine is busy"
        if (pace := self._quality.pace) < _SLOWEST:
            return (
                f"the arm moved at {100 * pace:.0f} % of real time, so its recording is "
                f"{1 / pace:.1f} times as fast: this machine is busy"
            )
        return ", ".join(self._quality.met())

    def _write_draft(self, frames: list[Frame], task: str) -> None:
        # Write errors are reported when the demonstration is saved.
        with contextlib.suppress(ValueError, OSError):
            self._writer.write_draft(task, frames)

    def _write(self, frames: list[Frame], task: str) -> int:
        self._writer.start_episode(task)
        try:
            for frame in frames:
                self._writer.add_frame(images=None, **frame)
            return self._writer.save_episode()
        except ValueError:
            self._writer.discard_draft()
            raise
        finally:
            self._writer.discard_episode()
