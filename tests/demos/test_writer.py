"""What is recorded comes back, and a recording that breaks off is neither lost nor whole."""

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot_folders import joint_path
from power_cuts import cut_off

from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    Demonstration,
    check_dataset,
    load_demos,
    recover_all,
    recover_dataset,
)

JOINTS = ("panda_joint1", "panda_joint2", "panda_joint3")


def frame(k: int, q: np.ndarray, seed: int = 0) -> dict:
    """Everything a frame can hold, made from the joint positions."""
    half = 0.02 * k + seed  # past a half turn within 160 frames
    return {
        "time": 100.0 + 0.0201 * k,
        "joint_position": q,
        "joint_velocity": 2 * q,
        "joint_effort": 3 * q,
        "position": q / 2,
        "orientation": [np.cos(half), 0.6 * np.sin(half), 0.0, 0.8 * np.sin(half)],
        "gripper": 0.04,
        "feature": [700.5 + k, 500.25],
        "feature_visible": k % 3 != 0,
        "human_effort": -q,
        "command_velocity": q + 1,
        "observation.shelf": [1.0, 2.0],
    }


def record(root, lengths=(160, 40), tasks=("reach", "place")):
    motions = [joint_path(n, seed=i) for i, n in enumerate(lengths)]
    with DatasetWriter(
        root, 50, "panda", JOINTS, {"observation.shelf": ["row", "column"]}
    ) as writer:
        for index, motion in enumerate(motions):
            writer.start_episode(tasks[index % len(tasks)])
            for k, q in enumerate(motion):
                writer.add_frame(**frame(k, q, index))
            assert writer.save_episode() == index
    return motions


def test_everything_recorded_comes_back(tmp_path):
    motions = record(tmp_path / "set")
    tolerance = 1e-6  # of float32
    demos = load_demos(tmp_path / "set")
    assert demos.joint_names == JOINTS
    assert demos.notes == ()  # the sidecar spares every guess
    for index, (demo, q) in enumerate(zip(demos, motions, strict=True)):
        assert (demo.task, demo.fps) == (("reach", "place")[index], 50.0)
        np.testing.assert_allclose(demo.time, 0.0201 * np.arange(len(q)), atol=1e-9)
        assert demo.start_time == 100.0
        np.testing.assert_allclose(demo.joint_position, q, atol=tolerance)
        np.testing.assert_allclose(demo.joint_velocity, 2 * q, atol=2 * tolerance)
        np.testing.assert_allclose(demo.joint_effort, 3 * q, atol=3 * tolerance)
        np.testing.assert_allclose(demo.position, q / 2, atol=tolerance)
        np.testing.assert_allclose(demo.human_effort, -q, atol=tolerance)
        np.testing.assert_allclose(demo.command_velocity, q + 1, atol=2 * tolerance)
        np.testing.assert_allclose(demo.feature[:, 0], 700.5 + np.arange(len(q)), rtol=1e-7)
        np.testing.assert_array_equal(demo.feature_visible, np.arange(len(q)) % 3 != 0)
        np.testing.assert_allclose(demo.gripper, 0.04, atol=tolerance)
        np.testing.assert_array_equal(demo.extra["observation.shelf"][0], [1, 2])
        assert demo.command_position is None
        given = np.array([frame(k, row, index)["orientation"] for k, row in enumerate(q)])
        assert np.abs((demo.orientation * given).sum(1)).min() > 1 - 1e-6
        assert np.abs(np.diff(demo.orientation, axis=0)).max() < 0.03
    assert check_dataset(tmp_path / "set").ok


def test_rotation_vectors_on_disk_do_not_jump_past_a_half_turn(tmp_path):
    record(tmp_path / "set")
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    names = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    columns = [names["observation.state"]["names"].index(f"ee.w{axis}") for axis in "xyz"]
    state = np.stack(table.column("observation.state").to_numpy())[:160]
    assert np.linalg.norm(state[:, columns], axis=1).max() > np.pi
    assert np.abs(np.diff(state[:, columns], axis=0)).max() < 0.1


def test_one_row_group_an_episode(tmp_path):
    record(tmp_path / "set", lengths=(30, 20, 25))
    metadata = pq.read_metadata(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert [metadata.row_group(i).num_rows for i in range(3)] == [30, 20, 25]


def test_large_recordings_are_cut_into_files_between_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr("hrc_learn.demos.read.metadata.FILE_SIZE_MB", 0.02)
    motions = record(tmp_path / "set", lengths=(60, 60))
    assert len(list((tmp_path / "set/data/chunk-000").iterdir())) > 1
    for demo, q in zip(load_demos(tmp_path / "set"), motions, strict=True):
        np.testing.assert_allclose(demo.joint_position, q, atol=1e-6)
    assert check_dataset(tmp_path / "set").ok


@settings(max_examples=8)
@given(
    lengths=st.lists(st.integers(2, 30), min_size=1, max_size=4),
    width=st.integers(1, 9),
    has_pose=st.booleans(),
)
def test_whole_demonstrations_come_back(tmp_path_factory, lengths, width, has_pose):
    root = tmp_path_factory.mktemp("any") / "set"
    names = tuple(f"j{i}" for i in range(width))
    rng = np.random.default_rng(len(lengths))
    given_demos = [
        Demonstration(
            time=np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 0.03, n - 1))]),
            joint_position=rng.normal(size=(n, width)),
            position=rng.normal(size=(n, 3)) if has_pose else None,
            joint_names=names,
            fps=50,
            start_time=12.5,
            task=f"task {i % 2}",
        )
        for i, n in enumerate(lengths)
    ]
    with DatasetWriter(root, 50, "any", names) as writer:
        for demo in given_demos:
            writer.add_episode(demo)
    read = load_demos(root)
    assert len(read) == len(lengths)
    for before, after in zip(given_demos, read, strict=True):
        stored = before.joint_position.astype(np.float32)
        np.testing.assert_array_equal(after.joint_position, stored)
        np.testing.assert_allclose(before.time, after.time, atol=1e-12)
        assert (before.task, before.start_time) == (after.task, after.start_time)
        assert (after.position is None) != has_pose


def test_without_stamps_frames_are_one_period_apart(tmp_path):
    with DatasetWriter(tmp_path / "set", 30, "any", JOINTS) as writer:
        writer.start_episode("")
        for q in joint_path(12):
            writer.add_frame(joint_position=q)
        writer.save_episode()
    np.testing.assert_allclose(load_demos(tmp_path / "set")[0].time, np.arange(12) / 30)


def test_a_feature_that_is_not_seen_need_not_be_a_number(tmp_path):
    with DatasetWriter(tmp_path / "set", 30, "any") as writer:
        writer.start_episode("")
        writer.add_frame(feature=[np.nan, np.nan], feature_visible=False)
        writer.add_frame(feature=[3.0, 4.0], feature_visible=True)
        writer.save_episode()
    demo = load_demos(tmp_path / "set")[0]
    np.testing.assert_array_equal(demo.feature, [[0, 0], [3, 4]])
    np.testing.assert_array_equal(demo.feature_visible, [False, True])


def test_arrays_are_copied_when_a_frame_is_added(tmp_path):
    buffer = np.zeros(3)
    with DatasetWriter(tmp_path / "set", 30, "any", JOINTS) as writer:
        writer.start_episode("")
        for k in range(3):
            buffer[:] = k
            writer.add_frame(joint_position=buffer)
        writer.save_episode()
    assert load_demos(tmp_path / "set")[0].joint_position[:, 0].tolist() == [0, 1, 2]


def test_an_existing_folder_is_refused(tmp_path):
    (tmp_path / "set").mkdir()
    with pytest.raises(FileExistsError, match="already exists"):
        DatasetWriter(tmp_path / "set", 50, "any")
    assert list(tmp_path.iterdir()) == [tmp_path / "set"]


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ({"joint_position": [1, 2]}, None, r"joint_position needs 3 numbers"),
        ({"speed": 1.0}, None, r"'speed' is no quantity of a frame; known are joint_position"),
        (
            {"gripper": 1.0},
            {"position": [1, 2, 3]},
            r"frame 1 lacks gripper and adds position",
        ),
    ],
)
def test_frames_that_do_not_fit_are_refused(tmp_path, first, second, message):
    with pytest.raises(ValueError, match=message):
        record_one(tmp_path / "set", [first, second])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([{"joint_position": [0, np.nan, 0]}], "episode 0 .*joint_position .*frame 0"),
        ([{"time": 1.0}, {"time": 1.0}], "time must increase.*frame 0"),
        ([{"orientation": [1, 1, 0, 0]}], "unit quaternion.*frame 0"),
        ([], "episode 0 has no frames"),
    ],
)
def test_episodes_no_reader_could_use_are_refused(tmp_path, frames, message):
    with pytest.raises(ValueError, match=message):
        record_one(tmp_path / "set", frames)
    assert list(tmp_path.iterdir()) == []


def test_an_episode_unlike_the_first_is_refused_and_the_first_kept(tmp_path):
    with writing(tmp_path / "set") as writer:
        writer.start_episode("")
        writer.add_frame(gripper=0.1)
        writer.save_episode()
        writer.start_episode("")
        writer.add_frame(position=[0, 0, 0])
        with pytest.raises(ValueError, match=r"episode 1 was not saved: lacks gripper"):
            writer.save_episode()
    assert len(load_demos(tmp_path / "set")) == 1


def test_episodes_are_started_and_ended_in_order(tmp_path):
    with writing(tmp_path / "set") as writer:
        with pytest.raises(RuntimeError, match="start_episode"):
            writer.add_frame(gripper=0.1)
        writer.start_episode("")
        writer.add_frame(gripper=0.1)
        with pytest.raises(RuntimeError, match="1 unsaved frames"):
            writer.start_episode("")
        with pytest.raises(RuntimeError, match="1 unsaved frames"):
            writer.finalize()
        writer.discard_episode()
        writer.start_episode("")
        writer.add_frame(gripper=0.2)
        writer.save_episode()
    assert load_demos(tmp_path / "set")[0].gripper == pytest.approx([0.2])


def test_a_recording_without_episodes_leaves_nothing(tmp_path):
    with pytest.raises(DatasetError, match="no episode was saved"), writing(tmp_path / "set"):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"fps": 0}, "fps must be positive, got 0"),
        ({"joint_names": ("a", "b", "a")}, "joint names must differ.*'a', 'b', 'a'"),
        ({"joint_names": ("a", "")}, "joint names must .*not be empty, got .*'a', ''"),
        ({"features": {"shelf": ("row",)}}, "LeRobot understands: 'observation.shelf'"),
    ],
)
def test_settings_that_no_reader_understands_are_refused(tmp_path, wrong, fault):
    with pytest.raises(ValueError, match=fault):
        DatasetWriter(tmp_path / "set", **({"fps": 50, "robot_type": "any"} | wrong))
    assert not list(tmp_path.iterdir())


def test_other_joints_pictures_in_drafts_and_other_columns_are_refused(tmp_path):
    root, time = tmp_path / "set", np.arange(9) / 50
    other = Demonstration(time=time, fps=50, joint_position=np.ones((9, 1)), joint_names=("b",))
    with DatasetWriter(root, 50, "any", ["a"]) as writer:
        with pytest.raises(ValueError, match=r"joints \('b',\) are not the dataset's \('a',\)"):
            writer.add_episode(other)
        writer.add_episode(replace(other, joint_names=("a",)))

    def append() -> None:
        with DatasetWriter(root, 50, "any", ["a"], append=True) as writer:
            writer.start_episode("reach")
            for _ in range(3):
                writer.add_frame(joint_velocity=[0.0])
            writer.save_episode()

    with pytest.raises(ValueError, match=r"cannot append to .*set: observation\.state.* there"):
        append()
    assert len(load_demos(root)) == 1

    def draft() -> None:
        with DatasetWriter(tmp_path / "seen", 50, "any", cameras={"front": (8, 8)}) as writer:
            writer.write_draft("reach", [{"gripper": 0.1}])

    with pytest.raises(RuntimeError, match="a draft holds no images"):
        draft()


@pytest.mark.parametrize("kind", ["missing", "damaged"])
def test_an_interrupted_recording_that_is_not_whole_is_named(tmp_path, kind):
    root = tmp_path / "set"

    def record_three() -> None:
        with DatasetWriter(root, 50, "any") as writer:
            for _ in range(3):
                writer.start_episode("reach")
                for _ in range(4):
                    writer.add_frame(gripper=0.1)
                writer.save_episode()
            raise OSError("lost")

    with pytest.raises(OSError, match="lost"):
        record_three()
    staged = sorted((tmp_path / "set.recording").rglob("episode_*.parquet"))
    assert len(staged) == 3
    if kind == "missing":
        staged[1].unlink()
        fault = "is missing from the recording; rename the later files"
    else:
        pq.write_table(pq.read_table(staged[1]).replace_schema_metadata({}), staged[1])
        fault = "no episode of a recording"
    with pytest.raises(DatasetError, match=fault) as raised:
        recover_dataset(root)
    assert str(raised.value.file).endswith("episode_000001.parquet")
    assert not root.exists()


def test_an_exception_keeps_the_saved_episodes_for_recovery(tmp_path):
    root = tmp_path / "set"
    with pytest.raises(OSError, match="robot lost") as raised:
        record_one(root, [{"gripper": 0.1}], then=OSError("robot lost"))
    assert "recover_dataset" in raised.value.__notes__[0]
    assert not root.exists()
    with pytest.raises(DatasetError, match="recover_dataset"):
        load_demos(root)
    with pytest.raises(FileExistsError, match="recover_dataset"):
        DatasetWriter(root, 50, "any")
    assert recover_dataset(root) == root
    assert len(load_demos(root)) == 1
    assert list(tmp_path.iterdir()) == [root]
    with pytest.raises(FileNotFoundError, match="no interrupted recording"):
        recover_dataset(root)


KILLED = textwrap.dedent(
    """
    import sys
    import numpy as np
    from hrc_learn.demos import DatasetWriter

    writer = DatasetWriter(sys.argv[1], 50, "any", ["a", "b"])
    for episode in range(10_000):
        writer.start_episode("reach")
        for k in range(20):
            writer.add_frame(joint_position=[episode, k])
        writer.save_episode()
        print(writer.episodes, flush=True)
    """
)


def kill_and_recover(root, seconds):
    """Kill a recording so long after its first episode was saved; what was and is there."""
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(root)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    first = process.stdout.readline()
    time.sleep(seconds)
    os.kill(process.pid, signal.SIGKILL)
    announced = int([first, *process.stdout.readlines()][-1])
    process.wait()
    assert not root.exists()  # nothing that looks whole
    return announced, load_demos(recover_dataset(root))


@pytest.mark.long
def test_a_killed_recording_loses_the_open_episode_at_most(tmp_path):
    announced, demos = kill_and_recover(tmp_path / "set", 0.05)
    assert announced <= len(demos) <= announced + 1
    assert [demo.joint_position[0, 0] for demo in demos] == list(range(len(demos)))
    assert check_dataset(tmp_path / "set").ok


@pytest.mark.slow
def test_whenever_a_recording_is_killed(tmp_path):
    moments = np.random.default_rng(0).uniform(0, 0.5, 20)
    for index, seconds in enumerate(moments):
        announced, demos = kill_and_recover(tmp_path / f"set{index}", seconds)
        assert announced <= len(demos) <= announced + 1


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_a_recovery_that_was_killed_starts_anew(tmp_path, every):
    root = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        record_one(root, [{"gripper": 0.1}], then=KeyboardInterrupt())
    interrupted = tmp_path / "interrupted"
    shutil.copytree(root.with_name("set.recording"), interrupted)
    mended = 0
    for _ in cut_off(lambda: recover_dataset(root), every):
        recover_all(root)
        assert len(load_demos(root)) == 1
        assert sorted(tmp_path.iterdir()) == [interrupted, root]
        shutil.rmtree(root)
        shutil.copytree(interrupted, root.with_name("set.recording"))
        mended += 1
    assert mended > 20 / every


def test_a_recording_killed_before_its_first_episode_is_no_obstacle(tmp_path):
    root, staging = tmp_path / "set", tmp_path / "set.recording"
    staging.mkdir()
    (staging / "front.unfinished.mp4").write_bytes(b"half")
    record_one(root, [{"gripper": 0.1}])
    assert list(tmp_path.iterdir()) == [root]
    staging.mkdir()
    with pytest.raises(DatasetError, match="no episode was saved"):
        recover_dataset(tmp_path / "set")
    assert list(tmp_path.iterdir()) == [root]


def test_a_recording_that_goes_on_is_left_alone(tmp_path):
    root = tmp_path / "set"
    with writing(root) as writer:
        with pytest.raises(FileExistsError, match=f"is being written by process {os.getpid()}"):
            writing(root)
        with pytest.raises(FileExistsError, match="is being written"):
            recover_dataset(root)
        writer.start_episode("")
        writer.add_frame(gripper=0.1)
        writer.save_episode()
    assert len(load_demos(root)) == 1


@pytest.mark.parametrize("name", ["notes.txt", "episode_1/raw.bin"])
def test_a_users_file_in_the_recording_is_kept(tmp_path, name):
    root = tmp_path / "set"
    with writing(root) as writer:
        writer.start_episode("")
        writer.add_frame(gripper=0.1)
        writer.save_episode()
        file = tmp_path / "set.recording" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    assert (tmp_path / "set.recording.kept" / name).read_text() == "mine"
    assert len(load_demos(root)) == 1


def test_a_folder_of_somebody_else_is_no_recording(tmp_path):
    """Though it is called like one."""
    other = tmp_path / "set.recording"
    (other / "episode_1").mkdir(parents=True)
    files = {"episode_0.mp4", "episode_000000.parquet", "episode_1/raw.bin", "notes.txt"}
    for name in files:
        (other / name).write_text("mine")
    assert recover_all(tmp_path) == []
    with pytest.raises(FileNotFoundError, match="no interrupted recording"):
        recover_dataset(tmp_path / "set")
    with pytest.raises(FileExistsError, match="is not touched: move it away"):
        writing(tmp_path / "set")
    left = {str(path.relative_to(other)) for path in other.rglob("*") if path.is_file()}
    assert left == files
    assert [path.name for path in tmp_path.iterdir()] == ["set.recording"]


def record_one(root, frames, then=None):
    with writing(root) as writer:
        writer.start_episode("reach")
        for values in frames:
            writer.add_frame(**values)
        writer.save_episode()
        if then is not None:
            raise then


def test_a_recovery_does_not_replace_a_dataset(tmp_path):
    root = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        record_one(root, [{"gripper": 0.1}], then=KeyboardInterrupt())
    root.mkdir()
    with pytest.raises(FileExistsError, match="move"):
        recover_dataset(root)
    root.rmdir()
    assert len(load_demos(recover_dataset(root))) == 1


def writing(root):
    return DatasetWriter(root, 50, "any", JOINTS)
