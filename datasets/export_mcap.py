"""Write the episodes of a LeRobot dataset into one MCAP file of ROS 2 messages.

Foxglove and other viewers open the file, `ros2 bag play` plays it, and `hrc import` makes a
dataset of it again. Joint states, commands, grippers, poses of the tool and further columns
equal those of the dataset to the bit, in SI units and radians; videos keep their encoding.

    python datasets/export_mcap.py --dataset demos --out demos.mcap --episodes 0 2
"""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hrc_learn import cli
from hrc_learn.demos import Demonstration, ImageReader, open_demos
from hrc_learn.demos.videos import encoded_samples
from hrc_learn.store import new_file

_PAUSE = 2.0
"""Time between two episodes [s]. `hrc import` divides bags where their joints pause."""
_VIDEO = "foxglove_msgs/msg/CompressedVideo"
_VIDEO_FIELDS = """\
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""
_BASE = "base_link"
"""Frame of the poses."""
_STATE = ("name", "position", "velocity", "effort")
"""Fields of a joint state."""

type _Timed = tuple[float, str, str, dict[str, Any]]
"""Time since the first frame [s], topic, message type, and fields other than the stamp."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Command line."""

    dataset: Path
    """Folder of the dataset."""
    out: Path
    """File to write; an existing one is replaced."""
    episodes: tuple[int, ...] = ()
    """Episodes to write; all by default."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    demos = open_demos(args.dataset, episodes=args.episodes or None, refuse_doubt=True)
    seconds = write_mcap(args.out, demos, ImageReader(args.dataset))
    print(f"{args.out}: {len(demos)} episodes, {seconds:.1f} s")
    cli.write_values(args.json, {"episodes": len(demos), "seconds": seconds})


def write_mcap(path: Path, demos: Iterable[Demonstration], reader: ImageReader) -> float:
    """Write demonstrations one after another into an MCAP file with ROS 2 messages.

    Quantities are in SI units and radians; other columns keep their unit. Videos keep their
    encoding if viewers can decode them on demand; other images become PNG files.

    Args:
        path: File to write; it appears only when complete.
        demos: The demonstrations. They keep their start times, except that each episode starts
            at least 2 s after the end of the episode before it.
        reader: Reader of the dataset's images.

    Returns:
        Duration of all demonstrations together [s].

    Raises:
        DatasetError: Images cannot be read.
    """
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_VIDEO_FIELDS, _VIDEO))
    made, free, total = store.types, _PAUSE, 0.0
    channels: dict[str, int] = {}
    with new_file(path) as part, part.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="hrc_learn")
        for demo in demos:
            start = max(free, demo.start_time)
            cameras = [_images(demo, reader, name) for name in reader.available(demo.episode)]
            streams = heapq.merge(_numbers(demo, made), *cameras, key=lambda one: one[0])
            for after, topic, kind, fields in streams:
                time = round((start + after) * 1e9)
                stamp = made["builtin_interfaces/msg/Time"](*divmod(time, 10**9))
                if kind == _VIDEO:
                    fields |= {"timestamp": stamp}
                elif not kind.startswith("std_msgs"):
                    fields |= {"header": made["std_msgs/msg/Header"](stamp, _BASE)}
                if topic not in channels:
                    text, _ = store.generate_msgdef(kind, ros_version=2)
                    schema = writer.register_schema(kind, "ros2msg", text.encode())
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                data = bytes(store.serialize_cdr(made[kind](**fields), kind))
                writer.add_message(channels[topic], time, data, time)
            free, total = start + demo.duration + _PAUSE, total + demo.duration
        writer.finish()
    return total


def _numbers(demo: Demonstration, made: Mapping[str, Any]) -> Iterator[_Timed]:
    """Task and all numbers of a demonstration, frame by frame.

    Args:
        demo: Demonstration.
        made: Class of each message type.
    """
    names, gripper = demo.joint_names, demo.gripper
    measured = (names, demo.joint_position, demo.joint_velocity, demo.joint_effort)
    commanded = (names, demo.command_position, demo.command_velocity, None)
    hand = (("gripper",), None if gripper is None else gripper[:, None], None, None)
    states = {"/joint_states": measured, "/command/joint_states": commanded}
    states |= {"/gripper/joint_states": hand}
    columns = {**demo.extra, "feature": demo.feature, "human_effort": demo.human_effort}
    place, turn = demo.position, demo.orientation
    if turn is None:
        columns["position"] = place
    layout = made["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    yield 0.0, "/task", "std_msgs/msg/String", {"data": demo.task}
    for k, time in enumerate(demo.time):
        for topic, (joints, *parts) in states.items():
            if any(part is not None for part in parts):  # empty: was not recorded
                rows = [np.zeros(0) if part is None else part[k] for part in parts]
                state: dict[str, Any] = dict(zip(_STATE, (list(joints), *rows), strict=True))
                yield time, topic, "sensor_msgs/msg/JointState", state
        if place is not None and turn is not None:
            point = made["geometry_msgs/msg/Point"](*place[k])
            quaternion = made["geometry_msgs/msg/Quaternion"](*turn[k, [1, 2, 3, 0]])
            pose = made["geometry_msgs/msg/Pose"](point, quaternion)
            yield time, "/tool/pose", "geometry_msgs/msg/PoseStamped", {"pose": pose}
        for key, values in columns.items():
            if values is not None:
                topic = "/" + key.replace(".", "/").replace(" ", "_")
                numbers = {"layout": layout, "data": values[k].astype(float).ravel()}
                yield time, topic, "std_msgs/msg/Float64MultiArray", numbers


def _images(demo: Demonstration, reader: ImageReader, camera: str) -> Iterator[_Timed]:
    """Images of a camera: the packets of its video, or PNG files."""
    name = camera.removeprefix("observation.images.")
    topic = f"/cameras/{name.replace('.', '/')}"
    segment = reader.segment(demo.episode, camera)
    video = None if segment is None else encoded_samples(segment)
    if video is not None:
        form = video.codec.replace("hevc", "h265")
        for time, data in zip(video.time, video.samples, strict=True):
            fields = {"data": np.frombuffer(data, np.uint8), "format": form, "frame_id": name}
            yield float(time), f"{topic}/video", _VIDEO, fields
        return
    for frame, image in reader.stream(demo.episode, camera):
        _, data = cv2.imencode(".png", image[..., ::-1])
        fields = {"format": "png", "data": data.ravel()}
        kind = "sensor_msgs/msg/CompressedImage"
        yield demo.time[frame], f"{topic}/compressed", kind, fields


if __name__ == "__main__":
    cli.run(main, Args)
