"""Recording demonstrations on request: start, stop, then save or discard; quality checks.

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
_NAMED = 3
"""Contacts that are named: a hand in a shelf meets many parts of it."""
_PRESSES = 60.0
"""Force at the end effector that is a collision [N]: the simulated arm's friction feels like
17 N, a gripper that sets something down presses with 20 to 40 N."""


class RecordingQuality:
    """Statistics of the frames since the start of the demonstration.

    Attributes:
        arrivals: Time at which each frame arrived [s].
        states: Joint positions [rad] and gripper width [m] of each frame.
    """

    def __init__(self, fps: float, chain: SerialChain | None = None):
        """Begin with nothing.

        Args:
            fps: Frames a second that there should be.
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
            gripper: Opening [m].
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
        """Time that passed for the arm, by that which passed for the person.

        A simulation slower than real time makes the recorded motion faster than the
        demonstrated one.
        """
        passed = self.arrivals[-1] - self.arrivals[0]
        return self.seconds / passed if passed else 1.0

    def late(self, periods: float) -> Float[np.ndarray, " late"]:
        """Gap before each frame that came later than so many periods [s]."""
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
        """Why the frames show nothing at all; empty if they show something."""
        if not self._stamps:
            return "the demonstration has no frames"
        if (part := self.moving()) is None:
            return "the arm has not moved"
        shown = self._stamps[part]
        if (seconds := shown[-1] - shown[0]) < _SHORTEST:
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
    """Unexpected contact, detected from external torques."""
    if state.external_torque is None:
        return ()
    jacobian = chain.jacobian(torch.from_numpy(state.joint_position))
    force = contact_force(jacobian, state)
    if force is None or float(np.linalg.norm(force)) < _PRESSES:
        return ()
    return (f"the arm pressed against something with more than {_PRESSES:.0f} N",)


RecorderState = Literal["ready", "recording", "stopped"]
"""Stopped: a demonstration waits to be saved or discarded."""

_LATE, _MOST_LATE = 2.0, 0.2
"""Delay in control periods after which a frame counts as late, and the fraction of late frames
from which a demonstration is doubted. One in five, so that a briefly busy machine raises no
warning.
"""
_SLOWEST = 0.8
"""Pace of a simulated arm from which a demonstration is doubted: it is a quarter faster in the
dataset than it was shown, and reproductions that are faster still meet limits."""
_DRAFT_EVERY = 2.0
"""Time from one draft of the open demonstration to the next [s]."""

UNNAMED = "not named"
"""Task of a demonstration that was open when the program ended, without a name."""


@dataclass(frozen=True, kw_only=True)
class RecorderStatus:
    """Recording status shown to the person."""

    state: RecorderState = "ready"
    seconds: float = 0.0
    """Length of the demonstration in hand [s]."""
    saved: int = 0
    """Demonstrations saved so far."""
    note: str = ""
    """Outcome of the last request."""


class DemonstrationRecorder:
    """Keeps the frames of one demonstration at a time, and writes those that are worth it.

    A person needs seconds from the button to the arm, and back: that rest is left out.

    Episodes are written by a thread, so that the control loop never waits for the disk. The
    dataset is complete when the `with` block has ended; without any episode there is none. A
    demonstration that is still open then is saved: a signal or an error loses none. While it
    is recorded a draft of it is written every `_DRAFT_EVERY` seconds, which `recover_dataset`
    makes an episode of after a power cut.

    Attributes:
        state: State of the demonstration in hand.
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
        if isinstance(error, SystemExit | KeyboardInterrupt):  # asked to end: nothing failed
            kind = error = trace = None
        empty = contextlib.nullcontext()
        if error is None and not self._writer.episodes:
            empty = contextlib.suppress(DatasetError)
        with empty:
            self._writer.__exit__(kind, error, trace)

    def finish(self) -> None:
        """Keep what is open, unless nothing in it moves, and wait until all is on disk."""
        if self.state != "ready":  # ended by a signal, say: what was shown is not lost
            self._insists = True
            self._save(task=self._task() or UNNAMED)
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
        """Do what a person asks; what makes no sense now is noted, not done."""
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
            # A long demonstration takes longer to write: drafts of it become rarer.
            self._draft_due = now + max(_DRAFT_EVERY, self._quality.seconds / 10)
            if not self._quality.worthless():
                frames, task = self._frames[:], self._task() or UNNAMED
                self._draft = self._thread.submit(self._write_draft, frames, task)

    def _forget(self) -> None:
        """Drop the demonstration in hand, and its draft."""
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
        """Why a demonstration should rather be shown again; empty if it is good."""
        if lost := self._quality.lost():
            return lost
        late, frames = len(self._quality.late(_LATE)), len(self._frames)
        if late > _MOST_LATE * (frames - 1):
            return f"the loop was late at {late} of {frames} frames: this machine is busy"
        if (pace := self._quality.pace) < _SLOWEST:
            return (
                f"the arm moved at {100 * pace:.0f} % of real time, so what was shown is "
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
