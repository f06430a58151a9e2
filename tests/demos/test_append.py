"""Episodes added to a dataset that is there already."""

from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import joint_path, read_info

from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    check_dataset,
    load_demos,
    recover_dataset,
)

JOINTS = ("a", "b", "c")


def record(root, seeds, tasks, *, append=False, then=None, **settings):
    settings = {"fps": 50, "robot_type": "any", "joint_names": JOINTS, **settings}
    with DatasetWriter(root, append=append, **settings) as writer:
        for seed, task in zip(seeds, tasks, strict=True):
            writer.start_episode(task)
            for k, q in enumerate(joint_path(40 + seed, seed=seed)):
                writer.add_frame(time=0.02 * k, joint_position=q, command_position=q + 0.1)
            writer.save_episode()
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


def test_nothing_is_appended_where_nothing_was_recorded(tmp_path):
    root = record(tmp_path / "set", [0], ["reach"])
    with pytest.raises(DatasetError, match="no episode was saved"):
        record(root, [], [], append=True)
    assert_holds(root, [0], ["reach"])
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fps": 30}, r"its frame rate is 50\.0, not 30\.0"),
        ({"robot_type": "panda"}, "its robot is 'any', not 'panda'"),
        ({"joint_names": ("a", "b", "d")}, "its joints is"),
        ({"dtype": "float64"}, "observation.state there is"),
        ({"cameras": {"front": (4, 6)}}, "gives? images of no camera|expected front"),
    ],
)
def test_other_settings_than_the_datasets_are_refused(tmp_path, settings, message):
    root = record(tmp_path / "set", [0], ["reach"])
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
    with pytest.raises(FileExistsError, match="recover_dataset"):
        record(root, [2], ["pour"], append=True)
    assert recover_dataset(root) == root
    assert_holds(root, [0, 1], ["reach", "place"])
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.parametrize("survives", range(5))
def test_finalizing_may_be_broken_off_at_any_step(tmp_path, monkeypatch, survives):
    """Whichever folder is renamed last, `recover_dataset` gets everything."""
    root = record(tmp_path / "set", [0], ["reach"])
    renamed, rename = [], Path.rename

    def die(path, target):
        if path.is_dir() and len(renamed) >= survives:
            raise KeyboardInterrupt
        renamed.append(path)
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", die)
    try:
        record(root, [1], ["place"], append=True)
    except KeyboardInterrupt:
        assert survives < 3
    monkeypatch.setattr(Path, "rename", rename)
    if survives < 3:
        recover_dataset(root)
    assert_holds(root, [0, 1], ["reach", "place"])
    assert list(tmp_path.iterdir()) == [root]


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
