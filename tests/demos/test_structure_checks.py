"""Checks of index columns, tasks, statistics and videos of a dataset."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from lerobot_folders import write_folder

from hrc_learn.demos.issues import ValidationReport
from hrc_learn.demos.quality import structure_checks, video_checks
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, open_folder
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.profiles import FeatureProfiles, profile_columns
from hrc_learn.demos.videos import VideoSegment

pytestmark = pytest.mark.simulation


STATE = "observation.state"


def entry(index=0, length=100, start=0, file="data/a.parquet", tasks=()):
    return EpisodeEntry(index=index, length=length, tasks=tasks, file=file, start=start)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three episodes of 20 frames at 50 Hz."""
    root = tmp_path_factory.mktemp("limits") / "set"
    episodes = [{STATE: np.zeros((20, 2))}] * 3
    return open_folder(write_folder(root, episodes, {STATE: ["a", "b"]}))


def messages(issues):
    return [(issue.episode, issue.frame, issue.key, issue.message) for issue in issues]


def test_index_columns_are_of_this_episode(folder):
    second = folder.episodes[1]
    count = np.arange(20)[:, None]
    sound = {
        "frame_index": count,
        "episode_index": np.full((20, 1), 1),
        "index": count + 20,
        "task_index": np.zeros((20, 1)),
    }
    assert messages(structure_checks.indices(folder, second, sound)) == []
    assert messages(structure_checks.indices(folder, second, {})) == []
    for key, value in (
        ("frame_index", 9),
        ("episode_index", 0),
        ("index", 3),
        ("task_index", 5),
    ):
        wrong = sound[key].copy()
        wrong[7] = wrong[11] = value
        ((episode, frame, at, text),) = messages(
            structure_checks.indices(folder, second, sound | {key: wrong})
        )
        assert (episode, frame, at) == (1, 7, key)
        begin = "task 5 is not in" if key == "task_index" else f"is {value}, expected "
        assert text.startswith(begin)
        if key != "task_index":
            assert text.startswith(f"is {value}, expected {sound[key][7, 0]};")


def test_episodes_that_overlap_or_leave_a_gap(folder):
    for shift in (-1, 1):
        entries = list(folder.episodes)
        entries[1] = replace(entries[1], start=20 + shift)
        own = replace(folder, episodes=tuple(entries))
        found = messages(structure_checks.offsets(own))
        assert found[0][0] == 1
        assert found[0][3].startswith(f"begins at row {20 + shift}, but episode 0 ends at 20")
        assert found[1][3].startswith(f"begins at row 40, but episode 1 ends at {40 + shift}")
    assert messages(structure_checks.offsets(folder)) == []
    moved = replace(folder, episodes=folder.episodes[::-1])
    assert messages(structure_checks.offsets(moved)) == []


@pytest.mark.parametrize("text", ["test", " TODO ", "Untitled", ""])
def test_texts_of_tasks_say_something(folder, text):
    own = replace(folder, tasks={0: "reach", 1: text}, info={**folder.info, "total_tasks": 2})
    (found,) = messages(structure_checks.task_texts(own))
    assert found[3].startswith("task 1")
    assert messages(structure_checks.task_texts(folder)) == []
    twice = replace(own, tasks={0: "reach", 1: "reach"})
    assert messages(structure_checks.task_texts(twice))[0][3] == "a task is listed twice"
    more = replace(folder, info={**folder.info, "total_tasks": 3})
    assert messages(structure_checks.task_texts(more))[0][3] == "says 3, but 1 are listed"
    other = replace(folder, tasks={0: "pour"})
    found = messages(structure_checks.task_texts(other))
    assert [f[0] for f in found] == [0, 1, 2]
    assert found[0][3] == "task 'reach' is not in the list of tasks"


def camera_folder(folder, shape=(4, 6, 3), version="v3.0"):
    """The dataset, with a camera declared."""
    feature = replace(folder.features[STATE], key="cam", dtype="video", shape=shape, names=None)
    return replace(
        folder,
        features={**folder.features, "cam": feature},
        info={**folder.info, "codebase_version": version},
    )


PLACE = {"file": "v.mp4", "key": "cam"}


@pytest.mark.parametrize(
    ("shape", "size", "rate", "text"),
    [
        ((4, 6, 3), (4, 6), 50.0, None),
        ((3, 4, 6), (4, 6), 50.0, None),
        ((4, 6, 3), (6, 4), 50.0, "has images of 6 x 4, but [4, 6, 3] is declared"),
        ((4, 6), (6, 4), 50.0, None),
        ((4, 6, 3), (4, 6), 50.9, None),
        ((4, 6, 3), (4, 6), 51.1, "runs at 51.1 images a second, the dataset at 50"),
        ((4, 6, 3), (4, 6), 48.9, "runs at 48.9 images a second, the dataset at 50"),
        ((4, 6, 3), (4, 6), 0.0, None),
    ],
)
def test_size_and_rate_of_a_video(folder, shape, size, rate, text):
    stream = video_checks._Stream(20, rate, size)
    found = video_checks._size_and_rate(camera_folder(folder, shape), stream, PLACE)
    assert [issue.message for issue in found] == ([text] if text else [])


def segments(*bounds):
    return [
        (entry(k, 20), VideoSegment(file=Path("v.mp4"), start=a, stop=b))
        for k, (a, b) in enumerate(bounds)
    ]


@pytest.mark.parametrize(
    ("bounds", "images", "found"),
    [
        (((0, 0.4), (0.4, 0.8)), 40, []),
        (((0, 0.42), (0.42, 0.82)), 41, []),
        (
            ((0, 0.44), (0.44, 0.84)),
            42,
            [(0, "shows 22 images, but the episode has 20 frames")],
        ),
        (
            ((0, 0.36), (0.36, 0.76)),
            38,
            [(0, "shows 18 images, but the episode has 20 frames")],
        ),
        (((0, 0.4), (0.4, 0.8)), 39, []),
        (
            ((0, 0.4), (0.4, 0.8)),
            38,
            [(None, "ends after 0.760 s, but episodes reach to 0.800")],
        ),
        (((0, 0.4), (0.392, 0.792)), 40, []),
        (
            ((0, 0.4), (0.388, 0.788)),
            40,
            [(1, "begins at 0.388 s, before episode 0 ends (0.4")],
        ),
    ],
)
def test_episodes_of_a_video_have_their_images_and_do_not_overlap(
    folder, bounds, images, found
):
    shown = segments(*bounds)
    stream = video_checks._Stream(images, 50.0, (4, 6))
    told = [*video_checks._length(camera_folder(folder), shown, stream, PLACE)]
    assert [issue.episode for issue in told] == [episode for episode, _ in found]
    for issue, (_, text) in zip(told, found, strict=True):
        assert issue.message.startswith(text)
    # In any order of the list.
    assert len(
        [*video_checks._length(camera_folder(folder), shown[::-1], stream, PLACE)]
    ) == len(found)
    old = camera_folder(folder, version="v2.1")
    for count, off in ((21, 0), (22, 2), (18, 2), (19, 0)):
        stream = video_checks._Stream(count, 50.0, (4, 6))
        told = [*video_checks._length(old, shown[:1], stream, PLACE)]
        assert [issue.severity for issue in told] == [off] * bool(off)


def test_copies_of_a_video_are_known_by_their_ends(tmp_path):
    rng = np.random.default_rng(0)
    content = rng.bytes(300_000)
    one, two = tmp_path / "a", tmp_path / "b"
    one.write_bytes(content)

    def same(other):
        two.write_bytes(other)
        return video_checks._digest(one) == video_checks._digest(two)

    assert same(content)
    assert not same(content[:-1])
    ends = 2**16, 300_000 - 2**16
    for at in (0, 2**16 - 1, 2**16, 150_000, ends[1] - 1, ends[1], 299_999):
        changed = bytearray(content)
        changed[at] ^= 1
        assert same(bytes(changed)) == (ends[0] <= at < ends[1])
    one.write_bytes(b"ab")
    assert same(b"ab")
    assert not same(b"aa")


@pytest.mark.parametrize(
    ("name", "shift", "told"),
    [
        ("min", 0.19, False),
        ("min", 0.21, True),
        ("max", -0.19, False),
        ("max", -0.21, True),
        ("mean", 5.19, False),
        ("mean", 5.21, True),
        ("mean", -5.19, False),
        ("mean", -5.21, True),
        ("std", -2.0, False),
        ("std", -2.01, True),
        ("max", 190.9, False),
        ("max", 191.1, True),
        ("min", float("nan"), True),
    ],
)
def test_statistics_fit_within_a_fiftieth_of_the_range(folder, tmp_path, name, shift, told):
    """Values from 0 to 10: a fiftieth is 0.2; twenty ranges and one are 201."""
    stated = {"min": 0.0, "max": 10.0, "mean": 5.0, "std": 2.0}
    stated[name] += shift
    (tmp_path / "meta").mkdir()
    rows = {key: [value, 5.0 * (key != "min")] for key, value in stated.items()}
    text = json.dumps({STATE: rows})
    (tmp_path / "meta/stats.json").write_text(text)
    values = np.stack([np.linspace(0, 10, 30), np.linspace(0, 5, 30)], axis=1)
    profiles = [profile_columns({STATE: values})[STATE]] * 2
    feature = FeatureProfiles(
        key=STATE,
        fps=50.0,
        entries=[entry(0), entry(1)],
        profiles=profiles,
        names=["a", "b"],
        smooth=np.ones(2, bool),
    )
    found = [*structure_checks.statistics_fit(replace(folder, root=tmp_path), [feature])]
    assert len(found) == told
    assert all("do not fit the data in 1 components" in issue.message for issue in found)


def named(folder, names, width=3, dtype="float32"):
    """A dataset with another feature, whose names are declared so."""
    flat = tuple(names) if isinstance(names, list) and len(names) == width else None
    feature = Feature(key="x", dtype=dtype, shape=(width,), names=flat)
    declared = {"dtype": dtype, "shape": [width], "names": names}
    features = {**folder.info["features"], "x": declared}
    return replace(
        folder,
        features={**folder.features, "x": feature},
        info={**folder.info, "features": features},
    )


@pytest.mark.parametrize(
    ("names", "width", "text"),
    [
        (["a", "b", "c"], 3, None),
        (None, 3, None),
        (["all"], 3, None),
        (["a", "b"], 3, "2 names for 3 components: they are not used; correct names or shape"),
        (["a", "b", "c", "d"], 3, "4 names for 3 components"),
        (["a", "b", "a"], 3, "two components have the same name"),
        (["a", "b\x1b", "c"], 3, "a name holds unprintable characters"),
    ],
)
def test_names_of_components(folder, names, width, text):
    found = messages(structure_checks.component_names(named(folder, names, width)))
    assert [(key, message[: len(text or "")]) for *_, key, message in found] == (
        [("x", text)] if text else []
    )


def test_names_of_pictures_are_those_of_their_axes(folder):
    own = named(folder, ["height", "width", "channels"], 4, "video")
    assert messages(structure_checks.component_names(own)) == []


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (pa.float16(), "float16"),
        (pa.float32(), "float32"),
        (pa.float64(), "float64"),
        (pa.int16(), "int16"),
        (pa.bool_(), "bool"),
        (pa.list_(pa.float32(), 3), "float32"),
        (pa.list_(pa.list_(pa.float64())), "float64"),
        (pa.struct([("bytes", pa.binary())]), "struct<bytes: binary>"),
    ],
)
def test_types_of_numbers_in_columns(kind, name):
    assert structure_checks._number_type(kind) == name


def test_columns_of_a_file_are_those_declared(folder):
    declared = pa.schema(
        {STATE: pa.list_(pa.float32(), 2), "timestamp": pa.float32()}
        | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), pa.int64())
    )

    def found(schema):
        report = ValidationReport(path=folder.root)
        report.run(structure_checks._column_faults, folder, "f.parquet", schema, report)
        again = structure_checks._column_faults(folder, "g.parquet", schema, report)
        issues = [*report.errors, *report.warnings]
        return [(one.level, one.key, one.message[:30]) for one in issues], len([*again])

    place = declared.get_field_index(STATE)
    assert found(declared) == ([], 0)
    assert found(declared.append(declared.field(STATE))) == (
        [("error", STATE, "the column is there more than ")],
        1,
    )
    assert found(declared.remove(place)) == (
        [("error", STATE, "the column is declared in meta")],
        1,
    )
    double = declared.set(place, pa.field(STATE, pa.list_(pa.float64())))
    assert found(double) == ([("warning", STATE, "holds float64, but meta/info.j")], 1)
    # A missing index column is named once for all files.
    bare = declared.remove(declared.get_field_index("task_index"))
    assert found(bare) == ([("warning", "task_index", "the column is missing: LeRobot")], 0)


@pytest.mark.parametrize(
    ("stated", "level", "text"),
    [
        ({"min": [0, 0], "max": [1, 1], "mean": [0.5, 0.5]}, "warning", "are incomplete"),
        ({"min": "x", "max": 1, "mean": 1, "std": 1}, "warning", "are incomplete"),
        (
            {"min": [0], "max": [1], "mean": [0.5], "std": [0.3]},
            "error",
            "of 1 components for 2",
        ),
        (
            {"min": [0, 0], "max": [1, 1], "mean": [0.5, 0.5], "std": [0.3]},
            "error",
            "of 2 components for 2",
        ),
        (
            {"min": [0, 0], "max": [1, 1], "mean": [0.5, 0.5], "std": [0.3, -0.1]},
            "warning",
            "do not fit the data in 1 components",
        ),
        (
            {"min": [0, 2], "max": [1, 1], "mean": [0.5, 0.5], "std": [0.3, 0]},
            "warning",
            "do not fit the data in 1 components",
        ),
        ({"min": [0, 0], "max": [1, 1], "mean": [0.5, 0.5], "std": [0.3, 0]}, None, ""),
        ({"min": [[0], [0]], "max": [1, 1], "mean": [0.5, 0.5], "std": [0.3, 0]}, None, ""),
    ],
)
def test_statistics_have_a_number_for_each_component(folder, tmp_path, stated, level, text):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/stats.json").write_text(json.dumps({STATE: stated}))
    values = np.linspace(0, 1, 30)[:, None].repeat(2, 1)
    feature = FeatureProfiles(
        key=STATE,
        fps=50.0,
        entries=[entry(0)],
        profiles=[profile_columns({STATE: values})[STATE]],
        names=["a", "b"],
        smooth=np.ones(2, bool),
    )
    own = replace(folder, root=tmp_path)
    found = [*structure_checks.statistics_fit(own, [feature, replace(feature, key="other")])]
    assert [issue.level for issue in found] == ([level] if level else [])
    assert all(f"statistics {text}" in issue.message for issue in found)


def test_statistics_of_either_version_are_looked_for(folder, tmp_path):
    own = replace(folder, root=tmp_path)
    (tmp_path / "meta").mkdir()
    assert len(messages(structure_checks.statistics_exist(own))) == 1
    for name in ("stats.json", "episodes_stats.jsonl"):
        path = tmp_path / "meta" / name
        path.touch()
        assert messages(structure_checks.statistics_exist(own)) == []
        path.unlink()
