"""Preparation of demonstrations for learning: cutting, filtering, resampling, alignment."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from hrc_learn.demos.demonstration import JOINT_FIELDS, Demonstration, DemonstrationSet
from hrc_learn.demos.read.dataset_folder import FASTEST
from hrc_learn.geometry import quaternion


def local_polynomial(
    time: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames components"],
    *,
    window: float | int,
    degree: int = 3,
) -> tuple[Float64[np.ndarray, "frames components"], Float64[np.ndarray, "frames components"]]:
    """Value and slope of a polynomial fitted around each sample by least squares.

    This generalises the filter of Savitzky and Golay (1964) to the uneven stamps of robots and
    cameras: each fit uses the same number of neighbours at their true times. Near the ends, the
    first and last full windows are used. On even stamps, the result equals that of the original
    filter. Samples of a polynomial of the given degree are returned unchanged.

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
    if not 0 < window < np.inf or degree < 1:
        raise ValueError(f"window and degree must be positive, got {window} s and {degree}")
    if len(time) <= degree:
        text = f"{len(time)} samples do not determine a polynomial of degree {degree}"
        raise ValueError(text)
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


_MEASURED = (name for name in JOINT_FIELDS if not name.startswith("command_"))
_SMOOTHED = (*_MEASURED, "position", "orientation")
"""Fields that are smoothed; commands are left as they are."""


def savitzky_golay(demo: Demonstration, window: float | int, degree: int = 3) -> Demonstration:
    """Smooth motion and efforts by polynomials around each frame; stamps may be uneven.

    Orientations are filtered as quaternions of continuous sign, then normalised. The result
    does not depend on the reference frame.

    Args:
        demo: The demonstration.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: There are too few frames.
    """
    fit = partial(local_polynomial, demo.time, window=window, degree=degree)
    return _filtered(demo, lambda values: fit(values)[0])


def butterworth(demo: Demonstration, cutoff: float | int, order: int = 2) -> Demonstration:
    """Smooth motion and efforts by a Butterworth low-pass, forwards and backwards, without lag.

    The cut-off of each pass is raised such that the two passes together halve the power at
    `cutoff` (Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4).
    The ends are extended by point reflection.

    Args:
        demo: Demonstration with even stamps, such as from `resample`.
        cutoff: Frequency whose power is halved [Hz].
        order: Order of each pass.

    Raises:
        ValueError: The stamps are uneven, the cut-off exceeds half the frame rate, or there are
            too few frames.
    """
    from scipy.signal import butter, sosfiltfilt

    steps = np.diff(demo.time)
    if not len(steps) or np.ptp(steps) > 0.01 * steps.mean():  # stamps are rounded
        text = "a Butterworth filter needs even stamps: resample(demo, fps) first, or smooth"
        raise ValueError(f"{text} with savitzky_golay, which accepts uneven ones")
    rate = 1 / steps.mean()
    if not 0 < cutoff < rate / 2:
        text = f"the cut-off must lie between 0 and half the frame rate, {rate / 2:g} Hz"
        raise ValueError(f"{text}, got {cutoff}")
    correction = (np.sqrt(2) - 1) ** (1 / (2 * order))
    # Bilinear transform: the correction applies to the frequencies of the analogue filter.
    raised = np.arctan(np.tan(np.pi * cutoff / rate) / correction) * rate / np.pi
    sections = np.asarray(butter(order, raised, fs=rate, output="sos"))
    return _filtered(
        demo, lambda values: sosfiltfilt(sections, values, axis=0, padlen=3 * (order + 1))
    )


def _filtered(demo: Demonstration, smooth: Callable[[np.ndarray], np.ndarray]) -> Demonstration:
    smoothed = {}
    for name in (name for name in _SMOOTHED if name in demo.recorded):
        result = smooth(getattr(demo, name))
        if name == "orientation":
            result /= np.linalg.norm(result, axis=1, keepdims=True)
        smoothed[name] = result
    return replace(demo, **smoothed)


def estimate_joint_velocity(demo: Demonstration, window: float | int = 0.1) -> Demonstration:
    """Estimate `joint_velocity` from the joint positions.

    A polynomial is fitted around each frame (`local_polynomial`), at the true stamps. Finite
    differences at jittered stamps would amplify the noise.

    Args:
        demo: Demonstration with joint positions.
        window: Width of the neighbourhood [s].

    Raises:
        ValueError: No joint positions are recorded, or there are too few frames.
    """
    if demo.joint_position is None:
        raise ValueError("joint velocities come from joint positions; none are recorded")
    _, velocity = local_polynomial(demo.time, demo.joint_position, window=window)
    return replace(demo, joint_velocity=velocity)


def estimate_twist(
    demo: Demonstration, window: float | int = 0.1
) -> Float64[np.ndarray, "_frames 6"]:
    """Linear [m/s] and angular [rad/s] velocity of the end effector, in the base frame.

    The angular velocity is 2 q' q*, from the quaternion q, its time derivative q' and its
    conjugate q*; polynomials are fitted to the components of q. The estimated motion does not
    depend on the choice of the base frame.

    Args:
        demo: Demonstration with position and orientation.
        window: Width of the neighbourhood [s].

    Raises:
        ValueError: The pose is not recorded, or there are too few frames.
    """
    if demo.position is None or demo.orientation is None:
        raise ValueError("a twist needs position and orientation; one is not recorded")
    pose = np.hstack([demo.position, demo.orientation])
    smooth, rate = local_polynomial(demo.time, pose, window=window)
    q, q_dot = torch.from_numpy(smooth[:, 3:]), torch.from_numpy(rate[:, 3:])
    # Fitted quaternions deviate from unit length; the vector part ignores changes in length.
    product = quaternion.multiply(q_dot, quaternion.conjugate(q))
    angular = 2 * product[:, 1:] / q.square().sum(1, keepdim=True)
    return np.hstack([rate[:, :3], angular.numpy()])


_JOINT_REST, _LINEAR_REST = (0.01, 0.04), (0.003, 0.01)
"""`_JOINT_REST`: speeds of the fastest joint below which a rest begins and above which it ends
[rad/s]. `_LINEAR_REST`: these two speeds for the end effector [m/s]. Between the two speeds,
the last state persists, so that a speed close to one of them does not split a recording."""
_SHORTEST_REST = 0.3
"""Shortest rest [s]; shorter ones, as at a turning point, belong to the motion."""
_REST_WINDOW = 0.15
"""Width of the neighbourhood for speeds [s]."""


def resting(demo: Demonstration) -> Bool[np.ndarray, " _frames"]:
    """Mask of the frames at rest: joints at rest or, without joints, end effector at rest.

    Raises:
        ValueError: The demonstration holds neither joint nor Cartesian positions, or too few
            frames to estimate a speed.
    """
    joints = demo.joint_position
    values = demo.position if joints is None else joints
    if values is None:
        raise ValueError("rest is found in joint or tool positions; neither is recorded")
    _, rates = local_polynomial(demo.time, values, window=_REST_WINDOW, degree=2)
    speed = np.linalg.norm(rates, axis=1) if joints is None else np.abs(rates).max(1)
    low, high = _LINEAR_REST if joints is None else _JOINT_REST
    state = np.where(speed > high, 1, np.where(speed < low, -1, 0))
    # The arm counts as moving until its speed first shows clearly that it moves or rests.
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
        text = f"frames {start} to {stop} are no part of a demonstration of {len(demo)} frames"
        raise ValueError(text)
    rows = {name: getattr(demo, name)[start:stop] for name in demo.recorded}
    rows["time"] = demo.time[start:stop] - demo.time[start]
    return replace(
        demo,
        **rows,
        start_time=demo.start_time + float(demo.time[start]),
        extra={key: values[start:stop] for key, values in demo.extra.items()},
    )


def trim_rest(demo: Demonstration, keep: float | int = 0.1) -> Demonstration:
    """Remove the standstill before and after the motion.

    Args:
        demo: The demonstration.
        keep: Rest left at either end [s], so that the motion begins and ends at rest.

    Raises:
        ValueError: As in `resting`, or the arm never moves.
    """
    return cut(demo, *motion_range(demo, resting(demo), keep))


def motion_range(
    demo: Demonstration, rest: Bool[np.ndarray, " frames"], keep: float | int = 0.1
) -> tuple[int, int]:
    """First frame and exclusive end of the motion, with some rest at either end.

    Args:
        demo: The demonstration.
        rest: Mask of the frames at rest, as from `resting`.
        keep: Rest left at either end [s].

    Raises:
        ValueError: The arm never moves.
    """
    moving = np.flatnonzero(~rest)
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
        cut(demo, *_with_margin(demo, start, stop, keep))
        for start, stop in _runs(~resting(demo))
        if demo.time[stop - 1] - demo.time[start] >= shortest
    ]


def _runs(flags: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First frame and exclusive end of every run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _with_margin(demo: Demonstration, start: int, stop: int, keep: float) -> tuple[int, int]:
    first = int(np.searchsorted(demo.time, demo.time[start] - keep))
    behind = int(np.searchsorted(demo.time, demo.time[stop - 1] + keep, side="right"))
    return first, behind


_SMOOTH = ("joint_position", "joint_velocity", "position", "orientation")
"""Fields that vary smoothly, because the arm has inertia; all other fields may jump."""


def resample(demo: Demonstration, fps: float | int) -> Demonstration:
    """Resample a demonstration to a regular grid.

    The grid begins at the first frame. The end of the demonstration after the last grid point,
    less than one period, is dropped.

    Args:
        demo: Demonstration of at least two frames, with even or uneven stamps.
        fps: Frame rate of the grid [1/s].

    Raises:
        ValueError: `fps` is not positive, or the demonstration is shorter than a period.
    """
    grid = regular_grid(demo.duration, fps)
    return replace(at_times(demo, np.minimum(grid, demo.duration)), time=grid, fps=fps)


def regular_grid(duration: float | int, fps: float | int) -> Float64[np.ndarray, " frames"]:
    """Times from 0 to the duration in steps of 1/fps [s].

    Raises:
        ValueError: `fps` is not positive, or the duration is shorter than a period.
    """
    if not 0 < fps < FASTEST:
        raise ValueError(f"fps must be positive and below {FASTEST:g}, got {fps}")
    # The tolerance of a thousandth of a period allows for rounded stamps.
    count = int(np.floor(duration * fps + 1e-3)) + 1
    if count < 2:
        raise ValueError(f"{duration:.3g} s hold no two frames at {fps:g} Hz")
    return np.arange(count) / fps


def at_times(demo: Demonstration, time: Float64[np.ndarray, " _times"]) -> Demonstration:
    """Interpolate a demonstration at other times.

    Joint positions, joint velocities and poses follow a cubic spline through the frames
    (orientations: a spline of the quaternion's components, normalised). All other fields follow
    straight lines, but columns of whole numbers take the value of the nearest frame. A feature
    is visible if it is visible in both neighbouring frames.

    Args:
        demo: Demonstration of at least two frames.
        time: Increasing times within the demonstration [s].

    Raises:
        ValueError: The times exceed the demonstration, or it has only one frame.
    """
    return replace(demo, time=time, **_fields_at(demo, time))


def _fields_at(demo: Demonstration, time: Float64[np.ndarray, " _times"]) -> dict[str, Any]:
    """Fields and extra columns at other times, which may repeat."""
    from scipy.interpolate import CubicSpline, make_interp_spline

    if len(demo) < 2:
        raise ValueError("a demonstration of one frame cannot be interpolated")
    if time[0] < demo.time[0] or time[-1] > demo.time[-1]:
        text = f"times from {time[0]:.6g} s to {time[-1]:.6g} s exceed the demonstration"
        raise ValueError(f"{text}, which lasts {demo.duration:.6g} s")
    moved: dict[str, Any] = {}
    for name in demo.recorded[1:]:
        values = getattr(demo, name)
        if name == "feature" and demo.feature_visible is not None:
            # The pixel of an invisible feature need not be finite.
            sound = np.isfinite(values) | demo.feature_visible[:, None]
            values = np.where(sound, values, 0.0)
        if name in _SMOOTH:
            moved[name] = CubicSpline(demo.time, values)(time)
        else:
            moved[name] = make_interp_spline(demo.time, values.astype(float), k=1)(time)
    if "orientation" in moved:
        moved["orientation"] /= np.linalg.norm(moved["orientation"], axis=1, keepdims=True)
    if "feature_visible" in moved:
        # Visible in both neighbours; the tolerance allows for rounding at the frame itself.
        moved["feature_visible"] = moved["feature_visible"] > 1 - 1e-9
    moved["extra"] = {}
    nearest = nearest_frames(demo.time, time)
    for key, values in demo.extra.items():
        whole = (values == np.rint(values)).all(0)
        between = make_interp_spline(demo.time, values, k=1)(time)
        moved["extra"][key] = np.where(whole, values[nearest], between)
    return moved


def nearest_frames(
    known: Float64[np.ndarray, " frames"], time: Float64[np.ndarray, " times"]
) -> Int64[np.ndarray, " times"]:
    """Index of the frame nearest to each time; of two equally near frames, the earlier one."""
    return np.ceil(np.interp(time, known, np.arange(len(known))) - 0.5).astype(np.int64)


def set_duration(demo: Demonstration, duration: float | int) -> Demonstration:
    """Scale the duration of a demonstration; the path stays the same.

    Velocities and the nominal frame rate are scaled accordingly. No frame is added or removed;
    `resample` does that. Efforts stay as measured.

    Args:
        demo: Demonstration of at least two frames.
        duration: New duration [s].

    Raises:
        ValueError: The duration is not positive, or there is only one frame.
    """
    if not 0 < duration < np.inf or len(demo) < 2:
        text = f"a demonstration of {len(demo)} frames cannot be made to last {duration} s"
        raise ValueError(text)
    scale = duration / demo.duration
    rates = {"joint_velocity", "command_velocity"} & {*demo.recorded}
    scaled = {name: getattr(demo, name) / scale for name in rates}
    return replace(demo, time=demo.time * scale, fps=demo.fps / scale, **scaled)


def equalise_durations(demos: DemonstrationSet) -> DemonstrationSet:
    """Scale all demonstrations to their median duration.

    Raises:
        ValueError: As in `set_duration`.
    """
    duration = float(np.median([demo.duration for demo in demos]))
    return demos.map(lambda demo: set_duration(demo, duration))


def compensate_delay(demo: Demonstration, delays: Mapping[str, float]) -> Demonstration:
    """Shift fields to the times at which they were measured.

    An image that is stamped 40 ms after its exposure shows the arm 40 ms before the stamp.

    Args:
        demo: The demonstration.
        delays: Field -> time from its measurement to its stamp [s], such as {"feature": 0.04}.
            The demonstration is shortened by the longest delay, because the last values of the
            delayed field would be stamped after the end of the recording.

    Raises:
        ValueError: A field is not recorded, or a delay is negative or too long.
    """
    for name, delay in delays.items():
        if name not in demo.recorded[1:]:
            recorded = ", ".join(demo.recorded[1:])
            raise ValueError(f"{name} is not recorded; recorded fields: {recorded}")
        if not 0 <= delay < demo.duration:
            bounds = f"between 0 and {demo.duration:.4g} s"
            raise ValueError(f"the delay of {name} must be {bounds}, got {delay}")
    longest = max(delays.values(), default=0.0)
    kept = demo.time[demo.time <= demo.time[-1] - longest]
    moved = at_times(demo, kept)
    for name, delay in delays.items():
        # Rounding may put a sum after the last frame.
        shifted = at_times(demo, np.minimum(kept + delay, demo.time[-1]))
        seen = {"feature_visible": shifted.feature_visible} if name == "feature" else {}
        moved = replace(moved, **{name: getattr(shifted, name)}, **seen)
    return moved


def warp(
    cost: Float64[np.ndarray, "_first _second"],
) -> tuple[Int64[np.ndarray, " _pairs"], Int64[np.ndarray, " _pairs"]]:
    """Pair two sequences by dynamic time warping (Sakoe and Chiba 1978, symmetric form P = 0).

    D[i, j] = cost[i, j] + min(D[i-1, j-1], D[i-1, j], D[i, j-1])

    D[i, j] is the least cost of a path that ends with the pair i, j. Entries of an
    anti-diagonal depend only on earlier anti-diagonals, so they are computed together. The
    result is exact and takes about 0.1 s for 1000 by 1000 samples. No library is used:
    `dtaidistance` accepts no cost matrix, and `tslearn` needs numba, scikit-learn and
    statsmodels.

    Args:
        cost: Cost of pairing sample i of the first with sample j of the second; infinite for
            pairs that are not allowed.

    Returns:
        Indices into both sequences along the cheapest monotone path from both starts to both
        ends; ties prefer the diagonal.

    Raises:
        ValueError: No path has a finite cost.
    """
    rows, columns = cost.shape
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        j = diagonal - i
        before = np.minimum(np.minimum(total[i, j], total[i, j + 1]), total[i + 1, j])
        total[i + 1, j + 1] = cost[i, j] + before
    if not total[-1, -1] < np.inf:
        raise ValueError("no path of finite cost pairs the two sequences")
    i, j = rows, columns
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda place: total[place])
        path.append((i, j))
    pairs = np.array(path[::-1], dtype=np.int64) - 1
    return pairs[:, 0], pairs[:, 1]


_BAND = 0.2
"""Largest difference in phase between paired frames, as a fraction of the duration."""
_VELOCITY_WINDOW = 0.1
"""Width of the neighbourhood for smoothing warped times and for estimating velocities [s]."""


def align(demos: DemonstrationSet) -> DemonstrationSet:
    """Warp every demonstration to the timing of the demonstration of median duration.

    This demonstration is the reference.

    Time warping compares the joint positions, each scaled by its range over all demonstrations.
    Without joints, it compares the positions and the orientations of the end effector, scaled
    likewise. Afterwards, all demonstrations have the times of the reference, and frame k of
    each shows the same phase of the task. Recorded joint velocities are replaced by estimates.
    Commanded joint velocities are scaled to the new timing.

    Args:
        demos: At least one demonstration; all must record the quantity that is compared.

    Raises:
        ValueError: There are no demonstrations, or nothing to compare.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations cannot be aligned")
    leader = sorted(demos, key=lambda demo: demo.duration)[(len(demos) - 1) // 2]
    common = set.intersection(*(set(demo.recorded) for demo in demos))
    names = {"joint_position"} & common or {"position", "orientation"} & common
    if not names:
        raise ValueError("alignment needs joints or poses recorded in all demonstrations")
    scales = {name: _scale(name, [getattr(demo, name) for demo in demos]) for name in names}
    return demos.map(lambda demo: _follow(demo, leader, scales))


def _scale(name: str, motions: list[np.ndarray]) -> np.ndarray:
    """Range of each component over all motions; for orientations, the largest turn [rad]."""
    if name == "orientation":
        ranges = np.array([max(_angles(q, q[:1]).max() for q in motions)])
    else:
        ranges = np.ptp(np.concatenate(motions), axis=0)
    return np.maximum(ranges, 1e-9)  # a component at rest has no range to divide by


def _follow(
    demo: Demonstration, reference: Demonstration, scales: Mapping[str, np.ndarray]
) -> Demonstration:
    """The demonstration at the times that match the frames of the reference."""
    if demo is reference:
        return demo
    from scipy.spatial.distance import cdist

    squares = np.zeros((len(reference), len(demo)))
    for name, scale in scales.items():
        a, b = getattr(reference, name), getattr(demo, name)
        if name == "orientation":
            squares += (_angles(a, b) / scale) ** 2
        else:
            squares += cdist(a / scale, b / scale, "sqeuclidean")
    lead = np.linspace(0, 1, len(reference))[:, None] - np.linspace(0, 1, len(demo))
    # A difference of one frame is always allowed, as there might be no path otherwise.
    widest = max(_BAND, 1 / max(min(squares.shape) - 1, 1))
    allowed = np.abs(lead) <= widest + 1e-12
    first, second = warp(np.where(allowed, np.sqrt(squares), np.inf))
    # Several pairs may contain the same frame of the reference: use their mean time.
    times = np.bincount(first, weights=demo.time[second]) / np.bincount(first)
    if len(reference) > 2:
        # The path advances by whole frames. Lines fitted around each frame smooth these steps.
        column, window = times[:, None], _VELOCITY_WINDOW
        times = local_polynomial(reference.time, column, window=window, degree=1)[0][:, 0]
    times = np.maximum.accumulate(np.clip(times, 0, demo.time[-1]))
    fields = _fields_at(demo, times)
    for name in {"joint_velocity", "command_velocity"} & fields.keys():
        fields[name] *= np.gradient(times, reference.time)[:, None]
    warped = replace(demo, time=reference.time, fps=reference.fps, **fields)
    if demo.joint_velocity is None or demo.joint_position is None:
        return warped
    return estimate_joint_velocity(warped, _VELOCITY_WINDOW)


def _angles(
    p: Float64[np.ndarray, "a 4"], q: Float64[np.ndarray, "b 4"]
) -> Float64[np.ndarray, "a b"]:
    """Angles between all pairs of orientations [rad]."""
    return 2 * np.arccos(np.clip(np.abs(p @ q.T), 0, 1))
