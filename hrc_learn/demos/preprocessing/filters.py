"""Filters and derivatives of recorded signals, and compensation of their delay."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.preprocessing.resampling import at_times
from hrc_learn.geometry import quaternion

# Smooth values and rates of noisy samples at uneven stamps.


def local_polynomial(
    time: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames components"],
    *,
    window: float | int,
    degree: int = 3,
) -> tuple[Float64[np.ndarray, "frames components"], Float64[np.ndarray, "frames components"]]:
    """Fit a polynomial around each sample by least squares; its value and slope there.

    The filter of Savitzky and Golay (1964) for stamps that need not be even, as robots and
    cameras give them: each fit takes the same number of neighbours, at the times they really
    have. Near the ends the neighbours are those of the first and last full window. On even
    stamps this is that filter; a polynomial of the degree passes unchanged.

    Args:
        time: Increasing stamps [s].
        values: Samples.
        window: Width of the neighbourhood [s]; at least `degree + 2` samples are taken.
        degree: Degree of the polynomials.

    Returns:
        Values, and their rates [1/s].

    Raises:
        ValueError: There are no more samples than the degree, or the window is not positive.
    """
    if not window > 0 or degree < 1:
        raise ValueError(f"window and degree must be positive, got {window} s and {degree}")
    if len(time) <= degree:
        raise ValueError(
            f"{len(time)} samples do not determine a polynomial of degree {degree}"
        )
    neighbours = _neighbours(time, window, degree)
    offset = time[neighbours] - time[:, None]
    # Scaled to -1..1, for the powers to stay of one size.
    scale = np.abs(offset).max(1, keepdims=True)
    powers = (offset / scale)[..., None] ** np.arange(degree + 1)
    Q, R = np.linalg.qr(powers)
    coefficients = np.linalg.solve(R, Q.mT @ values[neighbours])
    return coefficients[:, 0], coefficients[:, 1] / scale


def _neighbours(
    time: Float64[np.ndarray, " frames"], window: float | int, degree: int
) -> np.ndarray:
    """Indices (frames, neighbours) of an odd number of samples around each."""
    count = round(window / float(np.median(np.diff(time))))
    count = min(max(count, degree + 2) | 1, len(time))
    first = np.clip(np.arange(len(time)) - count // 2, 0, len(time) - count)
    return first[:, None] + np.arange(count)


# Filters that take out noise and leave the timing.

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
"""By how much of a step steps may differ and count as even."""


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


# Velocities from recorded positions.


def estimate_joint_velocity(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Demonstration:
    """The demonstration with `joint_velocity` estimated from its joint positions.

    Differences of jittered stamps multiply the noise; a polynomial fitted around each frame
    (`local_polynomial`) does not, and uses the stamps as they are.

    Args:
        demo: Its joint positions recorded.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: No joint positions are recorded, or too few frames.
    """
    if demo.joint_position is None:
        raise ValueError(
            "a joint velocity is estimated from joint positions; none are recorded"
        )
    _, velocity = local_polynomial(demo.time, demo.joint_position, window=window, degree=degree)
    return replace(demo, joint_velocity=velocity)


def estimate_twist(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Float64[np.ndarray, "_frames 6"]:
    """Linear [m/s] and angular [rad/s] velocity of the end effector, in the base frame.

    The angular velocity is 2 q' q* of the polynomials fitted to the quaternion's components;
    it does not depend on the choice of the base frame.

    Args:
        demo: Its position and orientation recorded.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: The pose is not recorded, or too few frames.
    """
    if demo.position is None or demo.orientation is None:
        raise ValueError("a twist needs position and orientation; one is not recorded")
    _, linear = local_polynomial(demo.time, demo.position, window=window, degree=degree)
    q, q_dot = (
        torch.from_numpy(array)
        for array in local_polynomial(demo.time, demo.orientation, window=window, degree=degree)
    )
    # A fitted quaternion is not quite of unit length; its own growth drops out of this part.
    product = quaternion.multiply(q_dot, quaternion.conjugate(q))
    angular = 2 * product[:, 1:] / q.square().sum(1, keepdim=True)
    return np.hstack([linear, angular.numpy()])


# Streams of one demonstration that were stamped late.


def compensate_delay(demo: Demonstration, delays: Mapping[str, float]) -> Demonstration:
    """Move fields to the time they were measured at.

    An image that takes 40 ms from the lens to its stamp shows where the arm was 40 ms ago.

    Args:
        demo: A demonstration.
        delays: By how much fields lag behind the stamps of their frames [s], such as
            {"feature": 0.04}. The end of the demonstration, for which no later frame shows
            them, is cut off.

    Raises:
        ValueError: A field is not recorded, or a delay is negative or too long.
    """
    for name, delay in delays.items():
        if name not in demo.recorded or name == "time":
            raise ValueError(
                f"{name} is not recorded; there are {', '.join(demo.recorded[1:])}"
            )
        if not 0 <= delay < demo.duration:
            raise ValueError(
                f"the delay of {name} must be between 0 and {demo.duration:.4g} s, got {delay}"
            )
    longest = max(delays.values(), default=0.0)
    kept = demo.time[demo.time <= demo.time[-1] - longest]
    moved = {
        field: getattr(shifted, field)
        for name, delay in delays.items()
        # By rounding a sum may lie past the last frame.
        for shifted in [at_times(demo, np.minimum(kept + delay, demo.time[-1]))]
        for field in _together(name, shifted)
    }
    return replace(at_times(demo, kept), **moved)


def _together(name: str, demo: Demonstration) -> list[str]:
    """A feature and whether it is seen belong together."""
    both = ("feature", "feature_visible")
    return [n for n in both if n in demo.recorded] if name in both else [name]
