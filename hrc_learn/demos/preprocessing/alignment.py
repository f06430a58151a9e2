"""Dynamic time warping: several demonstrations brought to the timing of one."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from hrc_learn.demos.demonstration import Demonstration, DemonstrationSet
from hrc_learn.demos.preprocessing.filters import estimate_joint_velocity, local_polynomial
from hrc_learn.demos.preprocessing.resampling import fields_at

# Dynamic time warping: which moments of two sequences belong together.


@dataclass(frozen=True, kw_only=True, eq=False)
class WarpingPath:
    """A cheapest monotone pairing of two sequences, from both beginnings to both ends."""

    first: Int64[np.ndarray, " _pairs"]
    """Indices into the first sequence."""
    second: Int64[np.ndarray, " _pairs"]
    """Indices into the second."""
    cost: float
    """Sum of the pairs' costs."""


def warp(
    cost: Float64[np.ndarray, "_first _second"], band: float | int | None = None
) -> WarpingPath:
    """Pair two sequences by dynamic time warping (Sakoe and Chiba 1978, symmetric form P = 0).

    D[i, j] = cost[i, j] + min(D[i-1, j-1], D[i-1, j], D[i, j-1])

    Entries of one anti-diagonal depend on earlier ones only, so each is computed as a whole:
    exact, at some 0.1 s for 1000 samples against 1000. Of the libraries, `dtaidistance` takes
    no costs, such as those of orientations, and `tslearn`, which finds a path of the same cost
    ten times as fast, needs numba, scikit-learn and statsmodels.

    Args:
        cost: Cost of pairing sample i of the first with sample j of the second.
        band: Largest distance from the diagonal, as a fraction of the length (0 to 1); None:
            any.

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
    # Measured between the relative places; one step is allowed always, or no path is left.
    place = np.arange(rows)[:, None] / max(rows - 1, 1) - np.arange(columns) / max(
        columns - 1, 1
    )
    widest = max(band, 1 / max(min(rows, columns) - 1, 1))
    return np.where(np.abs(place) <= widest + 1e-12, cost, np.inf)  # beyond rounding


def _trace(total: np.ndarray) -> WarpingPath:
    """The way back along the cheapest predecessors; ties go along the diagonal."""
    i, j = total.shape[0] - 1, total.shape[1] - 1
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda place: total[place])
        path.append((i, j))
    pairs = np.array(path[::-1], dtype=np.int64) - 1
    return WarpingPath(first=pairs[:, 0], second=pairs[:, 1], cost=float(total[-1, -1]))


# Several demonstrations brought to the timing of one.


def align(
    demos: DemonstrationSet,
    reference: int | None = None,
    band: float | int | None = 0.2,
    window: float | int = 0.1,
) -> DemonstrationSet:
    """Warp every demonstration to the timing of one of them, by dynamic time warping.

    What is compared is the joint motion, each joint scaled by its range over all
    demonstrations; without joints, the position and the orientation (its angle as a part of
    the largest turn). Afterwards all have the reference's frames, and frame k of each shows
    the same moment of the task. Joint velocities, where recorded, are those of the new timing.

    Args:
        demos: At least one, in the same quantities.
        reference: Index of the one to follow; None: that of the median duration.
        band: Largest difference in timing, as a fraction of the duration; None: any.
        window: Width of the neighbourhood velocities are estimated from [s].

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
    """How far apart two frames are, in parts of the range of the motions."""

    def __init__(self, demos: DemonstrationSet):
        candidates = (("joint_position",), ("position", "orientation"))
        shared = set.intersection(*(set(demo.recorded) for demo in demos))
        fields = [tuple(f for f in group if f in shared) for group in candidates]
        self._fields = next((group for group in fields if group), ())
        if not self._fields:
            raise ValueError("demonstrations are aligned by joints or poses; none are in all")
        # What rests has no range to be scaled by.
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
        """Distance of every frame of one from every frame of the other."""
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
    leader: Demonstration,
    metric: _Metric,
    band: float | int | None,
    window: float | int,
) -> Demonstration:
    if demo is leader:
        return demo
    moments = _moments(leader, demo, warp(metric.cost(leader, demo), band), window)
    rows, extra = fields_at(demo, moments, "linear")
    warped = replace(demo, **rows | {"time": leader.time}, extra=extra, fps=leader.fps)
    if demo.joint_velocity is None or demo.joint_position is None:
        return warped
    return estimate_joint_velocity(warped, window)


def _moments(
    leader: Demonstration, demo: Demonstration, path: WarpingPath, window: float | int
) -> Float64[np.ndarray, " _leader"]:
    """When the demonstration is where the leader is.

    The path goes in steps of whole frames; a line fitted around each frame finds the time
    between them.
    """
    partners = np.bincount(path.first, weights=demo.time[path.second])
    times = partners / np.bincount(path.first)
    if len(leader) > 2:
        times = local_polynomial(leader.time, times[:, None], window=window, degree=1)[0][:, 0]
    return np.maximum.accumulate(np.clip(times, 0, demo.time[-1]))


def _angles(
    p: Float64[np.ndarray, "a 4"], q: Float64[np.ndarray, "b 4"]
) -> Float64[np.ndarray, "a b"]:
    """Angle between every two orientations [rad]."""
    return 2 * np.arccos(np.clip(np.abs(p @ q.T), 0, 1))
