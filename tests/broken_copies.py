"""Common defects of LeRobot datasets, each applied to a copy of a sound one.

LeRobotDataset 0.6.1 reports most of them as network faults, and opens the others silently.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

STATE = "observation.state"


class Copy:
    """A dataset of any version whose second episode is to be damaged."""

    episode = 1

    def __init__(self, root: Path):
        self.root = root
        self.info = json.loads((root / "meta/info.json").read_text())
        self.v3 = self.info["codebase_version"].startswith("v3")
        self.episodes_file = "meta/episodes/chunk-000/file-000.parquet"
        self.data = "data/chunk-000/file-000.parquet"
        self.start = 0
        if self.v3:
            rows = pq.read_table(root / self.episodes_file).to_pylist()
            self.start = rows[1]["dataset_from_index"]
            self.length = rows[1]["length"]
        else:
            self.episodes_file = "meta/episodes.jsonl"
            self.data = "data/chunk-000/episode_000001.parquet"
            self.length = pq.read_metadata(root / self.data).num_rows

    def change_info(self, **entries) -> None:
        self.info |= entries
        (self.root / "meta/info.json").write_text(json.dumps(self.info))

    def change_feature(self, **entries) -> None:
        self.info["features"][STATE] |= entries
        self.change_info()

    def rewrite(self, change: Callable[[pa.Table], pa.Table]) -> None:
        pq.write_table(change(pq.read_table(self.root / self.data)), self.root / self.data)

    def change_rows(self, key: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change the values of a column in the episode."""

        def replace(table: pa.Table) -> pa.Table:
            values = np.array(table.column(key).to_pylist())
            rows = slice(self.start, self.start + self.length)
            values[rows] = change(values[rows])
            kind = table.schema.field(key).type
            column = pa.array(list(values), kind)
            return table.set_column(table.schema.get_field_index(key), key, column)

        self.rewrite(replace)

    def remove_episode(self) -> None:
        if self.v3:
            file = self.root / self.episodes_file
            table = pq.read_table(file)
            pq.write_table(table.take([i for i in range(len(table)) if i != 1]), file)
        else:
            (self.root / self.data).unlink()


@dataclass(frozen=True, kw_only=True)
class Defect:
    """One kind of damage and the expected finding."""

    damage: Callable[[Copy], object]
    finding: str
    """Pattern of the message."""
    error: bool = True
    """True for an error, which `load_demos` raises too; False for a warning."""
    file: str | None = None
    """End of the file name; "data" and "episodes" stand for the files of the version."""
    episode: bool = False
    """True if the second episode is named."""
    frame: int | None = None
    key: str | None = None


def put(frame: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Set the second component of one frame."""

    def change(values: np.ndarray) -> np.ndarray:
        values[frame, 1] = value
        return values

    return change


def jump(values: np.ndarray) -> np.ndarray:
    values[20, 1] += 3.0
    return values


def tasks_file(copy: Copy) -> Path:
    return copy.root / ("meta/tasks.parquet" if copy.v3 else "meta/tasks.jsonl")


def remove_episodes(copy: Copy) -> None:
    path = copy.root / copy.episodes_file
    shutil.rmtree(path.parent) if copy.v3 else path.unlink()


def remove_statistics(copy: Copy) -> None:
    for name in ("stats.json", "episodes_stats.jsonl"):
        (copy.root / "meta" / name).unlink(missing_ok=True)


def declare_video(copy: Copy) -> None:
    video = {"dtype": "video", "shape": [4, 6, 3], "names": None}
    copy.change_info(features={**copy.info["features"], "observation.images.front": video})


def repeat_frames(copy: Copy) -> None:
    end = copy.start + copy.length
    copy.rewrite(
        lambda t: pa.concat_tables([t.slice(0, end), t.slice(end - 10, 10), t.slice(end)])
    )


def jitter(values: np.ndarray) -> np.ndarray:
    period = np.median(np.diff(values))
    return values + period * np.random.default_rng(0).uniform(-0.2, 0.2, len(values))


def names(copy: Copy) -> list[str]:
    return [f"motor{i}.pos" for i in range(copy.info["features"][STATE]["shape"][0])]


DEFECTS = {
    "no info.json": Defect(
        damage=lambda c: (c.root / "meta/info.json").unlink(),
        finding="no LeRobot dataset, or its recording was not finalized",
        file="meta/info.json",
    ),
    "never finalized": Defect(
        damage=remove_episodes, finding="not finalized|copy is incomplete", file="episodes"
    ),
    "no tasks": Defect(
        damage=lambda c: tasks_file(c).unlink(),
        finding="not found: the copy is incomplete",
        file="tasks",
    ),
    "no data file": Defect(
        damage=lambda c: (c.root / c.data).unlink(),
        finding="not found: the copy is incomplete",
        file="data",
    ),
    "one episode missing": Defect(
        damage=lambda c: c.remove_episode(), finding="missing|not found", episode=True
    ),
    "truncated parquet": Defect(
        damage=lambda c: (c.root / c.data).write_bytes((c.root / c.data).read_bytes()[:900]),
        finding="unreadable: the file is truncated",
        file="data",
    ),
    "wrong shape": Defect(
        damage=lambda c: c.change_feature(shape=[77], names=None),
        finding=r"declares the shape \[77\]",
        key=STATE,
    ),
    "video absent": Defect(
        damage=declare_video,
        finding="no file of it is here",
        error=False,
        key="observation.images.front",
    ),
    "fewer rows than promised": Defect(
        damage=lambda c: c.rewrite(lambda t: t.slice(0, len(t) - 7)),
        finding="the list of episodes promises",
        file="data",
    ),
    "more rows than promised": Defect(
        damage=repeat_frames, finding="the list of episodes promises", file="data"
    ),
    "unknown version": Defect(
        damage=lambda c: c.change_info(codebase_version="v4.0"),
        finding=r"codebase_version must be 2\.0, 2\.1 or 3\.0, got 'v4\.0'",
        key="codebase_version",
    ),
    "fps of zero": Defect(
        damage=lambda c: c.change_info(fps=0), finding="fps must be positive", key="fps"
    ),
    "NaN": Defect(
        damage=lambda c: c.change_rows(STATE, put(17, np.nan)),
        finding="is nan",
        file="data",
        episode=True,
        frame=17,
        key=STATE,
    ),
    "infinity": Defect(
        damage=lambda c: c.change_rows(STATE, put(18, np.inf)),
        finding="is inf",
        file="data",
        episode=True,
        frame=18,
        key=STATE,
    ),
    "column missing": Defect(
        damage=lambda c: c.rewrite(lambda t: t.drop_columns([STATE])),
        finding="declared in meta/info.json, but missing",
        file="data",
        key=STATE,
    ),
    "stamps that stall": Defect(
        damage=lambda c: c.change_rows(
            "timestamp", lambda v: np.concatenate([v[:10], v[9:-1]])
        ),
        finding="stamps must increase",
        file="data",
        episode=True,
        frame=10,
        key="timestamp",
    ),
    "names too short": Defect(
        damage=lambda c: c.change_feature(names=names(c)[:-1]),
        finding=r"\d+ names for \d+ components",
        file="meta/info.json",
        key=STATE,
        error=False,
    ),
    "gap": Defect(
        damage=lambda c: c.change_rows(
            "timestamp", lambda v: v + 5 * v[1] * (np.arange(len(v)) >= 15)
        ),
        finding="1 gaps, about 5 frames lost",
        error=False,
        file="data",
        episode=True,
        frame=15,
        key="timestamp",
    ),
    "jitter": Defect(
        damage=lambda c: c.change_rows("timestamp", jitter),
        finding="steps vary by",
        error=False,
        file="data",
        episode=True,
        key="timestamp",
    ),
    "frozen state": Defect(
        damage=lambda c: c.change_rows(STATE, lambda v: np.repeat(v[:1], len(v), 0)),
        finding="the state never changes: the recorder lost the robot",
        error=False,
        file="data",
        episode=True,
        frame=0,
        key=STATE,
    ),
    "jump": Defect(
        damage=lambda c: c.change_rows(STATE, jump),
        finding=r"jumps by .* rad in one frame",
        error=False,
        file="data",
        episode=True,
        frame=20,
    ),
    "fps wrong": Defect(
        damage=lambda c: c.change_info(fps=0.7 * c.info["fps"]),
        finding="but fps says",
        error=False,
        file="data",
        episode=True,
        key="timestamp",
    ),
    "names of no components": Defect(
        damage=lambda c: c.change_feature(names=None),
        finding="names no components",
        error=False,
    ),
    "no statistics": Defect(
        damage=remove_statistics, finding="no statistics", error=False, file="meta/stats.json"
    ),
}
"""Defects by name."""

# Unusual forms that are read like any other.
HARMLESS = {
    "names in a dict": lambda c: c.change_feature(names={"motors": names(c)}),
    "names nested": lambda c: c.change_feature(names=[names(c)]),
}
