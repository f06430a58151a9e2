"""Filters that take out noise and leave the timing."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from ..demonstration import Demonstration
from .local_polynomial import local_polynomial

MOVING_FIELDS = (
    "joint_position",
    "joint_velocity",
    "joint_effort",
    "human_effort",
    "position",
    "orientation",
)
"""Fields that are smoothed where nothing else is asked for."""

_EVEN = 0.01


def savitzky_golay(
    demo: Demonstration,
    window: float | int,
    degree: int = 3,
    fields: Sequence[str] = MOVING_FIELDS,
) -> Demonstration:
    """Smooth by polynomials fitted around each frame; stamps may be uneven.

    Orientations are filtered as quaternions of continuous sign and brought back to unit
    length, which does not depend on the frame they are given in.

    Args:
        demo: A demonstration.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.
        fields: Fields to smooth, where recorded.

    Raises:
        ValueError: There are too few frames, or a field cannot be smoothed.
    """
    return _filtered(
        demo,
        fields,
        lambda values: local_polynomial(demo.time, values, window=window, degree=degree)[0],
    )


def butterworth(
    demo: Demonstration,
    cutoff: float | int,
    order: int = 2,
    fields: Sequence[str] = MOVING_FIELDS,
) -> Demonstration:
    """Smooth by a Butterworth low-pass run forwards and backwards, so that nothing lags.

    Each pass is of the `order` given. Its own cut-off is raised so that both together halve
    the power at `cutoff` (Winter, Biomechanics and Motor Control of Human Movement, 4th ed.,
    section 3.4.4). The ends are continued by point reflection.

    Args:
        demo: On even stamps; `resample` makes them so.
        cutoff: Frequency whose power is halved [Hz].
        order: Order of one pass.
        fields: Fields to smooth, where recorded.

    Raises:
        ValueError: The stamps are uneven, the cut-off is beyond half the frame rate, there
            are too few frames, or a field cannot be smoothed.
    """
    from scipy.signal import butter, sosfiltfilt

    steps = np.diff(demo.time)
    if not len(steps) or np.ptp(steps) > _EVEN * steps.mean():
        raise ValueError(
            "a Butterworth filter needs even stamps: resample(demo, fps) first, or smooth "
            "with savitzky_golay, which takes them as they are"
        )
    rate = 1 / steps.mean()
    if not 0 < cutoff < rate / 2:
        raise ValueError(f"cutoff must be between 0 and {rate / 2:.4g} Hz, got {cutoff:.4g}")
    correction = (np.sqrt(2) - 1) ** (1 / (2 * order))
    # In the frequencies of the analogue filter that the digital one is made of.
    raised = np.arctan(np.tan(np.pi * cutoff / rate) / correction) * rate / np.pi
    sections = np.asarray(butter(order, raised, fs=rate, output="sos"))
    reflected = 3 * (order + 1)
    if len(demo) <= reflected:
        raise ValueError(
            f"{len(demo)} frames are too few for this filter: it takes {reflected + 1} at least"
        )
    return _filtered(
        demo, fields, lambda values: sosfiltfilt(sections, values, axis=0, padlen=reflected)
    )


def _filtered(
    demo: Demonstration,
    fields: Sequence[str],
    smooth: Callable[
        [Float64[np.ndarray, "frames components"]], Float64[np.ndarray, "frames components"]
    ],
) -> Demonstration:
    smoothed = {}
    for name in fields:
        if name not in demo.recorded:
            continue
        values = _filterable(demo, name)
        result = smooth(values.reshape(len(demo), -1)).reshape(values.shape)
        if name == "orientation":
            result /= np.linalg.norm(result, axis=1, keepdims=True)
        smoothed[name] = result
    return replace(demo, **smoothed)


def _filterable(demo: Demonstration, name: str) -> np.ndarray:
    if name in ("time", "feature_visible"):
        raise ValueError(f"{name} is nothing to be smoothed")
    seen = demo.feature_visible
    if name == "feature" and seen is not None and not seen.all():
        raise ValueError(
            f"the feature is lost at frame {int(np.argmin(seen))}: cut the demonstration to "
            f"where it is seen, or leave the feature as it is"
        )
    return getattr(demo, name)
