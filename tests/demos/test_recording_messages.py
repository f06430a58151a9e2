"""Messages of ROS become poses, joints and images."""

import base64
from types import SimpleNamespace as Message

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_messages import (
    Topic,
    image_field,
    image_of,
    matrix_of,
    parts_of,
    poses_of_frames,
    stamp_of,
)
from hrc_learn.demos.recording_tables import read_text_table

pytestmark = pytest.mark.simulation


def table(tmp_path, text, columns=()):
    path = tmp_path / "run.txt"
    path.write_text(text)
    found = read_text_table(path, columns)
    return {name: np.asarray(values).tolist() for name, values in found.items()}


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
        (
            Message(joint_names=["a"], points=[Message(positions=[4.0])]),
            [("arm/command/joint_positions", ("a",), [4])],
        ),
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


def test_a_frame_that_falls_silent_tells_of_no_more_poses():
    """Its last transform would put the tool anywhere."""
    edges = {("base", "a"): moving(0, 40), ("a", "tcp"): moving(1, 10)}
    (tool,) = poses_of_frames(edges).values()
    # The last transform, of 9.5 s, is held for three periods.
    assert tool.stamps == [k + 0.5 for k in range(13)]
    assert len(tool.received) == len(tool.values) == 13
    assert tool.values[-1][:2, 3].tolist() == [12, 9]
    edges["base", "a"] = moving(0, 40, late=90.0)  # both are never there together
    assert poses_of_frames(edges) == {}


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
