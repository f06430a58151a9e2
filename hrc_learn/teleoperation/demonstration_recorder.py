"""Recording demonstrations at a person's word: start, stop, then save or discard."""

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hrc_learn.demos import DatasetError, DatasetWriter
from hrc_learn.protocols import Request
from hrc_learn.teleoperation.hand_guiding import Frame

RecorderState = Literal["ready", "recording", "stopped"]
"""Stopped: a demonstration waits to be saved or discarded."""

_STILL = 0.005
"""Motion of a joint [rad], or of the gripper [m], below which a person has not begun yet."""
_REST = (0.3, 0.7)
"""Rest that is kept before and after the motion [s]: primitives smooth, and have to arrive."""


UNNAMED = "not named"
"""Task of a demonstration that was open when the program ended, without a name."""


@dataclass(frozen=True, kw_only=True)
class RecorderStatus:
    """What a person wants to know of a recording."""

    state: RecorderState = "ready"
    seconds: float = 0.0
    """Length of the demonstration in hand [s]."""
    saved: int = 0
    """Demonstrations saved so far."""
    note: str = ""
    """What became of the last request."""


class DemonstrationRecorder:
    """Keeps the frames of one demonstration at a time, and writes those that are worth it.

    A person needs seconds from the button to the arm, and back: that rest is left out.

    Episodes are written by a thread, so that the control loop never waits for the disk. The
    dataset is complete when the `with` block has ended; without any episode there is none. A
    demonstration that is still open then is saved: a signal or an error loses none.
    """

    def __init__(self, writer: DatasetWriter, task: Callable[[], str]):
        """Prepare.

        Args:
            writer: Of the dataset, used by nobody else.
            task: What is demonstrated, in words; asked for when a demonstration is saved.
        """
        self._writer, self._task = writer, task
        self._frames: list[Frame] = []
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._writing: list[Future[int]] = []
        self._state: RecorderState = "ready"
        self._note = ""

    def __enter__(self) -> "DemonstrationRecorder":
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if self._state != "ready":  # ended by a signal, say: what was shown is not lost
            self._save(task=self._task() or UNNAMED)
        self._thread.shutdown(wait=True)
        if isinstance(error, SystemExit | KeyboardInterrupt):  # asked to end: nothing failed
            kind = error = trace = None
        empty = contextlib.nullcontext()
        if error is None and not self._writer.episodes:
            empty = contextlib.suppress(DatasetError)
        with empty:
            self._writer.__exit__(kind, error, trace)

    @property
    def status(self) -> RecorderStatus:
        """As it is now."""
        seconds = 0.0
        if self._frames:
            seconds = float(self._frames[-1]["time"]) - float(self._frames[0]["time"])
        saved = sum(w.done() and w.exception() is None for w in self._writing)
        failed = next((w.exception() for w in self._writing[::-1] if w.done()), None)
        note = self._note if failed is None else f"not saved: {failed}"
        return RecorderStatus(state=self._state, seconds=seconds, saved=saved, note=note)

    def handle(self, request: Request) -> None:
        """Do what a person asks; what makes no sense now is noted, not done."""
        match request, self._state:
            case "start", "ready" | "stopped":
                # Starting over is the quickest way to discard.
                self._frames, self._state, self._note = [], "recording", ""
            case "stop", "recording":
                self._state, self._note = "stopped", "save it or discard it"
            case "save", "recording" | "stopped":
                self._save(self._task())
            case "discard", "recording" | "stopped":
                self._frames, self._state, self._note = [], "ready", "discarded"
            case (("stop" | "save" | "discard"), _):
                self._note = f"nothing to {request}: start a demonstration first"

    def add(self, frame: Frame) -> None:
        """Keep a frame while recording."""
        if self._state == "recording":
            self._frames.append(frame)

    def _save(self, task: str) -> None:
        frames = self._frames
        if not task.strip():
            self._state, self._note = (
                "stopped",
                "not saved yet: say in Task what is demonstrated",
            )
            return
        self._frames, self._state = [], "ready"
        if not frames:
            self._note = "nothing to save: the demonstration has no frames"
            return
        if not moves(frames):
            self._note = "nothing to save: the arm has not moved"
            return
        self._note = "saved"
        self._writing.append(self._thread.submit(self._write, without_rest(frames), task))

    def _write(self, frames: list[Frame], task: str) -> int:
        self._writer.start_episode(task)
        try:
            for frame in frames:
                self._writer.add_frame(images=None, **frame)
            return self._writer.save_episode()
        finally:
            self._writer.discard_episode()


def moves(frames: list[Frame]) -> bool:
    """Whether the arm or its gripper moves."""
    state = np.stack([_state(frame) for frame in frames])
    return bool((np.abs(state - state[0]) > _STILL).any())


def without_rest(frames: list[Frame]) -> list[Frame]:
    """Frames from shortly before the arm begins to move until shortly after it has stopped.

    All of them where it never moves.
    """
    state = np.stack([_state(frame) for frame in frames])
    away = np.flatnonzero((np.abs(state - state[0]) > _STILL).any(axis=1))
    not_there = np.flatnonzero((np.abs(state - state[-1]) > _STILL).any(axis=1))
    if not len(away):
        return frames
    time = np.array([float(frame["time"]) for frame in frames])
    first = np.searchsorted(time, time[away[0]] - _REST[0])
    end = len(frames)
    if len(not_there):
        end = np.searchsorted(time, time[not_there[-1]] + _REST[1], side="right")
    return frames[int(first) : int(end)]


def _state(frame: Frame) -> Float[np.ndarray, " n"]:
    """What moves: joints [rad] and gripper [m]."""
    return np.append(frame["joint_position"], frame.get("gripper", 0.0))
