"""Messages of robots as numbers, poses and images, recognised by their attributes.

Messages of any ROS version, JSON and protobuf are read alike; their types need no installation.
"""

import base64
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import compress, islice
from typing import Any

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.recording_files import Field, StreamRead, longest_hold
from hrc_learn.demos.videos import Image, decode_image, rgb_image

_JOINTS = {"position": "joint_positions", "velocity": "joint_velocities"}
_JOINTS |= {"effort": "joint_efforts"}
# Encodings of raw images: channels, and PyAV's name of the format.
_PIXELS = {"rgb8": (3, "rgb24"), "bgr8": (3, "bgr24"), "8uc3": (3, "bgr24")}
_PIXELS |= {"mono8": (1, "gray8"), "8uc1": (1, "gray8"), "yuv422_yuy2": (2, "yuyv422")}
_PIXELS |= {"rgba8": (4, "rgba"), "bgra8": (4, "bgra")}
_PIXELS |= {f"bayer_{p}8": (1, f"bayer_{p}8") for p in ("rggb", "bggr", "gbrg", "grbg")}
_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "av1": "av1", "vp9": "vp9"}
TOOL = re.compile(
    r"(?:^|[/_])(?:tcp|tool\d*|eef?|end_?effector|flange|hand)(?:$|[/_])", re.IGNORECASE
)
"""Names of tool frames, and of topics with the pose of a tool."""
_BASE = re.compile(r"(?:^|[/_])base(?:_link)?$|link_?0$", re.IGNORECASE)

type Messages = Callable[..., Iterator[tuple[str, int, Any]]]
"""Function that takes topics and the first time [ns]; it yields topic, time of reception [ns]
and message."""


@dataclass
class Topic:
    """Messages of one topic, or of one set of joints in a topic."""

    names: tuple[str, ...] | None = None
    received: list[float] = field(default_factory=list)
    """Times of reception [s]."""
    stamps: list[float] = field(default_factory=list)
    """Times in the messages [s]; 0 for messages without a time."""
    values: list[np.ndarray] = field(default_factory=list)
    sample: Any = None
    """First message; for images, its attributes name their format."""

    def add(self, received: int, stamp: float, value: np.ndarray, names: Any) -> None:
        """Add the numbers of a message, reordered to the names of the first message."""
        self.received.append(received * 1e-9)
        self.stamps.append(stamp)
        if names is not None and names != self.names:
            value = value[[names.index(name) for name in self.names or ()]]
        self.values.append(value)


def stamp_of(message: Any) -> float:
    """Time in a message [s]; 0 without one."""
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    stamp = stamp or getattr(message, "timestamp", None)
    seconds = getattr(stamp, "sec", getattr(stamp, "secs", getattr(stamp, "seconds", 0)))
    parts = ("nanosec", "nsecs", "nsec", "nanos")
    return seconds + 1e-9 * next((getattr(stamp, p) for p in parts if hasattr(stamp, p)), 0)


type Part = tuple[str, tuple[str, ...] | None, np.ndarray]
"""Field of a message, names of its components, and its values (empty for an image)."""


def parts_of(name: str, message: Any) -> Iterator[Part]:
    """Fields of a message; content that its attributes do not identify is left out."""
    has = lambda *names: all(hasattr(message, n) for n in names)  # noqa: E731
    if has("name", "position", "velocity"):
        for part, known in _JOINTS.items():
            values = np.array(getattr(message, part, ()), float)
            if len(values) == len(message.name) > 0:
                yield f"{name}/{known}", tuple(message.name), values
    elif has("joint_names"):
        points = getattr(message, "points", ())
        point = points[0] if len(points) == 1 else getattr(message, "reference", None)
        values = np.array(getattr(point or getattr(message, "desired", None), "positions", ()))
        if len(values) == len(message.joint_names) > 0:
            yield f"{name}/command/joint_positions", tuple(message.joint_names), values
    elif has("data") and (has("encoding", "width") or has("format") or has("pts")):
        yield name, None, np.zeros(0)
    elif has("pose"):
        yield from parts_of(name, message.pose)
    elif has("position", "orientation"):
        yield name, None, matrix_of(message.position, message.orientation)
    elif has("data") and not isinstance(message.data, (str, bytes)):
        values = np.atleast_1d(np.array(message.data))
        if values.dtype.kind in "fiub" and values.size and values.ndim == 1:
            yield name, None, values.astype(float)


def matrix_of(position: Any, turn: Any) -> Float64[np.ndarray, "4 4"]:
    """Transform from a position and a quaternion, which need not have unit length."""
    from scipy.spatial.transform import Rotation

    matrix, wxyz = np.eye(4), (turn.w, turn.x, turn.y, turn.z)
    if any(wxyz):
        matrix[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    matrix[:3, 3] = position.x, position.y, position.z
    return matrix


def poses_of_frames(edges: Mapping[tuple[str, str], list[tuple]]) -> dict[str, Topic]:
    """Poses, in the base frame, of tools and of frames without children, from `/tf` topics.

    A time is left out if a frame between base and tool has been silent for too long.
    """
    parents = {child: parent for parent, child in edges}
    moving = {c for (_, c), rows in edges.items() if np.ptp([r[2] for r in rows], axis=0).any()}
    wanted = [c for c in parents if TOOL.search(c) or c not in parents.values()]
    paths = {}
    for tip in wanted:
        chain = [tip]
        while parents.get(chain[-1]) not in (None, *chain):
            chain.append(parents[chain[-1]])
        last = max((k for k, frame in enumerate(chain) if frame in moving), default=-1)
        if last < 0:
            continue
        bases = [frame for frame in chain[last + 1 :] if _BASE.search(frame)]
        base = (bases or chain)[0 if bases else -1]
        links = chain[: chain.index(base)]
        rows = [edges[parents[c], c] for c in links]
        main = max((r for c, r in zip(links, rows, strict=True) if c in moving), key=len)
        times = np.array([r[1] or r[0] for r in main])
        poses, fresh = np.broadcast_to(np.eye(4), (len(times), 4, 4)), np.ones(len(times), bool)
        for frame, one in zip(links, rows, strict=True):
            own = np.array([r[1] or r[0] for r in one])
            at = np.maximum(np.searchsorted(own, times, side="right") - 1, 0)
            poses = np.stack([one[k if frame in moving else -1][2] for k in at]) @ poses
            if frame in moving:
                fresh &= times - own[at] <= longest_hold(own)
        if fresh.any():
            received, stamps, _ = map(list, zip(*compress(main, fresh), strict=True))
            values = [*poses[fresh]]
            paths[f"tf/{base}/{tip}"] = Topic(received=received, stamps=stamps, values=values)
    return paths


def image_field(name: str, one: Topic, messages: Messages, notes: list[str]) -> Field | None:
    """Field of an image topic; None, with a note, if the images cannot be read."""
    first, count = one.sample, len(one.received)
    kind = str(getattr(first, "encoding", "") or getattr(first, "format", "")).lower()
    raw, codec = hasattr(first, "width"), next((c for w, c in _CODECS.items() if w in kind), "")
    if "depth" in kind or kind in ("16uc1", "32fc1", "mono16"):
        return Field(shape=(count,), kind="depth", read=lambda a, b: np.zeros(0))
    if raw and not codec and kind not in _PIXELS:
        notes.append(f"{name} is left out: images of encoding {kind} are not read")
        return None

    def contents(start: int) -> Iterator[tuple[Any, bytes]]:
        since = int(one.received[start] * 1e9) - 1000  # 1 us earlier: times are rounded
        for _, _, message in messages([name, f"/{name}"], since):
            data = message.data
            yield message, base64.b64decode(data) if isinstance(data, str) else bytes(data)

    def decoded(start: int) -> Iterator[Any]:
        if codec:  # every image may depend on all earlier ones
            yield from islice(_decoded(name, codec, contents(0)), start, None)
        for message, data in contents(start):
            yield _rgb(message, data, *_PIXELS[kind]) if raw else data

    read = StreamRead(decoded)
    if not raw and not codec:
        return Field(shape=(count,), kind="encoded", read=read)
    return Field(shape=(count, *read(0, 1)[0].shape), kind="image", read=read)


def _decoded(name: str, codec: str, contents: Iterator[tuple[Any, bytes]]) -> Iterator[Image]:
    """RGB images of a video whose messages hold one packet each."""
    import av

    decoder: Any = av.CodecContext.create(codec, "r")
    image = None
    for _, data in contents:
        for frame in decoder.decode(av.Packet(data)):
            image = rgb_image(frame)
        if image is None:
            raise DatasetError("begins without a key frame", key=name)
        yield image


def image_of(message: Any) -> Image:
    """RGB image of a message with a raw or compressed image.

    Raises:
        DatasetError: The encoding is not supported, or the image is damaged.
    """
    if not hasattr(message, "width"):
        return decode_image(bytes(message.data))
    if message.encoding.lower() not in _PIXELS:
        raise DatasetError(f"images of encoding {message.encoding} are not read")
    return _rgb(message, bytes(message.data), *_PIXELS[message.encoding.lower()])


def _rgb(message: Any, data: bytes, channels: int, form: str) -> np.ndarray:
    """RGB image from raw data, whose rows may be padded beyond the width of the image."""
    import av

    rows = np.frombuffer(data, np.uint8).reshape(message.height, -1)
    image = rows[:, : message.width * channels]
    if channels > 1:
        image = image.reshape(message.height, message.width, channels)
    if form == "rgb24":
        return image
    return rgb_image(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), form))
