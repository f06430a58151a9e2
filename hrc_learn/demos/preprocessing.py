"""Preparation of demonstrations for learning: cutting, filtering, resampling, alignment."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet
from hrc_learn.demos.filters import butterworth as butterworth
from hrc_learn.demos.filters import cut as cut
from hrc_learn.demos.filters import estimate_joint_velocity as estimate_joint_velocity
from hrc_learn.demos.filters import estimate_twist as estimate_twist
from hrc_learn.demos.filters import local_polynomial as local_polynomial
from hrc_learn.demos.filters import resting as resting
from hrc_learn.demos.filters import savitzky_golay as savitzky_golay
from hrc_learn.demos.filters import split_at_rest as split_at_rest
from hrc_learn.demos.filters import trim_rest as trim_rest

_SMOOTH = ("joint_position", "joint_velocity", "position", "orientation")
"""Fields with the smoothness of a body with inertia; measurements and commands may jump."""


def resample(demo: Demonstration, fps: float | int) -> Demonstration:
    """Resample a demonstration to a regular grid.

    The grid begins at the first frame; the remainder after its last point, less than one
    period, is dropped.

    Args:
        demo: Demonstration of at least two frames, at any stamps.
        fps: Frame rate of the grid [1/s].

    Raises:
        ValueError: `fps` is not positive, or the demonstration is shorter than a period.
    """
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    # The tolerance of a thousandth of a period allows for rounded stamps.
    count = int(np.floor(demo.duration * fps + 1e-3)) + 1
    if count < 2:
        raise ValueError(
            f"a demonstration of {demo.duration:.3g} s has no two frames at {fps} Hz"
        )
    grid = np.minimum(np.arange(count) / fps, demo.duration)
    moved = at_times(demo, grid)
    return replace(moved, time=np.arange(count) / fps, fps=fps)


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
    from scipy.interpolate import CubicSpline

    if len(demo) < 2:
        raise ValueError("a demonstration of one frame cannot be interpolated")
    if time[0] < demo.time[0] or time[-1] > demo.time[-1]:
        raise ValueError(
            f"times from {time[0]:.6g} s to {time[-1]:.6g} s exceed the demonstration, which "
            f"lasts {demo.duration:.6g} s"
        )
    moved: dict[str, Any] = {}
    for name in demo.recorded[1:]:
        values = getattr(demo, name)
        if name in _SMOOTH:
            moved[name] = CubicSpline(demo.time, values)(time)
        else:
            moved[name] = linear(demo.time, values.astype(float), time)
    if "orientation" in moved:
        moved["orientation"] /= np.linalg.norm(moved["orientation"], axis=1, keepdims=True)
    if "feature_visible" in moved:
        # Visible in both neighbours; the tolerance allows for rounding at the frame itself.
        moved["feature_visible"] = moved["feature_visible"] > 1 - 1e-9
    moved["extra"] = {}
    nearest = nearest_frames(demo.time, time)
    for key, values in demo.extra.items():
        whole = (values == np.rint(values)).all(0)
        between = linear(demo.time, values, time)
        moved["extra"][key] = np.where(whole, values[nearest], between)
    return moved


def linear(
    known: Float64[np.ndarray, " frames"],
    values: Float[np.ndarray, "frames *components"],
    time: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, "times *components"]:
    """Linear interpolation between frames."""
    index = _interval(known, time)
    width = known[index + 1] - known[index]
    fraction = ((time - known[index]) / width).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - fraction) * values[index] + fraction * values[index + 1]


def nearest_frames(
    known: Float64[np.ndarray, " frames"], time: Float64[np.ndarray, " times"]
) -> Int64[np.ndarray, " times"]:
    """Index of the frame nearest to each time."""
    index = _interval(known, time)
    return index + (time - known[index] > known[index + 1] - time)


def _interval(known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Index of the frame before each time; the last frame is never returned."""
    return np.clip(np.searchsorted(known, time, side="right") - 1, 0, len(known) - 2)


def set_duration(demo: Demonstration, duration: float | int) -> Demonstration:
    """Scale the duration of a demonstration; the path stays the same.

    Velocities and the nominal frame rate scale with it: no frame is added or lost (`resample`
    sets another rate). Efforts stay as measured.

    Args:
        demo: Demonstration of at least two frames.
        duration: New duration [s].

    Raises:
        ValueError: The duration is not positive, or there is only one frame.
    """
    if not duration > 0 or len(demo) < 2:
        raise ValueError(
            f"a demonstration of {len(demo)} frames cannot be made to last {duration} s"
        )
    scale = duration / demo.duration
    scaled = {
        name: getattr(demo, name) / scale
        for name in ("joint_velocity", "command_velocity")
        if name in demo.recorded
    }
    return replace(demo, time=demo.time * scale, fps=demo.fps / scale, **scaled)


def equalise_durations(
    demos: DemonstrationSet, duration: float | int | None = None
) -> DemonstrationSet:
    """Scale all demonstrations to one duration.

    Args:
        demos: At least one demonstration.
        duration: Common duration [s]; None for the median.

    Raises:
        ValueError: The set is empty, or as in `set_duration`.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations has no duration")
    common = (
        float(np.median([demo.duration for demo in demos])) if duration is None else duration
    )
    return demos.map(lambda demo: set_duration(demo, common))


def compensate_delay(demo: Demonstration, delays: Mapping[str, float]) -> Demonstration:
    """Shift fields to the times at which they were measured.

    An image that is stamped 40 ms after its exposure shows the arm of 40 ms ago.

    Args:
        demo: The demonstration.
        delays: Field -> delay behind the stamps of its frames [s], such as {"feature": 0.04}.
            The end of the demonstration, for which no later frame exists, is cut off.

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

    Entries of one anti-diagonal depend on earlier ones only and are computed together: exact,
    in about 0.1 s for 1000 samples against 1000. `dtaidistance` accepts no cost matrix, and
    `tslearn` needs numba, scikit-learn and statsmodels.

    Args:
        cost: Cost of pairing sample i of the first with sample j of the second; infinite for
            pairs that are not allowed.

    Returns:
        Indices into both sequences along the cheapest monotone path from both starts to both
        ends; ties prefer the diagonal.
    """
    rows, columns = cost.shape
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        j = diagonal - i
        before = np.minimum(np.minimum(total[i, j], total[i, j + 1]), total[i + 1, j])
        total[i + 1, j + 1] = cost[i, j] + before
    i, j = rows, columns
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda place: total[place])
        path.append((i, j))
    pairs = np.array(path[::-1], dtype=np.int64) - 1
    return pairs[:, 0], pairs[:, 1]


_BAND = 0.2
"""Largest difference in timing, as a fraction of the duration."""
_VELOCITY_WINDOW = 0.1
"""Width of the neighbourhood for times and velocities [s]."""


def align(demos: DemonstrationSet, reference: int | None = None) -> DemonstrationSet:
    """Warp every demonstration to the timing of one of them, by dynamic time warping.

    Joint motions are compared, each joint scaled by its range over all demonstrations; without
    joints, the position and the orientation (its angle relative to the largest rotation).
    Afterwards all have the reference's frames, and frame k of each shows the same phase of the
    task. Recorded joint velocities are estimated anew.

    Args:
        demos: At least one demonstration, all of the same quantities.
        reference: Index of the reference; None for the one of median duration.

    Raises:
        ValueError: There are no demonstrations, no such reference, or nothing to compare.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations cannot be aligned")
    if reference is None:
        order = np.argsort([demo.duration for demo in demos])
        reference = int(order[(len(demos) - 1) // 2])
    leader = demos[reference]
    common = set.intersection(*(set(demo.recorded) for demo in demos))
    if "joint_position" in common:
        names = ("joint_position",)
    else:
        names = tuple(name for name in ("position", "orientation") if name in common)
    if not names:
        raise ValueError("alignment needs joints or poses recorded in all demonstrations")
    scales = {name: _scale(name, [getattr(demo, name) for demo in demos]) for name in names}
    return demos.map(lambda demo: _follow(demo, leader, scales))


def _scale(name: str, motions: list[np.ndarray]) -> np.ndarray:
    """Range of each component over all motions, of orientations the largest rotation."""
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
    squares = np.zeros((len(reference), len(demo)))
    for name, scale in scales.items():
        a, b = getattr(reference, name), getattr(demo, name)
        if name == "orientation":
            squares += (_angles(a, b) / scale) ** 2
            continue
        for k in range(a.shape[1]):
            squares += ((a[:, k, None] - b[:, k]) / scale[k]) ** 2
    phases = (np.linspace(0, 1, len(reference))[:, None], np.linspace(0, 1, len(demo)))
    # One step is always allowed, or there would be no path.
    widest = max(_BAND, 1 / max(min(squares.shape) - 1, 1))
    allowed = np.abs(phases[0] - phases[1]) <= widest + 1e-12
    first, second = warp(np.where(allowed, np.sqrt(squares), np.inf))
    # Several pairs may share a frame of the reference: their mean time counts.
    times = np.bincount(first, weights=demo.time[second]) / np.bincount(first)
    if len(reference) > 2:
        # The path advances by whole frames; a line fitted around each frame interpolates.
        times = local_polynomial(
            reference.time, times[:, None], window=_VELOCITY_WINDOW, degree=1
        )[0][:, 0]
    times = np.maximum.accumulate(np.clip(times, 0, demo.time[-1]))
    fields = _fields_at(demo, times)
    warped = replace(demo, time=reference.time, fps=reference.fps, **fields)
    if demo.joint_velocity is None or demo.joint_position is None:
        return warped
    return estimate_joint_velocity(warped, _VELOCITY_WINDOW)


def _angles(
    p: Float64[np.ndarray, "a 4"], q: Float64[np.ndarray, "b 4"]
) -> Float64[np.ndarray, "a b"]:
    """Angles between all pairs of orientations [rad]."""
    return 2 * np.arccos(np.clip(np.abs(p @ q.T), 0, 1))
