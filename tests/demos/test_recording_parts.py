"""Tables, messages, topics and meanings of recordings, mostly made in memory."""

import base64
import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Message

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos import recording_bags as bags
from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_formats import _attributes, open_recordings
from hrc_learn.demos.recording_import import ImportPlan, _images, _with_next_states
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_messages import (
    Topic,
    image_field,
    image_of,
    matrix_of,
    parts_of,
    poses_of_frames,
    stamp_of,
)
from hrc_learn.demos.recording_names import ImportOptions, find_cameras
from hrc_learn.demos.recording_tables import read_parquet_table, read_text_table

pytestmark = pytest.mark.simulation


def table(tmp_path, text, columns=()):
    path = tmp_path / "run.txt"
    path.write_text(text)
    found = read_text_table(path, columns)
    return {name: np.asarray(values).tolist() for name, values in found.items()}


@pytest.mark.parametrize(
    ("text", "columns", "found"),
    [
        ("a,b\n1,2\n3,4\n", (), {"a": [1, 3], "b": [2, 4]}),
        ("a;b\n1,5;2\n3;4,25\n", (), {"a": [1.5, 3], "b": [2, 4.25]}),
        ("a b\n1,5 2,0\n3,0 4,25\n", (), {"a": [1.5, 3], "b": [2, 4.25]}),
        ("a|b\n1|2\n", (), {"a": [1], "b": [2]}),
        ("a\tb\n1\t2\n", (), {"a": [1], "b": [2]}),
        ("# x y\n# t q\n1 2\n# in between\n3 4\n", (), {"t": [1, 3], "q": [2, 4]}),
        ("# a robot\n1 2 3\n3 4 5\n", (), {"array": [[1, 2, 3], [3, 4, 5]]}),
        ("1 2\n3 4\n", ("x", "y"), {"x": [1, 3], "y": [2, 4]}),
        ("% comment\n// another\na,b\n1,2\n", (), {"a": [1], "b": [2]}),
        ("a,a,a\n1,2,3\n", (), {"a": [1], "a (2)": [2], "a (3)": [3]}),
        ('"the time", b\n1, 2\n', (), {"the time": [1], "b": [2]}),
        ("a,b,\n1,2,\n3,4,\n", (), {"a": [1, 3], "b": [2, 4]}),
        # Rows are numbered from 0 or 1, without a name or as pandas names them.
        (",a\n0,5\n1,6\n", (), {"a": [5, 6]}),
        ("a\n1,5\n2,6\n3,7\n", (), {"a": [5, 6, 7]}),
        ("index,a\n0,5\n1,6\n", (), {"a": [5, 6]}),
        ("index,a\n2,5\n3,6\n", (), {"index": [2, 3], "a": [5, 6]}),
        ("index,a\n0,5\n2,6\n", (), {"index": [0, 2], "a": [5, 6]}),
        ("index\n0\n1\n", (), {"index": [0, 1]}),
        ("a,word\n1,x\n2,y\n", (), {"a": [1, 2]}),
        (" \n;;\na;b\n\n1;2\n", (), {"a": [1], "b": [2]}),
        ("1\n", (), {"array": [[1]]}),
        ("a b\n-1e-3 2E2\n", (), {"a": [-1e-3], "b": [200]}),
    ],
)
def test_text_becomes_columns_of_numbers(tmp_path, text, columns, found):
    assert table(tmp_path, text, columns) == found


def test_a_missing_number_is_nan(tmp_path):
    found = table(tmp_path, "b,a\n,1\nN/A,2\n4,3\n")
    np.testing.assert_array_equal(found["b"], [np.nan, np.nan, 4])
    assert found["a"] == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("", (), "is empty"),
        ("# only a comment\n", (), "is empty"),
        ("a,b\n", (), "holds a header and no numbers"),
        ("1,2\n", ("a", "b", "c"), "3 column names for 2 columns"),
        ("a,b\n1,2\n3\n", (), "line 3 does not hold 2 numbers separated by ','"),
        ("a,b\n\n1,2\n\n3,4,5\n", (), "line 5 does not hold 2 numbers separated by ','"),
        ("a,b\n1,2\n3,x\n", (), "line 3 does not hold 2 numbers separated by ',': 'x'"),
        ("a;b\n1,5;2\n1.5;2\n", (), "mixes decimal points and decimal commas"),
        ("word\nx\ny\n", (), "holds no column of numbers"),
        (",a\n7,1\n9,2\n", (), "holds a column without a name"),
    ],
)
def test_tables_that_are_damaged_name_the_line(tmp_path, text, columns, message):
    with pytest.raises(DatasetError, match=message):
        table(tmp_path, text, columns)


def test_other_encodings_are_named_with_the_byte(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes("a,ü\n1,2\n".encode("latin-1"))
    with pytest.raises(DatasetError, match=r"not encoded in UTF-8 \(.* at byte 2\)"):
        read_text_table(path)


def test_columns_of_parquet(tmp_path):
    path = tmp_path / "run.parquet"
    stamps = pa.array([1_500_000, 2_000_000], pa.timestamp("us"))
    columns = {
        "t": stamps,
        "q": pa.array([[1.0, 2.0], [3.0, 4.0]]),
        "n": pa.array([3, 4], pa.int8()),
        "image": pa.array([{"bytes": b"ab", "path": "x"}, {"bytes": b"cd", "path": "y"}]),
        "large": pa.array([b"e", b"f"], pa.large_binary()),
        "texts": pa.array([["a"], ["b"]]),
        "__index_level_0__": pa.array([0, 1]),
    }
    pq.write_table(pa.table(columns), path)
    found = read_parquet_table(path)
    assert {*found} == {"t", "q", "n", "image", "large"}
    np.testing.assert_allclose(found["t"], [1.5, 2.0])
    np.testing.assert_array_equal(found["q"], [[1, 2], [3, 4]])
    assert found["n"].dtype == float
    assert found["image"].tolist() == [b"ab", b"cd"]
    ragged = pa.table({"q": pa.array([[1.0, 2.0], [3.0], None])})
    pq.write_table(ragged, path)
    with pytest.raises(DatasetError, match="holds vectors of 0 to 2 components: all frames"):
        read_parquet_table(path)
    path.write_bytes(b"PAR1")
    with pytest.raises(DatasetError, match="cannot be read as Parquet"):
        read_parquet_table(path)


@pytest.mark.parametrize(
    ("message", "seconds"),
    [
        (Message(header=Message(stamp=Message(sec=3, nanosec=500_000_000))), 3.5),
        (Message(stamp=Message(secs=3, nsecs=250_000_000)), 3.25),
        (Message(timestamp=Message(seconds=2, nanos=1_000_000)), 2.001),
        (Message(header=Message(stamp=Message(sec=4, nsec=0))), 4),
        (Message(header=Message()), 0),
        (Message(data=1), 0),
    ],
)
def test_stamps_in_messages(message, seconds):
    assert stamp_of(message) == pytest.approx(seconds)


def parts(message, name="arm"):
    return [(n, names, np.asarray(v).tolist()) for n, names, v in parts_of(name, message)]


POINT = Message(positions=[1.0, 2.0])
POSITION, TURN = Message(x=1, y=2, z=3), Message(w=0.0, x=0.0, y=0.0, z=2.0)
MATRIX = [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("message", "found"),
    [
        (
            Message(name=["a", "b"], position=[1, 2], velocity=[3, 4], effort=[]),
            [
                ("arm/joint_positions", ("a", "b"), [1, 2]),
                ("arm/joint_velocities", ("a", "b"), [3, 4]),
            ],
        ),
        (
            Message(name=["a"], position=[1], velocity=[3, 4], effort=[5]),
            [("arm/joint_positions", ("a",), [1]), ("arm/joint_efforts", ("a",), [5])],
        ),
        (Message(name=[], position=[], velocity=[]), []),
        (
            Message(joint_names=["a", "b"], points=[POINT]),
            [("arm/command/joint_positions", ("a", "b"), [1, 2])],
        ),
        (Message(joint_names=["a", "b"], points=[POINT, POINT]), []),
        (
            Message(joint_names=["a", "b"], reference=POINT),
            [("arm/command/joint_positions", ("a", "b"), [1, 2])],
        ),
        (
            Message(joint_names=["a", "b"], desired=POINT),
            [("arm/command/joint_positions", ("a", "b"), [1, 2])],
        ),
        (Message(joint_names=["a"], points=[POINT]), []),
        (Message(joint_names=[], points=[]), []),
        (Message(data=b"", encoding="rgb8", width=4), [("arm", None, [])]),
        (Message(data=b"", format="jpeg"), [("arm", None, [])]),
        (Message(data=[1, 2]), [("arm", None, [1, 2])]),
        (Message(data=3), [("arm", None, [3])]),
        (Message(data=[]), []),
        (Message(data="text"), []),
        (Message(data=b"bytes"), []),
        (Message(data=[[1, 2], [3, 4]]), []),
        (Message(data=["a"]), []),
        (Message(pose=Message(position=POSITION, orientation=TURN)), [("arm", None, MATRIX)]),
        (Message(position=POSITION, orientation=TURN), [("arm", None, MATRIX)]),
        (Message(other=1), []),
    ],
)
def test_messages_are_understood_by_their_attributes(message, found):
    assert parts(message) == found


def test_a_quaternion_of_any_length_turns_and_none_does_not():
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    w, x, y, z = 3 * turn.as_quat(scalar_first=True)
    matrix = matrix_of(POSITION, Message(w=w, x=x, y=y, z=z))
    np.testing.assert_allclose(matrix[:3, :3], turn.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:, 3], [1, 2, 3, 1])
    none = matrix_of(POSITION, Message(w=0, x=0, y=0, z=0))
    np.testing.assert_array_equal(none[:3, :3], np.eye(3))


def test_numbers_of_a_topic_keep_the_order_of_its_first_message():
    one = Topic(("a", "b"))
    one.add(2_000_000_000, 1.5, np.array([1.0, 2]), ("a", "b"))
    one.add(3_000_000_000, 2.5, np.array([4.0, 3]), ("b", "a"))
    assert (one.received, one.stamps) == ([2.0, 3.0], [1.5, 2.5])
    assert [v.tolist() for v in one.values] == [[1, 2], [3, 4]]


def moving(axis, count=5, scale=1.0, late=0.5):
    """Rows of received, stamp and transform that move along an axis."""
    rows = []
    for k in range(count):
        matrix = np.eye(4)
        matrix[axis, 3] = scale * k
        rows.append((k + 10.0, k + late, matrix))
    return rows


def fixed(*shift):
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    return [(0.0, 0.0, matrix)]


def test_frames_become_poses_of_tools_in_their_base():
    edges = {
        ("world", "base_link"): fixed(9, 9, 9),
        ("base_link", "link1"): moving(0),
        ("link1", "tool0"): fixed(0, 0, 1),
        ("tool0", "camera"): fixed(0, 5, 0),
        ("world", "table"): fixed(1, 1, 1),
    }
    found = poses_of_frames(edges)
    assert {*found} == {"tf/base_link/tool0", "tf/base_link/camera"}
    tool = found["tf/base_link/tool0"]
    np.testing.assert_allclose([m[:3, 3] for m in tool.values], [[k, 0, 1] for k in range(5)])
    assert tool.received == [10, 11, 12, 13, 14]
    assert tool.stamps == [0.5, 1.5, 2.5, 3.5, 4.5]
    np.testing.assert_allclose(found["tf/base_link/camera"].values[2][:3, 3], [2, 5, 1])


def test_frames_of_a_slower_link_hold_their_last_transform():
    edges = {("base", "a"): moving(0, 6), ("a", "tcp"): moving(1, 3, late=2.0)}
    (tool,) = poses_of_frames(edges).values()
    # Transforms of the tool at 2, 3 and 4 s; the first counts before it, too.
    expected = [[0, 0], [1, 0], [2, 0], [3, 1], [4, 2], [5, 2]]
    assert [m[:2, 3].tolist() for m in tool.values] == expected


def test_without_a_name_the_root_is_the_base_and_still_frames_are_none():
    edges = {("world", "a"): moving(0), ("a", "b"): fixed(0, 1, 0)}
    assert [*poses_of_frames(edges)] == ["tf/world/b"]
    assert poses_of_frames({("world", "a"): fixed(1, 0, 0)}) == {}
    # A loop of frames ends.
    assert [*poses_of_frames({("a", "ee"): moving(0), ("ee", "a"): moving(1)})] == ["tf/a/ee"]


def image_topic(**message):
    return Topic(sample=Message(**message), received=[1.0, 2.0], stamps=[1, 2])


@pytest.mark.parametrize(
    ("encoding", "kind"),
    [("16UC1", "depth"), ("32FC1", "depth"), ("mono16", "depth"), ("compressedDepth", "depth")],
)
def test_images_of_depth_are_known(encoding, kind):
    notes = []
    made = image_field("cam", image_topic(encoding=encoding, width=2), None, notes)
    assert (made.kind, made.frames, notes) == (kind, 2, [])


def test_images_of_an_unknown_encoding_are_left_out():
    notes = []
    assert image_field("cam", image_topic(encoding="yuv9", width=2), None, notes) is None
    assert notes == ["cam is left out: images of encoding yuv9 are not read"]
    with pytest.raises(DatasetError, match="images of encoding yuv9 are not read"):
        image_of(Message(encoding="yuv9", width=2, data=b""))


BGR = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)


@pytest.mark.parametrize(
    ("encoding", "rows"),
    [
        ("rgb8", BGR[..., ::-1]),
        ("RGB8", BGR[..., ::-1]),
        ("bgr8", BGR),
        ("8UC3", BGR),
        ("rgba8", np.dstack([BGR[..., ::-1], np.full((4, 6), 255, np.uint8)])),
        ("bgra8", np.dstack([BGR, np.full((4, 6), 255, np.uint8)])),
    ],
)
def test_raw_images_become_rgb_whatever_the_length_of_their_rows(encoding, rows):
    padded = np.concatenate([rows.reshape(4, -1), np.zeros((4, 5), np.uint8)], axis=1)
    message = Message(encoding=encoding, width=6, height=4, data=padded.tobytes())
    np.testing.assert_array_equal(image_of(message), BGR[..., ::-1])
    topic = Topic(sample=message, received=[1.0, 2.0])
    asked = []

    def messages(topics, start):
        asked.append((topics, start))
        yield from [("cam", 0, message)] * 2

    made = image_field("cam", topic, messages, [])
    assert (made.kind, made.shape) == ("image", (2, 4, 6, 3))
    np.testing.assert_array_equal(made.read(1, 2)[0], BGR[..., ::-1])
    assert asked == [(["cam", "/cam"], 999_999_000)]


def test_grey_images_have_three_equal_colours():
    grey = BGR[..., 0]
    image = image_of(Message(encoding="mono8", width=6, height=4, data=grey.tobytes()))
    np.testing.assert_array_equal(image, np.repeat(grey[..., None], 3, axis=2))


def test_images_of_files_stay_encoded_until_they_are_read():
    content = cv2.imencode(".png", BGR)[1].tobytes()
    np.testing.assert_array_equal(image_of(Message(data=content)), BGR[..., ::-1])
    for data in (content, base64.b64encode(content).decode()):
        message = Message(format="png", data=data)
        topic = Topic(sample=message, received=[1.0])
        rows = [("cam", 0, message)]
        made = image_field("cam", topic, lambda *_, rows=rows: iter(rows), [])
        assert (made.kind, made.shape) == ("encoded", (1,))
        assert made.read(0, 1)[0] == content


def topic(stamps, received, values=None, names=None):
    values = [np.zeros(2)] * len(stamps) if values is None else values
    return Topic(names=names, received=[*received], stamps=[*stamps], values=values)


TIMES = np.arange(5) / 10


@pytest.mark.parametrize(
    ("offset", "other", "own"),
    [
        (0.0, 0.0, True),
        (0.49, 9.0, True),
        (-0.49, 9.0, True),
        (0.51, 9.0, False),
        (-0.51, 9.0, False),
        (900.0, 900.4, True),  # one clock, such as that of a simulation
        (900.0, 900.6, False),
    ],
)
def test_stamps_count_on_the_clock_of_the_recorder_or_of_all(offset, other, own):
    received = TIMES + 100
    topics = {"a": topic(received + offset, received), "b": topic(received + other, received)}
    notes = []
    times = bags._times(topics, notes)
    np.testing.assert_allclose(times["a"], received + (offset if own else 0))
    text = f"a: its stamps are {offset:.3g} s from the recorder's clock: times of reception"
    assert any(note.startswith(text) for note in notes) != own


def test_topics_without_stamps_have_times_of_reception():
    received = TIMES + 100
    notes = []
    times = bags._times({"a": topic(0 * TIMES, received)}, notes)
    np.testing.assert_allclose(times["a"], received)
    assert notes == []
    # A first stamp of zero may be the start of a simulation.
    times = bags._times({"a": topic(TIMES, TIMES + 3)}, notes)
    np.testing.assert_allclose(times["a"], TIMES)


def numbers(one, places=None, order=(), name="arm/joint_positions"):
    notes = []
    places = np.arange(len(one.values)) if places is None else places
    return bags._numbers(name, one, places, order, notes), notes


def test_joints_take_the_order_of_the_description():
    values = [np.array([1.0, 2, 3])] * 5
    one = topic(TIMES, TIMES, values, ("a", "b", "c"))
    made, _ = numbers(one, order=["x", "c", "a", "b"])
    assert made.names == ("c", "a", "b")
    assert made.numbers()[0].tolist() == [3, 1, 2]
    made, _ = numbers(one, order=["c", "a"])
    assert made.names == ("a", "b", "c")


def test_topics_that_cannot_be_used_are_noted():
    made, notes = numbers(topic(TIMES, TIMES, [np.zeros(2)] * 4 + [np.zeros(3)]))
    assert (made, notes) == (
        None, ["arm/joint_positions is left out: its messages differ in size"],
    )  # fmt: skip
    lost = topic(TIMES, TIMES, [np.array([np.nan])] * 5)
    made, notes = numbers(lost, name="force")
    assert (made, notes) == (None, ["force is left out: it holds NaN"])
    assert numbers(lost)[0] is not None
    made, notes = numbers(topic(TIMES, TIMES), np.array([0, 2, 4]))
    assert made.frames == 3
    assert notes == ["arm/joint_positions: 2 messages with repeated stamps"]
    made, notes = numbers(topic(TIMES, TIMES))
    assert notes == []


@pytest.mark.parametrize(
    ("name", "kind"), [("camera_pose", "pose"), ("tcp/pose", "number"), ("ee_pose", "number")]
)
def test_poses_of_a_tool_are_known_by_their_topic(name, kind):
    made, _ = numbers(topic(TIMES, TIMES, [np.eye(4)] * 5), name=name)
    assert made.kind == kind
    made, _ = numbers(topic(TIMES, TIMES, [np.eye(3)] * 5), name=name)
    assert made.kind == "number"


def streams(**stamps):
    """A recording of topics by their stamps; images begin with `cam`."""
    fields = {}
    for name, time in stamps.items():
        time = np.asarray(time, float)
        fields[name] = array_field(name, np.arange(len(time)) * 1.0, clock=f"{name}/stamp")
        if name.startswith("cam"):
            fields[name] = replace(fields[name], kind="image")
        if name.startswith("pose"):
            fields[name] = replace(fields[name], kind="pose")
        fields[f"{name}/stamp"] = array_field(f"{name}/stamp", time, unit="s")
    return Recording(file=Path("x.mcap"), fields=fields, streams=True)


def divided(**stamps):
    notes = []
    return bags._without_gaps(streams(**stamps), notes)


LONG = np.arange(0, 4, 0.05)


def without(start, stop, time=LONG):
    """Stamps without those in between."""
    return time[(time <= start + 1e-9) | (time >= stop - 1e-9)]


@pytest.mark.parametrize(("gap", "parts"), [(0.15, 1), (0.25, 2)])
def test_a_gap_of_more_than_a_fifth_of_a_second_divides(gap, parts):
    found = divided(q=without(1.0, 1.0 + gap))
    assert len(found) == parts
    if parts == 2:
        assert [one.label for one in found] == ["part 0", "part 1"]
        assert found[0].notes == ("q is silent for 0.25 s at 1.00 s: divided there",)
        assert found[1].notes == ()
        times = [one.fields["q/stamp"].numbers()[:, 0] for one in found]
        assert times[0][-1] == pytest.approx(1.0)
        assert times[1][0] == pytest.approx(1.25)
        assert sum(map(len, times)) == len(without(1.0, 1.25))
        assert [one.fields["q"].frames for one in found] == [*map(len, times)]


@pytest.mark.parametrize(("second", "parts"), [(1.45, 2), (1.55, 3)])
def test_parts_of_less_than_half_a_second_are_left_out(second, parts):
    time = without(second, second + 0.4, without(0.7, 1.0))
    assert len(divided(q=time)) == parts


def test_images_and_joints_are_present_together():
    (one,) = divided(q=LONG, cam=LONG[10:50])
    assert one.fields["q"].frames == len(LONG)
    found = divided(q=LONG, cam=without(1.0, 1.5, LONG[10:50]))
    times = [one.fields["q/stamp"].numbers()[:, 0] for one in found]
    np.testing.assert_allclose([(t[0], t[-1]) for t in times], [(0.5, 1.0), (1.5, 2.45)])
    with pytest.raises(DatasetError, match=r"q, cam are never present together for 0.5 s"):
        divided(q=LONG, cam=LONG + 3.6)
    with pytest.raises(DatasetError, match="no topic holds joints or poses of a tool"):
        divided(cam=LONG)


def test_another_topic_that_is_silent_is_left_out():
    (one,) = divided(arm__joint_positions=LONG, force=without(1.0, 1.5))
    assert "force" not in one.fields
    assert one.notes == ("force is left out: it is silent for 0.50 s",)
    # Silent only where the joints are, too.
    found = divided(arm__joint_positions=without(1.0, 1.5), force=without(1.1, 1.4))
    assert len(found) == 2
    assert all("force" in part.fields for part in found)
    # One message is silent before and after.
    (one,) = divided(arm__joint_positions=LONG, force=LONG[:1])
    assert "force" not in one.fields


def test_without_joints_any_pose_may_be_that_of_the_tool():
    (one,) = divided(pose=LONG)
    assert one.fields["pose"].kind == "number"
    (one,) = divided(pose=LONG, q=LONG)
    assert one.fields["pose"].kind == "pose"


@pytest.mark.parametrize(("step", "at_once"), [(1.9e-4, True), (2.1e-4, False)])
def test_messages_written_at_once_have_no_times(step, at_once):
    time = np.arange(6000) * step
    (one,) = divided(q=time)
    assert one.streams != at_once
    assert (one.fields["q"].clock == "") == at_once
    assert any("written at once" in note for note in one.notes) == at_once


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


Q = np.stack([np.sin(np.arange(200) / 20 * (k + 1)) for k in range(3)], axis=1)


def understood(options=None, hinted=False, names=None, kinds=None, units=None, **arrays):
    fields = {}
    for name, array in arrays.items():
        name = name.replace("__", "/")
        fields[name] = array_field(
            name,
            np.asarray(array),
            names=(names or {}).get(name),
            unit=(units or {}).get(name, ""),
        )
    one = Recording(file=Path("run.npz"), fields=fields)
    return understand([one], ImportOptions(**(options or {})), hinted)


def test_actions_that_joints_follow_are_commands():
    late = np.roll(Q, 1, axis=0)
    late[0] = Q[0]
    found = understood(qpos=late, action=Q)
    assert found.selections["command_position"].columns == tuple(
        ("action", k) for k in range(3)
    )
    assert found.decisions["command_position"].evidence == "the joints follow it"
    assert found.joint_names == ("joint1", "joint2", "joint3")
    cases = ((1.9, True), (0.55, True), (0.45, False), (-1, False), (2.1, False))
    for factor, follows in cases:
        found = understood(qpos=late, action=Q / factor)
        assert ("command_position" in found.selections) == follows
        assert ("action" in found.kept) != follows
    assert found.notes == ["the joints do not follow action: it is kept as recorded"]


def test_an_action_of_other_columns_is_kept():
    found = understood(qpos=Q, action=Q[:, :2])
    assert found.kept["action"][0] == (("action", 0), ("action", 1))
    grip = np.hstack([Q, (Q[:, :1] > 0) * 1.0])
    assert "command_position" not in understood(qpos=Q, action=grip).selections
    both = understood(qpos=Q, action=grip, gripper=np.abs(Q[:, 0]))
    assert "command_position" in both.selections
    assert both.kept["action"] == ((("action", 3),), ("gripper.pos",))


def test_commands_without_names_take_the_order_of_the_joints():
    found = understood(qpos=Q, action=Q[:, [2, 0, 1]])
    assert [k for _, k in found.selections["command_position"].columns] == [1, 2, 0]
    # Where two joints move alike the order is not clear.
    alike = Q.copy()
    alike[:, 1] = Q[:, 0] + 0.01 * Q[:, 2]
    found = understood(qpos=alike, action=alike[:, [1, 0, 2]] + 0.02 * Q[:, [2, 2, 0]])
    assert [k for _, k in found.selections["command_position"].columns] == [0, 1, 2]


def test_joints_at_rest_are_compared_by_their_distance():
    rest = np.tile([0.1, 0.2, 0.3], (50, 1))
    assert "command_position" in understood(qpos=rest, action=rest + 0.09).selections
    assert "command_position" not in understood(qpos=rest, action=rest + 0.11).selections


def test_a_state_of_unknown_content_is_kept_and_left_out_next_to_joints():
    found = understood(state=Q)
    assert found.kept["observation.state"][1] == ("state_0", "state_1", "state_2")
    assert found.notes == ["state is kept as recorded: its name tells no quantity"]
    found = understood(state=Q, qpos=Q)
    text = "a state of unknown content; to keep it: observation.NAME"
    assert found.left_out == {"state": text}
    found = understood(array=Q)
    assert found.notes == ["nothing names the columns: taken for joints (--columns names them)"]
    assert found.joint_names == ("joint1", "joint2", "joint3")


def test_joints_take_the_names_that_are_given():
    assert understood({"joint_names": ("a", "b", "c")}, qpos=Q).joint_names == ("a", "b", "c")
    with pytest.raises(DatasetError, match="2 joint names for 3 columns of joints"):
        understood({"joint_names": ("a", "b")}, qpos=Q)
    found = understood(qpos=Q, names={"qpos": ("x.pos", "y.pos", "z.pos")})
    assert found.joint_names == ("x", "y", "z")
    found = understood(qpos=Q, qvel=Q[:, :2])
    assert "joint_velocity" not in found.selections
    assert "qvel" in found.left_out


def test_columns_that_the_caller_names_have_a_width():
    for count, role in ((3, "rotation_vector"), (6, "rotation_6d"), (16, "pose_matrix")):
        turn = np.tile(np.eye(4).ravel(), (200, 1)) if count == 16 else np.ones((200, count))
        turn[:, 1] = 0 if count == 6 else turn[:, 1]
        columns = {"joint_position": "q", "quaternion_wxyz": "r"}
        given = understood({"columns": columns}, q=Q, r=turn)
        assert role in given.selections
    with pytest.raises(DatasetError, match="position takes 3 columns, not 2"):
        understood({"columns": {"position": "p[0:2]"}}, p=Q)
    two = understood(
        {"columns": {"gripper": "g", "joint_position": "q"}}, q=Q, g=Q[:, :2] * 0.03
    )
    assert len(two.selections["gripper"].columns) == 2
    with pytest.raises(DatasetError, match="gripper takes 1 columns, not 3"):
        understood({"columns": {"gripper": "g", "joint_position": "q"}}, q=Q, g=Q)


def gripper_like(count=1, rest=0.6, size=1.0):
    """Joints, and last columns that rest for a fraction of the frames."""
    steps = np.zeros(200)
    steps[: int(200 * (1 - rest))] = np.linspace(0, size, int(200 * (1 - rest)))
    steps[int(200 * (1 - rest)) :] = size
    return np.hstack([Q, Q, Q[:, :1], *[steps[:, None]] * count])


@pytest.mark.parametrize(
    ("array", "count"),
    [
        (gripper_like(), 1),
        (gripper_like(2), 2),
        (gripper_like(2)[:, 2:], 0),
        (gripper_like(rest=0.45), 0),
        (gripper_like(size=1.04), 1),
        (gripper_like(size=1.06), 0),
        (gripper_like(size=-0.02), 0),
        (Q, 0),
    ],
)
def test_last_columns_that_behave_as_a_gripper_are_asked_about(array, count):
    found = understood(qpos=array)
    asked = [text for text in found.warnings if "behave as a gripper" in text]
    assert len(asked) == bool(count)
    width = array.shape[1]
    for text in asked:
        assert f"the last {count} of {width} columns of qpos" in text
        assert (
            f"--joints qpos[0:{width - count}] --gripper qpos[{width - count}:{width}]" in text
        )
    assert not understood(
        qpos=array, names={"qpos": tuple(f"j{k}" for k in range(width))}
    ).warnings


def test_cameras_are_named_by_the_end_of_their_path():
    names = ("obs/front_image", "next_obs/front_image", "wrist/rgb", "cam/color/image_raw")
    images = {n: array_field(n, np.zeros((2, 16, 16, 3), np.uint8)) for n in names}
    one = Recording(file=Path("x"), fields=images | {"q": array_field("q", Q)})
    assert find_cameras(one, None) == {
        "front": "obs/front_image", "rgb": "wrist/rgb", "image_raw": "cam/color/image_raw",
    }  # fmt: skip
    topics = find_cameras(replace(one, streams=True), None)
    assert topics["wrist"] == "wrist/rgb"
    assert topics["cam"] == "cam/color/image_raw"
    with pytest.raises(DatasetError, match="q holds no images"):
        find_cameras(one, {"top": "q"})
    same = dict.fromkeys(("a/top", "b/top"), images["wrist/rgb"])
    assert find_cameras(replace(one, fields=same), None) == {"top": "a/top", "b_top": "b/top"}


def test_images_are_read_in_batches_and_cropped():
    pixels = np.arange(100 * 17 * 18 * 3, dtype=np.uint8).reshape(100, 17, 18, 3)
    reads = []
    field = array_field("rgb", pixels)
    spied = replace(field, read=lambda a, b: (reads.append((a, b)), pixels[a:b])[1])
    index = np.array([0, 0, 5, 31, 32, 70])
    shown = [*_images(spied, index, (16, 18))]
    np.testing.assert_array_equal(np.stack(shown), pixels[index][:, :16])
    assert reads == [(0, 32), (32, 33), (70, 71)]


@pytest.mark.parametrize(
    ("pixels", "first"),
    [
        (np.full((2, 16, 16, 3), 0.5), 128),
        (np.full((2, 16, 16, 3), 1.0), 255),
        (np.full((2, 16, 16, 3), 1.5), 2),
        (np.full((2, 16, 16, 3), 300.0), 255),
        (np.full((2, 16, 16, 1), 7, np.uint8), 7),
        (np.full((2, 16, 16, 4), 7, np.uint8), 7),
        (np.full((2, 3, 16, 16), 7, np.uint8), 7),
        (np.full((2, 16, 16), 7, np.uint8), 7),
    ],
)
def test_images_of_any_form_become_rgb(pixels, first):
    shown = [*_images(array_field("rgb", pixels), np.array([0, 1]))]
    assert all(image.shape == (16, 16, 3) for image in shown)
    assert all(image.dtype == np.uint8 for image in shown)
    assert {int(v) for image in shown for v in image.ravel()} == {first}


def test_the_next_state_is_the_action_where_none_was_recorded():
    time = np.arange(4.0)
    q = np.arange(8.0).reshape(4, 2)
    demo = Demonstration(time=time, joint_position=q, joint_names=("a", "b"), fps=1)
    np.testing.assert_array_equal(_with_next_states(demo).command_position, q[[1, 2, 3, 3]])
    turn = Rotation.from_rotvec(np.outer(time / 9, [1, 0, 0]))
    pose = Demonstration(
        time=time,
        position=np.arange(12.0).reshape(4, 3),
        orientation=turn.as_quat(scalar_first=True),
        fps=1,
    )
    action = _with_next_states(pose).extra["action"]
    np.testing.assert_array_equal(action[:, :3], pose.position[[1, 2, 3, 3]])
    np.testing.assert_allclose(action[:, 3], [1 / 9, 2 / 9, 3 / 9, 3 / 9])
    bare = Demonstration(time=time, extra={"observation.state": q}, fps=1)
    np.testing.assert_array_equal(_with_next_states(bare).extra["action"], q[[1, 2, 3, 3]])


def plan_of(options=None, **arrays):
    fields = {name: array_field(name, np.asarray(array)) for name, array in arrays.items()}
    one = Recording(file=Path("run.npz"), fields=fields)
    given = ImportOptions(**(options or {}))
    return ImportPlan(recordings=(one, one), meaning=understand([one], given), options=given)


def test_a_preview_counts_and_names_ranges_of_fields():
    wide = np.hstack([Q, Q, Q])
    columns = {"joint_position": ["w[0:3]"], "joint_velocity": ["w[6:9]"], "action": "a"}
    plan = plan_of({"columns": columns, "fps": 10}, w=wide, a=Q, odd=Q[:, :1])
    assert plan.counts() == {
        "episodes": 2, "frames": 400, "understood": 2, "kept": 1, "left_out": 1,
    }  # fmt: skip
    text = "\n".join(plan.lines())
    assert "w[0:3]" in text
    assert "w[6:9]" in text
    assert "joint_position of 3" in text
    assert "2 episodes of 400 frames in all" in text
    assert "no commands" not in text
    assert '"a"' in plan.template()
    bare = plan_of({"fps": 10}, qpos=Q)
    assert "no commands were recorded: the next states are the actions" in [*bare.lines()]
    assert "no commands were recorded: the dataset has no actions" in [*bare.lines(False)]
    sure = [line.split() for line in bare.lines() if line.startswith("qpos")]
    assert sure[0][:6] == ["qpos", "joint_position", "of", "3", "rad", "95"]


def test_a_value_that_is_not_finite_is_named_with_its_frame():
    q = Q.copy()
    q[7, 1] = np.nan
    plan = plan_of({"fps": 10}, qpos=q)
    with pytest.raises(DatasetError, match="is nan at frame 7: cut or mend"):
        next(plan.episodes())


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


def test_half_of_the_joints_are_too_few_to_follow_a_command():
    other = np.cos(np.arange(200) / 7)[:, None] + 3
    two = np.hstack([Q[:, :1], other])
    assert "command_position" not in understood(qpos=Q[:, :2], action=two).selections
    three = np.hstack([Q[:, :2], other])
    assert "command_position" in understood(qpos=Q, action=three).selections
