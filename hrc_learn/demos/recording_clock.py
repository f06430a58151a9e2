"""Clocks of recordings: the stamps of the state [s], and the frame of each field at each stamp.

The state is the field of joints or poses whose stamps determine the frames of the episode.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from hrc_learn.demos.recording_files import STEPS, Recording, is_time, longest_hold, read_stamps
from hrc_learn.demos.recording_meaning import Meaning
from hrc_learn.demos.recording_names import ImportOptions

_JUMP = 10.0
"""Smallest step between stamps that is reported, as a multiple of the median step."""
_FASTER = 1.5
"""Number of states per image above which recorded topics are thinned to one state per image."""


class Clock(NamedTuple):
    """Frames of the state at which every field of the recording has a value."""

    time: Float64[np.ndarray, " frames"]
    """Stamps of the state [s]."""
    frames: dict[str, Int64[np.ndarray, " frames"]]
    """Field -> its latest frame at each stamp."""
    notes: tuple[str, ...]


def clock_of_state(recording: Recording, meaning: Meaning, options: ImportOptions) -> Clock:
    """Assign the frames of all understood or kept fields to the stamps of the state.

    Slower fields hold their last value. Nothing is interpolated, because interpolation uses
    later measurements, which a robot would not have yet. Frames at either end are cut where a
    field has no value.

    Raises:
        DatasetError: Stamps are missing or do not increase. Or the stamps of a field have a
            gap, or do not overlap with those of the state.
    """
    place = f"{recording.file.name} {recording.label}".strip()
    time, notes = _stamps_of_state(recording, meaning, options)
    frames = {n: _latest(recording, n, time, meaning.time, options) for n in meaning.fields}
    known = np.all([index >= 0 for index in frames.values()], axis=0)
    partial = [name for name, index in frames.items() if (index < 0).any()]
    inside = np.flatnonzero(known)
    if len(inside) < 2:
        text = f"the clocks of {', '.join(partial)} and of the state do not overlap"
        raise recording.error(text)
    start, stop = int(inside[0]), int(inside[-1]) + 1
    for name in partial:
        silent = np.flatnonzero(frames[name][start:stop] < 0)
        if len(silent):
            at = time[start + silent[0]] - time[0]
            text = f"is silent for too long at {at:.2f} s: split the recording there"
            raise recording.error(text, name)
    if partial:
        cut = len(time) - (stop - start)
        notes.append(f"{cut} frames without {', '.join(partial)} are cut at the ends")
    rows = np.arange(start, stop)
    if recording.streams:
        cameras = {camera: frames[name][rows] for camera, name in meaning.cameras.items()}
        rows = rows[_thinned(time[rows], cameras, options.fps, notes)]
    chosen = {name: index[rows] for name, index in frames.items()}
    return Clock(time[rows], chosen, tuple(f"{place}: {note}" for note in notes))


def _thinned(
    time: Float64[np.ndarray, " frames"],
    cameras: Mapping[str, Int64[np.ndarray, " frames"]],
    fps: float | int | None,
    notes: list[str],
) -> Int64[np.ndarray, " _rows"]:
    """Rows to keep of a state that is recorded faster than the cameras or the wanted rate.

    Args:
        time: Stamps of the state [s].
        cameras: Latest image of each camera at each stamp.
        fps: Wanted rate [1/s]; None for the rate of the fastest camera.
        notes: Receives a note on the method.
    """
    rows, rate = np.arange(len(time)), (len(time) - 1) / (time[-1] - time[0])
    if fps is not None:
        ticks = np.arange(time[0], time[-1] + 1e-6, 1 / fps)
        rows = np.unique(np.searchsorted(time, ticks - 0.25 / rate))
        rows = rows[rows < len(time)]
        method = f"the first state at or after each tick of {fps:g} Hz"
    elif cameras:
        name = max(cameras, key=lambda camera: len(np.unique(cameras[camera])))
        new = np.flatnonzero(np.diff(cameras[name], prepend=-1) > 0)
        rows = new if len(rows) > _FASTER * len(new) else rows
        method = f"the first state after each image of {name}"
    if len(rows) < len(time):
        notes.append(f"states at {rate:.0f} Hz are thinned: {method}")
    return rows


def _stamps_of_state(
    recording: Recording, meaning: Meaning, options: ImportOptions
) -> tuple[Float64[np.ndarray, " frames"], list[str]]:
    """Stamps of the state [s], evenly spaced if only a duration or rate is known, and notes."""
    fields, frames = recording.fields, recording.fields[meaning.main].frames
    if frames < 2:
        raise recording.error(f"a demonstration needs at least two frames, got {frames}")
    stamps = meaning.time or next((n for n, one in fields.items() if is_time(n, one)), "")
    rate = options.fps or recording.fps
    if meaning.time and fields[stamps].frames == frames:
        time = read_stamps(recording, stamps, options.units.get("time", ""), rate)
        steps = np.diff(time)
        wide = np.flatnonzero(steps > max(_JUMP * float(np.median(steps)), STEPS[1]))
        jumps = [f"{stamps} jumps by {steps[k]:.3g} s after frame {k}" for k in wide[:1]]
        return time, jumps
    if options.duration is not None:
        return np.linspace(0.0, options.duration, frames), []
    if rate is None:
        videos = [fields[name] for name in meaning.cameras.values() if fields[name].rate]
        rate = videos[0].rate if videos and videos[0].frames == frames else None
    if rate is not None:
        return np.arange(frames) / rate, []
    if stamps:
        text = f"holds {fields[stamps].frames} stamps for {frames} frames of the state"
        raise recording.error(f"{text}: name its stamps (--time), or give --fps", stamps)
    text = "there are no stamps: name the field of stamps (time), or give duration or fps"
    raise recording.error(text)


def _latest(
    recording: Recording,
    name: str,
    time: Float64[np.ndarray, " frames"],
    main: str,
    options: ImportOptions,
) -> Int64[np.ndarray, " frames"]:
    """Latest frame of a field at each stamp of the state; -1 if it is missing or too old."""
    one, own = recording.fields[name], recording.clock_of(name, main)
    length, lasts = one.frames, float(time[-1] - time[0])
    if length == len(time) and own in ("", main if main else own):
        return np.arange(length)
    if own not in ("", main):
        rate, unit = options.fps or recording.fps, options.units.get("time", "")
        stamps = read_stamps(recording, own, rate=rate, likely=unit)
    elif one.rate:
        stamps = time[0] + np.arange(length) / one.rate
        if abs(length / one.rate - lasts) > 0.5 + 0.05 * lasts:
            text = f"lasts {length / one.rate:.1f} s, the states {lasts:.1f} s"
            raise recording.error(text, name)
    elif abs(length - len(time)) == 1:  # a last observation without an action, or the reverse
        return np.minimum(np.arange(len(time)), length - 1)
    else:
        text = f"has {length} frames, but the state {len(time)}; without stamps, the numbers"
        raise recording.error(f"{text} of frames must be equal", name)
    # The tolerance is for stamps that were rounded.
    index = np.searchsorted(stamps, time + 1e-6, side="right") - 1
    old = time - stamps[np.maximum(index, 0)] > longest_hold(stamps)
    return np.where(old, -1, index)
