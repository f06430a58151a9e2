"""Plain arrays become demonstrations, or say why they cannot."""

import io

import numpy as np
import pytest
from lerobot_folders import joint_path
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.array_import import (
    ArrayOptions,
    demonstrations_from_arrays,
    read_arrays,
)

TIME = np.cumsum(np.random.default_rng(0).uniform(0.002, 0.004, 40))
Q = joint_path(40)
TURN = Rotation.from_rotvec(Q)
Q_AND_O = {"joints": "q", "orientation": "o"}
POSE_COLUMNS = ("px", "py", "pz", "qw", "qx", "qy", "qz")


def read(path, columns=(), sources=None, **options):
    arrays = {name: text.split(",") for name, text in (sources or {}).items()}
    given = ArrayOptions(columns=columns, arrays=arrays, **options)
    return demonstrations_from_arrays(path, given)


def test_npz_by_array_names(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, t=TIME, q=np.rad2deg(Q), pos=100 * Q, R=TURN.as_quat(), note=np.array("x"))
    sources = {"joints": "q", "time": "t", "position": "pos", "orientation": "R"}
    units = {"joint_position": "deg", "position": "cm"}
    (demo,) = read(path, sources=sources, quaternion_order="xyzw", units=units, task="pour")
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
    demos = read(tmp_path / "poses.npy", POSE_COLUMNS, duration=5)
    assert len(demos) == 2
    assert demos[1].duration == pytest.approx(5)
    np.testing.assert_allclose(demos[1].position, Q[::-1])
    assert demos[0].joint_position is None
    assert demos[0].joint_names == ()


def test_npy_without_names_is_of_joints(tmp_path):
    np.save(tmp_path / "joints.npy", Q)
    (demo,) = read(tmp_path / "joints.npy", fps=100, joint_names=["x", "y", "z"])
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
    (bare,) = read(tmp_path / "bare.csv", ["t", "a", "b", "c"])
    for demo in (named, bare):
        np.testing.assert_allclose(demo.joint_position, Q)
        np.testing.assert_allclose(demo.time, TIME - TIME[0])


@pytest.mark.parametrize("header", ["", "time,q\n"])
def test_a_byte_order_mark_is_no_part_of_the_first_name(tmp_path, header):
    path = tmp_path / "run.csv"
    path.write_text(header + "0,1\n0.1,2\n0.2,3\n", encoding="utf-8-sig")
    (demo,) = read(path, [] if header else ["time", "q"])
    np.testing.assert_allclose(demo.time, [0, 0.1, 0.2])
    np.testing.assert_allclose(demo.joint_position, [[1], [2], [3]])


def test_names_of_several_words_are_not_taken_apart(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time,joint position 1,joint position 2\n\n0,1,2\n0.1,3,4\n")
    assert [*read_arrays(path)] == ["time", "joint position 1", "joint position 2"]


@pytest.mark.parametrize("name", ["duration", "fps"])
@pytest.mark.parametrize("value", [0, -1, float("inf")])
def test_durations_and_rates_are_positive(tmp_path, name, value):
    np.save(tmp_path / "joints.npy", Q)
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        read(tmp_path / "joints.npy", **{name: value})


@pytest.mark.parametrize(
    ("arrays", "sources", "message"),
    [
        ({"q": Q}, {}, "name the arrays of joints or poses.*it holds q"),
        ({"q": Q}, {"joints": "p"}, "no array 'p' for joints; it holds q"),
        ({"q": Q, "t": TIME[:-1]}, {"joints": "q", "time": "t"}, "differ in their numbers"),
        (
            {"a": Q[:, 0], "b": Q[:-1, 1], "t": TIME},
            {"joints": "a,b"},
            "differ in their numbers.*'a': .1, 40., 'b': .1, 39.",
        ),
        ({"q": Q[:1], "t": TIME[:1]}, {"joints": "q"}, "at least two frames, got 1"),
        ({"q": Q, "t": 0 * TIME}, {"joints": "q"}, "time must increase.*frame 0"),
        ({"q": Q}, {"joints": "q"}, "there are no stamps.*duration or fps"),
        ({"q": Q * np.nan, "t": TIME}, {"joints": "q"}, "episode 0: joints is nan at frame 0"),
        ({"q": Q, "t": TIME[::-1]}, {"joints": "q"}, "time must increase.*frame 0"),
        (
            {"o": np.ones((40, 4)), "t": TIME},
            {"orientation": "o"},
            "name the arrays of joints or poses",
        ),
        (
            {"o": np.ones((40, 4)), "q": Q, "t": TIME},
            {"joints": "q", "orientation": "o"},
            "of length 2",
        ),
        ({"o": Q[:, :2], "q": Q, "t": TIME}, {"joints": "q", "orientation": "o"}, "3 or 4 col"),
    ],
)
def test_arrays_that_are_no_demonstrations(tmp_path, arrays, sources, message):
    path = tmp_path / "run.npz"
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=message) as raised:
        read(path, sources=sources)
    assert raised.value.file == str(path)


def saved(save, *arrays, **named):
    """The bytes of a file of numpy's."""
    stream = io.BytesIO()
    save(stream, *arrays, **named)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", saved(np.savez, q=Q)[:-30], "cannot be read as numpy arrays"),
        ("a.npy", saved(np.save, Q)[:-30], "cannot be read as numpy arrays"),
        ("a.npy", saved(np.savez, q=Q), "its name should end in .npz"),
        ("a.npz", saved(np.save, Q), "its name should end in .npy"),
        ("a.npz", saved(np.savez, q=Q, o=np.array([{}])), "a.npz, o: cannot be read"),
        ("a.csv", "0,1\n0.1,2 °\n".encode("latin-1"), "a.csv: is not encoded in UTF-8"),
        ("a.csv", b"\n \n,,\n", "a.csv: is empty"),
        ("a.csv", b"t,q\n\n0,1\n0.1\n", "line 4 does not hold 2 numbers"),
        ("a.npy", b"junk", "cannot be read as numpy arrays"),
        ("a.npz", b"junk", "cannot be read as numpy arrays"),
        ("a.mat", b"junk", "neither .npz, .npy nor .csv"),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"t,q\n", "no numbers"),
        ("a.csv", b"t,q\n0,1\n0.1\n", "line 3 does not hold 2 numbers"),
        ("a.csv", b"0,1\n0.1,x\n", "line 2 does not hold 2 numbers"),
    ],
)
def test_files_that_are_no_arrays(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read_arrays(tmp_path / name)


def test_a_missing_file_and_wrong_column_names(tmp_path):
    with pytest.raises(DatasetError, match="not found"):
        read_arrays(tmp_path / "none.npy")
    np.save(tmp_path / "a.npy", Q)
    with pytest.raises(DatasetError, match="2 column names for 3 columns"):
        read_arrays(tmp_path / "a.npy", ["x", "y"])
    with pytest.raises(DatasetError, match="2 joint names for 3 columns"):
        read(tmp_path / "a.npy", fps=10, joint_names=["x", "y"])
