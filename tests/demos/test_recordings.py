"""Recordings become demonstrations, or say why they cannot."""

import io
import json

import cv2
import numpy as np
import pytest
from broken_copies import STATE
from lerobot_folders import one_step_of_act, read_info
from recording_samples import (
    TIME,
    TURN,
    Q,
    aloha,
    plan,
    read,
    robomimic,
    write_hdf5,
    write_video_and_table,
)

from hrc_learn.demos import DatasetError, ImageReader, load_demos
from hrc_learn.demos.recording_formats import open_recordings
from hrc_learn.demos.recording_import import write_plan
from hrc_learn.demos.recording_names import ImportOptions

Q_AND_O = {"joint_position": "q", "quaternion_wxyz": "o"}


POSE_COLUMNS = ("px", "py", "pz", "qw", "qx", "qy", "qz")


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
    with pytest.raises(ValueError, match=f"{name} must be (positive|finite), but is {value}"):
        read(tmp_path / "joints.npy", **{name: value})


@pytest.mark.parametrize(
    ("arrays", "columns", "message"),
    [
        ({"x": Q}, {}, "name the arrays of joints or poses.*there are x"),
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
        ({"o": Q[:, :2], "q": Q, "t": TIME}, Q_AND_O, "quaternion_wxyz needs 4 columns"),
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
        ("a.doc", b"junk", "has none of the known formats"),
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
        (dataset, "is a LeRobot dataset already: use `hrc check`"),
        (lambda path: (path / "notes.txt.bak").touch(), "holds no recording that is read here"),
        (kept_elsewhere, "a.h5, q: is in another file, and not read"),
        (
            buffer(episode_ends=np.array([10, 50])),
            r"exceed the 40 frames of the arrays, got \[10, 50",
        ),
        (
            buffer(episode_ends=np.array([20, 20, 40])),
            "and not exceed the 40 frames",
        ),
        (buffer(episode_ends=np.array([0, 40])), "and not exceed the 40 frames"),
        (
            buffer(episode=np.repeat([0, 1, 0, 2], 10)),
            "numbers the episodes, but repeats an earlier number",
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
            "has 30 frames, but the state 40; without stamps",
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


def write_pusht(path):
    import zarr

    rng = np.random.default_rng(0)
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    group.create_array("data/state", data=rng.uniform(0, 500, (60, 5)).astype("f4"))
    group.create_array("data/action", data=rng.uniform(0, 500, (60, 2)).astype("f4"))
    group.create_array("data/img", data=rng.uniform(0, 255, (60, 32, 32, 3)).astype("f4"))
    group.create_array("meta/episode_ends", data=np.array([25, 60]))


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
