"""Ranking of a dataset's episodes by how doubtful they are, and decisions on the episodes.

A ranking decides nothing: it tells a person which episodes to look at first, and why. Decisions
are kept next to the dataset, and a curated copy follows them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError, Issue, aligned
from hrc_learn.demos.preprocessing import motion_range, resting
from hrc_learn.demos.quality.check import check_dataset
from hrc_learn.demos.quality.episode_checks import motion_sketch
from hrc_learn.demos.quality.repair import RepairOptions, RepairReport, repair_dataset
from hrc_learn.demos.read.dataset_folder import Progress, open_folder
from hrc_learn.demos.read.source import DemonstrationSource, open_dataset
from hrc_learn.store import Count, read_json, read_toml, write_json

_MEASURES = read_toml(Path(__file__).with_name("measures.toml"))
MEASURES = {name: row["meaning"] for name, row in _MEASURES.items()}
"""Measure of an episode -> its meaning or unit."""

# Doubt added by one finding: an error counts as much as ten warnings.
_ERROR, _WARNING = 10.0, 1.0
_UNUSUAL = 4.0
"""Number of robust spreads (1.4826 times the median deviation) above which a measure is
unusual: one in 16,000 for a normal distribution."""
_PHASES = 20
"""Number of points along the motion at which episodes are compared."""
_DIMENSIONS = 16
"""Number of principal components for distances: with more, a neighbour search is far slower."""
_NEIGHBOURS = 3


@dataclass(kw_only=True)
class EpisodeQuality:
    """Measures of one episode, and the reasons to look at it."""

    episode: int
    length: int
    """Number of frames."""
    task: str
    measures: dict[str, float] = field(default_factory=dict)
    """Values by the names of `MEASURES`; empty if the episode cannot be read."""
    score: float = 0.0
    """Doubt: the sum of the weights of all reasons."""
    reasons: list[str] = field(default_factory=list)
    """Reasons: findings of the check, then faults of reading, then unusual measures."""
    place: tuple[float, float] | None = None
    """Place on a map of the episodes: the first two principal components of the motion. Similar
    episodes are close."""
    start: int = 0
    """First frame of the motion; the arm rests before."""
    stop: int = 0
    """End of the motion (exclusive)."""
    broken: bool = False
    """True if the episode has errors."""

    def doubt(self, weight: float, reason: str) -> None:
        """Add a reason to look at the episode."""
        self.score += weight
        self.reasons.append(reason)


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """Episodes of a dataset, the most doubtful first."""

    path: Path
    episodes: tuple[EpisodeQuality, ...]
    notes: tuple[str, ...] = ()
    """Faults of the dataset as a whole."""

    def lines(self, most: int | None = None) -> Iterator[str]:
        """The ranking as text: the first `most` episodes as a table, then a summary."""
        rows = [("episode", "doubt", "frames", *MEASURES, "why")]
        for q in self.episodes[:most]:
            measured = (f"{q.measures[m]:.3g}" if m in q.measures else "-" for m in MEASURES)
            place = (f"{q.episode}", f"{q.score:.1f}", f"{q.length}")
            rows.append((*place, *measured, "; ".join(q.reasons)))
        yield from aligned(rows, ">")
        if rest := len(self.episodes) - len(rows) + 1:
            yield f"and {rest} less doubtful episodes"
        yield from self.notes


def rank_episodes(path: str | Path, progress: Progress | None = None) -> Ranking:
    """Rank the episodes of a dataset by how doubtful they are.

    The score adds up the findings of `check_dataset`, the distance from the most similar
    motions, and unusual durations, gripper motions, rests, jerk and late frames. Memory grows
    by a few kilobytes per episode, independent of the episode's length.

    Args:
        path: Folder of the dataset.
        progress: Function that iterates over the episodes and shows the progress.

    Raises:
        DatasetError: The dataset cannot be read as a whole.
    """
    root = Path(path)
    report = check_dataset(root)
    qualities = {
        e.index: EpisodeQuality(
            episode=e.index, length=e.length, task=" / ".join(e.tasks), stop=e.length
        )
        for e in open_folder(root).episodes
    }
    notes = [f"error: {issue}" for issue in report.errors if issue.episode not in qualities]
    for quality, issue in _one_of_each_kind(qualities, report.errors):
        quality.broken = True
        quality.doubt(_ERROR, issue.reason)
    for quality, issue in _one_of_each_kind(qualities, report.warnings, len(qualities) // 2):
        quality.doubt(_WARNING, issue.reason)
    shapes: dict[int, Float64[np.ndarray, " numbers"]] = {}
    for quality, demo in _demonstrations(root, qualities, progress):
        if (motion := _measure(quality, demo)) is not None:
            shapes[quality.episode] = motion_sketch(motion, _PHASES)
    _compare(qualities, shapes)
    _mark_unusual([q for q in qualities.values() if q.measures])
    ranked = sorted(qualities.values(), key=lambda q: (-q.score, q.episode))
    return Ranking(path=root, episodes=tuple(ranked), notes=tuple(notes))


def _one_of_each_kind(
    qualities: Mapping[int, EpisodeQuality], issues: Iterable[Issue], most: int | None = None
) -> Iterator[tuple[EpisodeQuality, Issue]]:
    """The most severe issue of each kind in each episode.

    Args:
        qualities: Episodes by index.
        issues: Issues of the dataset.
        most: Number of episodes above which a kind is too common to count; None for no limit.
    """
    placed = [(issue.episode, issue) for issue in issues if issue.episode in qualities]
    worst: dict[tuple, Issue] = {}
    for episode, issue in sorted(placed, key=lambda pair: -pair[1].severity):
        worst.setdefault((episode, issue.kind), issue)
    counts = Counter(kind for _, kind in worst)
    for (episode, kind), issue in worst.items():
        if most is None or counts[kind] <= max(1, most):
            yield qualities[episode], issue


def _demonstrations(
    root: Path, qualities: Mapping[int, EpisodeQuality], progress: Progress | None
) -> Iterator[tuple[EpisodeQuality, Demonstration]]:
    """Readable episodes, one at a time; the error of any other episode adds to its doubt."""
    dataset = open_dataset(root)
    entries = dataset.folder.episodes
    # Faults are ignored here: the check reports episodes whose units differ from the others.
    decisions, _ = dataset.decide_units(entries, {})
    demos = DemonstrationSource(dataset, entries, decisions).each()
    for entry, demo in zip(progress(entries) if progress else entries, demos, strict=True):
        quality = qualities[entry.index]
        if isinstance(demo, Demonstration):
            yield quality, demo
        elif not quality.broken:
            quality.broken = True
            quality.doubt(_ERROR, str(demo))


def _measure(
    quality: EpisodeQuality, demo: Demonstration
) -> Float64[np.ndarray, "frames components"] | None:
    """Measure an episode.

    Returns:
        Joints or position, and gripper, as columns; None if none of these is recorded.
    """
    steps = np.diff(demo.time)
    quality.measures = {
        "duration": demo.duration,
        "late": float((steps > 1.5 / demo.fps).mean()) if len(steps) else 0.0,
    }
    if demo.gripper is not None:
        quality.measures["gripper"] = float(gripper_moves(demo.gripper))
    motion = demo.joint_position if demo.joint_position is not None else demo.position
    gripper = None if demo.gripper is None else demo.gripper[:, None]
    known = [part for part in (motion, gripper) if part is not None]
    shape = np.concatenate(known, axis=1) if known else None
    if motion is None or len(demo) < 5:
        return shape
    quality.measures["jerk"] = log_dimensionless_jerk(demo.time, motion)
    rest = resting(demo)
    quality.measures["idle"] = float(rest.mean())
    if not rest.all():
        quality.start, quality.stop = motion_range(demo, rest)
    return shape


def gripper_moves(gripper: Float64[np.ndarray, " frames"]) -> int:
    """Number of times that a gripper moves from one outer third of its travel to the other.

    A grasp that was tried twice, or an object that was dropped, adds two. Small changes of the
    opening, such as while holding an object, do not count.

    Args:
        gripper: Opening in any unit.
    """
    known = gripper[np.isfinite(gripper)]
    low, high = (known.min(), known.max()) if len(known) else (0.0, 0.0)
    if high <= low:
        return 0
    third = (high - low) / 3
    # In the middle third of the travel, the gripper keeps its last state.
    ends = np.where(known < low + third, -1, np.where(known > high - third, 1, 0))
    return int(np.count_nonzero(np.diff(ends[ends != 0])))


def log_dimensionless_jerk(
    time: Float64[np.ndarray, " frames"], motion: Float64[np.ndarray, "frames components"]
) -> float:
    """Natural logarithm of the integral of the squared jerk times duration^5 / length^2.

    The measure depends on neither units, speed nor size of the motion, and is smaller for
    smoother motions (Hogan and Sternad 2009, "Sensitivity of smoothness measures to movement
    duration, amplitude, and arrests").

    Args:
        time: Increasing times [s].
        motion: Positions in any unit.

    Returns:
        The measure; NaN if nothing moves.
    """
    values = motion
    for _ in range(3):
        values = np.gradient(values, time, axis=0)
    length = float(np.linalg.norm(np.diff(motion, axis=0), axis=1).sum())
    square = float(np.trapezoid((values**2).sum(1), time))
    if length <= 0 or square <= 0:
        return float("nan")
    return float(np.log(square * (time[-1] - time[0]) ** 5 / length**2))


def _compare(
    qualities: Mapping[int, EpisodeQuality],
    shapes: Mapping[int, Float64[np.ndarray, " numbers"]],
) -> None:
    """Find the place of each episode on the map, and its distance from its neighbours."""
    from scipy.spatial import KDTree

    if len(shapes) <= _NEIGHBOURS or len({len(shape) for shape in shapes.values()}) != 1:
        return
    points = _principal_components(np.stack([*shapes.values()]))
    distances = np.asarray(KDTree(points).query(points, k=_NEIGHBOURS + 1)[0])
    usual = float(np.median(distances[:, -1]))
    for index, point, own in zip(shapes, points, distances, strict=True):
        qualities[index].place = float(point[0]), float(point[1])
        if usual > 0:
            qualities[index].measures["distance"] = float(own[1:].mean() / usual)


def _principal_components(
    shapes: Float64[np.ndarray, "episodes numbers"],
) -> Float64[np.ndarray, "episodes dimensions"]:
    """Principal components of the shapes, all components of the motion weighted equally."""
    columns = shapes.reshape(len(shapes), _PHASES, -1)
    scale = np.maximum(np.median(np.ptp(columns, axis=1), axis=0), 1e-9)
    # A component that rests in most episodes must not dominate.
    scale = np.maximum(scale, 0.05 * scale.max())
    centred = ((columns - np.median(columns, axis=0)) / scale).reshape(len(shapes), -1)
    # Values are clipped at twenty ranges. Otherwise, outliers would determine all principal
    # components.
    left, sizes, _ = np.linalg.svd(np.clip(centred, -20, 20), full_matrices=False)
    return (left * sizes)[:, :_DIMENSIONS] / np.sqrt(_PHASES)


def _mark_unusual(qualities: Sequence[EpisodeQuality]) -> None:
    """Add a doubt for each unusual measure; durations are compared by their logarithms."""
    for name, test in _MEASURES.items():
        known = [q for q in qualities if np.isfinite(q.measures.get(name, np.nan))]
        if len(known) < 4:
            continue
        is_duration = name == "duration"
        values = np.array([q.measures[name] for q in known])
        if is_duration:
            values = np.log(np.maximum(values, 1e-9))
        usual = float(np.median(values))
        spread = max(1.4826 * float(np.median(np.abs(values - usual))), test["least_spread"])
        off = (np.abs(values - usual) if is_duration else values - usual) / spread
        for k in np.flatnonzero((off > _UNUSUAL) & (np.abs(values - usual) >= test["least"])):
            shown, own = float(np.exp(usual)) if is_duration else usual, known[k].measures[name]
            text = test["reason"].format(own=own, usual=shown, above=own - shown)
            known[k].doubt(min(off[k] / _UNUSUAL, 5.0), text)


Verdict = Literal["accept", "cut", "reject"]


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Decision on one episode."""

    verdict: Verdict
    length: Count
    """Number of frames of the episode."""
    start: Count = 0
    """First frame kept by a cut."""
    stop: Count = 0
    """End of the frames kept by a cut (exclusive)."""

    def __post_init__(self) -> None:
        is_cut = self.verdict == "cut"
        if min(self.start, self.stop) < 0 or (
            is_cut and not self.start < self.stop - 1 < self.length
        ):
            text = f"a cut must keep two frames or more of the {self.length} of its episode"
            raise ValueError(f"{text}, got frames {self.start} to {self.stop}")


Decisions = dict[int, Decision]
"""Episode index -> decision; episodes without one are accepted."""


@dataclass(frozen=True, kw_only=True)
class _DecisionFile:
    decisions: dict[Count, Decision]
    format: Literal[1] = 1


def decisions_path(root: Path) -> Path:
    """File of the decisions on a dataset, next to it."""
    root = root.resolve()
    return root.with_name(f"{root.name}.curation.json")


def read_decisions(root: Path) -> Decisions:
    """Decisions kept for the episodes of a dataset.

    Raises:
        DatasetError: The file is damaged, or belongs to another dataset.
    """
    path, advice = decisions_path(root), "delete it to begin anew"
    if not path.is_file():
        return {}
    lengths = {entry.index: entry.length for entry in open_folder(root).episodes}
    try:
        kept = read_json(path, _DecisionFile, advice).decisions
    except ValueError as error:
        raise DatasetError(str(error).removeprefix(f"{path}: "), file=path) from error
    for index, known in kept.items():
        if known.length != lengths.get(index):
            has = lengths.get(index, "no such episode")
            text = f"decides on an episode of {known.length} frames, the dataset has {has}"
            text += f": it belongs to another dataset; {advice}"
            raise DatasetError(text, file=path, episode=index)
    return kept


def keep_decisions(root: Path, decisions: Mapping[int, Decision]) -> None:
    """Write the decisions next to the dataset, which is not changed."""
    write_json(decisions_path(root), _DecisionFile(decisions=dict(decisions)))


def write_curated(
    path: str | Path,
    out: str | Path,
    decisions: Mapping[int, Decision],
    *,
    progress: Progress | None = None,
) -> RepairReport:
    """Write the accepted and cut episodes into a new dataset of version 3.0.

    Values stay as they are. Video files are copied whole. The times in the list of episodes
    select the part of a video that a cut episode shows. The old dataset is not changed.

    Args:
        path: The dataset.
        out: Folder of the new dataset, which must not exist.
        decisions: Decisions by episode; episodes without one are accepted.
        progress: Function as in `repair_dataset`.

    Raises:
        DatasetError: No episode is left, or an accepted episode cannot be read.
        FileExistsError: `out` exists.
    """
    kept = {entry.index: slice(0, entry.length) for entry in open_folder(path).episodes}
    for index, decision in decisions.items():
        if index not in kept:
            raise DatasetError("there is no such episode", file=path, episode=index)
        if decision.verdict == "cut":
            kept[index] = slice(decision.start, decision.stop)
        elif decision.verdict == "reject":
            del kept[index]
    if not kept:
        raise DatasetError("every episode is rejected: nothing is left to write", file=path)
    options = RepairOptions(trim=False, drop_late=False, unwrap=False, fix_signs=False)
    return repair_dataset(path, out, options, progress=progress, kept=kept)
