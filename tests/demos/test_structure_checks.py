"""Checks of index columns, tasks, statistics and videos of a dataset."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import write_folder

from hrc_learn.demos.quality import structure_checks, video_checks
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, open_folder
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
        ((4, 6, 3), (6, 4), 50.0, "has images of 6 x 4, declared are [4, 6, 3]"),
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
