"""A demonstration at other instants, or of another duration, than it was recorded at."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int64

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet

# A demonstration at other instants than it was recorded at.

_SMOOTH = ("joint_position", "joint_velocity", "position", "orientation")
"""Fields that move as a body with inertia does; measured and commanded ones may jump."""


def resample(
    demo: Demonstration, fps: float | int, method: Literal["cubic", "linear"] = "cubic"
) -> Demonstration:
    """The demonstration on a regular grid of `fps` frames a second.

    The grid begins with the first frame; what is left behind its last point, less than one
    period, is dropped.

    Args:
        demo: Recorded at any stamps, at least two frames.
        fps: Frame rate wanted [1/s].
        method: As in `at_times`.

    Raises:
        ValueError: `fps` is not positive, or the demonstration is shorter than a period.
    """
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    # A thousandth of a period makes up for the rounding of stamps.
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
    """The demonstration as it was at these times.

    Joint positions and velocities and poses follow a cubic spline through the frames
    (orientations: of the quaternion's components, brought back to unit length; between
    regular frames as exact as that of positions) or straight lines (orientations: turns at
    constant rate). All other fields follow straight lines, but columns of whole numbers take
    the nearest frame's. A feature is visible where it is in both neighbouring frames.

    Args:
        demo: At least two frames.
        time: Increasing, within the demonstration [s].
        method: For joints and poses.

    Raises:
        ValueError: The times leave the demonstration, or it has only one frame.
    """
    rows, extra = fields_at(demo, time, method)
    return replace(demo, **rows, extra=extra)


def fields_at(
    demo: Demonstration,
    time: Float64[np.ndarray, " _times"],
    method: Literal["cubic", "linear"],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Every array field, `time` included, and the extra columns, as in `at_times`.

    The times need not differ from each other.
    """
    if len(demo) < 2:
        raise ValueError("a demonstration of one frame cannot be interpolated")
    if time[0] < demo.time[0] or time[-1] > demo.time[-1]:
        raise ValueError(
            f"times from {time[0]:.6g} s to {time[-1]:.6g} s leave the demonstration, which "
            f"lasts {demo.duration:.6g} s"
        )
    rows: dict[str, np.ndarray] = {"time": time}
    for name in demo.recorded[1:]:
        values = getattr(demo, name)
        if name == "feature_visible":
            # In both neighbours; a weight of 1e-9 is rounding at the frame itself.
            rows[name] = linear(demo.time, values.astype(float), time) > 1 - 1e-9
        elif name in _SMOOTH:
            rows[name] = _moving(name, demo.time, values, time, method)
        else:
            rows[name] = linear(demo.time, values, time)
    return rows, {key: _extra(demo.time, values, time) for key, values in demo.extra.items()}


def linear(
    known: Float64[np.ndarray, " frames"],
    values: Float[np.ndarray, "frames *components"],
    time: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, "times *components"]:
    """Values on the straight lines between known ones."""
    index = _interval(known, time)
    width = known[index + 1] - known[index]
    fraction = ((time - known[index]) / width).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - fraction) * values[index] + fraction * values[index + 1]


def _moving(
    name: str, known: np.ndarray, values: np.ndarray, time: np.ndarray, method: str
) -> np.ndarray:
    if method == "cubic":
        from scipy.interpolate import CubicSpline

        moved = CubicSpline(known, values)(time)
        return _unit(moved) if name == "orientation" else moved
    return _turn(known, values, time) if name == "orientation" else linear(known, values, time)


def _turn(
    known: Float64[np.ndarray, " frames"],
    values: Float64[np.ndarray, "frames 4"],
    time: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, "times 4"]:
    """Spherical linear interpolation (Shoemake 1985) of quaternions of continuous sign."""
    index = _interval(known, time)
    fraction = (time - known[index]) / (known[index + 1] - known[index])
    p, q = values[index], values[index + 1]
    half = np.arccos(np.clip((p * q).sum(1), -1, 1))
    # np.sinc(x) is sin(pi x) / (pi x): finite where the two orientations agree.
    whole = np.sinc(half / np.pi)
    weight_p = (1 - fraction) * np.sinc((1 - fraction) * half / np.pi) / whole
    weight_q = fraction * np.sinc(fraction * half / np.pi) / whole
    return _unit(weight_p[:, None] * p + weight_q[:, None] * q)


def _unit(q: np.ndarray) -> np.ndarray:
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
    """Index of the frame before each time, such that there is one behind it."""
    return np.clip(np.searchsorted(known, time, side="right") - 1, 0, len(known) - 2)


# Demonstrations brought to the same duration.


def set_duration(demo: Demonstration, duration: float | int) -> Demonstration:
    """The same path, gone through evenly faster or slower.

    Velocities change with the pace, and so does the nominal frame rate: no frame is added or
    lost (`resample` sets another rate). Efforts are left as measured.

    Args:
        demo: At least two frames.
        duration: Its new duration [s].

    Raises:
        ValueError: The duration is not positive, or there is only one frame.
    """
    if not duration > 0 or len(demo) < 2:
        raise ValueError(
            f"a demonstration of {len(demo)} frames cannot be made to last {duration} s"
        )
    stretch = duration / demo.duration
    scaled = {
        name: getattr(demo, name) / stretch
        for name in ("joint_velocity", "command_velocity")
        if name in demo.recorded
    }
    return replace(demo, time=demo.time * stretch, fps=demo.fps / stretch, **scaled)


def equalise_durations(
    demos: DemonstrationSet, duration: float | int | None = None
) -> DemonstrationSet:
    """All demonstrations with one duration.

    Args:
        demos: At least one.
        duration: Duration wanted [s]; None: the median of theirs.

    Raises:
        ValueError: The set is empty, or as in `set_duration`.
    """
    if not len(demos):
        raise ValueError("an empty set of demonstrations has no duration")
    common = (
        float(np.median([demo.duration for demo in demos])) if duration is None else duration
    )
    return demos.map(lambda demo: set_duration(demo, common))
