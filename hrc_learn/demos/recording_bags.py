"""Bags of ROS 1 and ROS 2 (.bag, .db3, .mcap, folders) and other MCAP files as recordings.

No ROS is needed: the packages rosbags and mcap read the files.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64, Int64

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.recording_files import Field, Recording, array_field, longest_hold
from hrc_learn.demos.recording_messages import (
    TOOL,
    Messages,
    Topic,
    image_field,
    matrix_of,
    parts_of,
    poses_of_frames,
    stamp_of,
)

_SHORTEST = 0.5
"""Duration below which a part between gaps is left out [s]."""
_SAME_CLOCK = 0.5
"""Largest difference between stamps and times of reception if both use one clock [s]."""
_BURST = 2e-4
"""Smallest median interval between messages of a running robot [s]. Messages that were written
together after the motion are closer together."""
_ROS = {"cdr": "deserialize_cdr", "ros1": "deserialize_ros1"}


def read_bag(path: Path) -> list[Recording]:
    """Episodes of a bag; gaps in its joints or images divide it into several episodes.

    The stamps in the messages are used if their clock is the recorder's, or if all topics use
    the same clock; otherwise, the times of reception are used.

    Raises:
        DatasetError: The bag is damaged, or holds no topic that is understood.
    """
    types, messages = _opened_mcap(path) if path.suffix == ".mcap" else _opened_bag(path)
    topics, order = _gathered(types, messages)
    if not topics:
        kinds = ", ".join(f"{topic} ({kind})" for topic, kind in types.items())
        raise DatasetError(f"no topic holds joints, poses or images: {kinds}", file=path)
    notes: list[str] = []
    times, fields = _times(topics, notes), {}
    for name, one in topics.items():
        time, places = np.unique(times[name], return_index=True)
        if one.values[0].size:
            made = _numbers(name, one, places, order, notes)
        else:
            made = image_field(name, one, messages, notes)
            if len(places) < len(one.received) or (np.diff(places) < 0).any():
                time = np.array(one.received)
        if made is not None:
            clock = f"{name}/stamp"
            fields[name] = replace(made, clock=clock)
            fields[clock] = array_field(clock, time, unit="s")
    used = " ".join(f"/{name}/" for name in topics)
    unread = [t for t in types if f"/{t.strip('/')}/" not in used]
    if unread:
        notes.append(f"topics left out: {', '.join(f'{t} ({types[t]})' for t in unread)}")
    return _without_gaps(Recording(file=path, fields=fields, streams=True), notes)


def _opened_bag(path: Path) -> tuple[dict[str, str], Messages]:
    """Topic -> message type of a bag, and a function that reads its messages."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    def opened() -> AnyReader:  # bags older than ROS 2 Iron lack definitions
        return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))

    def messages(topics: Sequence[str], start: int | None = None) -> Iterator:
        with opened() as reader:
            known = reader.typestore.fielddefs
            wanted = [c for c in reader.connections if c.topic in topics and c.msgtype in known]
            for connection, time, raw in reader.messages(wanted, start) if wanted else ():
                yield connection.topic, time, reader.deserialize(raw, connection.msgtype)

    with opened() as reader:
        return {c.topic: c.msgtype for c in reader.connections}, messages


def _opened_mcap(path: Path) -> tuple[dict[str, str], Messages]:
    """Topic -> message type of an MCAP file, and a function that reads its messages."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    stream = path.open("rb")
    reader, store = make_reader(stream), get_typestore(Stores.EMPTY)
    try:
        summary = reader.get_summary()
    except McapError as error:
        text = f"is damaged or was not closed ({error}): repair it by `mcap recover`"
        raise DatasetError(text, file=path) from error
    if summary is None:
        raise DatasetError("has no index: repair it by `mcap recover`", file=path)
    for schema in summary.schemas.values():
        if schema.encoding == "ros2idl":
            store.register(get_types_from_idl(schema.data.decode()))
        elif schema.encoding in ("ros1msg", "ros2msg"):
            store.register(get_types_from_msg(schema.data.decode(), schema.name))

    def decoded(schema: Any, encoding: str, data: bytes) -> Any:
        if encoding in _ROS:
            name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
            return getattr(store, _ROS[encoding])(data, name)
        if encoding == "json":
            return json.loads(data, object_hook=lambda one: SimpleNamespace(**one))
        from mcap_protobuf.decoder import DecoderFactory

        decode = DecoderFactory().decoder_for(encoding, schema)
        return None if decode is None else decode(data)

    def messages(topics: Sequence[str], start: int | None = None) -> Iterator:
        for schema, channel, one in reader.iter_messages([*topics], starting_at=start):
            content = decoded(schema, channel.message_encoding, one.data)
            if content is not None:
                yield channel.topic, one.log_time, content

    schemas, channels = summary.schemas, summary.channels.values()
    names = {c.topic: schemas[c.schema_id].name if c.schema_id else "" for c in channels}
    return names, messages


def _gathered(
    types: Mapping[str, str], messages: Messages
) -> tuple[dict[str, Topic], list[str]]:
    """Field -> topic, and joint names in the order of the robot description.

    Drivers publish joints in any order, often alphabetically. The list of joint names is empty
    if the bag holds no robot description.
    """
    sets: dict[str, dict[frozenset[str], Topic]] = {}
    edges: dict[tuple[str, str], list[tuple[float, float, np.ndarray]]] = {}
    order: list[str] = []
    for topic, received, message in messages([*types]):
        stamp, data = stamp_of(message), getattr(message, "data", None)
        for one in getattr(message, "transforms", ()):
            edge = (one.header.frame_id.strip("/"), one.child_frame_id.strip("/"))
            pose = matrix_of(one.transform.translation, one.transform.rotation)
            edges.setdefault(edge, []).append((received * 1e-9, stamp_of(one), pose))
        if isinstance(data, str) and topic.endswith("robot_description") and not order:
            order = [j.get("name", "") for j in ElementTree.fromstring(data).iter("joint")]
        for name, names, value in parts_of(topic.strip("/"), message):
            group = sets.setdefault(name, {})
            one = group.setdefault(frozenset(names or ()), Topic(names))
            one.add(received, stamp, value, names)
            one.sample = one.sample or message
    topics = {}
    for name, group in sets.items():
        ranked = sorted(group.values(), key=lambda one: -len(one.values) * one.values[0].size)
        topics[name] = ranked[0]
        for one in ranked[1:]:  # a gripper's driver may publish to the same topic
            parent, _, last = name.rpartition("/")
            topics["/".join(filter(None, (parent, (one.names or "?")[0], last)))] = one
    return topics | poses_of_frames(edges), order


def _times(
    topics: Mapping[str, Topic], notes: list[str]
) -> dict[str, Float64[np.ndarray, " _messages"]]:
    """Times of the messages of each topic [s], on one clock."""
    times, late = {}, {}
    for name, one in topics.items():
        stamps, received = np.array(one.stamps), np.array(one.received)
        late[name] = float(np.median(stamps - received)) if stamps[1:].all() else np.nan
    offsets = np.array([*late.values()])
    shared = bool(np.ptp(offsets) < _SAME_CLOCK)  # such as the clock of a simulation
    for name, one in topics.items():
        own = shared or abs(late[name]) < _SAME_CLOCK
        times[name] = np.array(one.stamps if own else one.received)
        if not own and not np.isnan(late[name]):
            text = f"its stamps are {late[name]:.3g} s from the recorder's clock"
            notes.append(f"{name}: {text}: times of reception are used")
    return times


def _numbers(
    name: str,
    one: Topic,
    places: Int64[np.ndarray, " _frames"],
    order: Sequence[str],
    notes: list[str],
) -> Field | None:
    """Field of a topic of numbers; None, with a note, if it cannot be used.

    Args:
        name: Name of the field.
        one: Messages of the topic.
        places: Indices of the messages, sorted by time, without repeated times.
        order: Joints in the order of the robot's description.
        notes: Receives a note on everything that is left out.
    """
    if len({value.shape for value in one.values}) > 1:
        notes.append(f"{name} is left out: its messages differ in size")
        return None
    values, names = np.stack(one.values), one.names
    if not np.isfinite(values).all() and not name.endswith("joint_positions"):
        notes.append(f"{name} is left out: it holds NaN")
        return None
    if len(places) < len(values):
        notes.append(f"{name}: {len(values) - len(places)} messages with repeated stamps")
    if names and {*names} <= {*order}:
        columns = [names.index(name) for name in order if name in names]
        values, names = values[:, columns], tuple(names[i] for i in columns)
    made = array_field(name, values[places], names=names)
    is_pose = values.shape[1:] == (4, 4) and not TOOL.search(name)
    return replace(made, kind="pose") if is_pose else made


def _without_gaps(whole: Recording, notes: list[str]) -> list[Recording]:
    """The parts of a recording in which the joints and all images are present."""
    fields = whole.fields
    clocked = {name: one for name, one in fields.items() if one.clock}
    if not any(one.kind == "number" for one in clocked.values()):
        # There are no joints and no frame named as a tool: any pose may be the tool's.
        poses = {n: replace(f, kind="number") for n, f in fields.items() if f.kind == "pose"}
        fields = {**fields, **poses}
    numbers = [n for n in clocked if fields[n].kind == "number"]
    main = max(
        numbers, key=lambda n: (n.endswith("joint_positions"), fields[n].frames), default=""
    )
    if not main:
        raise whole.error("no topic holds joints or poses of a tool")
    steady = [main, *(n for n, one in fields.items() if one.kind in ("image", "encoded"))]
    times = {n: fields[one.clock].numbers()[:, 0] for n, one in clocked.items()}
    if np.median(np.diff(times[main])) < _BURST:
        text = "its messages have no stamps and were all written at the same time"
        notes.append(f"{main}: {text}")
        bare = {n: replace(fields[n], clock="") for n in clocked}
        return [replace(whole, fields=bare, streams=False, notes=tuple(notes))]
    gaps = {name: _gaps(time) for name, time in times.items()}
    start = max(times[name][0] for name in steady)
    stop = min(times[name][-1] for name in steady)
    parts = [(start, stop)]
    for name in steady:
        for left, right in gaps[name]:
            parts = [p for a, b in parts for p in ((a, min(b, left)), (max(a, right), b))]
            if start < left < stop:
                text = f"silent for {right - left:.2f} s at {left - times[main][0]:.2f} s"
                notes.append(f"{name} is {text}: the bag is divided there")
    parts = [(a, b) for a, b in parts if b - a >= _SHORTEST]
    if not parts:
        raise whole.error(f"{', '.join(steady)} are never present together for {_SHORTEST} s")
    for name in [name for name in gaps if name not in steady]:
        if any(a < right and left < b for left, right in gaps[name] for a, b in parts):
            longest = max(right - left for left, right in gaps[name])
            notes.append(f"{name} is left out: it is silent for {longest:.2f} s")
            fields = {n: one for n, one in fields.items() if n != name}
    whole = replace(whole, fields=fields, notes=tuple(notes))
    if parts == [(start, stop)]:
        return [whole]
    shown = whole.notes  # notes concern the whole bag, so only its first part shows them
    return [
        replace(whole, label=f"part {k}", fields=_during(fields, a, b), notes=shown * (not k))
        for k, (a, b) in enumerate(parts)
    ]


def _gaps(time: Float64[np.ndarray, " messages"]) -> list[tuple[float, float]]:
    """Times of the last message before and of the first message after each gap [s]."""
    steps = np.diff(time)
    if not len(steps):
        return [(-np.inf, np.inf)]
    wide = np.flatnonzero(steps > longest_hold(time))
    return [(float(time[k]), float(time[k + 1])) for k in wide]


def _during(fields: Mapping[str, Field], start: float, stop: float) -> dict[str, Field]:
    """Fields between two times [s]; each also keeps its last frame at or before `start`."""
    found = {}
    for name, one in fields.items():
        time = fields[one.clock or name].numbers()[:, 0]
        first = max(0, int(np.searchsorted(time, start, side="right")) - 1)
        found[name] = one.part(first, int(np.searchsorted(time, stop, side="right")))
    return found
