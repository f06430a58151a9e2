"""Demonstrations read one at a time are those that are read all at once."""

import dataclasses
from multiprocessing.reduction import ForkingPickler
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import (
    DatasetError,
    Demonstration,
    DemonstrationSource,
    UnitsWarning,
    load_demos,
    open_demos,
)
from hrc_learn.demos.read import frames
from hrc_learn.demos.read.source import open_dataset

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

STATE = "observation.state"
NAMES = ["a.pos", "b.pos", "c.pos"]
LENGTHS = (20, 25, 30, 35, 40)
TASKS = ("reach", "place", "reach", "pour", "place")


def write(root, version="v3.0", scale=1.0, lengths=LENGTHS):
    motions = [scale * joint_path(n, seed=i) for i, n in enumerate(lengths)]
    episodes = [{STATE: q, "observation.extra": 2 * q} for q in motions]
    return write_folder(root, episodes, {STATE: NAMES}, version=version, tasks=TASKS)


def assert_same(one: Demonstration, other: Demonstration) -> None:
    assert one.recorded == other.recorded
    for field in dataclasses.fields(Demonstration):
        np.testing.assert_equal(getattr(one, field.name), getattr(other, field.name))


@pytest.mark.parametrize("version", ["v3.0", "v2.1", "v2.0"])
def test_one_at_a_time_is_as_all_at_once(tmp_path, version):
    root = write(tmp_path / "set", version)
    options = {"episodes": [3, 1, 2, 3], "joint_names": ["c", "a"]}
    source, demos = open_demos(root, **options), load_demos(root, **options)
    assert isinstance(source, DemonstrationSource)
    assert (len(source), source.frames, source.lengths) == (4, 125, (35, 25, 30, 35))
    assert (source.joint_names, source.fps, source.source) == (("c", "a"), 50, str(root))
    assert source.notes == demos.notes
    for passes in range(2):
        for index, (lazy, demo) in enumerate(zip(source, demos, strict=True)):
            assert_same(lazy, demo)
            assert_same(source[index if passes else index - 4], demo)
    for lazy, demo in zip(source.load(), demos, strict=True):
        assert_same(lazy, demo)


def test_slices_are_shares_that_nobody_reads_twice(tmp_path):
    source = open_demos(write(tmp_path / "set"))
    shares = [source[rank::2] for rank in range(2)]
    assert [[demo.episode for demo in share] for share in shares] == [[0, 2, 4], [1, 3]]
    assert [demo.episode for demo in source[::-1]] == [4, 3, 2, 1, 0]
    assert len(source[5:]) == 0
    assert [demo.episode for demo in source.spread(3)] == [0, 2, 4]
    assert len(source.spread(9)) == 5
    with pytest.raises(IndexError):
        source[5]


def test_units_are_guessed_from_all_episodes_even_for_one(tmp_path):
    # Degrees that only the last episode gives away.
    motions = [0.01 * joint_path(20), 90 * joint_path(20, seed=1)]
    root = write_folder(tmp_path / "set", [{STATE: q} for q in motions], {STATE: NAMES})
    with pytest.warns(UnitsWarning, match="taken for deg"):
        source = open_demos(root)
    np.testing.assert_allclose(source[0].joint_position, np.deg2rad(motions[0]), rtol=1e-6)
    assert_same(source[:1][0], source[0])


def count_rows(monkeypatch) -> list[int]:
    """Rows of every table that is read from now on."""
    rows, read = [], frames.read_table

    def counting(*args, **kwargs):
        table = read(*args, **kwargs)
        rows.append(table.num_rows)
        return table

    monkeypatch.setattr(frames, "read_table", counting)
    return rows


def test_frames_are_read_once_and_a_batch_at_a_time(tmp_path, monkeypatch):
    root = write(tmp_path / "set", lengths=[30] * 40)
    monkeypatch.setattr(frames, "_BATCH_ROWS", 100)
    source = open_demos(root)
    rows = count_rows(monkeypatch)
    assert sum(len(demo) for demo in source) == 1200
    assert (sum(rows), max(rows)) == (1200, 120)
    rows.clear()
    assert source[17].episode == 17
    assert rows == [30]
    rows.clear()
    assert [demo.episode for demo in source[::20]] == [0, 20]
    assert rows == [30, 30]


def test_nothing_is_read_where_no_unit_must_be_guessed(tmp_path, monkeypatch):
    dataset = open_dataset(write(tmp_path / "set"))
    entries = dataset.folder.episodes
    rows = count_rows(monkeypatch)
    decisions, _ = dataset.decide_units(entries, {"joint_position": "rad"})
    assert decisions["joint_position"].unit == "rad"
    assert not rows
    dataset.decide_units(entries, {})
    assert sum(rows) == sum(LENGTHS)


def test_a_source_may_go_to_another_process(tmp_path):
    source = open_demos(write(tmp_path / "set"))
    sent = ForkingPickler.loads(ForkingPickler.dumps(source))
    assert_same(sent[2], source[2])


def test_a_fault_shows_when_its_episode_is_read(tmp_path):
    root = write(tmp_path / "set", "v2.1")
    source = open_demos(root)
    (root / "data/chunk-000/episode_000003.parquet").unlink()
    assert len(source[2]) == 30
    with pytest.raises(DatasetError, match=r"episode_000003.*episode 3: not found"):
        source[3]


@pytest.mark.parametrize("read", [load_demos, open_demos])
def test_episodes_are_chosen_by_task_and_by_their_metadata(tmp_path, read):
    root = write(tmp_path / "set")
    by_task = read(root, tasks="place")
    assert [demo.episode for demo in by_task] == [1, 4]
    several = read(root, tasks=["pour", "place"], episodes=[4, 0, 3])
    assert [demo.episode for demo in several] == [4, 3]
    long = read(root, where=lambda entry: entry.length > 30)
    assert [demo.episode for demo in long] == [3, 4]
    with pytest.raises(DatasetError, match=r"'stir'; tasks shown: 'place', 'pour', 'reach'"):
        read(root, tasks="stir")
    with pytest.raises(DatasetError, match="no episode of two frames is left by the filters"):
        read(root, tasks="pour", where=lambda entry: entry.length > 90)


def test_demonstrations_are_chosen_and_changed_by_what_they_hold(tmp_path):
    demos = load_demos(write(tmp_path / "set"))
    ending_left = demos.filter(lambda demo: demo.joint_position[-1, 0] < 0)
    assert 0 < len(ending_left) < len(demos)
    assert all(demo.joint_position[-1, 0] < 0 for demo in ending_left)
    assert ending_left.notes == demos.notes
    later = demos.map(lambda demo: dataclasses.replace(demo, start_time=5.0))
    assert {demo.start_time for demo in later} == {5.0}
    assert later.source == demos.source


@pytest.mark.parametrize("read", [load_demos, open_demos])
def test_an_open_dataset_is_read_from_its_folder(tmp_path, read):
    root = write(tmp_path / "set")
    dataset = SimpleNamespace(root=root, episodes=[2, 4])  # as LeRobotDataset has them
    assert [demo.episode for demo in read(dataset)] == [2, 4]
    assert [demo.episode for demo in read(dataset, episodes=[1])] == [1]
    dataset.episodes = None
    assert len(read(dataset)) == 5
