"""Recordings of every format become demonstrations, or say why they cannot."""

import io
import json

import cv2
import numpy as np
import pytest
from broken_copies import STATE
from lerobot_folders import joint_path, one_step_of_act, read_info
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError, ImageReader, load_demos
from hrc_learn.demos.recording_formats import open_recordings
from hrc_learn.demos.recording_import import plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions

TIME = np.cumsum(np.random.default_rng(0).uniform(0.002, 0.004, 40))
Q = joint_path(40)
TURN = Rotation.from_rotvec(Q)
Q_AND_O = {"joint_position": "q", "quaternion_wxyz": "o"}
POSE_COLUMNS = ("px", "py", "pz", "qw", "qx", "qy", "qz")


def plan(*paths, names=(), **options):
    return plan_import(paths, ImportOptions(**options), names)


def read(*paths, names=(), **options):
    return [one.demonstration for one in plan(*paths, names=names, **options).episodes()]


def test_npz_by_array_names(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, t=TIME, q=np.rad2deg(Q), pos=100 * Q, R=TURN.as_quat(), note=np.array("x"))
    columns = {"joint_position": "q", "position": "pos", "quaternion_xyzw": "R"}
    units = {"joint_position": "deg", "position": "cm"}
    (demo,) = read(path, columns=columns, time="t", units=units, task="pour")
    np.testing.assert_allclose(demo.joint_position, Q)
    np.testing.assert_allclose(demo.position, Q)
    np.testing.assert_allclose(demo.time + demo.start_time, TIME)
    assert demo.joint_names == ("joint1", "joint2", "joint3")
    assert (demo.fps, demo.task) == (round(1 / np.median(np.diff(TIME))), "pour")
    expected = TURN.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demo.orientation * expected).sum(1)), 1)


def test_npy_of_several_demonstrations_with_named_columns(tmp_path):
    pose = np.hstack([Q, TURN.as_quat(scalar_first=True)])
    np.save(tmp_path / "poses.npy", np.stack([pose, pose[::-1]]))
    demos = read(tmp_path / "poses.npy", names=POSE_COLUMNS, duration=5)
    assert len(demos) == 2
    assert demos[1].duration == pytest.approx(5)
    np.testing.assert_allclose(demos[1].position, Q[::-1])
    assert demos[0].joint_position is None
    assert demos[0].joint_names == ()


def test_npy_without_names_is_of_joints(tmp_path):
    np.save(tmp_path / "joints.npy", Q)
    (demo,) = read(tmp_path / "joints.npy", fps=100, joint_names=("x", "y", "z"))
    np.testing.assert_array_equal(demo.joint_position, Q)
    np.testing.assert_allclose(demo.time, np.arange(40) / 100)
    assert demo.joint_names == ("x", "y", "z")


@pytest.mark.parametrize("delimiter", [",", ";", " ", ", "])
def test_csv_with_and_without_a_header(tmp_path, delimiter):
    rows = [delimiter.join(map(repr, row)) for row in np.column_stack([TIME, Q]).tolist()]
    header = delimiter.join(["time", "j1", "j2", "j3"])
    (tmp_path / "named.csv").write_text("\n".join([header, *rows]))
    (tmp_path / "bare.csv").write_text("\n".join(rows) + "\n")
    (named,) = read(tmp_path / "named.csv")
    (bare,) = read(tmp_path / "bare.csv", names=["t", "a", "b", "c"])
    for demo in (named, bare):
        np.testing.assert_allclose(demo.joint_position, Q)
        np.testing.assert_allclose(demo.time, TIME - TIME[0])


@pytest.mark.parametrize("header", ["", "time,q\n"])
def test_a_byte_order_mark_is_no_part_of_the_first_name(tmp_path, header):
    path = tmp_path / "run.csv"
    path.write_text(header + "0,1\n0.1,2\n0.2,3\n", encoding="utf-8-sig")
    (demo,) = read(path, names=[] if header else ["time", "q"])
    np.testing.assert_allclose(demo.time, [0, 0.1, 0.2])
    np.testing.assert_allclose(demo.joint_position, [[1], [2], [3]])


def test_names_of_several_words_are_not_taken_apart(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time,joint position 1,joint position 2\n\n0,1,2\n0.1,3,4\n")
    (recording,) = open_recordings(path)
    assert [*recording.fields] == ["time", "joint position 1", "joint position 2"]


@pytest.mark.parametrize("name", ["duration", "fps"])
@pytest.mark.parametrize("value", [0, -1, float("inf")])
def test_durations_and_rates_are_positive(tmp_path, name, value):
    np.save(tmp_path / "joints.npy", Q)
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        read(tmp_path / "joints.npy", **{name: value})


@pytest.mark.parametrize(
    ("arrays", "columns", "message"),
    [
        ({"x": Q}, {}, "name the arrays of joints or poses.*it holds x"),
        (
            {"q": Q},
            {"joint_position": "p"},
            "no column 'p' for joint_position; there are features q",
        ),
        ({"q": Q, "t": TIME[:-2]}, {"joint_position": "q"}, "38 stamps for 40 frames"),
        (
            {"a": Q[:, 0], "b": Q[:-1, 1], "t": TIME},
            {"joint_position": ["a", "b"]},
            "differ in their numbers.*'a': 40, 'b': 39",
        ),
        ({"q": Q[:1], "t": TIME[:1]}, {"joint_position": "q"}, "at least two frames, got 1"),
        ({"q": Q, "t": 0 * TIME}, {"joint_position": "q"}, "time must increase.*frame 0"),
        ({"q": Q}, {"joint_position": "q"}, "there are no stamps.*duration or fps"),
        ({"q": Q * np.nan, "t": TIME}, {"joint_position": "q"}, "q: is nan at frame 0"),
        ({"q": Q, "t": TIME[::-1]}, {"joint_position": "q"}, "time must increase.*frame 0"),
        ({"o": np.ones((40, 4)), "q": Q, "t": TIME}, Q_AND_O, "of length 2"),
        ({"o": Q[:, :2], "q": Q, "t": TIME}, Q_AND_O, "quaternion_wxyz takes 4 columns"),
        ({"q": 1000 * np.arange(40), "t": TIME}, {"joint_position": "q[1:3]"}, "no range"),
        ({"q": Q, "t": np.arange(40)}, {}, "t: steps by 1: a count of frames"),
        ({"q": Q, "t": 200 * TIME}, {}, "t: steps by .*: s, ms, us or ns"),
    ],
)
def test_arrays_that_are_no_demonstrations(tmp_path, arrays, columns, message):
    path = tmp_path / "run.npz"
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=message) as raised:
        read(path, columns=columns)
    assert raised.value.file == str(path)


def saved(save, *arrays, **named):
    """The bytes of a file of numpy's."""
    stream = io.BytesIO()
    save(stream, *arrays, **named)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", saved(np.savez, q=Q)[:-30], "cannot be read"),
        ("a.npy", saved(np.save, Q)[:-30], "cannot be read"),
        ("a.npy", saved(np.save, np.array([{}, {}])), "holds pickled Python objects"),
        ("a.pkl", b"junk", "is a pickle"),
        ("a.h5", b"junk", "cannot be read"),
        ("a.parquet", b"junk", "cannot be read as Parquet"),
        ("a.tfrecord", b"junk" * 10, "ends within record 0"),
        ("a.mp4", b"junk", "is a video"),
        (
            "a.npz",
            saved(np.savez, q=Q, o=np.array([{}])),
            "a.npz, o: holds pickled Python objects",
        ),
        ("a.csv", "0,1\n0.1,2 °\n".encode("latin-1"), "a.csv: is not encoded in UTF-8"),
        ("a.csv", b"\n \n,,\n", "a.csv: is empty"),
        ("a.csv", b"t,q\n\n0,1\n0.1\n", "line 4 does not hold 2 numbers"),
        ("a.npy", b"junk", "cannot be read"),
        ("a.npz", b"junk", "cannot be read"),
        ("a.mat", b"junk", "cannot be read"),
        ("a.doc", b"junk", "is of no kind"),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"t,q\n", "no numbers"),
        ("a.csv", b"t,q\n0,1\n0.1\n", "line 3 does not hold 2 numbers"),
        ("a.csv", b"0,1\n0.1,x\n", "line 2 does not hold 2 numbers"),
    ],
)
def test_files_that_are_no_arrays(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        open_recordings(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content"), [("a.npy", saved(np.savez, array=Q)), ("a.npz", saved(np.save, Q))]
)
def test_numpy_files_are_told_by_their_content(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    (recording,) = open_recordings(tmp_path / name)
    np.testing.assert_array_equal(recording.fields["array"].numbers(), Q)


def test_a_missing_file_and_wrong_column_names(tmp_path):
    with pytest.raises(DatasetError, match="not found"):
        open_recordings(tmp_path / "none.npy")
    np.save(tmp_path / "a.npy", Q)
    with pytest.raises(DatasetError, match="2 column names for 3 columns"):
        open_recordings(tmp_path / "a.npy", ("x", "y"))
    with pytest.raises(DatasetError, match="2 joint names for 3 columns"):
        read(tmp_path / "a.npy", fps=10, joint_names=("x", "y"))


def write_hdf5(path, arrays, attributes=None):
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        for place, named in (attributes or {}).items():
            for name, value in named.items():
                file[place].attrs[name] = value


def aloha(frames=40):
    q = joint_path(frames, 14)
    images = np.random.default_rng(0).integers(0, 255, (frames, 32, 48, 3), np.uint8)
    return {
        "observations/qpos": q,
        "observations/qvel": np.gradient(q, 0.02, axis=0),
        "observations/images/cam_high": images,
        "action": np.roll(q, -1, axis=0),
    }


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


def robomimic(path, order=(2, 0, 10)):
    arrays, pose = {}, RigidPath()
    for k in order:
        group = f"data/demo_{k}"
        arrays |= {
            f"{group}/obs/robot0_eef_pos": pose.position + 0.001 * k,
            f"{group}/obs/robot0_eef_quat": pose.turn.as_quat(),
            f"{group}/obs/robot0_joint_pos": joint_path(40, 7),
            f"{group}/obs/robot0_gripper_qpos": np.tile([0.02, -0.02], (40, 1)),
            f"{group}/obs/object": joint_path(40, 10),
            f"{group}/next_obs/robot0_eef_pos": pose.position,
            f"{group}/actions": np.random.default_rng(k).uniform(-1, 1, (40, 7)),
            f"{group}/rewards": np.zeros(40),
        }
    settings = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
    write_hdf5(path, arrays, {"data": {"env_args": settings}})
    return arrays


class RigidPath:
    position = 0.1 * Q + 0.5
    turn = Rotation.from_rotvec(Q)


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
        cells[k] = {"pos": 0.1 * Q.T + k, "t": TIME[None]}
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


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (",time,j1,j2\n0,0.0,1,2\n1,0.1,3,4\n2,0.2,5,6\n", ("j1", "j2")),
        ("time;j1;j2\n0,0;1,0;2,0\n0,1;3,0;4,0\n0,2;5,0;6,0\n", ("j1", "j2")),
        ("time\tj1\tj2\tphase\n0,0\t1\t2\tgo\n0,1\t3\t4\tgo\n0,2\t5\t6\tstop\n", ("j1", "j2")),
        ("# time j1 j2\n0.0 1 2\n0.1 3 4\n# pause\n0.2 5 6\n", ("j1", "j2")),
        ("0,0 1,0 2,0\n0,1 3,0 4,0\n0,2 5,0 6,0\n", ("a", "b")),
        ("t,q1,q2,\n2024-05-01 12:00:00.0,1,2,\n2024-05-01 12:00:00.1,3,4,\n"
         "2024-05-01 12:00:00.2,5,6,\n", ("joint1", "joint2")),
        ("stamp_ms|joint_1|joint_2\n0|1|2\n100|3|4\n200|5|6\n", ("joint_1", "joint_2")),
        ("timestamp,actual_q_0,actual_q_1,temperature\n"
         "1700000000.0,1,2,30\n1700000000.1,3,4,31\n1700000000.2,5,6,32\n", None),
    ],
)  # fmt: skip
def test_text_tables_as_programs_write_them(tmp_path, content, names):
    path = tmp_path / "run.csv"
    path.write_text(content)
    (demo,) = read(path, names=("t", "a", "b") if content[0] == "0" else ())
    np.testing.assert_allclose(demo.time, [0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(demo.joint_position, [[1, 2], [3, 4], [5, 6]])
    if names:
        assert demo.joint_names == names


def test_transforms_are_poses_and_those_of_a_camera_are_not(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURN.as_matrix(), Q
    np.savez(tmp_path / "a.npz", poses=poses, camera_extrinsics=poses, t=TIME)
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)
    expected = TURN.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demo.orientation * expected).sum(1)), 1)
    assert "camera_extrinsics" in plan(tmp_path / "a.npz").meaning.left_out


@pytest.mark.parametrize(("name", "shape"), [("H", (40, 4, 4)), ("hand_pose", (40, 16))])
def test_transforms_are_known_by_their_shape_or_by_sixteen_numbers_of_a_pose(
    tmp_path, name, shape
):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = Q
    np.savez(tmp_path / "a.npz", **{name: poses.reshape(shape), "t": TIME})
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)


def test_slower_sensors_hold_their_last_value_and_know_no_future(tmp_path):
    time, slow = np.arange(100) / 100, np.arange(12) / 10 - 0.05
    write_hdf5(
        tmp_path / "run.h5",
        {
            "robot/time": time + 5,
            "robot/q": joint_path(100),
            "tool/time": slow + 5,
            "tool/gripper": 0.001 * np.arange(12),
            "camera/stamps": slow[::2] + 5,
            "camera/image": np.zeros((6, 32, 32, 3), np.uint8),
        },
    )
    (one,) = plan(tmp_path / "run.h5").episodes()
    expected = np.floor((time + 0.05) * 10 + 1e-9)
    np.testing.assert_allclose(one.demonstration.gripper, 0.001 * expected)
    np.testing.assert_array_equal(one.images["image"][1], np.floor((time + 0.05) * 5 + 1e-9))


def test_frames_before_a_sensor_speaks_are_cut_and_a_silent_one_is_named(tmp_path):
    time = np.arange(200) / 100
    arrays = {"robot/time": time, "robot/q": joint_path(200), "tool/time": time[50::5]}
    arrays["tool/gripper"] = np.full(30, 0.01)
    write_hdf5(tmp_path / "late.h5", arrays)
    (one,) = plan(tmp_path / "late.h5").episodes()
    assert len(one.demonstration) == 150
    assert "50 frames without tool/gripper are cut" in one.notes[0]
    arrays["tool/time"] = np.concatenate([time[:50:5], time[100::5]])
    write_hdf5(tmp_path / "gap.h5", arrays)
    with pytest.raises(DatasetError, match=r"gap.h5, tool/gripper|silent for too long at"):
        list(plan(tmp_path / "gap.h5").episodes())


def test_links_and_pickles_are_not_followed(tmp_path):
    import h5py
    import zarr

    write_hdf5(tmp_path / "other.h5", {"q": Q})
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["q"] = h5py.ExternalLink("other.h5", "q")
    with pytest.raises(DatasetError, match=r"linked.h5, q: is a link"):
        open_recordings(tmp_path / "linked.h5")
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    group.create_array("q", data=Q)
    meta = json.loads((tmp_path / "a.zarr/q/.zarray").read_text())
    meta["filters"] = [{"id": "pickle", "protocol": 5}]
    (tmp_path / "a.zarr/q/.zarray").write_text(json.dumps(meta))
    with pytest.raises(DatasetError, match="pickle"):
        open_recordings(tmp_path / "a.zarr")
    (tmp_path / "b").mkdir()
    (tmp_path / "b/run.npz").symlink_to(tmp_path / "other.h5")
    with pytest.raises(DatasetError, match="is a link"):
        open_recordings(tmp_path / "b")


def test_a_unit_that_the_file_declares_counts(tmp_path):
    write_hdf5(tmp_path / "run.h5", {"q": Q, "t": TIME}, {"q": {"units": "degrees"}})
    (demo,) = read(tmp_path / "run.h5")
    np.testing.assert_allclose(demo.joint_position, np.deg2rad(Q))


def test_large_values_are_no_radians(tmp_path):
    np.savez(tmp_path / "a.npz", q=np.rad2deg(Q), t=TIME)
    made = plan(tmp_path / "a.npz")
    np.testing.assert_allclose(next(made.episodes()).demonstration.joint_position, Q)
    assert "taken for deg" in made.meaning.warnings[0]
    said = plan(tmp_path / "a.npz", units={"joint_position": "rad"})
    assert "degrees?" in said.meaning.warnings[0]


def test_six_numbers_of_a_pose_do_not_tell_their_angles(tmp_path):
    np.savez(tmp_path / "a.npz", tcp_pose=0.1 * joint_path(40, 6), t=TIME)
    made = plan(tmp_path / "a.npz")
    assert next(made.episodes()).demonstration.orientation is None
    assert "euler_xyz" in made.meaning.left_out["tcp_pose[3:6]"]


def test_an_array_without_names_that_holds_quaternions_is_asked_about(tmp_path):
    np.save(tmp_path / "a.npy", np.hstack([Q, TURN.as_quat()]))
    with pytest.raises(DatasetError, match="unit length, as a quaternion has"):
        plan(tmp_path / "a.npy", fps=10)


def test_lengths_in_cm_or_mm_are_asked_about(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = 40 * (0.3 + 0.1 * Q)
    np.savez(tmp_path / "a.npz", eef_pos=poses[:, :3, 3], t=TIME)
    np.savez(tmp_path / "b.npz", tcp_pose=poses, t=TIME)
    for path, role in ((tmp_path / "a.npz", "position"), (tmp_path / "b.npz", "pose_matrix")):
        with pytest.raises(DatasetError, match=f"doubtful.*--units {role} mm"):
            plan(path)
        (demo,) = read(path, units={role: "mm"})
        np.testing.assert_allclose(demo.position, 1e-3 * poses[:, :3, 3])


@pytest.mark.parametrize("scale", [0.04, 1.0])
def test_a_gripper_at_the_end_of_the_joints_is_asked_about(tmp_path, scale):
    opening = scale * (np.arange(40) > 20)
    two = np.column_stack([joint_path(40, 7), *[0.02 + 0.02 * Q[:, 0] ** 2] * 2])
    one = np.column_stack([joint_path(40, 6), opening])
    for name, values, columns in (("two", two, "[7:9]"), ("one", one, "[6:7]")):
        np.savez(tmp_path / f"{name}.npz", qpos=values, t=TIME)
        try:
            (said,) = plan(tmp_path / f"{name}.npz").meaning.warnings
        except DatasetError as error:  # a column of some centimetres is no joint in rad
            said = str(error)
        assert f"--gripper qpos{columns}" in said
    np.savez(tmp_path / "arm.npz", qpos=joint_path(40, 7), t=TIME)
    assert not plan(tmp_path / "arm.npz").meaning.warnings


def test_the_order_of_a_quaternion_without_names_is_asked_about(tmp_path):
    pose = np.hstack([Q, TURN.as_quat()])
    np.savez(tmp_path / "a.npz", tcp_pose=pose, t=TIME)
    made = plan(tmp_path / "a.npz")
    assert next(made.episodes()).demonstration.orientation is None
    assert "quaternion_wxyz or" in made.meaning.left_out["tcp_pose[3:7]"]
    columns = {"position": "tcp_pose[0:3]", "quaternion_xyzw": "tcp_pose[3:7]"}
    (demo,) = read(tmp_path / "a.npz", columns=columns)
    expected = TURN.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((demo.orientation * expected).sum(1)), 1)


def test_a_table_of_lerobot_has_joints_commands_and_grippers(tmp_path):
    names = ("shoulder", "elbow", "gripper")
    head = [f"{kind}.{n}.pos" for kind in ("observation.state", "action") for n in names]
    rows = np.column_stack([TIME, joint_path(40, 2), TIME, joint_path(40, 2) + 0.01, 2 * TIME])
    np.savetxt(
        tmp_path / "a.csv", rows, delimiter=",", header="t," + ",".join(head), comments=""
    )
    made = plan(tmp_path / "a.csv")
    (one,) = made.episodes()
    assert one.demonstration.joint_names == names[:2]
    np.testing.assert_allclose(one.demonstration.gripper, TIME)
    np.testing.assert_allclose(one.demonstration.command_position, joint_path(40, 2) + 0.01)
    assert made.meaning.kept["action"][1] == ("gripper.pos",)
    assert "no commands were recorded" not in "\n".join(made.lines())
    # The same table without its commands.
    text = "t," + ",".join(head[:3])
    np.savetxt(tmp_path / "b.csv", rows[:, :4], delimiter=",", header=text, comments="")
    bare = plan(tmp_path / "b.csv")
    for actions, made_of in ((True, "next states are the actions"), (False, "has no actions")):
        assert made_of in "\n".join(bare.lines(actions))


def test_rx_ry_rz_may_be_angles(tmp_path):
    rows = np.column_stack([TIME, Q, 0.1 * Q])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y,z,rx,ry,rz", comments="")
    assert "euler_xyz" in " ".join(plan(tmp_path / "a.csv").meaning.notes)


def test_cameras_are_named_by_the_end_of_their_path_or_left_out(tmp_path):
    frames = np.zeros((40, 32, 48, 3), np.uint8)
    write_hdf5(tmp_path / "a.h5", {"q": Q, "t": TIME, "obs/top": frames, "obs/side": frames})
    made = plan(tmp_path / "a.h5", images={"front": "top"})
    assert made.meaning.cameras == {"front": "obs/top"}
    assert "obs/side" in made.meaning.left_out
    with pytest.raises(
        DatasetError, match="no column 'back' for front; there are features obs"
    ):
        plan(tmp_path / "a.h5", images={"front": "back"})
    with pytest.raises(DatasetError, match="q holds no images"):
        plan(tmp_path / "a.h5", images={"front": "q"})


def test_a_topic_of_ros_as_a_table(tmp_path):
    head = "%time," + ",".join(
        f"field.{n}{k}" for n in ("position", "velocity") for k in range(3)
    )
    rows = [[int(1.7e18 + 1e7 * k), *q, *q] for k, q in enumerate(Q.tolist())]
    lines = [head, *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "joint_states.csv").write_text("\n".join(lines))
    (demo,) = read(tmp_path / "joint_states.csv")
    np.testing.assert_allclose(demo.joint_position, Q)
    np.testing.assert_allclose(demo.joint_velocity, Q)
    np.testing.assert_allclose(np.diff(demo.time), 0.01, atol=1e-6)


def test_arrays_that_count_are_episodes(tmp_path):
    arrays = {f"{name}_{k}": (Q + k)[: 30 + k] for name in ("qpos", "actions") for k in (0, 1)}
    write_hdf5(tmp_path / "a.h5", arrays)
    demos = read(tmp_path / "a.h5", fps=10)
    assert [len(demo) for demo in demos] == [30, 31]
    np.testing.assert_allclose(demos[1].joint_position, (Q + 1)[:31])


def buffer(**arrays):
    """A file of one array for each name, after each other in one buffer."""
    return lambda path: np.savez(path / "a.npz", **({"q": Q} | arrays))


def clocks(**arrays):
    """A file of states at their own stamps, with further fields."""
    given = {name.replace("__", "/"): values for name, values in arrays.items()}
    content = {"robot/time": np.arange(40) / 20, "robot/q": Q} | given
    return lambda path: write_hdf5(path / "a.h5", content)


def kept_elsewhere(path):
    import h5py

    with h5py.File(path / "a.h5", "w") as file:
        file.create_dataset("q", (40, 3), "f8", external=[("raw.bin", 0, h5py.h5f.UNLIMITED)])


def of_two_rates(path):
    for number, rate in enumerate((20, 30)):
        np.savez(path / f"run_{number}.npz", q=Q, t=np.arange(40) / rate)


def dataset(path):
    (path / "meta").mkdir()
    (path / "meta/info.json").write_text("{}")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (dataset, "is a LeRobot dataset already: `hrc check`"),
        (lambda path: (path / "notes.txt.bak").touch(), "holds no recording that is read here"),
        (kept_elsewhere, "a.h5, q: is kept in another file: not opened"),
        (
            buffer(episode_ends=np.array([10, 50])),
            r"up to the 40 frames there are, got \[10, 50",
        ),
        (buffer(episode_ends=np.array([20, 20, 40])), r"must increase up to the 40 frames"),
        (buffer(episode_ends=np.array([0, 40])), r"must increase up to the 40 frames"),
        (
            buffer(episode=np.repeat([0, 1, 0, 2], 10)),
            "numbers the episodes, but comes back to earlier ones",
        ),
        (
            buffer(q=np.stack([Q] * 3), u=np.stack([Q] * 2)),
            "(q|u): holds (2|3) demonstrations, other arrays hold (2|3)",
        ),
        (buffer(t=np.where(np.arange(40) == 7, np.nan, TIME)), "t: is nan at frame 7"),
        (
            clocks(tool__time=100 + np.arange(40) / 20, tool__gripper=np.full(40, 0.01)),
            r"clocks of tool/gripper and of the state do not overlap",
        ),
        (
            clocks(gripper=np.full(30, 0.01)),
            "it has 30, the state 40, and no stamps are its own",
        ),
    ],
)
def test_recordings_that_cannot_be_read_say_why(tmp_path, write, message):
    write(tmp_path)
    with pytest.raises(DatasetError, match=message):
        read(
            *([tmp_path] if write is dataset else [*tmp_path.glob("a.*")] or [tmp_path]), fps=20
        )


def test_other_rates_need_one_for_the_dataset(tmp_path):
    of_two_rates(tmp_path)
    with pytest.raises(ValueError, match=r"frame rates differ: 20 \(run_0.npz\), 30 \(run_1"):
        write_plan(plan(tmp_path), tmp_path / "set", "any", True)
    write_plan(plan(tmp_path, fps=25), tmp_path / "set", "any", True)
    for demo, rate in zip(load_demos(tmp_path / "set"), (20, 30), strict=True):
        np.testing.assert_allclose(np.diff(demo.time), 1 / rate)


def test_quantities_that_do_not_exist_are_named():
    with pytest.raises(ValueError, match="unknown quantity 'wrench'; known are time, joint"):
        ImportOptions(columns={"wrench": "x"})
    ImportOptions(columns={"observation.wrench": "x", "action": "u", "joint_effort": "tau"})


@pytest.mark.parametrize(
    ("flags", "lengths"),
    [
        ({"dones": np.arange(40) % 10 == 9}, [10, 10, 10, 10]),
        ({"dones": np.arange(40) == 24}, [25, 15]),
        ({"terminals": np.arange(40) == 14, "timeouts": np.arange(40) == 29}, [15, 15, 10]),
    ],
)
def test_flags_end_episodes_after_their_frame(tmp_path, flags, lengths):
    np.savez(tmp_path / "a.npz", q=Q, **{name: f.astype(float) for name, f in flags.items()})
    demos = read(tmp_path / "a.npz", fps=10)
    assert [len(demo) for demo in demos] == lengths
    np.testing.assert_array_equal(np.concatenate([d.joint_position for d in demos]), Q)


def test_a_table_of_named_columns_in_one_array(tmp_path):
    kinds = [("time", "f8"), ("j1", "f8"), ("j2", "f8"), ("j3", "f8")]
    rows = [(t, *row) for t, row in zip(TIME.tolist(), Q.tolist(), strict=True)]
    np.save(tmp_path / "a.npy", np.array(rows, kinds))
    (demo,) = read(tmp_path / "a.npy")
    np.testing.assert_array_equal(demo.joint_position, Q)
    np.testing.assert_allclose(demo.time, TIME - TIME[0])


def test_arrays_of_one_folder_are_one_recording_and_folders_in_it_several(tmp_path):
    for number in range(2):
        folder = tmp_path / f"run_{number}"
        folder.mkdir()
        np.save(folder / "qpos.npy", Q + number)
        np.save(folder / "gripper.npy", np.full(40, 0.01 * number))
    demos = read(tmp_path, fps=10)
    for number, demo in enumerate(demos):
        np.testing.assert_array_equal(demo.joint_position, Q + number)
        np.testing.assert_array_equal(demo.gripper, 0.01 * number)


def test_the_last_observation_may_have_no_action(tmp_path):
    """Of n + 1 states and n actions, the last action counts for two."""
    np.savez(tmp_path / "a.npz", qpos=Q, actions=Q[1:])
    (one,) = plan(tmp_path / "a.npz", fps=10).episodes()
    expected = np.concatenate([Q[1:], Q[-1:]])
    np.testing.assert_array_equal(one.demonstration.command_position, expected)


def test_transforms_of_three_rows_are_poses(tmp_path):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURN.as_matrix(), Q
    np.savez(tmp_path / "a.npz", ee_pose=poses[:, :3], t=TIME)
    (demo,) = read(tmp_path / "a.npz")
    np.testing.assert_allclose(demo.position, Q)
    turned = Rotation.from_quat(demo.orientation, scalar_first=True)
    assert (turned * TURN.inv()).magnitude().max() < 1e-9


def test_images_are_written_from_bytes_and_from_real_numbers(tmp_path):
    """Levels up to 1 are fractions of 255; images of one size are padded to no other."""
    levels = np.linspace(0, 1, 40)
    flat = np.ones((40, 32, 48, 3), "f4") * levels[:, None, None, None]
    coded = [cv2.imencode(".png", np.full((32, 48, 3), k, np.uint8))[1] for k in range(40)]
    rows = np.zeros((40, max(map(len, coded))), np.uint8)
    for row, data in zip(rows, coded, strict=True):
        row[: len(data)] = data.ravel()
    depth = np.full((40, 32, 48), 900, np.uint16)
    arrays = {"qpos": Q, "images/flat": flat, "images/coded": rows, "images/depth": depth}
    write_hdf5(tmp_path / "a.h5", arrays)
    made = plan(tmp_path / "a.h5", fps=10)
    assert {*made.meaning.cameras} == {"flat", "coded"}
    write_plan(made, tmp_path / "set", "any", True)
    shown = ImageReader(tmp_path / "set").read(0)
    for name, expected in (("flat", 255 * levels), ("coded", np.arange(40))):
        mean = shown[f"observation.images.{name}"].float().mean((1, 2, 3))
        np.testing.assert_allclose(mean, expected, atol=4)  # the encoder rounds, twice


def test_commands_that_joints_do_not_follow_are_kept_as_recorded(tmp_path):
    away = np.random.default_rng(1).uniform(-1, 1, Q.shape)
    columns = {f"joint_{k}": Q[:, k] for k in range(3)}
    columns |= {f"target_joint_{k}": away[:, k] for k in range(3)}
    header = ",".join(["time", *columns])
    rows = np.column_stack([TIME, *columns.values()])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="")
    made = plan(tmp_path / "a.csv")
    (one,) = made.episodes()
    assert one.demonstration.command_position is None
    np.testing.assert_allclose(one.demonstration.extra["action"], away)
    assert any("do not follow the recorded action" in note for note in made.meaning.notes)


def test_joint_velocities_of_other_joints_are_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", qpos=Q, qvel=Q[:, :2], t=TIME)
    columns = {"joint_position": "qpos", "joint_velocity": "qvel"}
    made = plan(tmp_path / "a.npz", columns=columns)
    (one,) = made.episodes()
    assert one.demonstration.joint_velocity is None
    assert made.meaning.left_out["qvel"] == "2 columns for 3 joints"


def write_pusht(path):
    import zarr

    rng = np.random.default_rng(0)
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    group.create_array("data/state", data=rng.uniform(0, 500, (60, 5)).astype("f4"))
    group.create_array("data/action", data=rng.uniform(0, 500, (60, 2)).astype("f4"))
    group.create_array("data/img", data=rng.uniform(0, 255, (60, 32, 32, 3)).astype("f4"))
    group.create_array("meta/episode_ends", data=np.array([25, 60]))


def write_video_and_table(path):
    import av

    path.mkdir()
    rows = np.column_stack([np.arange(40) / 20, Q])
    np.savetxt(path / "run.csv", rows, delimiter=",", header="t,j1,j2,j3", comments="")
    with av.open(str(path / "run_front.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in range(20):
            image = np.full((48, 64, 3), 12 * level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def test_a_video_beside_a_table_is_a_camera_at_its_own_rate(tmp_path):
    write_video_and_table(tmp_path / "run")
    made = plan(tmp_path / "run")
    write_plan(made, tmp_path / "set", "any", True)
    assert made.meaning.cameras == {"front": "front"}
    shown = ImageReader(tmp_path / "set").read(0)["observation.images.front"]
    expected = 12.0 * np.minimum(np.arange(40) // 2, 19)
    # The encoder rounds, twice.
    np.testing.assert_allclose(shown.float().mean((1, 2, 3)), expected, atol=4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "write", "options"),
    [
        ("aloha.hdf5", lambda path: write_hdf5(path, aloha()), {"fps": 50}),
        ("lift.hdf5", robomimic, {}),
        ("pusht.zarr", write_pusht, {"fps": 10}),
        ("run", write_video_and_table, {}),
        ("a.npz", lambda path: np.savez(path, q=Q, t=TIME), {}),
    ],
)
def test_lerobot_trains_on_what_was_imported(tmp_path, name, write, options):
    write(tmp_path / name)
    write_plan(plan(tmp_path / name, **options), tmp_path / "set", "any", True)
    features = read_info(tmp_path / "set")["features"]
    seen = [key for key in features if key.startswith("observation.")]
    assert all(key == STATE or key.startswith("observation.images.") for key in seen)
    assert np.isfinite(one_step_of_act(tmp_path / "set", 20))
