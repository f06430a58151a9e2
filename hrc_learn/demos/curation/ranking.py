"""Episodes of a dataset ranked by how doubtful they are, and grouped by how alike.

A ranking decides nothing: it says where to look first, and why.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.format.dataset_folder import EpisodeEntry, open_folder
from hrc_learn.demos.issue import DatasetError, Issue, plain_text
from hrc_learn.demos.preprocessing import resting
from hrc_learn.demos.read.column_mapping import MappingSpec
from hrc_learn.demos.read.frames import each_or_fault
from hrc_learn.demos.read.reader import DemonstrationSource, open_demos
from hrc_learn.demos.validation.check import check_dataset

MEASURES = {
    "distance": "distance from the most similar episodes, over the usual one",
    "duration": "s",
    "idle": "share of the time at rest",
    "jerk": "log of the dimensionless jerk",
    "late": "share of frames that came late",
}
"""What is measured of each episode, and its unit."""

Progress = Callable[[Sequence[EpisodeEntry]], Iterable[EpisodeEntry]]


@dataclass(kw_only=True)
class EpisodeQuality:
    """What speaks for looking at one episode."""

    episode: int
    length: int
    """Frames."""
    task: str
    measures: dict[str, float] = field(default_factory=dict)
    """By the names of `MEASURES`; empty where the episode cannot be read."""
    score: float = 0.0
    """How doubtful: 0 where nothing speaks against it."""
    reasons: list[str] = field(default_factory=list)
    """Why, the weightiest first."""
    cluster: int = -1
    """Episodes alike share a number; -1: like no other."""
    place: tuple[float, float] | None = None
    """On a map on which episodes alike lie close: their two main components."""
    resembles: int | None = None
    """An episode that this one nearly repeats."""
    start: int = 0
    """First frame of the motion: what lies before is rest."""
    stop: int = 0
    """Where the motion ends (not included)."""
    broken: bool = False
    """Whether it has errors."""

    def doubt(self, weight: float, reason: str) -> None:
        """Add a reason to look at it."""
        self.score += weight
        self.reasons.append(reason)


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """The episodes of a dataset, the most doubtful first."""

    path: Path
    episodes: tuple[EpisodeQuality, ...]
    notes: tuple[str, ...] = ()
    """What is wrong with the dataset as a whole."""

    @property
    def clusters(self) -> dict[int, list[int]]:
        """Number of each group of episodes alike -> its episodes; -1: those like no other."""
        groups: dict[int, list[int]] = {}
        for quality in sorted(self.episodes, key=lambda q: (q.cluster, q.episode)):
            groups.setdefault(quality.cluster, []).append(quality.episode)
        return groups

    def rows(self) -> list[tuple[str, ...]]:
        """The ranking as a table, its head first."""
        rows = [("episode", "doubt", "group", "frames", *MEASURES, "why")]
        for q in self.episodes:
            measured = (f"{q.measures[m]:.3g}" if m in q.measures else "-" for m in MEASURES)
            group = "-" if q.cluster < 0 else f"{q.cluster}"
            why = "; ".join(q.reasons)
            doubt = f"{q.score:.1f}"
            rows.append((f"{q.episode}", doubt, group, f"{q.length}", *measured, why))
        return rows

    def lines(self, most: int | None = None) -> Iterator[str]:
        """The ranking as text.

        Args:
            most: Episodes shown; None: all.
        """
        head, *rows = self.rows()
        shown = [head, *rows[:most]]
        widths = [max(len(row[i]) for row in shown) for i in range(len(head) - 1)]
        for row in shown:
            cells = (f"{cell:>{w}}" for cell, w in zip(row, widths, strict=False))
            yield f"{'  '.join(cells)}  {row[-1]}".rstrip()
        if len(rows) > len(shown) - 1:
            yield f"and {len(rows) - len(shown) + 1} episodes less doubtful (--full)"
        groups = {k: v for k, v in self.clusters.items() if k >= 0}
        alone = len(self.clusters.get(-1, ()))
        sizes = ", ".join(str(len(v)) for v in groups.values())
        yield (
            f"{len(groups)} groups of episodes alike ({sizes or 'none'}); {alone} like no other"
        )
        yield from self.notes


# What one episode weighs: an error alone puts it before all that are merely unusual.
_ERROR, _WARNING, _REPEAT = 10.0, 1.0, 3.0
_UNUSUAL = 4.0
"""Spreads (1.4826 times the median deviation) from which a measure is unusual: one in 16,000
of a normal distribution."""


def rank_episodes(
    path: str | Path,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Ranking:
    """Find out which episodes of a dataset a person should look at first.

    By what `check_dataset` finds in each, by how far its motion is from the most similar ones,
    and by what is unusual of its duration, rests, smoothness and stamps. Memory grows with the
    number of episodes, by some kilobytes each, and not with their lengths.

    Args:
        path: The dataset's folder.
        mapping: Where quantities are that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`.
        progress: Called with the episodes one after another, and gives them back: a hook for
            a progress bar.

    Raises:
        DatasetError: The dataset cannot be read as a whole.
    """
    root = Path(path)
    report = check_dataset(root, mapping, units)
    folder = open_folder(root)
    qualities = {
        e.index: EpisodeQuality(
            episode=e.index, length=e.length, task=" / ".join(e.tasks), stop=e.length
        )
        for e in folder.episodes
    }
    notes = [f"error: {issue}" for issue in report.errors if issue.episode not in qualities]
    for quality, issue in _one_of_each_kind(qualities, report.errors):
        quality.broken = True
        quality.doubt(_ERROR, _said(issue))
    for quality, issue in _one_of_each_kind(qualities, report.warnings, len(qualities) // 2):
        quality.doubt(_WARNING, _said(issue))
    shapes: dict[int, Float64[np.ndarray, " numbers"]] = {}
    for quality, demo in _demonstrations(root, mapping, units, qualities, progress):
        _measure(quality, demo)
        if (motion := _motion(demo)) is not None:
            shapes[quality.episode] = _shape(motion)
    _compare(qualities, shapes)
    _mark_unusual([q for q in qualities.values() if q.measures])
    ranked = sorted(qualities.values(), key=lambda q: (-q.score, q.episode))
    return Ranking(path=root, episodes=tuple(ranked), notes=tuple(notes))


def _one_of_each_kind(
    qualities: Mapping[int, EpisodeQuality], issues: Iterable[Issue], most: int | None = None
) -> Iterator[tuple[EpisodeQuality, Issue]]:
    """The weightiest finding of each kind in an episode.

    Args:
        qualities: The episodes.
        issues: What was found.
        most: Kinds that more episodes share tell none from the others; None: no such limit.
    """
    worst: dict[tuple, Issue] = {}
    for issue in issues:
        if issue.episode in qualities:
            place = (issue.episode, issue.kind)
            if place not in worst or issue.severity > worst[place].severity:
                worst[place] = issue
    counts = Counter(kind for _, kind in worst)
    for (episode, kind), issue in worst.items():
        if most is None or counts[kind] <= max(1, most):
            yield qualities[episode], issue


def _said(issue: Issue) -> str:
    where = f"{issue.key}: " if issue.key else ""
    return plain_text(f"{where}{issue.message}")


def _demonstrations(
    root: Path,
    mapping: MappingSpec | None,
    units: Mapping[str, str] | None,
    qualities: Mapping[int, EpisodeQuality],
    progress: Progress | None,
) -> Iterator[tuple[EpisodeQuality, Demonstration]]:
    """Episodes that can be read, one at a time; of the others, why not."""
    entries = open_folder(root).episodes
    try:
        source: DemonstrationSource = open_demos(root, mapping=mapping, units=units)
    except DatasetError as error:
        if error.finding.episode is None:
            raise
        sound = [e.index for e in entries if not qualities[e.index].broken]
        if not sound:
            return
        source = open_demos(root, sound, mapping=mapping, units=units)
        entries = tuple(e for e in entries if e.index in set(sound))
    shown = progress(entries) if progress else entries
    demos = each_or_fault(len(source), lambda first: source[first:], source.__getitem__)
    for entry, demo in zip(shown, demos, strict=True):
        quality = qualities[entry.index]
        if isinstance(demo, Demonstration):
            yield quality, demo
        elif not quality.broken:
            quality.broken = True
            quality.doubt(_ERROR, str(demo))


def _motion(demo: Demonstration) -> Float64[np.ndarray, "frames components"] | None:
    """What moves, grippers included."""
    parts = [demo.joint_position if demo.joint_position is not None else demo.position]
    parts += [None if demo.gripper is None else demo.gripper[:, None]]
    known = [part for part in parts if part is not None]
    return np.concatenate(known, axis=1) if known else None


_PHASES = 20
"""Points along the motion at which episodes are compared."""


def _shape(motion: Float64[np.ndarray, "frames components"]) -> Float64[np.ndarray, " numbers"]:
    """The motion at even phases, whatever its duration."""
    phase = np.linspace(0, 1, len(motion))
    at = np.linspace(0, 1, _PHASES)
    return np.stack([np.interp(at, phase, column) for column in motion.T], axis=1).ravel()


def _measure(quality: EpisodeQuality, demo: Demonstration) -> None:
    steps = np.diff(demo.time)
    quality.measures = {
        "duration": demo.duration,
        "late": float((steps > 1.5 / demo.fps).mean()) if len(steps) else 0.0,
    }
    motion = demo.joint_position if demo.joint_position is not None else demo.position
    if motion is None or len(demo) < 5:
        return
    quality.measures["jerk"] = log_dimensionless_jerk(demo.time, motion)
    try:
        rest = resting(demo)
    except ValueError:  # too few frames to tell a speed
        return
    quality.measures["idle"] = float(rest.mean())
    moving = np.flatnonzero(~rest)
    if len(moving):
        margin = round(0.1 * demo.fps)
        quality.start = max(0, int(moving[0]) - margin)
        quality.stop = min(len(demo), int(moving[-1]) + 1 + margin)


def log_dimensionless_jerk(
    time: Float64[np.ndarray, " frames"], motion: Float64[np.ndarray, "frames components"]
) -> float:
    """Natural logarithm of the integral of the squared jerk times duration^5 / length^2.

    Neither units, nor speed, nor size change it; less is smoother (Hogan and Sternad 2009,
    "Sensitivity of smoothness measures to movement duration, amplitude, and arrests").

    Args:
        time: [s], increasing.
        motion: In any unit.

    Returns:
        NaN where nothing moves.
    """
    values = motion
    for _ in range(3):
        values = np.gradient(values, time, axis=0)
    length = float(np.linalg.norm(np.diff(motion, axis=0), axis=1).sum())
    square = float(np.trapezoid((values**2).sum(1), time))
    if length <= 0 or square <= 0:
        return float("nan")
    return float(np.log(square * (time[-1] - time[0]) ** 5 / length**2))


# Episodes against each other.

_DIMENSIONS = 16
"""Principal components that distances are taken in: neighbours in more cost far more."""
_NEIGHBOURS = 3
_REACH = 2.0
"""Usual distances to the third neighbour within which episodes are of one group."""
_SAME = 0.05
"""Share of the usual distance to the nearest episode within which one repeats the other."""


def _compare(
    qualities: Mapping[int, EpisodeQuality],
    shapes: Mapping[int, Float64[np.ndarray, " numbers"]],
) -> None:
    """Groups of episodes alike, repeats, and those far from all others."""
    from scipy.spatial import KDTree

    widths = {len(shape) for shape in shapes.values()}
    if len(shapes) <= _NEIGHBOURS or len(widths) != 1:
        return
    indices = [*shapes]
    points = _principal(np.stack([*shapes.values()]))
    tree = KDTree(points)
    distances, found = tree.query(points, k=_NEIGHBOURS + 1)
    neighbours = np.asarray(found)
    usual = float(np.median(distances[:, 1]))
    reach = float(np.median(distances[:, -1]))
    if reach <= 0:
        return
    labels = density_clusters(points, _REACH * reach, _NEIGHBOURS)
    for number, index in enumerate(indices):
        quality = qualities[index]
        quality.cluster = int(labels[number])
        quality.place = float(points[number, 0]), float(points[number, 1])
        quality.measures["distance"] = float(distances[number, 1:].mean() / reach)
        # Of two episodes alike the later one repeats.
        near = neighbours[number][distances[number] < _SAME * usual]
        earlier = [indices[i] for i in near if indices[i] < index]
        if earlier:
            quality.resembles = min(earlier)
            quality.doubt(_REPEAT, f"nearly repeats episode {quality.resembles}")


def _principal(
    shapes: Float64[np.ndarray, "episodes numbers"],
) -> Float64[np.ndarray, "episodes dimensions"]:
    """Shapes in their principal components, every component of the motion counted alike."""
    columns = shapes.reshape(len(shapes), _PHASES, -1)
    scale = np.maximum(np.median(np.ptp(columns, axis=1), axis=0), 1e-9)
    # A component that rests in most episodes must not drown the others.
    scale = np.maximum(scale, 0.05 * scale.max())
    centred = ((columns - np.median(columns, axis=0)) / scale).reshape(len(shapes), -1)
    # Values that are far off would take all components for themselves.
    centred = np.clip(centred, -20, 20)
    # Of the smaller of the two products, whose main axes span the same space.
    if centred.shape[1] <= len(centred):
        axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :_DIMENSIONS]
        return centred @ axes / np.sqrt(_PHASES)
    values, vectors = np.linalg.eigh(centred @ centred.T)
    main = np.sqrt(np.maximum(values[::-1][:_DIMENSIONS], 0.0))
    return vectors[:, ::-1][:, :_DIMENSIONS] * main / np.sqrt(_PHASES)


_FRONT = 32
"""Points whose neighbours are looked up at once."""


def density_clusters(
    points: Float64[np.ndarray, "points dimensions"], radius: float, neighbours: int
) -> Int64[np.ndarray, " points"]:
    """Groups of points that lie close to each other, by density (DBSCAN).

    Ester et al. 1996, "A density-based algorithm for discovering clusters": points with enough
    others about them are cores, cores within reach of each other are of one group, and other
    points of that of a core within reach.

    Args:
        points: To be grouped.
        radius: Reach.
        neighbours: Others within reach that make a point a core.

    Returns:
        Number of each point's group, the largest group 0; -1 for points of none.
    """
    from scipy.spatial import KDTree

    tree = KDTree(points)
    # A point is within reach of itself.
    core = tree.query_ball_point(points, radius, return_length=True) > neighbours
    labels = np.full(len(points), -1)
    for group, seed in enumerate(np.flatnonzero(core)):
        if labels[seed] >= 0:
            continue
        labels[seed] = group
        front = np.array([seed])
        while len(front):
            # Some at a time: all pairs of points of a dense group are too many to hold.
            near = tree.query_ball_point(points[front[:_FRONT]], radius)
            reached = np.unique(np.concatenate([*near]).astype(int))
            new = reached[labels[reached] < 0]
            labels[new] = group
            front = np.concatenate([front[_FRONT:], new[core[new]]])
    known, sizes = np.unique(labels[labels >= 0], return_counts=True)
    order = {int(label): rank for rank, label in enumerate(known[np.argsort(-sizes)])}
    return np.array([order.get(int(label), -1) for label in labels])


def _mark_unusual(qualities: Sequence[EpisodeQuality]) -> None:
    """Weigh what is unusual among the measures."""
    says = {
        "distance": "moves unlike all others: {value:.1f} times as far from the nearest",
        "duration": "takes {value:.1f} s, {usual:.1f} s are usual",
        "idle": "rests for {percent:.0f} % of the time, {usual_percent:.0f} % are usual",
        "jerk": "moves jerkily: e^{excess:.1f} times the usual jerk",
        "late": "{percent:.0f} % of its frames came late, {usual_percent:.0f} % are usual",
    }
    least = {"distance": 1.0, "duration": 0.0, "idle": 0.1, "jerk": 1.0, "late": 0.02}
    for name, text in says.items():
        known = [q for q in qualities if np.isfinite(q.measures.get(name, np.nan))]
        if len(known) < 4:
            continue
        values = np.array([q.measures[name] for q in known])
        if name == "duration":
            values = np.log(np.maximum(values, 1e-9))
        usual = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - usual)))
        # Where nearly all are alike the least difference would count.
        spread = max(spread, {"duration": 0.05}.get(name, 0.25 * least[name]))
        for quality, value in zip(known, values, strict=True):
            off = (value - usual) / spread
            both_ways = name == "duration"
            if not (abs(off) if both_ways else off) > _UNUSUAL:
                continue
            if abs(value - usual) < least[name]:
                continue
            own = quality.measures[name]
            shown = float(np.exp(usual)) if name == "duration" else usual
            reason = text.format(
                value=own,
                usual=shown,
                percent=100 * own,
                usual_percent=100 * shown,
                excess=own - shown,
            )
            quality.doubt(min(abs(off) / _UNUSUAL, 5.0), reason)
