"""Filters, derivatives and rests of recorded signals, at even or uneven stamps."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.geometry import quaternion


def local_polynomial(
    time: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames components"],
    *,
    window: float | int,
    degree: int = 3,
) -> tuple[Float64[np.ndarray, "frames components"], Float64[np.ndarray, "frames components"]]:
    """Value and slope of a polynomial fitted around each sample by least squares.

    This generalises the filter of Savitzky and Golay (1964) to uneven stamps, as robots and
    cameras give them: each fit uses the same number of neighbours at their true times. Near the
    ends, the first and last full windows are used. On even stamps it equals that filter; a
    polynomial of the given degree passes unchanged.

    Args:
        time: Increasing stamps [s].
        values: Samples.
        window: Width of the neighbourhood [s]; at least `degree + 2` samples are used.
        degree: Degree of the polynomials.

    Returns:
        Smoothed values and their rates [1/s].

    Raises:
        ValueError: There are too few samples for the degree, or the window is not positive.
    """
    if not window > 0 or degree < 1:
        raise ValueError(f"window and degree must be positive, got {window} s and {degree}")
    if len(time) <= degree:
        raise ValueError(
            f"{len(time)} samples do not determine a polynomial of degree {degree}"
        )
    count = round(window / float(np.median(np.diff(time))))
    count = min(max(count, degree + 2) | 1, len(time))  # an odd number around each sample
    first = np.clip(np.arange(len(time)) - count // 2, 0, len(time) - count)
    neighbours = first[:, None] + np.arange(count)
    offset = time[neighbours] - time[:, None]
    # Scaled to -1..1 for a well-conditioned fit.
    scale = np.abs(offset).max(1, keepdims=True)
    powers = (offset / scale)[..., None] ** np.arange(degree + 1)
    Q, R = np.linalg.qr(powers)
    coefficients = np.linalg.solve(R, Q.mT @ values[neighbours])
    return coefficients[:, 0], coefficients[:, 1] / scale


MOVING_FIELDS = (
    "joint_position",
    "joint_velocity",
    "joint_effort",
    "human_effort",
    "position",
    "orientation",
)
"""Fields that are smoothed by default."""

_EVEN = 0.01
"""Largest difference of even steps, as a fraction of a step."""


def savitzky_golay(
    demo: Demonstration,
    window: float | int,
    degree: int = 3,
    fields: Sequence[str] = MOVING_FIELDS,
) -> Demonstration:
    """Smooth by polynomials fitted around each frame; stamps may be uneven.

    Orientations are filtered as quaternions of continuous sign and normalised, which does not
    depend on their reference frame.

    Args:
        demo: The demonstration.
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
    """Smooth by a Butterworth low-pass run forwards and backwards, without any lag.

    The cut-off of each pass is raised such that both together halve the power at `cutoff`
    (Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4). The ends
    are extended by point reflection.

    Args:
        demo: Demonstration with even stamps, such as from `resample`.
        cutoff: Frequency whose power is halved [Hz].
        order: Order of each pass.
        fields: Fields to smooth, where recorded.

    Raises:
        ValueError: The stamps are uneven, the cut-off exceeds half the frame rate, there are
            too few frames, or a field cannot be smoothed.
    """
    from scipy.signal import butter, sosfiltfilt

    steps = np.diff(demo.time)
    if not len(steps) or np.ptp(steps) > _EVEN * steps.mean():
        raise ValueError(
            "a Butterworth filter needs even stamps: resample(demo, fps) first, or smooth "
            "with savitzky_golay, which accepts uneven ones"
        )
    rate = 1 / steps.mean()
    correction = (np.sqrt(2) - 1) ** (1 / (2 * order))
    # Bilinear transform: the correction applies to the frequencies of the analogue filter.
    raised = np.arctan(np.tan(np.pi * cutoff / rate) / correction) * rate / np.pi
    sections = np.asarray(butter(order, raised, fs=rate, output="sos"))
    return _filtered(
        demo,
        fields,
        lambda values: sosfiltfilt(sections, values, axis=0, padlen=3 * (order + 1)),
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
        if name in ("time", "feature_visible"):
            raise ValueError(f"{name} cannot be smoothed")
        seen = demo.feature_visible
        if name == "feature" and seen is not None and not seen.all():
            raise ValueError(
                f"the feature is not visible at frame {int(np.argmin(seen))}: cut the "
                f"demonstration to the visible part, or do not smooth the feature"
            )
        values = getattr(demo, name)
        result = smooth(values.reshape(len(demo), -1)).reshape(values.shape)
        if name == "orientation":
            result /= np.linalg.norm(result, axis=1, keepdims=True)
        smoothed[name] = result
    return replace(demo, **smoothed)


def estimate_joint_velocity(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Demonstration:
    """Estimate `joint_velocity` from the joint positions.

    Differences of jittered stamps multiply the noise; a polynomial fitted around each frame
    (`local_polynomial`) does not, and uses the stamps as they are.

    Args:
        demo: Demonstration with joint positions.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: No joint positions are recorded, or there are too few frames.
    """
    if demo.joint_position is None:
        raise ValueError(
            "joint velocities are estimated from joint positions; none are recorded"
        )
    _, velocity = local_polynomial(demo.time, demo.joint_position, window=window, degree=degree)
    return replace(demo, joint_velocity=velocity)


def estimate_twist(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Float64[np.ndarray, "_frames 6"]:
    """Linear [m/s] and angular [rad/s] velocity of the end effector, in the base frame.

    The angular velocity is 2 q' q*, with polynomials fitted to the quaternion's components; it
    does not depend on the choice of the base frame.

    Args:
        demo: Demonstration with position and orientation.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: The pose is not recorded, or there are too few frames.
    """
    if demo.position is None or demo.orientation is None:
        raise ValueError("a twist needs position and orientation; one is not recorded")
    _, linear = local_polynomial(demo.time, demo.position, window=window, degree=degree)
    q, q_dot = (
        torch.from_numpy(array)
        for array in local_polynomial(demo.time, demo.orientation, window=window, degree=degree)
    )
    # A fitted quaternion is not exactly of unit length; the vector part ignores its growth.
    product = quaternion.multiply(q_dot, quaternion.conjugate(q))
    angular = 2 * product[:, 1:] / q.square().sum(1, keepdim=True)
    return np.hstack([linear, angular.numpy()])


_JOINT_REST, _LINEAR_REST = (0.01, 0.04), (0.003, 0.01)
"""Speeds below which a rest begins and above which it ends, of the fastest joint [rad/s], and
of the end effector [m/s]. Between them, the last state persists: a speed close to one bound
does not split a recording."""
_SHORTEST_REST = 0.3
"""Shortest rest [s]; shorter ones, as at a turning point, belong to the motion."""
_REST_WINDOW = 0.15
"""Width of the neighbourhood for speeds [s]."""


def resting(demo: Demonstration) -> Bool[np.ndarray, " _frames"]:
    """Mask of frames in which the joints, or else the end effector, rest.

    Raises:
        ValueError: The demonstration holds neither joint nor Cartesian positions, or too few
            frames to estimate a speed.
    """
    joints = demo.joint_position
    values = demo.position if joints is None else joints
    if values is None:
        raise ValueError("rest is found in joint positions or positions; neither is recorded")
    _, rates = local_polynomial(demo.time, values, window=_REST_WINDOW, degree=2)
    speed = np.linalg.norm(rates, axis=1) if joints is None else np.abs(rates).max(1)
    low, high = _LINEAR_REST if joints is None else _JOINT_REST
    state = np.where(speed > high, 1, np.where(speed < low, -1, 0))
    # The arm moves before the first clear state.
    last = np.maximum.accumulate(np.where(state != 0, np.arange(len(demo)), -1))
    still = np.where(last >= 0, state[last], 1) < 0
    for start, stop in _runs(still):
        if demo.time[stop - 1] - demo.time[start] < _SHORTEST_REST:
            still[start:stop] = False
    return still


def cut(demo: Demonstration, start: int, stop: int) -> Demonstration:
    """Frames `start` to `stop` (exclusive) of a demonstration; time begins at zero again.

    Raises:
        ValueError: The range is empty or exceeds the demonstration.
    """
    if not 0 <= start < stop <= len(demo):
        raise ValueError(
            f"frames {start} to {stop} are no part of a demonstration of {len(demo)} frames"
        )
    rows = {name: getattr(demo, name)[start:stop] for name in demo.recorded}
    rows["time"] = demo.time[start:stop] - demo.time[start]
    return replace(
        demo,
        **rows,
        start_time=demo.start_time + float(demo.time[start]),
        extra={key: values[start:stop] for key, values in demo.extra.items()},
    )


def trim_rest(demo: Demonstration, keep: float | int = 0.1) -> Demonstration:
    """Trim the rest before and after the motion.

    Args:
        demo: The demonstration.
        keep: Rest left at either end [s], so that the motion begins and ends at rest.

    Raises:
        ValueError: As in `resting`, or the arm never moves.
    """
    moving = np.flatnonzero(~resting(demo))
    if not len(moving):
        raise ValueError(f"episode {demo.episode}: the arm rests all the time")
    return _with_margin(demo, int(moving[0]), int(moving[-1]) + 1, keep)


def split_at_rest(
    demo: Demonstration, *, shortest: float | int = 0.5, keep: float | int = 0.1
) -> list[Demonstration]:
    """Split a demonstration into the motions between rests.

    Args:
        demo: Demonstration of several motions, such as the parts of a task.
        shortest: Duration below which motions are left out [s].
        keep: Rest left at either end of each motion [s].

    Raises:
        ValueError: As in `resting`.
    """
    return [
        _with_margin(demo, start, stop, keep)
        for start, stop in _runs(~resting(demo))
        if demo.time[stop - 1] - demo.time[start] >= shortest
    ]


def _runs(flags: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First frame and exclusive end of every run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _with_margin(
    demo: Demonstration, start: int, stop: int, keep: float | int
) -> Demonstration:
    time = demo.time
    first = int(np.searchsorted(time, time[start] - keep))
    behind = int(np.searchsorted(time, time[stop - 1] + keep, side="right"))
    return cut(demo, first, behind)
