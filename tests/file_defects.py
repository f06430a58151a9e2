"""Defects of files, of metadata and of videos, each done to a copy of a sound dataset."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from broken_copies import STATE, Copy, remove_statistics, tasks_file
from clean_sets import CAMERA, write_video
from value_defects import Kind, NotHereError

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 123456\n"

# Files, and what metadata say of them.


def text(name: str, content: str | bytes) -> Callable[[Copy], object]:
    """Replace a file; `data`, `episodes` and `tasks` stand for those of the version."""

    def damage(copy: Copy) -> None:
        path = place(copy, name)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return damage


def place(copy: Copy, name: str) -> Path:
    if name == "tasks":
        return tasks_file(copy)
    return copy.root / {"data": copy.data, "episodes": copy.episodes_file}.get(name, name)


def cut(name: str, share: float) -> Callable[[Copy], object]:
    def damage(copy: Copy) -> None:
        path = place(copy, name)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return damage


def corrupt(copy: Copy) -> None:
    """Bytes turned over in a data file, its description left whole."""
    path = copy.root / copy.data
    content = bytearray(path.read_bytes())
    for i in range(len(content) // 4, len(content) // 2):
        content[i] ^= 0xA5
    path.write_bytes(content)


def instead(make: Callable[[Path, Copy], object]) -> Callable[[Copy], None]:
    """Something else in the place of the data file."""

    def damage(copy: Copy) -> None:
        path = copy.root / copy.data
        path.unlink()
        make(path, copy)

    return damage


def linked_outside(path: Path, copy: Copy) -> None:
    elsewhere = copy.root.parent / f"{copy.root.name}-elsewhere.parquet"
    elsewhere.write_bytes(b"PAR1")
    path.symlink_to(elsewhere)


def info(**entries) -> Kind:
    return Kind(lambda c: c.change_info(**entries))


def raw_info(change: Callable[[str], str]) -> Callable[[Copy], object]:
    def damage(copy: Copy) -> None:
        path = copy.root / "meta/info.json"
        path.write_text(change(path.read_text()))

    return damage


def listed(**entries) -> Callable[[Copy], None]:
    """Change the second episode's entry in the list of episodes."""

    def damage(copy: Copy) -> None:
        file = copy.root / copy.episodes_file
        if copy.v3:
            table = pq.read_table(file)
            for key, value in entries.items():
                if key not in table.column_names:
                    raise NotHereError(key)
                column = table.column(key).to_pylist()
                column[1] = value(column[1]) if callable(value) else value
                number = table.schema.get_field_index(key)
                table = table.set_column(
                    number, key, pa.array(column, table.schema.field(key).type)
                )
            pq.write_table(table, file)
            return
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        for key, value in entries.items():
            if key not in lines[1]:
                raise NotHereError(key)
            lines[1][key] = value(lines[1][key]) if callable(value) else value
        file.write_text("".join(json.dumps(line) + "\n" for line in lines))

    return damage


def column(key: str, make: Callable[[pa.Table], pa.Array]) -> Callable[[Copy], None]:
    """Replace a column by one of another kind."""

    def change(table: pa.Table) -> pa.Table:
        return table.set_column(table.schema.get_field_index(key), key, make(table))

    return lambda copy: copy.rewrite(change)


def short_row(table: pa.Table) -> pa.Array:
    lists = table.column(STATE).to_pylist()
    lists[-3] = lists[-3][:-1]
    return pa.array(lists, pa.list_(pa.float64()))


def twice(table: pa.Table) -> pa.Table:
    return table.append_column(STATE, table.column(STATE))


def retitle(copy: Copy) -> None:
    """All episodes show a task whose text was typed to get past the question."""
    if copy.v3:
        for file, key, value in (
            (tasks_file(copy), "task", "test"),
            (copy.root / copy.episodes_file, "tasks", ["test"]),
        ):
            table = pq.read_table(file)
            if key not in table.schema.names:  # LeRobot has it as the index of pandas
                key = "__index_level_0__"
            field = table.schema.field(key)
            renamed = pa.array([value] * len(table), field.type)
            number = table.schema.get_field_index(key)
            pq.write_table(table.set_column(number, field, renamed), file)
        return
    for file, change in (
        (tasks_file(copy), {"task": "test"}),
        (copy.root / copy.episodes_file, {"tasks": ["test"]}),
    ):
        lines = [json.loads(line) | change for line in file.read_text().splitlines()]
        file.write_text("".join(json.dumps(line) + "\n" for line in lines))


def version_2(damage: Callable[[Copy], object]) -> Callable[[Copy], None]:
    def only(copy: Copy) -> None:
        if copy.v3:
            raise NotHereError("version 3")
        damage(copy)

    return only


def feature(**entries) -> Callable[[Copy], None]:
    return lambda copy: copy.change_feature(**entries)


def own_names(change: Callable[[list[str]], list[str]]) -> Callable[[Copy], None]:
    def damage(copy: Copy) -> None:
        known = [f"joint{i}.pos" for i in range(copy.info["features"][STATE]["shape"][0])]
        copy.change_feature(names=change(known))

    return damage


def statistics(change: Callable[[dict], object]) -> Callable[[Copy], None]:
    """Statistics of the dataset as they should be, but for one change."""

    def damage(copy: Copy) -> None:
        files = sorted((copy.root / "data").glob("*/*.parquet"))
        values = np.concatenate(
            [np.array(pq.read_table(f).column(STATE).to_pylist()) for f in files]
        )
        made = {
            name: getattr(values, name)(0).tolist() for name in ("min", "max", "mean", "std")
        }
        made["count"] = [len(values)]
        change(made)
        (copy.root / "meta/stats.json").write_text(json.dumps({STATE: made}))

    return damage


FILES = {
    "no info.json": Kind(lambda c: (c.root / "meta/info.json").unlink()),
    "info.json breaks off": Kind(cut("meta/info.json", 0.6)),
    "info.json is a pointer of Git LFS": Kind(text("meta/info.json", POINTER)),
    "info.json is a list": Kind(text("meta/info.json", "[1, 2]")),
    "info.json is deep": Kind(text("meta/info.json", "[" * 200_000)),
    "info.json is binary": Kind(text("meta/info.json", bytes(range(128, 256)))),
    "no list of episodes": Kind(lambda c: place(c, "episodes").unlink()),
    "the list of episodes is a pointer of Git LFS": Kind(text("episodes", POINTER)),
    "the list of episodes breaks off": Kind(cut("episodes", 0.7)),
    "no list of tasks": Kind(lambda c: tasks_file(c).unlink()),
    "the list of tasks is empty": Kind(text("tasks", "")),
    "an episode is not listed": Kind(
        lambda c: (
            c.remove_episode()
            if c.v3
            else place(c, "episodes").write_text(
                "".join(place(c, "episodes").read_text().splitlines(True)[:1])
            )
        )
    ),
    "no data file": Kind(lambda c: (c.root / c.data).unlink(), local=True),
    "data are a pointer of Git LFS": Kind(text("data", POINTER), local=True),
    "data break off": Kind(cut("data", 0.5), local=True),
    "data are empty": Kind(text("data", ""), local=True),
    "data hold turned bytes": Kind(corrupt, local=True),
    "data are a folder": Kind(instead(lambda p, _: p.mkdir()), local=True),
    "data are a pipe": Kind(instead(lambda p, _: os.mkfifo(p)), local=True),
    "data link to themselves": Kind(instead(lambda p, _: p.symlink_to(p)), local=True),
    "data link out of the set": Kind(instead(linked_outside), local=True),
    "rows lost": Kind(lambda c: c.rewrite(lambda t: t.slice(0, len(t) - 7)), local=True),
    "rows twice": Kind(
        lambda c: c.rewrite(lambda t: pa.concat_tables([t, t.slice(len(t) - 9)])), local=True
    ),
    "a column is missing": Kind(lambda c: c.rewrite(lambda t: t.drop_columns([STATE]))),
    "a column is there twice": Kind(lambda c: c.rewrite(twice)),
    "a column of strings": Kind(column(STATE, lambda t: pa.array(["up"] * len(t)))),
    "a column of pickles": Kind(column(STATE, lambda t: pa.array([b"\x80\x04."] * len(t)))),
    "a column of nulls": Kind(
        column(
            STATE, lambda t: pa.nulls(len(t), pa.list_(t.schema.field(STATE).type.value_type))
        )
    ),
    "a row with a component less": Kind(column(STATE, short_row), local=True),
    "numbers of another type": Kind(
        column(STATE, lambda t: pa.array(t.column(STATE).to_pylist(), pa.list_(pa.float16()))),
        severe=False,
    ),
    "version unknown": info(codebase_version="v7.3"),
    "version no text": info(codebase_version=None),
    "fps of zero": info(fps=0),
    "fps infinite": info(fps=float("inf")),
    "fps nan": info(fps=float("nan")),
    "fps a text": info(fps="thirty"),
    "fps off by a third": Kind(lambda c: c.change_info(fps=0.7 * c.info["fps"]), severe=False),
    "features are a list": info(features=[1]),
    "a feature is no object": Kind(
        lambda c: c.change_info(features={**c.info["features"], STATE: 3})
    ),
    "shape of a thousand million": Kind(feature(shape=[10**9], names=None)),
    "shape with a component more": Kind(
        lambda c: c.change_feature(
            shape=[c.info["features"][STATE]["shape"][0] + 1], names=None
        )
    ),
    "shape negative": Kind(feature(shape=[-3])),
    "shape null": Kind(feature(shape=None)),
    "a name less": Kind(own_names(lambda names: names[:-1])),
    "a name twice": Kind(own_names(lambda names: [names[0], *names[:-1]])),
    "escapes in names": Kind(
        own_names(lambda names: ["\x1b[2J\x1b]0;owned\x07", *names[1:]]), severe=False
    ),
    "data_path leads up": info(data_path="../../{episode_index}.parquet"),
    "data_path absolute": info(data_path="/etc/hostname"),
    "data_path of unknown fields": info(data_path="data/{nobody}.parquet"),
    "data_path of attributes": info(data_path="{episode_index.__class__}"),
    "data_path a format bomb": info(data_path="{episode_index:0999999999d}.parquet"),
    "data_path missing": info(data_path=None),
    "chunks_size 0": Kind(version_2(lambda c: c.change_info(chunks_size=0))),
    "chunks_size null": Kind(version_2(lambda c: c.change_info(chunks_size="many"))),
    "count of episodes wrong": info(total_episodes=77),
    "count of frames wrong": info(total_frames=7),
    "length null": Kind(listed(length=None)),
    "length 0": Kind(listed(length=0)),
    "length negative": Kind(version_2(listed(length=-5))),
    "length too long by five": Kind(listed(length=lambda n: n + 5)),
    "length of 20 million": Kind(listed(length=20_000_000)),
    "an episode's number twice": Kind(listed(episode_index=0)),
    "an offset into another episode": Kind(listed(dataset_from_index=lambda n: n - 9)),
    "a data file that is not there": Kind(listed(**{"data/file_index": 9})),
    "a task that says nothing": Kind(retitle, severe=False),
    "a task of no list": Kind(listed(tasks=["juggle"]), severe=False),
    "a data file of no episode": Kind(
        lambda c: shutil.copy(
            c.root / c.data, (c.root / c.data).with_name("left-over.parquet")
        ),
        severe=False,
    ),
    "no statistics": Kind(remove_statistics, severe=False),
    "statistics of other data": Kind(
        statistics(lambda s: s.update(max=[m + 500 for m in s["max"]])), severe=False
    ),
    "statistics too narrow": Kind(
        statistics(
            lambda s: s.update(
                max=[0.5 * (a + b) for a, b in zip(s["min"], s["max"], strict=True)]
            )
        ),
        severe=False,
    ),
    "statistics of nan": Kind(
        statistics(lambda s: s.update(mean=[float("nan")] * len(s["mean"]))), severe=False
    ),
    "statistics of fewer components": Kind(
        statistics(lambda s: s.update({k: s[k][:-1] for k in ("min", "max", "mean", "std")}))
    ),
}
"""Defects of files and metadata."""


def video(change: Callable[[Path, Copy], object]) -> Callable[[Copy], None]:
    """Defect of the video of the second episode."""

    def damage(copy: Copy) -> None:
        shown = sorted(copy.root.glob(f"videos/**/*{CAMERA}*/**/*.mp4"))
        if not shown:
            raise NotHereError(CAMERA)
        change(shown[0] if copy.v3 else shown[1], copy)

    return damage


def again(**other) -> Callable[[Copy], None]:
    """Encode the file anew, by default with the same number of images."""

    def write(path: Path, copy: Copy) -> None:
        frames = other.pop("frames", None) or (
            copy.info["total_frames"] if copy.v3 else copy.length
        )
        write_video(path, frames, **({"fps": copy.info["fps"]} | other))

    return video(write)


def fewer(path: Path, copy: Copy) -> None:
    frames = copy.info["total_frames"] if copy.v3 else copy.length
    write_video(path, frames - 25, fps=copy.info["fps"])


def exchange_videos(path: Path, copy: Copy) -> None:
    """Exchange the videos of the first two episodes."""
    if copy.v3:
        raise NotHereError("one file for all")
    other = path.with_name("episode_000000.mp4")
    first = other.read_bytes()
    other.write_bytes(path.read_bytes())
    path.write_bytes(first)


def remove_one(path: Path, copy: Copy) -> None:
    if copy.v3:
        raise NotHereError("one file for all")
    path.unlink()


def copy_video(path: Path, copy: Copy) -> None:
    if copy.v3:
        raise NotHereError("one file for all")
    shutil.copy(path.with_name("episode_000000.mp4"), path)


def turned_bytes(path: Path, _: Copy) -> None:
    content = bytearray(path.read_bytes())
    for i in range(len(content) // 3, 2 * len(content) // 3):
        content[i] ^= 0xA5
    path.write_bytes(content)


_STOP, _START = (f"videos/{CAMERA}/{end}_timestamp" for end in ("to", "from"))

VIDEOS = {
    "no video of an episode": Kind(video(remove_one), local=True),
    "no videos": Kind(video(lambda p, c: shutil.rmtree(c.root / "videos")), severe=False),
    "a video is a pointer of Git LFS": Kind(
        video(lambda p, _: p.write_text(POINTER)), local=True
    ),
    "a video breaks off": Kind(
        video(lambda p, _: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2])), local=True
    ),
    "a video is empty": Kind(video(lambda p, _: p.write_bytes(b"")), local=True),
    "a video is a text": Kind(video(lambda p, _: p.write_text("no video" * 99)), local=True),
    "a video holds turned bytes": Kind(video(turned_bytes), local=True),
    "a video of fewer images": Kind(video(fewer), local=True),
    "videos of two episodes exchanged": Kind(video(exchange_videos), local=True),
    "a video twice": Kind(video(copy_video), severe=False, local=True),
    "a video of another size": Kind(again(size=(48, 80)), local=True),
    "a video of another rate": Kind(again(fps=11), local=True),
    "a video that is black": Kind(again(still=True), severe=False, local=True),
    "a video beyond its end": Kind(listed(**{_STOP: lambda t: t + 900.0})),
    "a video of a part": Kind(listed(**{_STOP: lambda t: t - 1.0})),
    "a video that overlaps another": Kind(listed(**{_START: lambda t: t - 2.0})),
    "video_path leads up": Kind(
        video(lambda _, c: c.change_info(video_path="../../{episode_index}.mp4"))
    ),
    "video_path of unknown fields": Kind(
        video(lambda _, c: c.change_info(video_path="{nobody}.mp4"))
    ),
}
"""Defects of images."""
