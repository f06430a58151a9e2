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
        ({"dt": -0.02, "fps": 30}, {"fps": 30.0}),
        ({"fps": -30}, {}),
        ({"fps": 0, "rate": np.inf, "hz": np.nan}, {}),
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


def test_an_hdf5_file_gives_what_its_nodes_hold(tmp_path):
    import h5py

    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["task"], file.attrs["fps"] = "pour", 25
        arm = file.create_group("arm")
        arm.attrs["language_instruction"] = "stir"  # the first one counts
        arm["q"], arm["force"], arm["turned"] = Q, Q, Q
        arm["q"].attrs["units"], arm["force"].attrs["units"] = b"degree", "Nm"
        file["control_freq"], file["rows"], file["type"] = 50, np.zeros((0, 3)), np.dtype("f4")
        file["table"] = np.zeros(40, [("a", "f8")])
        layout = h5py.VirtualLayout((40, 3), float)
        layout[:] = h5py.VirtualSource(file["arm/q"])
    (one,) = open_recordings(path)
    assert {name: field.unit for name, field in one.fields.items()} == {
        "arm/q": "deg",
        "arm/force": "N m",
        "arm/turned": "",
    }
    assert (one.task, one.fps) == ("pour", 25)
    np.testing.assert_array_equal(one.fields["arm/q"].read(3, 7), Q[3:7])
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset("copy", layout)
    with pytest.raises(DatasetError, match=r"a\.h5, copy: is in another file"):
        open_recordings(path)
    with h5py.File(path, "a") as file:
        del file["copy"]
        file["again"] = h5py.SoftLink("/arm/q")
    with pytest.raises(DatasetError, match=r"a\.h5, again: is a link"):
        open_recordings(path)


def test_a_zarr_store_gives_its_arrays(tmp_path):
    import zarr

    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    group.attrs["rate"], group.attrs["task"] = 12, "pour"
    group.create_array("data/q", data=Q)
    group.create_array("data/empty", data=np.zeros((0, 2)))
    group.create_array("data/one", data=np.array(3.0))
    (one,) = open_recordings(tmp_path / "a.zarr")
    assert (one.fps, one.task, [*one.fields]) == (12, "pour", ["data/q"])
    np.testing.assert_array_equal(one.fields["data/q"].read(3, 7), Q[3:7])
    (tmp_path / "a.zarr/data/more").symlink_to(tmp_path)
    with pytest.raises(DatasetError, match="more: is a link"):
        open_recordings(tmp_path / "a.zarr")


def test_matlab_structures_and_cells_are_named_by_their_places(tmp_path):
    from scipy.io import savemat

    cells = np.empty((1, 2), object)
    cells[0, 0], cells[0, 1] = Q.T, 2 * Q.T
    content = {
        "robot": {"q": Q.T, "flag": TIME[None] > 0.05, "name": "x"},
        "force": cells,
        "goal": [[1.0, 2.0, 3.0]],
        "table": np.ones((3, 40, 2)),
        "fps": 30.0,
        "task": "pour",
    }
    savemat(tmp_path / "a.mat", content)
    parts = open_recordings(tmp_path / "a.mat")
    assert len(parts) == 3
    for part in parts:
        assert (part.fps, part.task) == (30, "pour")
        expected = {
            "robot/q": Q,
            "robot/flag": TIME > 0.05,
            "force/0": Q,
            "force/1": 2 * Q,
            "goal": [1, 2, 3],
            "table": np.ones((40, 2)),
        }
        assert part.fields.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(part.fields[name].read(0, 40), values)


def test_frames_of_matlab_are_as_many_as_most_arrays_have(tmp_path):
    """Arrays of MATLAB 7.3 are transposed; those with their frames first stay."""
    import h5py

    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["q"], file["u"], file["t"] = Q.T, 2 * Q, TIME[None]
        file["gain"], file["square"] = np.ones((3, 7)), np.arange(9.0).reshape(3, 3)
    with (tmp_path / "a.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    (one,) = open_recordings(tmp_path / "a.mat")
    for name, values in (
        ("q", Q),
        ("u", 2 * Q),
        ("t", TIME[:, None]),
        ("gain", np.ones((3, 7))),
        ("square", np.arange(9.0).reshape(3, 3)),
    ):
        np.testing.assert_array_equal(one.fields[name].numbers(), values)


def write_records(path, *records):
    from tfrecord.writer import TFRecordWriter

    writer = TFRecordWriter(str(path))
    for record in records:
        writer.write(record)
    writer.close()


def test_a_record_gives_steps_of_numbers_texts_and_images(tmp_path):
    jpeg = b"\xff\xd8\xff\xe0"
    steps = {
        "steps/q": (Q.ravel().astype("f4"), "float"),
        "steps/reward": (np.arange(40), "int"),
        "steps/image": ([jpeg + bytes([k]) for k in range(40)], "byte"),
        "steps/note": ([b"a"] * 40, "byte"),
        "steps/observation/task": ([b"pour"] * 40, "byte"),
        "steps/optional": ([], "float"),
        "episode/number": ([3], "int"),
    }
    path = tmp_path / "set.tfrecord"
    write_records(path, steps, steps)
    parts = open_recordings(path)
    labels = [(part.label, part.task) for part in parts]
    assert labels == [("record 0", "pour"), ("record 1", "pour")]
    fields = parts[1].fields
    assert {name: field.kind for name, field in fields.items()} == {
        "q": "number",
        "reward": "number",
        "image": "encoded",
        "note": "text",
        "observation/task": "text",
    }
    np.testing.assert_allclose(fields["q"].numbers(), Q, atol=1e-6)
    np.testing.assert_array_equal(fields["reward"].numbers()[:, 0], np.arange(40))
    assert fields["image"].read(3, 5).tolist() == [jpeg + b"\3", jpeg + b"\4"]
    assert fields["image"].frames == 40
    content = path.read_bytes()
    half = len(content) // 2
    for size, record in ((half - 1, 0), (half + 5, 1), (2 * half - 1, 1)):
        path.write_bytes(content[:size])
        with pytest.raises(DatasetError, match=f"ends within record {record}: copy it again"):
            open_recordings(path)
    path.write_bytes(content[:half])
    assert len(open_recordings(path)) == 1


def test_a_record_whose_numbers_do_not_divide_by_its_steps_is_named(tmp_path):
    numbers = {"steps/q": (np.ones(8, "f4"), "float"), "steps/u": (np.ones(11, "f4"), "float")}
    write_records(tmp_path / "set.tfrecord", numbers)
    with pytest.raises(DatasetError, match="record 0/steps/u: holds 11 numbers for 8 steps"):
        open_recordings(tmp_path / "set.tfrecord")


def saved(folder, *names, values=Q):
    folder.mkdir(exist_ok=True)
    for name in names:
        np.save(folder / f"{name}.npy", values)
    return folder


def test_files_of_a_folder_that_count_are_episodes_and_others_belong_together(tmp_path):
    counted = open_recordings(saved(tmp_path / "a", "run_10", "run_9", ".run_1"))
    assert [part.file.name for part in counted] == ["run_9.npy", "run_10.npy"]
    (together,) = open_recordings(saved(tmp_path / "b", "qpos", "u"))
    assert together.file.name == "b"
    assert [*together.fields] == ["qpos", "u"]
    np.savez(tmp_path / "b/more.npz", x=Q)
    (together,) = open_recordings(tmp_path / "b")
    assert [*together.fields] == ["more/x", "qpos", "u"]
    (alone,) = open_recordings(saved(tmp_path / "c", "qpos"))
    assert [*alone.fields] == ["array"]
    # Files of several episodes each are not joined.
    several = open_recordings(saved(tmp_path / "d", "qpos", "u", values=np.stack([Q, Q])))
    assert len(several) == 4
    saved(tmp_path / "e")
    for number in (10, 9):
        saved(tmp_path / f"e/run_{number}", "q")
    found = open_recordings(tmp_path / "e")
    assert [part.file.parent.name for part in found] == ["run_9", "run_10"]
    (tmp_path / "e/notes.npy").symlink_to(tmp_path / "c/qpos.npy")
    with pytest.raises(DatasetError, match=r"notes\.npy: is a link"):
        open_recordings(tmp_path / "e")


def test_a_video_belongs_to_the_episode_whose_name_it_begins_with(tmp_path):
    write_video_and_table(tmp_path / "run")
    folder = tmp_path / "run"
    video, table = (folder / "run_front.mp4").read_bytes(), (folder / "run.csv").read_bytes()

    def cameras():
        return [
            sorted(name for name, field in part.fields.items() if field.kind == "image")
            for part in open_recordings(folder)
        ]

    (one,) = open_recordings(folder)
    front = one.fields["front"]
    assert (front.shape, front.rate) == ((20, 48, 64, 3), 10)
    # A stream that promises more images than it holds repeats the last one.
    levels = [image.mean() for image in front.read(15, 23)]
    np.testing.assert_allclose(levels, 12 * np.r_[15:20, 19, 19, 19], atol=3)
    (folder / "run_front.mp4").rename(folder / "Side.MP4")
    assert cameras() == [["Side"]]
    (folder / "Side.MP4").unlink()
    (folder / "run.csv").unlink()
    for number in (1, 10):
        (folder / f"run_{number}.csv").write_bytes(table)
    (folder / "run_1.mp4").write_bytes(video)
    (folder / "run_10-left.mp4").write_bytes(video)
    (folder / "other.mp4").write_bytes(video)
    assert cameras() == [["run_1"], ["left"]]
    notes = [part.notes for part in open_recordings(folder)]
    text = "videos left out, as their names do not begin with a file's name: other.mp4"
    assert notes == [(text,), ()]


def test_a_file_of_several_episodes_takes_no_video(tmp_path):
    write_video_and_table(tmp_path / "run")
    (tmp_path / "run/run.csv").unlink()
    np.save(tmp_path / "run/run.npy", np.stack([Q, Q]))
    with pytest.raises(DatasetError, match=r"run\.npy: holds several episodes, but its"):
        open_recordings(tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.MP4", "is a video: give the folder of the video and its states"),
        ("a.PKL", "is a pickle, which can run any program"),
        ("a.docx", r"has none of the known formats: \.csv, \.tsv"),
        ("a.bag.active", "has none of the known formats"),
    ],
)
def test_files_that_are_not_opened(tmp_path, name, text):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(DatasetError, match=text):
        open_recordings(tmp_path / name)
    with pytest.raises(DatasetError, match=f"other-{name}: not found"):
        open_recordings(tmp_path / f"other-{name}")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", Q),
        ("a.npy", Q[0]),
        ("a.npy", np.ones((2, 3), bool)),
        ("a.npy", Q.astype("i2")),
    ],
)
def test_an_array_without_a_name_is_kept_whole(tmp_path, name, content):
    np.save(tmp_path / name, content)
    (one,) = open_recordings(tmp_path / name)
    assert [*one.fields] == ["array"]
    np.testing.assert_array_equal(
        one.fields["array"].numbers(), content.reshape(len(content), -1)
    )
