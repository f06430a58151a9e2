"""Bags of ROS 1 and ROS 2 and other MCAP files become demonstrations without ROS."""

import base64
import json
from fractions import Fraction

import av
import numpy as np
import pytest
from lerobot_folders import one_step_of_act
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_import import plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions

START = 1.76e9
UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")
SORTED = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint")
"""Order in which the broadcaster of a UR publishes these joints."""
STATES = np.arange(0, 2, 1 / 100)
COMMANDS = np.arange(0.002, 2, 1 / 50)
IMAGES = np.arange(0.004, 1.98, 1 / 20)


def joints(time):
    return np.stack([np.sin(2 * time + k) / (k + 1) for k in range(3)], axis=-1)


def position_of(name, time):
    return joints(np.asarray(time))[..., UR.index(name)]


class Messages:
    """Messages of one ROS version, by attribute names alone."""

    def __init__(self, store):
        self.store, self.rows = store, []

    def of(self, kind, **values):
        known = {name for name, _ in self.store.fielddefs[kind][1]}
        return self.store.types[kind](**{k: v for k, v in values.items() if k in known})

    def header(self, time, frame=""):
        seconds, rest = divmod(time, 1)
        stamp = self.of(
            "builtin_interfaces/msg/Time", sec=int(seconds), nanosec=int(rest * 1e9)
        )
        return self.of("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame)

    def add(self, topic, received, kind, **values):
        self.rows.append((received, topic, kind, self.of(kind, **values)))

    def state(self, topic, time, names, values, stamp=None):
        values, stamp = np.asarray(values, float), time if stamp is None else stamp
        content = {"position": values, "velocity": 0 * values, "effort": np.zeros(0)}
        header = self.header(stamp)
        kind = "sensor_msgs/msg/JointState"
        self.add(topic, time, kind, header=header, name=list(names), **content)

    def array(self, topic, time, values):
        layout = self.of("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        data = np.asarray(values, float)
        self.add(topic, time, "std_msgs/msg/Float64MultiArray", layout=layout, data=data)

    def image(self, topic, time, image):
        height, width = image.shape[:2]
        padded = np.pad(image[..., ::-1].reshape(height, -1), ((0, 0), (0, 5)))
        content = {"height": height, "width": width, "encoding": "bgr8", "is_bigendian": 0}
        content |= {"step": padded.shape[1], "data": padded.ravel()}
        self.add(topic, time, "sensor_msgs/msg/Image", header=self.header(time), **content)

    def compressed(self, topic, time, data, form):
        content = {"format": form, "data": np.frombuffer(data, np.uint8)}
        header = self.header(time)
        self.add(topic, time, "sensor_msgs/msg/CompressedImage", header=header, **content)

    def transform(self, topic, time, parent, child, matrix, stamp=None):
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        turn = self.of("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        moved = self.of(
            "geometry_msgs/msg/Vector3", **dict(zip("xyz", matrix[:3, 3], strict=True))
        )
        one = self.of(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time if stamp is None else stamp, parent),
            child_frame_id=child,
            transform=self.of("geometry_msgs/msg/Transform", translation=moved, rotation=turn),
        )
        self.add(topic, time, "tf2_msgs/msg/TFMessage", transforms=[one])

    def write(self, writer, serialize):
        connections = {}
        with writer:
            for received, topic, kind, message in sorted(self.rows, key=lambda row: row[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, kind, typestore=self.store
                    )
                data = getattr(self.store, serialize)(message, kind)
                writer.write(connections[topic], int(received * 1e9), data)


def ros2():
    return Messages(get_typestore(Stores.ROS2_JAZZY))


def write2(path, messages, plugin=StoragePlugin.MCAP):
    messages.write(Writer2(path, version=9, storage_plugin=plugin), "serialize_cdr")
    return path


def shown(k):
    image = np.full((48, 64, 3), (10 * k) % 256, np.uint8)
    image[:, :32] = (200, 30, 90)
    return image


def work(messages):
    """An arm with a camera: states at 100 Hz, commands at 50 Hz, images at 20 Hz."""
    for t in START + STATES:
        q = [position_of(name, t - START) for name in SORTED]
        messages.state("/joint_states", t, SORTED, q)
    for t in START + COMMANDS:
        messages.array("/forward_position_controller/commands", t, joints(t - START + 0.02))
    for k, t in enumerate(START + IMAGES):
        messages.image("/wrist_camera/color/image_raw", t, shown(k))
    return messages


def plan(*paths, **options):
    return plan_import(paths, ImportOptions(**options))


def write_db3(folder):
    return write2(folder / "bag", work(ros2()), StoragePlugin.SQLITE3)


def write_db3_alone(folder):
    return next(write_db3(folder).glob("*.db3"))


def write_mcap_alone(folder):
    return next(write2(folder / "bag", work(ros2())).glob("*.mcap"))


def write_ros1(folder):
    messages = work(Messages(get_typestore(Stores.ROS1_NOETIC)))
    messages.write(Writer1(folder / "work.bag"), "serialize_ros1")
    return folder / "work.bag"


KINDS = [write_db3, write_db3_alone, write_mcap_alone, write_ros1]


@pytest.mark.parametrize("write", KINDS)
def test_a_bag_of_each_kind_becomes_a_demonstration(tmp_path, write):
    made = plan(write(tmp_path))
    (episode,) = made.episodes()
    demo = episode.demonstration
    assert demo.joint_names == SORTED
    assert demo.fps == 20
    expected = np.stack(
        [position_of(n, demo.time + demo.start_time - START) for n in SORTED], 1
    )
    # Stamps near 1.76e9 s are known to 0.2 us.
    np.testing.assert_allclose(demo.joint_position, expected, atol=1e-5)
    # The controller's order is another one than that of the states: its joints are found.
    at = demo.time + demo.start_time - START
    late = np.stack([position_of(name, at + 0.02) for name in SORTED], axis=1)
    np.testing.assert_allclose(demo.command_position, late, atol=0.05)
    text = "\n".join(made.lines())
    assert "camera wrist_camera" in text
    assert any(
        "100 Hz are thinned: the first state after each image" in n for n in episode.notes
    )


def test_lerobot_reads_the_images_of_a_bag(tmp_path):
    LeRobotDataset = pytest.importorskip("lerobot.datasets").LeRobotDataset

    write_plan(plan(write_mcap_alone(tmp_path)), tmp_path / "set", "ur", True)
    dataset = LeRobotDataset("local/set", root=tmp_path / "set")
    assert len(dataset) == len(IMAGES)
    for k in (0, 7, 20):
        image = 255 * dataset[k]["observation.images.wrist_camera"].numpy()
        np.testing.assert_allclose(image[:, 24, 8], (200, 30, 90), atol=12)
        np.testing.assert_allclose(image[:, 24, 56], 10 * k, atol=12)


@pytest.mark.slow
def test_lerobot_trains_on_a_bag(tmp_path):
    write_plan(plan(write_mcap_alone(tmp_path)), tmp_path / "set", "ur", True)
    assert np.isfinite(one_step_of_act(tmp_path / "set"))


def test_a_wanted_rate_thins_the_states(tmp_path):
    messages = ros2()
    for t in START + STATES:
        messages.state("/joint_states", t, UR, joints(t - START))
    path = write2(tmp_path / "bag", messages)
    (whole,), (thin,) = plan(path).episodes(), plan(path, fps=25).episodes()
    assert len(whole.demonstration) == len(STATES)
    assert len(thin.demonstration) == len(STATES) // 4
    np.testing.assert_allclose(np.diff(thin.demonstration.time), 0.04, atol=1e-5)


@pytest.mark.parametrize("odd", ["a stamp twice", "two stamps exchanged"])
def test_images_count_by_their_reception_where_their_stamps_do_not_rise(tmp_path, odd):
    messages = ros2()
    for t in START + STATES:
        messages.state("/joint_states", t, UR, joints(t - START))
    stamps = IMAGES.copy()
    stamps[[10, 11]] = stamps[[10, 10]] if odd == "a stamp twice" else stamps[[11, 10]]
    for k, (stamp, received) in enumerate(zip(stamps, IMAGES + 0.003, strict=True)):
        messages.image("/wrist_camera/color/image_raw", START + stamp, shown(k))
        messages.rows[-1] = (START + received, *messages.rows[-1][1:])
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    # The first state after each image, all of which are kept.
    assert len(demo) == len(IMAGES)
    first = np.ceil((IMAGES + 0.003) * 100) / 100
    np.testing.assert_allclose(demo.time + demo.start_time - START, first, atol=1e-4)


def test_a_bag_that_is_silent_in_between_becomes_two_episodes(tmp_path):
    messages = work(ros2())
    messages.rows = [row for row in messages.rows if not 0.8 < row[0] - START < 1.3]
    made = plan(write2(tmp_path / "bag", messages))
    first, second = (one.demonstration for one in made.episodes())
    assert first.time[-1] + first.start_time - START < 0.81
    assert second.start_time - START > 1.29
    assert "joint_states/joint_positions is silent for 0.5" in "\n".join(made.lines())


def test_commands_that_pause_are_left_out_and_named(tmp_path):
    messages = work(ros2())
    messages.rows = [r for r in messages.rows if "commands" not in r[1] or r[0] < START + 0.5]
    messages.array("/forward_position_controller/commands", START + 1.9, joints(1.9))
    made = plan(write2(tmp_path / "bag", messages))
    assert not made.has_actions
    assert "commands is left out: it is silent for 1.4" in "\n".join(made.lines())


def test_a_gripper_on_the_topic_of_the_arm_is_kept_apart(tmp_path):
    messages = ros2()
    for t in START + STATES:
        messages.state("/joint_states", t, UR, joints(t - START))
        messages.state("/joint_states", t + 0.001, ["finger_joint"], [0.04 * (t - START)])
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    assert demo.joint_names == UR
    now = demo.time + demo.start_time - START
    np.testing.assert_allclose(demo.gripper, 0.04 * now, atol=5e-4)


def test_joints_keep_the_order_of_the_robot_description(tmp_path):
    messages = ros2()
    links = "".join(f'<joint name="{name}" type="revolute"/>' for name in UR)
    text = f'<robot name="ur">{links}</robot>'
    messages.add("/robot_description", START, "std_msgs/msg/String", data=text)
    for t in START + STATES:
        values = [position_of(name, t - START) for name in SORTED]
        messages.state("/joint_states", t, SORTED, values)
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    assert demo.joint_names == UR
    expected = joints(demo.time + demo.start_time - START)
    np.testing.assert_allclose(demo.joint_position, expected, atol=1e-5)


def test_commands_of_a_trajectory_are_put_in_the_order_of_the_joints(tmp_path):
    messages, empty = ros2(), np.zeros(0)
    for t in START + STATES:
        messages.state("/joint_states", t, UR, joints(t - START))
        point = messages.of(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array([position_of(name, t - START + 0.02) for name in SORTED]),
            velocities=empty,
            accelerations=empty,
            effort=empty,
            time_from_start=messages.of("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        )
        content = {"header": messages.header(t), "joint_names": list(SORTED), "points": [point]}
        messages.add("/arm/trajectory", t, "trajectory_msgs/msg/JointTrajectory", **content)
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    late = joints(demo.time + demo.start_time - START + 0.02)
    np.testing.assert_allclose(demo.command_position, late, atol=0.03)


@pytest.mark.parametrize("offset", [-START, 40.0])
def test_stamps_of_a_simulation_or_another_machine(tmp_path, offset):
    messages = ros2()
    for t in START + STATES:
        messages.state("/joint_states", t, UR, joints(t - START), stamp=t + offset)
        if offset > 0:
            messages.state("/leader/joint_states", t, UR, joints(t - START))
    made = plan(write2(tmp_path / "bag", messages))
    (episode,) = made.episodes()
    simulated = offset < 0  # all topics share that clock
    assert episode.demonstration.start_time == pytest.approx(
        0 if simulated else START, abs=0.01
    )
    said = "stamps are 40 s from the recorder's clock: times of reception" in "\n".join(
        made.lines()
    )
    assert said != simulated


def pose(time, angle=0.0):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zy", [np.sin(time), angle]).as_matrix()
    matrix[:3, 3] = (0.1 + angle, 0.2 * time, 0.3)
    return matrix


def test_transforms_become_poses_of_the_tool_in_the_base(tmp_path):
    messages, static = ros2(), np.eye(4)
    static[:3, 3] = (1, 2, 3)
    messages.transform("/tf_static", START, "world", "base_link", static, stamp=0)
    messages.transform("/tf_static", START, "link_2", "tool0", pose(0, 0.4), stamp=0)
    messages.transform("/tf_static", START, "link_2", "camera_mount", pose(0, 0.9), stamp=0)
    for t in START + STATES:
        messages.transform("/tf", t, "base_link", "link_1", pose(t - START))
        messages.transform("/tf", t, "link_1", "link_2", pose(2 * (t - START), 0.1))
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    for k in (0, 50, 150):
        now = demo.time[k] + demo.start_time - START
        expected = pose(now) @ pose(2 * now, 0.1) @ pose(0, 0.4)
        np.testing.assert_allclose(demo.position[k], expected[:3, 3], atol=1e-5)
        turn = Rotation.from_quat(demo.orientation[k], scalar_first=True)
        np.testing.assert_allclose(turn.as_matrix(), expected[:3, :3], atol=1e-5)


def test_the_only_pose_is_that_of_the_tool_whatever_its_name(tmp_path):
    messages = ros2()
    for t in START + STATES:
        x, y, z = 0.1 * joints(t - START)
        pose = messages.of(
            "geometry_msgs/msg/Pose",
            position=messages.of("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=messages.of("geometry_msgs/msg/Quaternion", x=0, y=0, z=0, w=1),
        )
        header = messages.header(t)
        messages.add("/tracker/p", t, "geometry_msgs/msg/PoseStamped", header=header, pose=pose)
        messages.image("/front/color", t, shown(3))
    (episode,) = plan(write2(tmp_path / "bag", messages)).episodes()
    demo = episode.demonstration
    expected = 0.1 * joints(demo.time + demo.start_time - START)
    np.testing.assert_allclose(demo.position, expected, atol=1e-5)
    assert [*episode.images] == ["front"]


def write_json_mcap(path, finish=True):
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        schema = writer.register_schema("Joints", "jsonschema", b"{}")
        arm = writer.register_channel("/arm/joint_states", "json", schema)
        camera = writer.register_channel("/front/image_raw", "json", schema)
        for t in START + STATES:
            values = joints(t - START).tolist()
            content = {"name": UR, "position": values, "velocity": values, "effort": values}
            writer.add_message(arm, int(t * 1e9), json.dumps(content).encode(), int(t * 1e9))
        for k, t in enumerate(START + IMAGES):
            data = base64.b64encode(encoded(shown(k), "mjpeg", "yuvj444p")[0]).decode()
            content = json.dumps({"format": "jpeg", "data": data}).encode()
            writer.add_message(camera, int(t * 1e9), content, int(t * 1e9))
        if finish:
            writer.finish()
    return path


def encoded(image, codec, pixels, encoder=None):
    """Packets of one image."""
    if encoder is None:
        encoder = av.CodecContext.create(codec, "w")
        encoder.height, encoder.width, encoder.pix_fmt = *image.shape[:2], pixels
        encoder.time_base = Fraction(1, 20)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    packets = encoder.encode(frame.reformat(format=pixels))
    return [bytes(packet) for packet in packets or encoder.encode(None)]


def test_an_mcap_file_of_json_has_joints_and_images(tmp_path):
    path = write_json_mcap(tmp_path / "work.mcap")
    (episode,) = plan(path).episodes()
    demo = episode.demonstration
    expected = joints(demo.time + demo.start_time - START)
    np.testing.assert_allclose(demo.joint_position, expected, atol=1e-5)
    assert [*episode.images] == ["front"]
    assert len(demo) == len(IMAGES)


def test_compressed_video_is_decoded(tmp_path):
    LeRobotDataset = pytest.importorskip("lerobot.datasets").LeRobotDataset

    messages = work(ros2())
    messages.rows = [row for row in messages.rows if "camera" not in row[1]]
    encoder = av.CodecContext.create("libx264", "w")
    encoder.height, encoder.width, encoder.pix_fmt = 48, 64, "yuv420p"
    encoder.time_base, encoder.options = (
        Fraction(1, 20),
        {"tune": "zerolatency", "preset": "ultrafast"},
    )
    for k, t in enumerate(START + IMAGES):
        (packet,) = encoded(shown(k), "", "yuv420p", encoder)
        messages.compressed("/front/video", t, packet, "h264")
    write_plan(plan(write2(tmp_path / "bag", messages)), tmp_path / "set", "ur", True)
    dataset = LeRobotDataset("local/set", root=tmp_path / "set")
    for k in (0, 20):
        image = 255 * dataset[k]["observation.images.front"].numpy()
        np.testing.assert_allclose(image[:, 24, 56], 10 * k, atol=12)


def test_a_bag_that_was_not_closed_says_how_to_mend_it(tmp_path):
    path = write_json_mcap(tmp_path / "work.mcap", finish=False)
    with pytest.raises(DatasetError, match=r"work\.mcap.*`mcap recover`"):
        plan(path)


def test_a_bag_without_joints_names_its_topics(tmp_path):
    messages = ros2()
    messages.add("/chatter", START, "std_msgs/msg/String", data="hello")
    with pytest.raises(DatasetError, match=r"no topic holds joints.*/chatter"):
        plan(write2(tmp_path / "bag", messages))


def test_a_bag_that_a_program_wrote_at_once_needs_a_rate(tmp_path):
    messages = ros2()
    for k, t in enumerate(STATES):
        messages.state("/joint_states", START + 2e-6 * k, UR, joints(t), stamp=0)
    path = write2(tmp_path / "bag", messages)
    with pytest.raises(DatasetError, match="there are no stamps"):
        [*plan(path).episodes()]
    (episode,) = plan(path, fps=100).episodes()
    np.testing.assert_allclose(episode.demonstration.joint_position, joints(STATES))
