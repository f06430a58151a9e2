"""Recording demonstrations at a person's word: start, stop, then save or discard."""

import contextlib
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hrc_learn.demos import DatasetError, DatasetWriter
from hrc_learn.kinematics import SerialChain
from hrc_learn.protocols import Request
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.recording_quality import RecordingQuality, moving_part

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
        self._quality = RecordingQuality(writer.fps, chain, _LATE)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._writing: list[Future[int]] = []
        self._draft: Future[float] | None = None
        self._draft_due = 0.0
        self._state: RecorderState = "ready"
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
        if self._state != "ready":  # ended by a signal, say: what was shown is not lost
            self._insists = True
            self._save(task=self._task() or UNNAMED)
        wait(self._writing)

    @property
    def status(self) -> RecorderStatus:
        """Current recording status."""
        saved = sum(w.done() and w.exception() is None for w in self._writing)
        failed = next((w.exception() for w in self._writing[::-1] if w.done()), None)
        note = self._note if failed is None else f"not saved: {failed}"
        seconds = _duration(self._frames)
        return RecorderStatus(state=self._state, seconds=seconds, saved=saved, note=note)

    @property
    def recording(self) -> bool:
        """True while frames are recorded."""
        return self._state == "recording"

    def handle(self, request: Request) -> None:
        """Do what a person asks; what makes no sense now is noted, not done."""
        match request, self._state:
            case "start", "ready" | "stopped":
                # Starting over is the quickest way to discard.
                self._forget()
                self._state, self._note = "recording", ""
                self._draft_due = self._clock() + _DRAFT_EVERY
            case "stop", "recording":
                self._state, self._note = "stopped", ""
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
        if not self.recording:
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
        if self._draft is not None and self._draft.done():
            # A long demonstration takes longer to write: a tenth of the time at most.
            took = self._draft.result()
            self._draft, self._draft_due = None, now + max(_DRAFT_EVERY, 10 * took)
        if self._draft is None and now >= self._draft_due:
            frames, task = self._frames[:], self._task() or UNNAMED
            if self._quality.worthless():
                self._draft_due = now + _DRAFT_EVERY
            else:
                self._draft = self._thread.submit(self._write_draft, frames, task)

    def _forget(self) -> None:
        """Drop the demonstration in hand, and its draft."""
        self._clear()
        self._thread.submit(self._writer.discard_draft)

    def _clear(self) -> None:
        self._frames, self._state, self._insists = [], "ready", False
        self._quality.clear()

    def _save(self, task: str) -> None:
        frames = self._frames
        if not task.strip():
            self._state = "stopped"
            self._note = "not saved yet: say in Task what is demonstrated"
            return
        if why := self._quality.worthless():
            self._forget()
            self._note = f"nothing to save: {why}"
            return
        if not self._insists and (doubt := self._doubt()):
            self._state, self._insists = "stopped", True
            self._note = f"not saved yet: {doubt}. Save again to keep it all the same"
            return
        self._clear()
        self._note = "saved"
        self._writing.append(self._thread.submit(self._write, without_rest(frames), task))

    def _doubt(self) -> str:
        """Why a demonstration should rather be shown again; empty if it is good."""
        if lost := self._quality.lost():
            return lost
        late = self._quality.ticks
        if late.late_ticks > _MOST_LATE * (late.ticks - 1):
            return (
                f"the loop was late at {late.late_ticks} of {late.ticks} frames: this machine "
                f"is busy"
            )
        if (pace := self._quality.pace) < _SLOWEST:
            return (
                f"the arm moved at {100 * pace:.0f} % of real time, so what was shown is "
                f"{1 / pace:.1f} times as fast: this machine is busy"
            )
        return ", ".join(self._quality.met())

    def _write_draft(self, frames: list[Frame], task: str) -> float:
        """Time that it took [s]."""
        began = time.perf_counter()
        # Write errors are reported when the demonstration is saved.
        with contextlib.suppress(ValueError, OSError):
            self._writer.write_draft(task, frames)
        return time.perf_counter() - began

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


def _duration(frames: list[Frame]) -> float:
    return float(frames[-1]["time"]) - float(frames[0]["time"]) if frames else 0.0


def without_rest(frames: list[Frame]) -> list[Frame]:
    """Frames from shortly before the arm begins to move until shortly after it has stopped.

    All of them where it never moves.
    """
    time = np.array([float(frame["time"]) for frame in frames])
    state = [np.append(f["joint_position"], f.get("gripper", 0.0)) for f in frames]
    part = moving_part(time, np.stack(state))
    return frames if part is None else frames[part]
