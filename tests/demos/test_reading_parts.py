"""Columns, rows and files of a dataset, one function at a time."""

import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot_folders import write_folder
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.read import dataset_files as files
from hrc_learn.demos.read import frames as reading
from hrc_learn.demos.read import quantities
from hrc_learn.demos.read.columns import column_places, map_columns
from hrc_learn.demos.read.dataset_folder import EpisodeEntry, open_folder
from hrc_learn.demos.read.metadata import Feature

pytestmark = pytest.mark.simulation


@pytest.mark.parametrize(
    ("value", "lowest", "number"),
    [
        (0, 0, 0), (5, 5, 5), (4, 5, None), (3.0, 0, 3), (3.5, 0, None), (True, 0, None),
        ("3", 0, None), (None, 0, None), (2**53 - 1, 0, 2**53 - 1), (2**53, 0, None),
        (-1, -1, -1),
    ],
)  # fmt: skip
def test_whole_numbers_of_metadata(value, lowest, number):
    if number is None:
        with pytest.raises(DatasetError, match="n must be a whole number of at least"):
            files.integer(value, "n", "meta/info.json", lowest)
    else:
        assert files.integer(value, "n", "meta/info.json", lowest) == number


def test_a_file_is_in_the_dataset_once_its_links_are_followed(tmp_path):
    root = tmp_path / "hub/snapshots/abc"
    (root / "data").mkdir(parents=True)
    (tmp_path / "hub/blobs").mkdir()
    (tmp_path / "hub/blobs/x").write_text("x")
    (tmp_path / "out.txt").write_text("x")
    (root / "own.txt").write_text("x")
    (root / "blob.txt").symlink_to(tmp_path / "hub/blobs/x")
    (root / "out.txt").symlink_to(tmp_path / "out.txt")
    assert files.is_inside(root, "own.txt")
    assert files.is_inside(root, "blob.txt")
    assert not files.is_inside(root, "out.txt")
    assert not files.is_inside(root, "data/../own.txt")
    assert not files.is_inside(root, "../../blobs/x")
    assert not files.is_inside(root, str(tmp_path / "out.txt"))
    files.require_file(root, "own.txt")
    for name, message in (
        ("data", "is a folder, not a file"),
        ("none", "not found: the copy is incomplete"),
        ("out.txt", "leads out of the dataset"),
    ):
        with pytest.raises(DatasetError, match=message):
            files.require_file(root, name)
    os.mkfifo(root / "pipe")
    with pytest.raises(DatasetError, match="is a device or pipe, not a file"):
        files.require_file(root, "pipe")
    (root / "own.txt").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(DatasetError, match="is a pointer of Git LFS"):
        files.require_file(root, "own.txt")


@pytest.mark.parametrize(
    ("template", "path"),
    [
        (
            "data/chunk-{chunk:03d}/file-{file:06d}.parquet",
            "data/chunk-002/file-000013.parquet",
        ),
        ("x-{file}.parquet", "x-13.parquet"),
        ("{file:3d}", " 13"),
        ("../{file}", None),
        ("{other}", None),
        ("{file", None),
        ("{file.real}", None),
        (None, None),
    ],
)
def test_paths_come_from_templates(tmp_path, template, path):
    if path is None:
        with pytest.raises(DatasetError):
            files.path_in(tmp_path, template, "data_path", chunk=2, file=13)
    else:
        assert files.path_in(tmp_path, template, "data_path", chunk=2, file=13) == path


def test_lines_of_json_are_counted(tmp_path):
    (tmp_path / "x").write_text('\ufeff{"a": 1}\n\n{"a": 2}\n')
    assert files.read_json_lines(tmp_path, "x", ("a",)) == [{"a": 1}, {"a": 2}]
    for text, message in (
        ('{"a": 1}\n\n{"b": 1}', "line 3 lacks a"),
        ('{"a": 1}\n{', "line 2 is no valid JSON"),
        ("[1]", "line 1 is no JSON object"),
    ):
        (tmp_path / "x").write_text(text)
        with pytest.raises(DatasetError, match=message):
            files.read_json_lines(tmp_path, "x", ("a",))
    (tmp_path / "x").write_bytes(b"\xff\xfe")
    with pytest.raises(DatasetError, match="cannot be read as text"):
        files.read_json(tmp_path, "x")


def parquet(path, rows=100, group=7):
    table = pa.table({"a": range(rows), "b": np.arange(rows) * 0.5})
    pq.write_table(table, path, row_group_size=group)
    return pq.ParquetFile(path)


@pytest.mark.parametrize(
    "rows",
    [slice(0, 100), slice(0, 7), slice(6, 8), slice(7, 14), slice(13, 50), slice(99, 100)],
)
def test_only_the_rows_of_a_range_are_read(tmp_path, rows):
    opened = parquet(tmp_path / "x")
    assert files.row_group_starts(opened.metadata) == [*range(0, 100, 7)]
    read = files.read_table(opened, "x", ["a"], rows)
    assert read["a"].to_pylist() == [*range(rows.start, rows.stop)]
    assert read.column_names == ["a"]
    assert files.read_table(opened, "x").num_rows == 100


def test_a_file_whose_writer_was_killed_gets_a_footer(tmp_path):
    """Read again by pyarrow: the complete row groups, whatever their columns hold."""
    rng = np.random.default_rng(0)
    count = 600
    table = pa.table(
        {
            "t": np.arange(count) / 50,
            "q": pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=3 * count)), 3),
            "n": pa.array(rng.integers(-300, 300, count)),
            "done": pa.array(rng.random(count) > 0.5),
            "task": pa.array([f"task {k % 3}" for k in range(count)]),
        }
    )
    path = tmp_path / "x.parquet"
    pq.write_table(table, path, row_group_size=200)
    content = path.read_bytes()
    assert not files.is_unfinished(path)
    whole = pq.ParquetFile(path).metadata
    ends = []
    for group in range(3):
        last = whole.row_group(group).column(whole.num_columns - 1)
        ends.append(last.data_page_offset + last.total_compressed_size)
    for cut, groups in ((ends[2], 3), (ends[1] + 50, 2), (ends[0] + 50, 1), (40, 0)):
        path.write_bytes(content[:cut])
        assert files.is_unfinished(path)
        made = files.finished_parquet(content[:cut], table.slice(0, 1))
        read = pq.read_table(pa.BufferReader(made))
        assert read.to_pylist() == table.slice(0, 200 * groups).to_pylist()
        metadata = pq.ParquetFile(pa.BufferReader(made)).metadata
        assert metadata.num_row_groups == groups
    assert not files.is_unfinished(Path(__file__))


def test_a_new_footer_states_what_the_old_one_did():
    """Sizes and offsets of every column of pages of both versions, several to a column."""
    rng = np.random.default_rng(1)
    count = 900
    table = pa.table(
        {
            "q": pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=3 * count)), 3),
            "n": pa.array(rng.integers(-300, 300, count).astype("int32")),
            "done": pa.array(rng.random(count) > 0.5),
            "task": pa.array([f"task {k % 3}" for k in range(count)]),
        }
    )
    for version, size in (("1.0", 512), ("2.0", 512), ("1.0", 2**20)):
        sink = pa.BufferOutputStream()
        options = {"data_page_version": version, "data_page_size": size}
        pq.write_table(table, sink, row_group_size=400, write_batch_size=50, **options)
        content = sink.getvalue().to_pybytes()
        old = pq.ParquetFile(pa.BufferReader(content)).metadata
        begin = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
        for cut, groups in ((begin, 3), (begin - 1, 2)):
            made = files.finished_parquet(content[:cut], table.slice(0, 1))
            assert made[-4:] == b"PAR1"
            new = pq.ParquetFile(pa.BufferReader(made)).metadata
            assert (new.num_row_groups, new.num_columns) == (groups, old.num_columns)
            assert new.num_rows == min(400 * groups, count)
            for group in range(groups):
                one, other = old.row_group(group), new.row_group(group)
                assert one.num_rows == other.num_rows
                assert one.total_byte_size == other.total_byte_size
                for column in range(old.num_columns):
                    a, b = one.column(column), other.column(column)
                    for name in SIZES:
                        assert getattr(a, name) == getattr(b, name), (group, column, name)
            read = pq.read_table(pa.BufferReader(made), page_checksum_verification=False)
            assert read.equals(table.slice(0, new.num_rows))


SIZES = ("num_values", "total_compressed_size", "total_uncompressed_size", "physical_type")
SIZES += ("data_page_offset", "has_dictionary_page", "dictionary_page_offset", "compression")
SIZES += ("path_in_schema",)


@pytest.mark.parametrize(
    ("data", "kind", "value"),
    [
        # The specification of Thrift's compact protocol, read by hand.
        ("", 1, True),
        ("", 2, False),
        ("a7", 3, 0xA7),
        ("00", 5, 0),
        ("02", 5, 1),
        ("01", 6, -1),
        ("7f", 6, -64),
        ("8001", 6, 64),
        ("ffffffff0f", 5, -(2**31)),
        ("80808080808002", 6, 2**42),
        ("03616263", 8, b"abc"),
        ("00", 8, b""),
        ("8001" + "78" * 128, 8, b"x" * 128),
        ("f503020406", 9, (5, [1, 2, 3])),
        ("f800", 9, (8, [])),
        ("00", 12, {}),
        ("1502250400", 12, {1: (5, 1), 3: (5, 2)}),
        ("111213ff00", 12, {1: (1, True), 2: (2, False), 3: (3, 255)}),
        ("f80201610162", 9, (8, [b"a", b"b"])),
        ("2c150200160400", 12, {2: (12, {1: (5, 1)}), 3: (6, 2)}),
        ("19f5010600", 12, {1: (9, (5, [3]))}),
    ],
)
def test_values_of_thrifts_compact_protocol(data, kind, value):
    raw = bytes.fromhex(data)
    assert files._written(kind, value) == raw
    # At another place, and with other bytes behind it.
    assert files._read(b"\xff" * 3 + raw + b"\x85", 3, kind) == (value, 3 + len(raw))


@pytest.mark.parametrize(
    ("data", "kind", "value"),
    [
        ("35020406", 9, (5, [1, 2, 3])),  # short lists have their size in the first byte
        ("05280200", 12, {20: (5, 1)}),  # fields more than 15 numbers on
        ("1502055004150600", 12, {1: (5, 1), 40: (5, 2), 41: (5, 3)}),
        ("e5" + "02" * 14, 9, (5, [1] * 14)),
    ],
)
def test_shorter_and_longer_forms_are_read_too(data, kind, value):
    raw = bytes.fromhex(data)
    assert files._read(raw, 0, kind) == (value, len(raw))


FEATURES = {
    "observation.state": Feature(
        key="observation.state", dtype="float32", shape=(4,), names=("a.pos", "b.pos", "c", "d")
    ),
    "group/pose": Feature(key="group/pose", dtype="float32", shape=(3,), names=("x", "y", "d")),
    "bare": Feature(key="bare", dtype="float32", shape=(2,), names=None),
}


@pytest.mark.parametrize(
    ("text", "places"),
    [
        ("bare", [("bare", 0), ("bare", 1)]),
        ("bare[1]", [("bare", 1)]),
        ("bare[0:1]", [("bare", 0)]),
        ("bare[1:]", [("bare", 1)]),
        ("bare[:1]", [("bare", 0)]),
        ("bare[:]", [("bare", 0), ("bare", 1)]),
        ("observation.state[1:3]", [("observation.state", 1), ("observation.state", 2)]),
        ("c", [("observation.state", 2)]),
        ("group/pose/y", [("group/pose", 1)]),
        ("pose", [("group/pose", k) for k in range(3)]),
        ("pose[0]", [("group/pose", 0)]),
        ("d", "'d' for position is ambiguous: write one of observation.state/d, group/pose/d"),
        ("bare[2]", "is no range of the 2 components"),
        ("bare[1:1]", "is no range"),
        ("bare[0:3]", "is no range"),
        ("bare[x]", "is no range"),
        ("bare[]", "is no range"),
        ("none", "there is no column 'none' for position; there are features"),
    ],
)
def test_columns_that_a_text_stands_for(text, places):
    if isinstance(places, list):
        assert column_places("position", text, FEATURES, "meta/info.json") == places
    else:
        with pytest.raises(DatasetError) as error:
            column_places("position", text, FEATURES, "meta/info.json")
        assert places in str(error.value)


def mapped(**features):
    made = {}
    for key, names in features.items():
        key = key.replace("__", ".")
        width = names if isinstance(names, int) else len(names)
        given = None if isinstance(names, int) else tuple(names)
        made[key] = Feature(key=key, dtype="float32", shape=(width,), names=given)
    return map_columns(made)


@pytest.mark.parametrize(
    ("width", "roles"),
    [
        (3, {"position"}),
        (6, {"position", "euler_xyz"}),
        (7, {"position", "quaternion_xyzw"}),
        (9, {"position", "rotation_6d"}),
        (16, {"pose_matrix"}),
        (5, set()),
    ],
)
def test_poses_without_names_are_known_by_their_width(width, roles):
    found = mapped(observation__ee_pose=width)
    assert {*found.selections} == roles
    for role, selection in found.selections.items():
        first = 0 if role in ("position", "pose_matrix") else 3
        places = [index for _, index in selection.columns]
        assert places == [*range(first, first + len(places))]
    assert ("observation.ee_pose" in found.extra) == (not roles)


def test_joints_of_several_quantities_come_in_the_order_of_the_first():
    found = mapped(
        **{
            "observation.state": ("b.pos", "a.pos", "a.vel", "b.vel"),
            "action": ("a.pos", "b.pos"),
        }
    )
    assert found.joint_names == ("b", "a")
    columns = {role: [i for _, i in s.columns] for role, s in found.selections.items()}
    assert columns == {
        "joint_position": [0, 1], "joint_velocity": [3, 2], "command_position": [1, 0],
    }  # fmt: skip
    other = mapped(**{"observation.state": ("a.pos", "b.pos"), "action": ("c.pos", "b.pos")})
    assert other.joint_names == ("b",)
    assert [i for _, i in other.selections["command_position"].columns] == [1]


def entries(*spans):
    return [
        EpisodeEntry(index=k, length=length, tasks=(), file="x", start=start)
        for k, (start, length) in enumerate(spans)
    ]


@pytest.mark.parametrize(
    ("spans", "groups", "batches"),
    [
        (((0, 10), (10, 10), (20, 10)), [0, 10, 20], [3]),
        (((0, 10), (20, 10)), [0, 10, 20], [1, 1]),
        (((20, 10), (0, 10)), [0, 10, 20], [1, 1]),
        (((0, 10), (0, 10)), [0, 10], [1, 1]),
        (((0, 40_000), (40_000, 40_000), (80_000, 10)), [0, 40_000, 80_000], [2, 1]),
        (((0, 65_535), (65_535, 1), (65_536, 9)), [0, 65_535, 65_536], [2, 1]),
        (((0, 70_000), (70_000, 10)), [0], [2]),
        (((0, 5), (5, 0), (5, 5)), [0], [2, 1]),
    ],
)
def test_episodes_are_read_in_batches_of_whole_row_groups(spans, groups, batches):
    found = [*reading._batches(entries(*spans), groups)]
    assert [len(batch) for batch in found] == batches


def fault(row, message):
    return DatasetError(f"{row}: {message}", file="x")


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (pa.array([1, 2, 3]), [[1], [2], [3]]),
        (pa.array([[1.0, 2], [3, 4]]), [[1, 2], [3, 4]]),
        (pa.array([[[1], [2]], [[3], [4]]]), [[1, 2], [3, 4]]),
        (pa.array([True, False]), [[True], [False]]),
        (pa.array([[True, False]]), [[True, False]]),
        (pa.array([], pa.float32()), np.zeros((0, 0))),
    ],
)
def test_nested_lists_become_rows_of_numbers(array, expected):
    found = reading.to_numpy(pa.chunked_array([array]), fault)
    np.testing.assert_array_equal(found, expected)
    two = pa.chunked_array([array, array])
    assert len(reading.to_numpy(two, fault)) == 2 * len(array)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (pa.array([1, None, 3]), "1: holds no value"),
        (pa.array([[1, 2], [3, None], [None, 6]]), "1: holds no value"),
        (pa.array([[1, 2], [3, 4], [5]]), "2: holds 1 components, the first row 2"),
        (pa.array([[[1, 2], [1, 2]], [[1, 2], [1]]]), "1: holds 1 components, the first row 2"),
        (pa.array(["a"]), "0: holds string, not numbers"),
    ],
)
def test_rows_without_usable_values_are_named(array, message):
    with pytest.raises(DatasetError, match=message):
        reading.to_numpy(pa.chunked_array([array]), fault)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("parts") / "set"
    state = {"observation.state": np.arange(60.0).reshape(20, 3)}
    return open_folder(write_folder(root, [state, state], {"observation.state": [*"abc"]}))


def test_stamps_of_frames(folder):
    first, _ = folder.episodes
    regular = np.arange(20) / 50
    rounded = {"timestamp": regular.astype(np.float32)[:, None]}
    found = reading.frame_timestamps(folder, first, rounded, None)
    np.testing.assert_array_equal(found, regular)
    for error, kept in ((2e-7, False), (5e-7, True)):
        moved = regular + error * (np.arange(20) == 7)
        found = reading.frame_timestamps(folder, first, {"timestamp": moved[:, None]}, None)
        np.testing.assert_array_equal(found, moved if kept else regular)
    true = (regular * 1.01)[:, None]
    found = reading.frame_timestamps(folder, first, rounded, true)
    np.testing.assert_array_equal(found, true[:, 0])
    none = {"observation.state": np.zeros((20, 3))}
    np.testing.assert_array_equal(reading.recorded_stamps(folder, none), regular)
    stalled = regular.copy()
    stalled[7] = stalled[6]
    text = "go from 0.120000 s to 0.120000 s"
    with pytest.raises(DatasetError, match=text) as error:
        reading.frame_timestamps(folder, first, {"timestamp": stalled[:, None]}, None)
    assert (error.value.frame, error.value.key) == (7, "timestamp")
    with pytest.raises(DatasetError, match="must increase") as error:
        reading.frame_timestamps(folder, first, rounded, stalled[:, None])
    assert error.value.key == "time"


def test_frames_of_another_episode_are_noticed(folder):
    first, second = folder.episodes
    frames = {"episode_index": np.zeros((20, 1))}
    assert reading._misplaced(first, frames) is None
    assert reading._misplaced(first, {}) is None
    frames["episode_index"][13:] = 1
    fault = reading._misplaced(first, frames)
    assert fault.frame == 13
    assert "belongs to episode 1 by its episode_index" in str(fault)
    assert reading._misplaced(second, frames).frame == 0
    assert reading.require_rows(folder, first.file, 40) is None
    for rows in (39, 41):
        text = f"holds {rows} frames, but the list of episodes promises 40"
        with pytest.raises(DatasetError, match=text):
            reading.require_rows(folder, first.file, rows)


ANGLES = np.random.default_rng(0).uniform(-1.4, 1.4, (8, 3))
TURN = Rotation.from_euler("xyz", ANGLES)


@pytest.mark.parametrize(
    ("role", "values"),
    [
        ("quaternion_wxyz", TURN.as_quat(scalar_first=True)),
        ("quaternion_xyzw", TURN.as_quat()),
        ("quaternion_xyzw", 1.009 * TURN.as_quat()),
        ("rotation_vector", TURN.as_rotvec()),
        ("euler_xyz", TURN.as_euler("xyz")),
        ("euler_intrinsic_xyz", TURN.as_euler("XYZ")),
        ("rotation_6d", TURN.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(8, 6)),
        ("rotation_6d", 3 * TURN.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(8, 6)),
        ("rotation_6d_rows", TURN.as_matrix()[:, :2].reshape(8, 6)),
        ("rotation_matrix", TURN.as_matrix().reshape(8, 9)),
    ],
)
def test_every_encoding_is_the_same_rotation(role, values):
    found = quantities.to_quaternion(role, values)
    np.testing.assert_allclose(
        Rotation.from_quat(found, scalar_first=True).as_matrix(), TURN.as_matrix(), atol=1e-9
    )
    assert ((found[1:] * found[:-1]).sum(1) >= 0).all()


def test_transforms_in_row_and_column_order_are_poses():
    matrices = np.tile(np.eye(4), (8, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = TURN.as_matrix(), ANGLES
    for order in (matrices, matrices.transpose(0, 2, 1)):
        fields = quantities.demonstration_fields(
            {"pose_matrix": order.reshape(8, 16)}, {"pose_matrix": 1e-3}
        )
        np.testing.assert_allclose(fields["position"], 1e-3 * ANGLES)
        found = Rotation.from_quat(fields["orientation"], scalar_first=True)
        np.testing.assert_allclose(found.as_matrix(), TURN.as_matrix(), atol=1e-9)
    for error, valid in ((0.9e-4, True), (1.2e-4, False)):
        wrong = matrices.copy()
        wrong[2, 3, 3] += error
        wrong[3, 3, 0] += error
        if valid:
            numbers = torch.from_numpy(wrong.reshape(8, 16))
            assert torch.is_tensor(quantities.transforms(numbers))
        else:
            with pytest.raises(ValueError, match="are no 4x4 transform"):
                quantities.transforms(torch.from_numpy(wrong.reshape(8, 16)))


@pytest.mark.parametrize(
    ("role", "values", "frame", "text"),
    [
        ("quaternion_wxyz", [1.011, 0, 0, 0], 1, "quaternion of length 1.011 at frame 1"),
        ("quaternion_wxyz", [0.989, 0, 0, 0], 1, "quaternion of length 0.989 at frame 1"),
        ("rotation_6d", [1, 0, 0, 1, 0, 0], 1, "the two columns at frame 1 span no plane"),
        (
            "rotation_matrix",
            [1, 0, 0, 0, 1.006, 0, 0, 0, 1],
            1,
            "numbers at frame 1 are no rotation",
        ),
    ],
)
def test_numbers_that_are_no_rotation(role, values, frame, text):
    good = {4: [1, 0, 0, 0], 6: [1, 0, 0, 0, 1, 0], 9: np.eye(3).ravel()}[len(values)]
    with pytest.raises(ValueError, match=text):
        quantities.to_quaternion(role, np.array([good, values], float))
    if role != "rotation_6d":
        near = np.array([good, np.add(good, 0.8 * np.subtract(values, good))], float)
        assert len(quantities.to_quaternion(role, near)) == 2


def test_two_fingers_open_by_their_distance():
    found = quantities.demonstration_fields(
        {"gripper": np.array([[0.01, -0.02], [0.03, -0.03]])}, {"gripper": 2.0}
    )
    np.testing.assert_allclose(found["gripper"], [0.06, 0.12])
    one = quantities.demonstration_fields({"gripper": np.array([[0.01]])}, {"gripper": 1.0})
    assert one["gripper"].tolist() == [0.01]
    seen = quantities.demonstration_fields(
        {"feature_visible": np.array([[0.0], [1.0], [0.5]])}, {"feature_visible": 1.0}
    )
    assert seen["feature_visible"].tolist() == [False, True, True]
