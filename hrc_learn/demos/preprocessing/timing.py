"""Timing of demonstrations: resampling, durations, delays, and alignment by time warping."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int64

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet
from hrc_learn.demos.preprocessing.filters import estimate_joint_velocity, local_polynomial

_SMOOTH = ("joint_position", "joint_velocity", "position", "orientation")
"""Fields with the smoothness of a body with inertia; measurements and commands may jump."""


def resample(
    demo: Demonstration, fps: float | int, method: Literal["cubic", "linear"] = "cubic"
) -> Demonstration:
    """Resample a demonstration to a regular grid.

    The grid begins at the first frame; the remainder after its last point, less than one
    period, is dropped.

    Args:
        demo: Demonstration of at least two frames, at any stamps.
        fps: Frame rate of the grid [1/s].
        method: Interpolation, as in `at_times`.

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
    moved = at_times(demo, grid, method)
    return replace(moved, time=np.arange(count) / fps, fps=fps)


def at_times(
    demo: Demonstration,
    time: Float64[np.ndarray, " _times"],
    method: Literal["cubic", "linear"] = "cubic",
) -> Demonstration:
    """Interpolate a demonstration at other times.

    Joint positions, joint velocities and poses follow a cubic spline through the frames
    (orientations: a spline of the quaternion's components, normalised) or straight lines
    (orientations: rotations at constant rate). All other fields follow straight lines, but
    columns of whole numbers take the value of the nearest frame. A feature is visible if it is
    visible in both neighbouring frames.

    Args:
        demo: Demonstration of at least two frames.
        time: Increasing times within the demonstration [s].
        method: Interpolation of joints and poses.

    Raises:
        ValueError: The times exceed the demonstration, or it has only one frame.
    """
    rows, extra = fields_at(demo, time, method)
    return replace(demo, **rows, extra=extra)


def fields_at(
    demo: Demonstration,
    time: Float64[np.ndarray, " _times"],
    method: Literal["cubic", "linear"],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Array fields with `time`, and extra columns, as in `at_times`; times may repeat."""
    if len(demo) < 2:
        raise ValueError("a demonstration of one frame cannot be interpolated")
    if time[0] < demo.time[0] or time[-1] > demo.time[-1]:
        raise ValueError(
            f"times from {time[0]:.6g} s to {time[-1]:.6g} s exceed the demonstration, which "
            f"lasts {demo.duration:.6g} s"
        )
    rows: dict[str, np.ndarray] = {"time": time}
    for name in demo.recorded[1:]:
        values = getattr(demo, name)
        if name == "feature_visible":
            # Visible in both neighbours; the tolerance allows for rounding at the frame itself.
            rows[name] = linear(demo.time, values.astype(float), time) > 1 - 1e-9
        elif name in _SMOOTH:
            rows[name] = _interpolate_smooth(name, demo.time, values, time, method)
        else:
            rows[name] = linear(demo.time, values, time)
    return rows, {key: _extra(demo.time, values, time) for key, values in demo.extra.items()}


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


def _interpolate_smooth(
    name: str, known: np.ndarray, values: np.ndarray, time: np.ndarray, method: str
) -> np.ndarray:
    if method == "cubic":
        from scipy.interpolate import CubicSpline

        moved = CubicSpline(known, values)(time)
        return _normalized(moved) if name == "orientation" else moved
    return _slerp(known, values, time) if name == "orientation" else linear(known, values, time)


def _slerp(
    known: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames 4"],
    time: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, "times 4"]:
    """Spherical linear interpolation (Shoemake 1985) of quaternions of continuous sign."""
    index = _interval(known, time)
    fraction = (time - known[index]) / (known[index + 1] - known[index])
    p, q = values[index], values[index + 1]
    half = np.arccos(np.clip((p * q).sum(1), -1, 1))
    # np.sinc(x) is sin(pi x) / (pi x): finite if both orientations agree.
    whole = np.sinc(half / np.pi)
    weight_p = (1 - fraction) * np.sinc((1 - fraction) * half / np.pi) / whole
    weight_q = fraction * np.sinc(fraction * half / np.pi) / whole
    return _normalized(weight_p[:, None] * p + weight_q[:, None] * q)


def _normalized(q: np.ndarray) -> np.ndarray:
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _extra(
    known: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames components"],
    time: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, "times components"]:
    moved = linear(known, values, time)
    whole = (values == np.rint(values)).all(0)
    moved[:, whole] = values[nearest_frames(known, time)][:, whole]
    return moved


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
    moved = {
        field: getattr(shifted, field)
        for name, delay in delays.items()
        # Rounding may put a sum after the last frame.
        for shifted in [at_times(demo, np.minimum(kept + delay, demo.time[-1]))]
        for field in _together(name, shifted)
    }
    return replace(at_times(demo, kept), **moved)


def _together(name: str, demo: Demonstration) -> list[str]:
    """The field, and for a feature also its visibility."""
    both = ("feature", "feature_visible")
    return [n for n in both if n in demo.recorded] if name in both else [name]


@dataclass(frozen=True, kw_only=True, eq=False)
class WarpingPath:
    """Cheapest monotone pairing of two sequences, from both starts to both ends."""

    first: Int64[np.ndarray, " _pairs"]
    """Indices into the first sequence."""
    second: Int64[np.ndarray, " _pairs"]
    """Indices into the second sequence."""
    cost: float
    """Sum of the costs of all pairs."""


def warp(
    cost: Float64[np.ndarray, "_first _second"], band: float | int | None = None
) -> WarpingPath:
    """Pair two sequences by dynamic time warping (Sakoe and Chiba 1978, symmetric form P = 0).

    D[i, j] = cost[i, j] + min(D[i-1, j-1], D[i-1, j], D[i, j-1])

    Entries of one anti-diagonal depend on earlier ones only and are computed together: exact,
    in about 0.1 s for 1000 samples against 1000. `dtaidistance` accepts no cost matrix, and
    `tslearn` needs numba, scikit-learn and statsmodels.

    Args:
        cost: Cost of pairing sample i of the first with sample j of the second.
        band: Largest distance from the diagonal, as a fraction of the length (0 to 1); None
            for no bound.

    Raises:
        ValueError: A cost is not finite, a sequence is empty, or the band is no fraction.
    """
    rows, columns = cost.shape
    if not cost.size or not np.isfinite(cost).all():
        raise ValueError("warping needs finite costs of at least one pair")
    if band is not None and not 0 <= band <= 1:
        raise ValueError(f"band must be a fraction from 0 to 1, got {band}")
    allowed = _within_band(cost, band)
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        j = diagonal - i
        before = np.minimum(np.minimum(total[i, j], total[i, j + 1]), total[i + 1, j])
        total[i + 1, j + 1] = allowed[i, j] + before
    return _trace(total)


def _within_band(cost: np.ndarray, band: float | int | None) -> np.ndarray:
    if band is None:
        return cost
    rows, columns = cost.shape
    # Distance of relative positions; one step is always allowed, or there would be no path.
    place = np.arange(rows)[:, None] / max(rows - 1, 1) - np.arange(columns) / max(
        columns - 1, 1
    )
    widest = max(band, 1 / max(min(rows, columns) - 1, 1))
    return np.where(np.abs(place) <= widest + 1e-12, cost, np.inf)  # beyond rounding


def _trace(total: np.ndarray) -> WarpingPath:
    """Path back along the cheapest predecessors; ties prefer the diagonal."""
    i, j = total.shape[0] - 1, total.shape[1] - 1
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda place: total[place])
        path.append((i, j))
    pairs = np.array(path[::-1], dtype=np.int64) - 1
    return WarpingPath(first=pairs[:, 0], second=pairs[:, 1], cost=float(total[-1, -1]))


def align(
    demos: DemonstrationSet,
    reference: int | None = None,
    band: float | int | None = 0.2,
    window: float | int = 0.1,
) -> DemonstrationSet:
    """Warp every demonstration to the timing of one of them, by dynamic time warping.

    Joint motions are compared, each joint scaled by its range over all demonstrations; without
    joints, the position and the orientation (its angle relative to the largest rotation).
    Afterwards all have the reference's frames, and frame k of each shows the same phase of the
    task. Recorded joint velocities are estimated anew.

    Args:
        demos: At least one demonstration, all of the same quantities.
        reference: Index of the reference; None for the one of median duration.
        band: Largest difference in timing, as a fraction of the duration; None for no bound.
        window: Width of the neighbourhood for velocities [s].

    Raises:
        ValueError: There are no demonstrations, no such reference, or nothing to compare.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations cannot be aligned")
    if reference is None:
        order = np.argsort([demo.duration for demo in demos])
        reference = int(order[(len(demos) - 1) // 2])
    leader = demos[reference]
    metric = _Metric(demos)
    return demos.map(lambda demo: _follow(demo, leader, metric, band, window))


class _Metric:
    """Distance of two frames, relative to the range of the motions."""

    def __init__(self, demos: DemonstrationSet):
        candidates = (("joint_position",), ("position", "orientation"))
        common = set.intersection(*(set(demo.recorded) for demo in demos))
        fields = [tuple(f for f in group if f in common) for group in candidates]
        self._fields = next((group for group in fields if group), ())
        if not self._fields:
            raise ValueError("alignment needs joints or poses recorded in all demonstrations")
        # The bound avoids a division by the range of a component at rest.
        self._range = {
            name: np.maximum(np.ptp(np.concatenate([getattr(d, name) for d in demos]), 0), 1e-9)
            for name in self._fields
            if name != "orientation"
        }
        turns = [
            _angles(d.orientation, d.orientation[:1]).max()
            for d in demos
            if "orientation" in self._fields and d.orientation is not None
        ]
        self._turn = max(turns, default=0.0)

    def cost(
        self, one: Demonstration, other: Demonstration
    ) -> Float64[np.ndarray, "_one _other"]:
        """Distance of every frame of one demonstration from every frame of the other."""
        squares = np.zeros((len(one), len(other)))
        for name in self._fields:
            a, b = getattr(one, name), getattr(other, name)
            if name == "orientation":
                squares += (_angles(a, b) / max(self._turn, 1e-9)) ** 2
                continue
            for k, scale in enumerate(self._range[name]):
                squares += ((a[:, k, None] - b[:, k]) / scale) ** 2
        return np.sqrt(squares)


def _follow(
    demo: Demonstration,
    reference: Demonstration,
    metric: _Metric,
    band: float | int | None,
    window: float | int,
) -> Demonstration:
    if demo is reference:
        return demo
    times = _matching_times(reference, demo, warp(metric.cost(reference, demo), band), window)
    rows, extra = fields_at(demo, times, "linear")
    warped = replace(demo, **rows | {"time": reference.time}, extra=extra, fps=reference.fps)
    if demo.joint_velocity is None or demo.joint_position is None:
        return warped
    return estimate_joint_velocity(warped, window)


def _matching_times(
    reference: Demonstration, demo: Demonstration, path: WarpingPath, window: float | int
) -> Float64[np.ndarray, " _reference"]:
    """Times at which the demonstration matches each frame of the reference [s].

    The path advances by whole frames; a line fitted around each frame interpolates.
    """
    # Several pairs may share a frame of the reference: their mean time counts.
    partners = np.bincount(path.first, weights=demo.time[path.second])
    times = partners / np.bincount(path.first)
    if len(reference) > 2:
        times = local_polynomial(reference.time, times[:, None], window=window, degree=1)[0][
            :, 0
        ]
    return np.maximum.accumulate(np.clip(times, 0, demo.time[-1]))


def _angles(
    p: Float64[np.ndarray, "a 4"], q: Float64[np.ndarray, "b 4"]
) -> Float64[np.ndarray, "a b"]:
    """Angles between all pairs of orientations [rad]."""
    return 2 * np.arccos(np.clip(np.abs(p @ q.T), 0, 1))
