"""Frames of an episode as they are checked, completed, laid out and written."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.read.contract import Sidecar
from hrc_learn.demos.recorded_episode import RecordingHeader

pytestmark = pytest.mark.simulation

WIDTHS = {"joint_position": 2, "gripper": 1, "position": 3}


def test_a_frame_is_a_copy_of_its_numbers():
    q = np.array([1.0, 2])
    row = recorded.frame_row({"joint_position": q, "gripper": 3}, WIDTHS, [])
    q[0] = 9
    assert {name: values.tolist() for name, values in row.items()} == {
        "joint_position": [1, 2],
        "gripper": [3],
    }


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (
            {"cup": 1.0},
            "'cup' is no quantity of a frame; known are joint_position, gripper",
        ),
        (
            {"joint_position": [1.0]},
            r"frame 0: joint_position needs 2 numbers, got shape \(1",
        ),
        ({"joint_position": [[1.0, 2.0]]}, r"needs 2 numbers, got shape \(1, 2\)"),
        ({"joint_position": [1.0, 2, 3]}, r"needs 2 numbers, got shape \(3,\)"),
        ({"gripper": []}, r"gripper needs 1 numbers, got shape \(0,\)"),
    ],
)
def test_a_frame_that_does_not_fit(values, text):
    with pytest.raises(ValueError, match=text):
        recorded.frame_row(values, WIDTHS, [])


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (["joint_position"], "frame 2 lacks gripper: all frames need the quantities of the"),
        (["joint_position", "gripper", "position"], "frame 2 adds position: all"),
        (["position"], "frame 2 lacks gripper, joint_position and adds position: all"),
    ],
)
def test_frames_of_an_episode_hold_the_same_quantities(names, text):
    given = {"joint_position": [1.0, 2], "gripper": 3.0, "position": [1.0, 2, 3]}
    first = {name: np.zeros(1) for name in ("joint_position", "gripper")}
    with pytest.raises(ValueError, match=text):
        recorded.frame_row({name: given[name] for name in names}, WIDTHS, [first, first])


def test_frames_are_stacked():
    frames = [{"q": np.array([k, 2.0 * k])} for k in range(3)]
    np.testing.assert_array_equal(recorded.stacked(frames)["q"], [[0, 0], [1, 2], [2, 4]])
    assert recorded.stacked([]) == {}


def test_stamps_and_visibility_are_completed():
    feature = np.array([[1.0, 2], [np.nan, 3], [np.inf, np.nan]])
    seen = np.array([1.0, 0, 0])
    got = recorded.complete({"feature": feature, "feature_visible": seen}, 50)
    np.testing.assert_allclose(got["time"], [0, 0.02, 0.04])
    np.testing.assert_array_equal(got["feature"], [[1, 2], [0, 3], [0, 0]])
    assert got["feature_visible"].tolist() == [[True], [False], [False]]
    bare = recorded.complete({"feature": feature[:, ::-1]}, 50)
    assert bare["feature_visible"].all()
    assert np.isnan(bare["feature"]).sum() == 2
    own = recorded.complete({"time": np.array([0.0, 5, 6]), "q": feature}, 50)
    assert own["time"].tolist() == [0, 5, 6]
    assert "feature" not in own


TURN = np.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0], [0, 0, 1, 0]])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, None),
        ({"q": np.array([[1.0, 2], [1, np.nan], [np.inf, 0]])}, "q is not finite at frame 1"),
        ({"time": np.array([0.0, 1, 1])}, "time must increase, but does not after frame 1"),
        ({"time": np.array([[2.0], [1], [3]])}, "does not after frame 0"),
        ({"orientation": TURN * [[1], [1.0009], [1]]}, None),
        ({"orientation": TURN * [[1], [1], [1.0011]]}, "wxyz.* not at frame 2"),
        ({"orientation": TURN * [[1], [0.9989], [1]]}, "wxyz.* not at frame 1"),
    ],
)
def test_values_that_no_reader_can_use(change, text):
    episode = {"time": np.arange(3.0), "q": np.zeros((3, 2)), "orientation": TURN, **change}
    if text is None:
        recorded.require_valid(episode)
        return
    text = text.replace("wxyz", r"orientation must be a unit quaternion \(w, x, y, z\)")
    with pytest.raises(ValueError, match=text):
        recorded.require_valid(episode)


def test_rotation_vectors_go_on_beyond_half_a_turn():
    angle = np.linspace(3.0, 3.5, 20)
    axis = np.array([0.6, 0, 0.8])
    q = Rotation.from_rotvec(angle[:, None] * axis).as_quat(scalar_first=True)
    got = recorded.rotation_vectors(q)
    np.testing.assert_allclose(got, angle[:, None] * axis, atol=1e-9)


def test_columns_are_named_by_joints_and_features():
    given = ["joint_position", "orientation", "position", "gripper", "observation.cup"]
    features = {"observation.cup": ("u", "v")}
    columns = recorded.columns_for(given, ("a", "b"), features)
    declared = recorded.lerobot_features(columns)
    state = declared["observation.state"]
    assert state["names"][:2] == ["a.pos", "b.pos"]
    assert state["shape"] == [len(state["names"])]
    assert declared["observation.cup"] == {
        "dtype": "float32",
        "shape": [2],
        "names": ["u", "v"],
    }
    timed = recorded.lerobot_features(recorded.columns_for(["time"], (), {}))
    assert {key: feature["dtype"] for key, feature in timed.items()} == {"time": "float64"}
    q, turn = np.arange(6.0).reshape(3, 2), TURN
    values = {
        "joint_position": q,
        "orientation": turn,
        "position": np.ones((3, 3)),
        "gripper": np.array([4.0, 5, 6]),
        "observation.cup": q + 7,
    }
    encoded = recorded.encode(columns, values)
    table = dict(zip(state["names"], encoded["observation.state"].T, strict=True))
    np.testing.assert_array_equal(table["b.pos"], q[:, 1])
    np.testing.assert_array_equal(encoded["observation.cup"], q + 7)
    expected = Rotation.from_quat(turn, scalar_first=True).as_rotvec()
    found = np.stack([table[name] for name in state["names"] if "w" in name], axis=1)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-9)


FEATURES = {
    "q": {"dtype": "float32", "shape": [2]},
    "grid": {"dtype": "int16", "shape": [2, 3]},
    "flag": {"dtype": "bool", "shape": [1]},
    "both": {"dtype": "bool", "shape": [2]},
    "word": {"dtype": "string", "shape": [1]},
}


def test_a_table_holds_numbers_lists_and_grids():
    grid = np.arange(18).reshape(3, 6)
    values = {
        "grid": grid,
        "q": np.arange(6.0).reshape(3, 2),
        "flag": np.array([True, False, True]),
        "both": np.array([[True, False]] * 3),
        "unknown": np.zeros(3),
    }
    table = recorded.to_table(values, FEATURES, {"word": pa.array(["a", "b", "c"])})
    assert table.column_names == ["q", "grid", "flag", "both", "word"]
    assert table["q"].type == pa.list_(pa.float32(), 2)
    assert table["grid"].to_pylist() == grid.reshape(3, 2, 3).tolist()
    assert table["flag"].to_pylist() == [True, False, True]
    assert table["both"].to_pylist() == [[True, False]] * 3
    assert recorded.to_table({"q": values["q"]}, FEATURES).column_names == ["q"]


def header():
    index = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    kinds = {"q": "float32", "timestamp": "float32", **index}
    features = {
        key: {"dtype": kind, "shape": [2 if key == "q" else 1]} for key, kind in kinds.items()
    }
    return RecordingHeader(fps=20.0, robot_type="any", features=features, sidecar=Sidecar())


def test_an_episode_is_written_with_its_index_and_statistics(tmp_path):
    path = recorded.episode_path(tmp_path, 12)
    assert (path.name, recorded.episode_number(path)) == ("episode_000012.parquet", 12)
    q = np.random.default_rng(0).normal(size=(5, 2)).astype("float32")
    tasks = (["pour", "stir"], np.array([3, 3, 3, 1, 1]))
    recorded.write_episode(path, header(), {"q": q}, tasks, 40, provenance="{}")
    table = pq.read_table(path)
    assert table["index"].to_pylist() == [40, 41, 42, 43, 44]
    assert table["frame_index"].to_pylist() == [0, 1, 2, 3, 4]
    assert table["episode_index"].to_pylist() == [12] * 5
    assert table["task_index"].to_pylist() == [3, 3, 3, 1, 1]
    np.testing.assert_allclose(table["timestamp"].to_numpy(), np.arange(5) / 20, atol=1e-7)
    np.testing.assert_array_equal(table["q"].to_pylist(), q)
    described, again = recorded.read_episode(path)
    assert again.equals(table)
    assert (described.tasks, described.provenance) == (["pour", "stir"], "{}")
    assert described.header == header()
    np.testing.assert_allclose(described.statistics["q"]["mean"], q.mean(0), atol=1e-6)
    np.testing.assert_allclose(described.statistics["q"]["std"], q.std(0), atol=1e-6)
    assert described.statistics["index"]["max"] == [44]
    given = {"q": {"mean": [7.0]}}
    recorded.write_episode(path, header(), {"q": q}, tasks, 0, statistics=given)
    assert recorded.read_episode(path)[0].statistics["q"] == given["q"]


def test_files_that_are_no_episodes_are_named(tmp_path):
    path = tmp_path / "episode_000000.parquet"
    pq.write_table(pa.table({"q": [1.0]}), path)
    with pytest.raises(DatasetError, match="no episode of a recording"):
        recorded.read_episode(path)
    content = {"hrc_learn": json.dumps({"tasks": 3})}
    pq.write_table(pa.table({"q": [1.0]}).replace_schema_metadata(content), path)
    with pytest.raises(DatasetError, match="no episode of a recording"):
        recorded.read_episode(path)


def test_saved_episodes_count_without_a_gap(tmp_path):
    with pytest.raises(DatasetError, match="no episode was saved"):
        recorded.staged_paths(tmp_path)
    paths = [recorded.episode_path(tmp_path, k) for k in (3, 4, 6)]
    for path in paths:
        path.touch()
    with pytest.raises(DatasetError, match="is missing from the recording") as caught:
        recorded.staged_paths(tmp_path, 3)
    assert caught.value.issue.episode == 5
    paths[2].unlink()
    assert recorded.staged_paths(tmp_path, 3) == paths[:2]
    with pytest.raises(DatasetError, match="is missing") as caught:
        recorded.staged_paths(tmp_path)
    assert caught.value.issue.episode == 0
