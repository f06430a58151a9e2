"""A bag of an arm with a camera, as rosbag2 writes it, for measurements."""

from pathlib import Path
from typing import Any

import numpy as np

JOINTS = ("elbow", "shoulder_lift", "shoulder_pan", "wrist_1", "wrist_2", "wrist_3")
RATE, IMAGES = 500, 30
SIZE = (480, 640, 3)


def write_bag(path: Path, megabytes: float) -> Path:
    """Write joint states at 500 Hz, and raw images of 640x480 at 30 Hz."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    seconds = megabytes * 1e6 / (IMAGES * np.prod(SIZE))
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 255, (8, 10, 3), np.uint8).repeat(60, 0).repeat(64, 1)

    def header(time: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time), nanosec=int(time % 1 * 1e9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = ("sensor_msgs/msg/JointState", "sensor_msgs/msg/Image")
        topics = ("/joint_states", "/front/image_raw")
        states, images = (
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in zip(topics, kinds, strict=True)
        )
        for k in range(int(seconds * RATE)):
            time = 1.76e9 + k / RATE
            q = np.sin(0.5 * k / RATE + np.arange(6))
            content: dict[str, Any] = {"position": q, "velocity": 0 * q, "effort": 0 * q}
            state = types[kinds[0]](header=header(time), name=list(JOINTS), **content)
            writer.write(states, int(time * 1e9), store.serialize_cdr(state, kinds[0]))
            if int(k * IMAGES / RATE) == int((k - 1) * IMAGES / RATE) and k:
                continue
            content = {"height": SIZE[0], "width": SIZE[1], "step": 3 * SIZE[1]}
            data = np.roll(scene, k // 4, axis=1).ravel()
            image = types[kinds[1]](
                header=header(time), encoding="rgb8", is_bigendian=0, data=data, **content
            )
            writer.write(images, int(time * 1e9), store.serialize_cdr(image, kinds[1]))
    return path
