"""When each frame was taken."""

import numpy as np
from jaxtyping import Float64

from .finding import DatasetError
from .frames import RawFrames
from .layout import DatasetFolder, EpisodeEntry


def stamps(
    folder: DatasetFolder,
    entry: EpisodeEntry,
    frames: RawFrames,
    true_stamps: Float64[np.ndarray, "frames 1"] | None,
) -> Float64[np.ndarray, " frames"]:
    """Stamps of one episode [s].

    A column of true stamps is preferred. LeRobot's own `timestamp` is frame / fps by
    definition, and where it is so to the resolution of float32, that is computed anew.

    Raises:
        DatasetError: The stamps do not increase.
    """
    nominal = np.arange(entry.length) / folder.fps
    if true_stamps is not None:
        time, key = true_stamps[:, 0], "time"
    elif "timestamp" in frames:
        time, key = frames["timestamp"][:, 0].astype(float), "timestamp"
    else:
        return nominal
    stalled = np.flatnonzero(~(np.diff(time) > 0))
    if len(stalled):
        k = int(stalled[0])
        raise DatasetError(
            f"stamps must increase, but go from {time[k]:.6f} s to {time[k + 1]:.6f} s; "
            f"drop the repeated frames, or have frames taken 1/fps apart "
            f"(mapping={{'time': None}} where the column is one of true stamps)",
            file=entry.file,
            episode=entry.index,
            frame=k + 1,
            key=key,
        )
    resolution = 2 * np.finfo(np.float32).eps * max(1.0, float(np.abs(time).max()))
    regular = time[0] + nominal
    if key == "timestamp" and (np.abs(time - regular) <= resolution).all():
        return regular
    return time
