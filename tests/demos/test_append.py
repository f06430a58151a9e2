"""Episodes added to a dataset that is there already."""

import functools
import json
import shlex
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import hrc
from lerobot_folders import joint_path, read_info
from power_cuts import cut_off

from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    check_dataset,
    load_demos,
    recover_all,
    recover_dataset,
)
from hrc_learn.demos.quality.ranking import Decision, write_curated
from hrc_learn.demos.read.contract import read_sidecar

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

JOINTS = ("a", "b", "c")


def record(root, seeds, tasks, *, append=False, then=None, saved=None, **settings):
    settings = {"fps": 50, "robot_type": "any", "joint_names": JOINTS, **settings}
    with DatasetWriter(root, append=append, **settings) as writer:
        for seed, task in zip(seeds, tasks, strict=True):
            writer.start_episode(task)
            for k, q in enumerate(joint_path(40 + seed, seed=seed)):
                writer.add_frame(time=0.02 * k, joint_position=q, command_position=q + 0.01)
            episode = writer.save_episode()
            if saved is not None:
                saved.append(episode)
        if then is not None:
            raise then
    return root


def assert_holds(root, seeds, tasks):
    demos = load_demos(root)
    assert [demo.task for demo in demos] == list(tasks)
    for demo, seed in zip(demos, seeds, strict=True):
        np.testing.assert_allclose(
            demo.joint_position, joint_path(40 + seed, seed=seed), atol=1e-6
        )
    report = check_dataset(root)
    assert report.ok, report
    assert report.warnings == []


def test_the_longer_dataset_is_as_if_recorded_at_once(tmp_path):
    once = record(tmp_path / "once", [0, 1, 2], ["reach", "place", "reach"])
    twice = record(tmp_path / "twice", [0], ["reach"])
    record(twice, [1, 2], ["place", "reach"], append=True)
    assert_holds(twice, [0, 1, 2], ["reach", "place", "reach"])
    assert read_info(twice) == read_info(once)
    for file in ("meta/stats.json", "meta/hrc_learn.json", "meta/tasks.parquet"):
        assert (twice / file).read_bytes() == (once / file).read_bytes()
    assert len(list((twice / "data").glob("*/*.parquet"))) == 2
    assert sorted(tmp_path.iterdir()) == [once, twice]
    record(twice, [3], ["pour"], append=True)
    assert_holds(twice, [0, 1, 2, 3], ["reach", "place", "reach", "pour"])


def test_a_list_of_episodes_that_is_put_together_of_pieces_is_the_same(tmp_path, monkeypatch):
    tasks = ("reach", "place", "reach", "pour", "reach")
    whole = record(tmp_path / "whole", range(5), tasks)
    monkeypatch.setattr("hrc_learn.demos.dataset_assembly._PACKED", 2)
    pieces = record(tmp_path / "pieces", range(3), tasks[:3])
    record(pieces, (3, 4), tasks[3:], append=True)
    lists = [
        pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
        for root in (whole, pieces)
    ]
    for row in (row for rows in lists for row in rows):
        row.pop("data/file_index")  # what is appended has files of its own
    assert lists[0] == lists[1]
    statistics = [
        json.loads((root / "meta/stats.json").read_text()) for root in (whole, pieces)
    ]
    assert statistics[0].keys() == statistics[1].keys()
    for key, of_whole in statistics[0].items():
        for name, values in of_whole.items():
            np.testing.assert_allclose(statistics[1][key][name], values, rtol=1e-12)


def test_nothing_is_appended_where_nothing_was_recorded(tmp_path):
    root = record(tmp_path / "set", [0], ["reach"])
    with pytest.raises(DatasetError, match="no episode was saved: the dataset stays as it was"):
        record(root, [], [], append=True)
    assert_holds(root, [0], ["reach"])
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fps": 30}, r"its frame rate is 50\.0, not 30\.0"),
        ({"robot_type": "panda"}, "its robot is 'any', not 'panda'"),
        ({"joint_names": ("a", "b", "d")}, "its joints is"),
        ({"cameras": {"front": (4, 6)}}, "gives? images of no camera|expected front"),
        ({"frames": {"base": "table"}}, "its reference frames is {'base': 'link0'}, not"),
    ],
)
def test_other_settings_than_the_datasets_are_refused(tmp_path, settings, message):
    root = record(tmp_path / "set", [0], ["reach"], frames={"base": "link0"})
    with pytest.raises(ValueError, match=message):
        record(root, [1], ["reach"], append=True, **settings)
    assert_holds(root, [0], ["reach"])
    assert list(tmp_path.iterdir()) == [root]


def test_there_must_be_something_to_append_to(tmp_path):
    with pytest.raises(DatasetError, match="there is no dataset"):
        record(tmp_path / "set", [0], ["reach"], append=True)
    assert not list(tmp_path.iterdir())


def test_a_broken_recording_leaves_the_dataset_whole_and_its_episodes_safe(tmp_path):
    root = record(tmp_path / "set", [0], ["reach"])
    with pytest.raises(KeyboardInterrupt) as raised:
        record(root, [1], ["place"], append=True, then=KeyboardInterrupt())
    assert "The 1 episodes saved" in raised.value.__notes__[0]
    assert_holds(root, [0], ["reach"])
    with pytest.raises(FileExistsError, match="recover_dataset") as raised:
        record(root, [2], ["pour"], append=True)
    # The command that it names, as pasted.
    command = shlex.split(str(raised.value).split("`")[1])
    assert command[0] == "hrc"
    assert not hrc(*command[1:]).status
    assert_holds(root, [0, 1], ["reach", "place"])
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.parametrize(
    ("append", "every"),
    [
        (True, 9),
        pytest.param(True, 1, marks=pytest.mark.slow),
        pytest.param(False, 1, marks=pytest.mark.slow),
    ],
)
def test_a_recording_cut_off_at_any_step_keeps_what_it_had_saved(tmp_path, append, every):
    """And leaves nothing else, nor loses anything of the dataset that it is appended to."""
    before, root, finished = tmp_path / "before", tmp_path / "here" / "set", 0
    record(before, [0], ["reach"])
    (before / "README.md").write_text("mine")
    root.parent.mkdir()
    saved = []

    def begin():
        shutil.rmtree(root, ignore_errors=True)
        saved.clear()
        if append:
            shutil.copytree(before, root)

    begin()
    lengths = [len(joint_path(40 + seed)) for seed in ((0, 1) if append else (1,))]
    recording = functools.partial(record, root, [1], ["place"], append=append, saved=saved)
    for _ in cut_off(recording, every):
        recover_all(root)
        found = [len(demo) for demo in load_demos(root)] if root.exists() else []
        # What is saved but not yet acknowledged may be there as well.
        assert found == lengths or (found == lengths[:-1] and not saved)
        assert not append or (root / "README.md").read_text() == "mine"
        assert list(root.parent.iterdir()) == [root] * root.exists()
        finished += found == lengths
        begin()
    assert finished > 5 / every  # some cuts come after the episode was saved


def test_a_file_of_the_users_own_stays_in_the_dataset(tmp_path):
    root = record(tmp_path / "set", [0], ["reach"])
    (root / "README.md").write_text("mine")
    (root / "meta" / "notes.txt").write_text("mine")
    for seed in (1, 2):
        record(root, [seed], ["place"], append=True)
    assert_holds(root, [0, 1, 2], ["reach", "place", "place"])
    assert (root / "README.md").read_text() == (root / "meta/notes.txt").read_text() == "mine"


def test_a_dataset_that_was_shortened_meanwhile_is_not_extended(tmp_path):
    root = record(tmp_path / "set", [0, 1], ["reach"] * 2)
    with pytest.raises(KeyboardInterrupt):
        record(root, [2], ["reach"], append=True, then=KeyboardInterrupt())
    one, both = tmp_path / "one", tmp_path / "both"
    write_curated(root, one, {0: Decision(verdict="reject", length=40)})
    root.rename(both)
    one.rename(root)
    with pytest.raises(DatasetError, match="holds 1 episodes, but 2 when the recording began"):
        recover_dataset(root)
    assert_holds(root, [1], ["reach"])
    root.rename(one)
    both.rename(root)
    recover_dataset(root)
    assert_holds(root, [0, 1, 2], ["reach"] * 3)


def test_what_was_kept_of_a_dataset_stays_with_the_longer_one(tmp_path):
    own = {"details": {"who": "me", "room": 1}, "frames": {"base": "link0"}}
    root = record(tmp_path / "set", [1, 2], ["a", "b"], **own)
    assert hrc("check", root, "--keep-contract").status == 0
    before = read_sidecar(root)
    assert before.contract
    record(root, [3], ["a"], append=True, details={"room": 2})
    after = read_sidecar(root)
    assert after.contract == before.contract
    assert after.details == {"who": "me", "room": 2}
    assert after.frames == {"base": "link0"}
    assert len(load_demos(root)) == 3


def test_a_dataset_behind_a_link_grows_there(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "set"
    link.symlink_to(tmp_path / "disk" / "set")
    record(link, [0], ["reach"])
    record(link, [1], ["place"], append=True)
    assert link.is_symlink()
    assert_holds(tmp_path / "disk" / "set", [0, 1], ["reach", "place"])
    assert sorted(tmp_path.rglob("set")) == [tmp_path / "disk" / "set", link]


def test_videos_are_appended_too(tmp_path):
    root, cameras = tmp_path / "set", {"front": (16, 24)}
    for append in (False, True):
        with DatasetWriter(root, 50, "any", ["a"], cameras=cameras, append=append) as writer:
            for _ in range(2):
                writer.start_episode("look")
                for k in range(12):
                    image = np.full((16, 24, 3), 20 * k, np.uint8)
                    writer.add_frame(joint_position=[0.01 * k], images={"front": image})
                writer.save_episode()
    assert len(list((root / "videos").glob("**/*.mp4"))) == 4
    assert len(load_demos(root)) == 4
    assert check_dataset(root).ok


def test_nothing_is_added_to_the_observations(tmp_path):
    features = read_info(record(tmp_path / "set", [0], ["reach"]))["features"]
    assert [key for key in features if key.startswith("observation")] == ["observation.state"]
