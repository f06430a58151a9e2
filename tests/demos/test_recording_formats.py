"""Recordings in the formats of other programs."""

import io

import numpy as np
import pytest
from recording_samples import (
    TIME,
    Q,
    RigidPath,
    aloha,
    plan,
    read,
    robomimic,
    write_hdf5,
    write_video_and_table,
)

from hrc_learn.demos import DatasetError, ImageReader
from hrc_learn.demos.recording_formats import _attributes, open_recordings
from hrc_learn.demos.recording_import import (
    write_plan,
)


def test_an_episode_of_aloha_has_arms_grippers_commands_and_images(tmp_path):
    arrays = aloha()
    write_hdf5(tmp_path / "episode_0.hdf5", arrays)
    made = plan(tmp_path / "episode_0.hdf5", fps=50)
    (one,) = made.episodes()
    arm = [*range(6), *range(7, 13)]
    q = arrays["observations/qpos"]
    np.testing.assert_allclose(one.demonstration.joint_position, q[:, arm])
    np.testing.assert_allclose(one.demonstration.command_position, arrays["action"][:, arm])
    np.testing.assert_allclose(one.demonstration.extra["observation.state"], q[:, [6, 13]])
    assert one.demonstration.joint_names[5:7] == ("left_wrist_rotate", "right_waist")
    assert made.meaning.kept["action"][1] == ("left_gripper.pos", "right_gripper.pos")
    assert made.meaning.cameras == {"cam_high": "observations/images/cam_high"}


def test_episodes_of_robomimic_come_in_counting_order_at_the_rate_of_the_file(tmp_path):
    arrays = robomimic(tmp_path / "lift.hdf5")
    made = plan(tmp_path / "lift.hdf5")
    demos = [one.demonstration for one in made.episodes()]
    assert [one.label for one in made.recordings] == [f"data/demo_{k}" for k in (0, 2, 10)]
    np.testing.assert_allclose(demos[1].position, RigidPath.position + 0.002)
    expected = RigidPath.turn.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demos[0].orientation * expected).sum(1)), 1)
    np.testing.assert_allclose(demos[0].gripper, 0.04)
    assert demos[0].fps == 20
    # Deltas of a controller for the hand are no commands of seven joints.
    assert demos[0].command_position is None
    np.testing.assert_array_equal(demos[0].extra["action"], arrays["data/demo_0/actions"])
    assert "obs/object" in made.meaning.left_out


@pytest.mark.parametrize("name", ["buffer.zarr", "buffer.zarr.zip"])
def test_a_replay_buffer_is_split_at_its_ends_and_kept_as_recorded(tmp_path, name):
    import zarr
    from zarr.storage import LocalStore, ZipStore

    action = np.random.default_rng(0).uniform(0, 500, (60, 2)).astype("f4")
    state = np.random.default_rng(1).uniform(0, 500, (60, 5)).astype("f4")
    store = (ZipStore if name.endswith("zip") else LocalStore)(
        tmp_path / name, **({"mode": "w"} if name.endswith("zip") else {})
    )
    group = zarr.open_group(store, mode="w", zarr_format=2)
    for key, values in (
        ("data/action", action),
        ("data/state", state),
        ("data/img", np.zeros((60, 32, 32, 3), "f4")),
        ("meta/episode_ends", np.array([25, 60])),
    ):
        group.create_array(key, data=values)
    store.close()
    made = plan(tmp_path / name, fps=10)
    demos = [one.demonstration for one in made.episodes()]
    assert [len(demo) for demo in demos] == [25, 35]
    np.testing.assert_array_equal(demos[1].extra["observation.state"], state[25:])
    np.testing.assert_array_equal(demos[1].extra["action"], action[25:])
    # Numbers up to 500 that nothing names are no joints.
    assert not made.meaning.selections
    assert made.meaning.cameras == {"img": "data/img"}


def test_cells_of_matlab_are_episodes_with_frames_in_their_columns(tmp_path):
    from scipy.io import savemat

    cells = np.empty(2, object)
    for k in range(2):
        note = {"operator": "A", "empty": np.zeros((0, 0)), "weight": 0.2}
        cells[k] = {"pos": 0.1 * Q.T + k, "t": TIME[None], "note": note}
    savemat(tmp_path / "demos.mat", {"demos": cells})
    demos = read(tmp_path / "demos.mat")
    np.testing.assert_allclose(demos[1].position, 0.1 * Q + 1)
    np.testing.assert_allclose(demos[1].time, TIME - TIME[0])


def test_a_matlab_file_of_version_7_3_is_read_with_its_axes_turned(tmp_path):
    write_hdf5(tmp_path / "run.mat", {"run/q": Q.T, "run/time": TIME[None]})
    content = (tmp_path / "run.mat").read_bytes()
    # MATLAB writes 512 bytes of its own before the HDF5 signature.
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    import h5py

    with h5py.File(tmp_path / "seven.mat", "w", userblock_size=512) as file:
        file["run/q"], file["run/time"] = np.ascontiguousarray(Q.T), TIME[None]
    with (tmp_path / "seven.mat").open("r+b") as stream:
        stream.write(header)
    assert content
    (demo,) = read(tmp_path / "seven.mat")
    np.testing.assert_allclose(demo.joint_position, Q)


def test_a_parquet_table_of_pandas_is_split_by_its_episodes(tmp_path):
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"episode": [0] * 15 + [1] * 25, "t": TIME, "qpos": [*Q]})
    frame.index += 3
    frame.to_parquet(tmp_path / "runs.parquet")
    demos = read(tmp_path / "runs.parquet")
    assert [len(demo) for demo in demos] == [15, 25]
    np.testing.assert_allclose(demos[1].joint_position, Q[15:])


def test_a_record_of_rlds_is_one_episode(tmp_path):
    from tfrecord.writer import TFRecordWriter

    writer = TFRecordWriter(str(tmp_path / "set-train.tfrecord-00000-of-00001"))
    for k in range(2):
        writer.write(
            {
                "steps/observation/joint_pos": ((Q + k).ravel().astype("f4"), "float"),
                "steps/action": (np.roll(Q + k, -1, 0).ravel().astype("f4"), "float"),
                "steps/is_first": (np.eye(40, dtype=int)[0], "int"),
                "steps/language_instruction": ([b"pour the water"] * 40, "byte"),
            }
        )
    writer.close()
    demos = read(tmp_path, fps=10)
    assert [demo.task for demo in demos] == ["pour the water"] * 2
    np.testing.assert_allclose(demos[1].joint_position, Q + 1, atol=1e-6)
    np.testing.assert_allclose(demos[1].command_position, np.roll(Q + 1, -1, 0), atol=1e-6)


def test_a_video_beside_a_table_is_a_camera_at_its_own_rate(tmp_path):
    write_video_and_table(tmp_path / "run")
    made = plan(tmp_path / "run")
    write_plan(made, tmp_path / "set", "any", True)
    assert made.meaning.cameras == {"front": "front"}
    shown = ImageReader(tmp_path / "set").read(0)["observation.images.front"]
    expected = 12.0 * np.minimum(np.arange(40) // 2, 19)
    # The encoder rounds, twice.
    np.testing.assert_allclose(shown.float().mean((1, 2, 3)), expected, atol=4)


@pytest.mark.parametrize(
    ("attributes", "details"),
    [
        ({"fps": 30}, {"fps": 30.0}),
        ({"Control_Freq": np.array([20])}, {"fps": 20.0}),
        ({"dt": 0.02}, {"fps": 50.0}),
        ({"dt": 0}, {}),
        ({"task": b"pour"}, {"task": "pour"}),
        ({"lang": "x" * 499}, {"task": "x" * 499}),
        ({"lang": "x" * 500}, {}),
        ({"fps": "fast", "task": 3}, {}),
        ({"env_args": '{"env_kwargs": {"control_freq": 20}}'}, {"fps": 20.0}),
        ({"fps": 30, "rate": 20}, {"fps": 30.0}),
    ],
)
def test_attributes_tell_the_rate_and_the_task(attributes, details):
    found = {}
    _attributes(attributes, found)
    assert found == details


def test_files_are_told_by_their_content(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 2)))
    content = path.read_bytes()
    (one,) = open_recordings(path)
    assert one.fields["array"].shape == (3, 2)
    with pytest.raises(DatasetError, match="3 column names for 2 columns"):
        open_recordings(path, ["a", "b", "c"])
    (one,) = open_recordings(path, ["a", "b"])
    assert [*one.fields] == ["a", "b"]
    path.write_bytes(content[:5])
    with pytest.raises(DatasetError, match="it is damaged"):
        open_recordings(path)
    for array in (np.zeros((0, 2)), np.array("x"), np.array(["x", "y"])):
        np.save(path, array)
        with pytest.raises(DatasetError, match="holds no frames of numbers"):
            open_recordings(path)
    stream = io.BytesIO()
    np.savez(stream, q=np.zeros((3, 2)), fps=np.array(20), task=np.array("pour"))
    path.write_bytes(stream.getvalue())
    (one,) = open_recordings(path)
    assert (one.fps, one.task, [*one.fields]) == (20, "pour", ["q"])
