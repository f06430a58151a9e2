"""MCAP files of datasets: read by the package mcap, by rosbags, and by our own import."""

import av
import cv2
import numpy as np
import pytest
from clean_sets import CAMERA, write_set
from mcap.reader import make_reader
from programs_as_modules import load_program
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetWriter, ImageReader, load_demos
from hrc_learn.demos.recording_import import plan_import
from hrc_learn.demos.recording_names import ImportOptions

export_mcap = load_program("datasets/export_mcap.py")
pytestmark = pytest.mark.simulation  # whole datasets are written and read

JOINTS = ("shoulder", "elbow")
LENGTHS = (40, 25)


def image(k):
    shown = np.full((48, 64, 3), 60, np.uint8)
    shown[:, k : k + 16] = (220, 40, 40)
    return shown


def state(episode, k):
    """Joints, tool, gripper and a further column of a frame."""
    turn = Rotation.from_rotvec([0.1, 0.02 * k, -0.3]).as_quat(scalar_first=True)
    return {
        "joint_position": [np.sin(0.05 * k + episode), np.cos(0.07 * k)],
        "position": [0.4, 0.01 * k, 0.3],
        "orientation": turn,
        "gripper": 0.001 * k,
        "observation.shelf": [float(episode), 2.5],
    }


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("bag") / "set"
    features = {"observation.shelf": ["level", "height"]}
    with DatasetWriter(root, 20, "any", JOINTS, features, cameras={"front": (48, 64)}) as made:
        for episode, length in enumerate(LENGTHS):
            made.start_episode(f"place {episode}")
            for k in range(length):
                made.add_frame(images={"front": image(k)}, **state(episode, k))
            made.save_episode()
    return root


@pytest.fixture(scope="module")
def bag(root):
    demos = load_demos(root)
    seconds = export_mcap.write_mcap(root.parent / "set.mcap", demos, ImageReader(root))
    assert seconds == pytest.approx(sum(demo.duration for demo in demos))
    return root.parent / "set.mcap"


def read(path):
    """Topic -> times [ns] and messages, decoded by the definitions in the file alone."""
    store, found = get_typestore(Stores.EMPTY), {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema in reader.get_summary().schemas.values():
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
        last = 0
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert message.log_time >= last  # viewers need not sort
            last = message.log_time
            times, rows = found.setdefault(channel.topic, ([], []))
            times.append(message.log_time)
            rows.append(store.deserialize_cdr(message.data, schema.name))
    return found


def test_numbers_are_equal_to_the_bit(root, bag):
    found, demos = read(bag), load_demos(root)

    def every(name):
        return np.concatenate([getattr(demo, name) for demo in demos])

    _, states = found["/joint_states"]
    np.testing.assert_array_equal([one.position for one in states], every("joint_position"))
    assert {tuple(one.name) for one in states} == {JOINTS}
    assert all(len(one.velocity) == len(one.effort) == 0 for one in states)
    _, hand = found["/gripper/joint_states"]
    np.testing.assert_array_equal([one.position[0] for one in hand], every("gripper"))
    poses = [one.pose for one in found["/tool/pose"][1]]
    places = [(p.position.x, p.position.y, p.position.z) for p in poses]
    np.testing.assert_array_equal(places, every("position"))
    turns = [(q.w, q.x, q.y, q.z) for q in (p.orientation for p in poses)]
    np.testing.assert_array_equal(turns, every("orientation"))
    _, shelves = found["/observation/shelf"]
    assert [[*one.data] for one in shelves[:: LENGTHS[0]]] == [[0.0, 2.5], [1.0, 2.5]]
    assert [one.data for one in found["/task"][1]] == ["place 0", "place 1"]
    assert "/command/joint_states" not in found


def test_messages_carry_the_time_of_their_frame(root, bag):
    times, states = read(bag)["/joint_states"]
    stamps = [one.header.stamp.sec * 10**9 + one.header.stamp.nanosec for one in states]
    assert stamps == times
    first, second = load_demos(root)
    after = 1e-9 * (np.array(times) - times[0])
    np.testing.assert_allclose(after[: len(first)], first.time, atol=1e-9)
    # The next episode comes 2 s after the end of this one.
    expected = first.time[-1] + 2 + second.time
    np.testing.assert_allclose(after[len(first) :], expected, atol=1e-9)


def test_videos_keep_their_encoding(bag):
    times, packets = read(bag)["/cameras/front/video"]
    assert {(one.format, one.frame_id) for one in packets} == {("h264", "front")}
    assert [one.timestamp.nanosec for one in packets] == [time % 10**9 for time in times]
    decoder = av.CodecContext.create("h264", "r")
    shown = [f for one in packets for f in decoder.decode(av.Packet(bytes(one.data)))]
    shown += decoder.decode(None)
    assert len(shown) == len(packets) == sum(LENGTHS)
    for k in (0, 17, 39):
        assert np.abs(shown[k].to_ndarray(format="rgb24").astype(int) - image(k)).mean() < 6


def test_other_images_become_png_files(tmp_path):
    root = write_set(tmp_path / "set", "v3.0", camera=True)  # its video holds B-frames
    reader, demos = ImageReader(root), load_demos(root, episodes=[1])
    export_mcap.write_mcap(tmp_path / "set.mcap", demos, reader)
    _, files = read(tmp_path / "set.mcap")["/cameras/front/compressed"]
    assert {one.format for one in files} == {"png"}
    for k in (0, 9):
        shown = cv2.imdecode(files[k].data, cv2.IMREAD_COLOR)[..., ::-1]
        expected = reader.read(1, frames=[k])[CAMERA][0].permute(1, 2, 0)
        np.testing.assert_array_equal(shown, expected)


def test_import_gives_the_demonstrations_back(root, bag):
    plan = plan_import([bag], ImportOptions())
    episodes = [one.demonstration for one in plan.episodes()]
    assert len(episodes) == len(LENGTHS)
    for made, demo in zip(episodes, load_demos(root), strict=True):
        assert made.joint_names == demo.joint_names
        np.testing.assert_allclose(made.joint_position, demo.joint_position, atol=1e-6)
        np.testing.assert_allclose(made.position, demo.position, atol=1e-6)
        np.testing.assert_allclose(made.gripper, demo.gripper, atol=1e-6)
        np.testing.assert_allclose(np.diff(made.time), np.diff(demo.time), atol=1e-6)
    assert "camera" in "\n".join(plan.lines())


def test_chosen_episodes_are_written(root, run_here, tmp_path):
    out = tmp_path / "one.mcap"
    given = ("--dataset", root, "--out", out, "--episodes", 1)
    status, output, _ = run_here("datasets/export_mcap.py", *given)
    assert status == 0
    assert output == f"{out}: 1 episodes, {(LENGTHS[1] - 1) / 20:.1f} s\n"
    assert [one.data for one in read(out)["/task"][1]] == ["place 1"]
