"""Oddities of the stamps."""

import numpy as np
from jaxtyping import Float64

from ..layout import EpisodeEntry
from .report import Report

_RATE_TOLERANCE = 0.05
_JITTER_TOLERANCE = 0.10
_GAP = 1.6
"""Steps longer than this many usual ones have lost a frame between them."""
_SHORT_FRAMES = 10
_SHORT_SECONDS = 0.5


def check_stamps(
    entry: EpisodeEntry,
    key: str,
    time: Float64[np.ndarray, " frames"],
    fps: float,
    report: Report,
) -> None:
    """Order, rate, regularity and gaps of the stamps [s] of one episode."""
    place = {"file": entry.file, "episode": entry.index, "key": key}
    if not np.isfinite(time).all():
        return  # reported with the values that are not finite
    steps = np.diff(time)
    if not len(steps):
        return
    stalled = np.flatnonzero(steps <= 0)
    if len(stalled):
        k = int(stalled[0])
        report.error(
            f"stamps must increase, but go from {time[k]:.6f} s to {time[k + 1]:.6f} s "
            f"({len(stalled)} times); repair_dataset.py drops the repeated "
            f"frames",
            frame=k + 1,
            **place,
        )
        return
    usual = float(np.median(steps))
    if abs(usual * fps - 1) > _RATE_TOLERANCE:
        report.warning(
            f"frames are {1e3 * usual:.4g} ms apart ({1 / usual:.4g} Hz), but fps says "
            f"{fps:g}; repair_dataset.py --fps {round(1 / usual)} resamples to the true rate",
            **place,
        )
    gaps = np.flatnonzero(steps > _GAP * usual)
    if len(gaps):
        lost = int(np.rint(steps[gaps] / usual - 1).sum())
        report.warning(
            f"{len(gaps)} gaps, about {lost} frames lost; the first is "
            f"{1e3 * steps[gaps[0]]:.4g} ms long; repair_dataset.py --fps {fps:g} fills them "
            f"in",
            frame=int(gaps[0]) + 1,
            **place,
        )
    jitter = float(np.quantile(np.abs(np.delete(steps, gaps) - usual), 0.95)) / usual
    if jitter > _JITTER_TOLERANCE:
        report.warning(
            f"steps vary by {100 * jitter:.0f} % (95th percentile); repair_dataset.py "
            f"--fps {fps:g} resamples",
            **place,
        )


def check_length(entry: EpisodeEntry, fps: float, report: Report) -> None:
    """Episodes too short to be a demonstration."""
    seconds = entry.length / fps
    if entry.length < _SHORT_FRAMES or seconds < _SHORT_SECONDS:
        report.warning(
            f"only {entry.length} frames ({seconds:.2g} s): a false start?",
            file=entry.file,
            episode=entry.index,
        )
