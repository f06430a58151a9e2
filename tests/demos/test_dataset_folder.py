"""Metadata of a dataset's folder: versions, lists of episodes and tasks, and their faults."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_folders import joint_path, read_info, write_folder, write_info

from hrc_learn.demos import DatasetError
from hrc_learn.demos.read.dataset_folder import (
    count_faults,
    generation,
    open_folder,
    places_v2,
    recorded_statistics,
    recovery_advice,
    select_episodes,
    staging_folder,
)
from hrc_learn.demos.read.dataset_folder import (
    read_info as checked_info,
)

pytestmark = pytest.mark.simulation

STATE = "observation.state"
LENGTHS, TASKS = (12, 7, 20), ("pour", "stir", "pour")


@pytest.fixture(params=["v3.0", "v2.1"])
def root(request, tmp_path):
    episodes = [{STATE: joint_path(n)} for n in LENGTHS]
    return write_folder(
        tmp_path / "set", episodes, {STATE: list("abc")}, version=request.param, tasks=TASKS
    )


@pytest.mark.parametrize(
    ("version", "number"),
    [
        ("v3.0", 3),
        ("3.0", 3),
        (3.0, 3),
        ("v3.1", 3),
        ("v2.1", 2),
        ("2.0", 2),
        (2.1, 2),
        ("v2.2", None),
        ("v1.6", None),
        ("v30.0", None),
        ("", None),
        (None, None),
    ],
)
def test_versions_that_are_read(version, number):
    assert generation(version) == number


def test_files_of_version_2_lie_in_chunks():
    for episode, chunk in ((0, 0), (999, 0), (1000, 1), (2500, 2)):
        expected = {"episode_chunk": chunk, "chunk_index": chunk, "episode_index": episode}
        assert places_v2(episode, 1000) == expected


def test_episodes_are_listed_alike_in_every_version(root):
    folder = open_folder(root)
    assert [entry.index for entry in folder.episodes] == [0, 1, 2]
    assert tuple(entry.length for entry in folder.episodes) == LENGTHS
    assert [entry.tasks for entry in folder.episodes] == [("pour",), ("stir",), ("pour",)]
    assert folder.tasks == {0: "pour", 1: "stir"}
    assert folder.first_index == {0: 0, 1: 12, 2: 19}
    assert (folder.fps, folder.robot_type, folder.numbers) == (50.0, "test", [STATE])
    assert folder.is_v3 == folder.version.startswith("v3")
    starts = [entry.start for entry in folder.episodes]
    assert starts == ([0, 12, 19] if folder.is_v3 else [0, 0, 0])
    assert len(folder.files) == (1 if folder.is_v3 else 3)
    assert sum(map(len, folder.files.values())) == 3
    assert [*count_faults(folder)] == []


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"codebase_version": "v1.6"}, "codebase_version must be 2.0, 2.1 or 3.0, got 'v1.6'"),
        ({"fps": 0}, "fps must be positive and below 1e.06, got '0'"),
        ({"fps": 1e6}, "fps must be positive and below"),
        ({"fps": True}, "fps must be positive and below"),
        ({"fps": "50"}, "fps must be positive and below"),
        ({"features": []}, r"features must be an object, got '\[\]'"),
    ],
)
def test_values_that_no_dataset_has(root, change, text):
    write_info(root, read_info(root) | change)
    with pytest.raises(DatasetError, match=text):
        checked_info(root)


def test_what_is_absent_is_explained(root, tmp_path):
    info = read_info(root)
    for key in ("fps", "features"):
        del info[key]
    write_info(root, info)
    with pytest.raises(DatasetError, match="lacks fps, features"):
        checked_info(root)
    with pytest.raises(DatasetError, match="there is no dataset: the folder does not exist"):
        checked_info(tmp_path / "none")
    with pytest.raises(DatasetError, match="this folder is no LeRobot dataset"):
        checked_info(tmp_path)
    staging_folder(tmp_path / "none").mkdir()
    with pytest.raises(DatasetError, match="the recording was interrupted before") as caught:
        checked_info(tmp_path / "none")
    assert recovery_advice(tmp_path / "none") in str(caught.value)


def faults(folder):
    found = [fault.issue for fault in count_faults(folder)]
    return [(one.episode, one.key, one.message.split(",")[0].split(":")[0]) for one in found]


def test_counts_that_contradict_each_other(root):
    folder = open_folder(root)
    info = folder.info | {"total_episodes": 4, "total_frames": 38}
    assert faults(replace(folder, info=info)) == [
        (None, "total_episodes", "says 4"),
        (None, "total_frames", "says 38"),
    ]
    less = {k: v for k, v in folder.info.items() if not k.startswith("total_")}
    assert faults(replace(folder, info=less)) == []
    one, two, three = folder.episodes
    known = replace(folder, info=less)
    assert faults(replace(known, episodes=())) == [
        (None, None, "the dataset holds no episodes")
    ]
    assert faults(replace(known, episodes=(one, two, two))) == [
        (1, None, "is listed more than once")
    ]
    assert faults(replace(known, episodes=(one, three))) == [
        (1, None, "is missing from the list of episodes")
    ]
    empty = replace(two, length=0)
    assert faults(replace(known, episodes=(one, empty, three))) == [(1, None, "has no frames")]


def test_episodes_are_selected_by_index_task_and_condition(root):
    folder = open_folder(root)

    def chosen(*args, **options):
        return [entry.index for entry in select_episodes(folder, *args, **options)]

    assert chosen() == [0, 1, 2]
    assert chosen([2, 0]) == [2, 0]
    assert chosen(tasks="pour") == [0, 2]
    assert chosen([2, 1], tasks=["stir", "pour"]) == [2, 1]
    assert chosen(where=lambda entry: entry.length > 7) == [0, 2]
    assert chosen([1, 2], "pour", lambda entry: entry.length > 7) == [2]
    for given, text in (
        ({"episodes": []}, "no episode was asked for; None reads all"),
        ({"episodes": [0, 3]}, "there is no such episode: choose from 0 to 2"),
        ({"tasks": "cut"}, "no episode shows the task 'cut'; tasks shown: 'pour', 'stir'"),
        (
            {"episodes": [0], "tasks": "stir"},
            "no episode of two frames is left by the filters given",
        ),
        (
            {"where": lambda entry: False},
            "no episode of two frames is left by the filters given",
        ),
    ):
        with pytest.raises(DatasetError, match=text):
            select_episodes(folder, **given)
    with pytest.raises(DatasetError, match="the dataset holds no episodes"):
        select_episodes(replace(folder, episodes=()))


@pytest.mark.parametrize("name", ["task", "__index_level_0__", "index"])
def test_texts_of_tasks_have_one_of_three_names(tmp_path, name):
    episodes = [{STATE: joint_path(12)}]
    root = write_folder(tmp_path / "set", episodes, {STATE: list("abc")})
    table = pa.table({"task_index": [1, 0], name: ["stir", "pour"]})
    pq.write_table(table, root / "meta/tasks.parquet")
    assert open_folder(root).tasks == {1: "stir", 0: "pour"}


def test_statistics_count_where_they_are_complete(root):
    folder = open_folder(root)
    assert not any(recorded_statistics(folder).values())
    names = ("q01", "q10", "q50", "q90", "q99", "min", "max", "mean", "std", "count")
    own = {name: [float(k)] for k, name in enumerate(names)}
    part = {name: value for name, value in own.items() if name != "std"}
    if folder.is_v3:
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        table = pq.read_table(path)
        for key, given in ((STATE, own), ("part", part)):
            for name, value in given.items():
                column = pa.array([value, None, value])
                table = table.append_column(f"stats/{key}/{name}", column)
        pq.write_table(table, path)
    else:
        lines = [
            json.dumps({"episode_index": k, "stats": {STATE: own, "part": part}})
            for k in (0, 2)
        ]
        (root / "meta/episodes_stats.jsonl").write_text("\n".join(lines))
    found = recorded_statistics(folder)
    assert {k: v for k, v in found.items() if v} == {0: {STATE: own}, 2: {STATE: own}}


def test_data_of_several_files_begin_at_their_own_first_row(tmp_path):
    episodes = [{STATE: joint_path(n)} for n in LENGTHS]
    root = write_folder(tmp_path / "set", episodes, {STATE: list("abc")}, tasks=TASKS)
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    place = table.column_names.index("data/file_index")
    table = table.set_column(place, "data/file_index", pa.array([0, 1, 1]))
    pq.write_table(table.take([2, 0, 1]), path)
    found = open_folder(root).episodes
    assert [entry.start for entry in found] == [0, 0, 7]
    assert [entry.file[-11:-8] for entry in found] == ["000", "001", "001"]
    np.testing.assert_array_equal([entry.length for entry in found], LENGTHS)
