"""Meaning of the fields of recordings: by the caller's word, by name, and by their values.

Names and units are judged as for datasets (`read.columns`, `read.units`). What is not
understood is left out and listed, or kept as recorded where it is the state or the action.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.issues import aligned
from hrc_learn.demos.read.columns import ColumnSelection, map_columns, replaced_roles
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.metadata import Feature, Sidecar
from hrc_learn.demos.read.naming import is_hand, joint_of, meaning_of_component, role_of_key
from hrc_learn.demos.read.profiles import track
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, ROLES
from hrc_learn.demos.read.units import UnitDecision, unit_factor, units_from_episodes
from hrc_learn.demos.recording_files import UNNAMED, Field, Recording

Place = tuple[str, int]
"""Field and component."""

_DOUBTFUL = 0.6
"""Confidence below which a unit has to be given."""
_TIME = re.compile(
    r"%?(?:.*[_. ])?(?:t|time|timestamps?|time_?stamps?|stamps?|times|elapsed|elapsed_time|"
    r"rosbagtimestamp|secs?|seconds|ros_?time|(?:header[._])?stamp|zeit)"
    r"(?:[ _]?[\[(]?"
    r"(?P<unit>s|sec|secs|seconds|ms|msec|millis|us|usec|micros|ns|nsec|nanos)[\])]?)?"
)
_NO_CLOCK = re.compile(r"execut|cycle|delay|latency|comput|process|duration|delta|response")
_COMMAND = re.compile(
    r"(?:^|(?<=[_./ ]))(?:actions?|qaction|cmd|command|commanded|commands|target|desired|des|"
    r"setpoint|leader|master)(?=[_./ \d]|$)[_ ]?"
)
_STATE = re.compile(r"(?:low_dim_)?(?:states?|obs|observations?|proprio|agent_pos|robot_state)")
_IGNORED = {
    r"rewards?|terminals?|timeouts?|dones?|truncations?|is_(?:first|last|terminal)|discounts?|"
    r"success|mask|infos?|compress_len": "belongs to a learner, not to the robot",
    r"frame(?:_?(?:index|number|id|nr))?|step|seq|index|task_index": "counts frames",
    r"episode.*|demo(?:_?id)?|traj.*|trial|run": "counts episodes",
    r".*_ends": "ends of the episodes",
}
_LATER = re.compile(r"(?:^|/)next_")
_SYNONYMS = {
    "qpos": "q actual_q joint_angles joint_angle joint_states robot_q arm_qpos",
    "qvel": "dq qd qdot q_dot actual_qd",
    "effort": "tau tau_j torques",
    "eef_pos": "eef_position ee_positions tcp_positions",
    "eef_quat": "eef_orientation quat quaternion orientation_quat",
    "eef_rot6d": "rot6d",
    "tcp_pose": "pose poses o_t_ee end_effector_pose end_effector ee_poses",
    "gripper": "gripper_qpos gripper_state gripper_states gripper_opening",
}
_KEYS = {name: key for key, names in _SYNONYMS.items() for name in names.split()}
"""Names of whole fields in recordings -> the names that datasets use."""
_JOINT_NAME = re.compile(
    r"(?:.*[._\- ])?(?:j|q|jnt|joint|axis|motor|servo|dof|theta|angle|a)[ _\-.]*\[?\d+\]?"
    r"(?:[ _.\-]?[\[(]?(?:deg|degrees?|rad|radians?|pos|position)[\])]?)?|"
    r".*(?:shoulder|elbow|wrist|waist|forearm|upper_?arm|joint).*"
)
_MEASURED = re.compile(r"^(?:measured|meas|follower|puppet|obs|observation|state)[_. /]")
_INDEXED = re.compile(r"(.*?)[_.\[ ]?(\d+)\]?")
# ALOHA's `qpos`, `qvel`, `effort` and `action`: github.com/tonyzhaozh/act, record_episodes.py.
_ALOHA = tuple(
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in (
        *(
            "waist",
            "shoulder",
            "elbow",
            "forearm_roll",
            "wrist_angle",
            "wrist_rotate",
            "gripper",
        ),
    )
)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """The caller's word about recordings; also the content of a mapping file."""

    columns: dict[str, str | list[str]] = field(default_factory=dict)
    """Quantity of `demos.ROLES`, "action" or "observation.NAME" -> fields, ranges of fields
    ("qpos[0:6]") or columns."""
    images: dict[str, str] | None = None
    """Camera -> field; None for all images."""
    units: dict[str, str] = field(default_factory=dict)
    """Units by quantity."""
    time: str = ""
    """Field of the stamps."""
    joint_names: tuple[str, ...] = ()
    """Joint names."""
    fps: float | int | None = None
    """Frame rate [1/s] where there are no stamps; with stamps, it is only recorded."""
    duration: float | int | None = None
    """Duration of each episode [s] where there are no stamps."""
    task: str | None = None
    """Task in words."""
    hinted: bool = False
    """True if the caller named the columns of a file: unknown ones are then joints."""

    def __post_init__(self) -> None:
        for name, value in (("duration", self.duration), ("fps", self.fps)):
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive, got {value}")
        for name in self.columns:
            if name not in ROLES and name != "action" and not name.startswith("observation."):
                known = ", ".join(ROLES)
                text = f"columns name the unknown quantity {name!r}; known are {known}"
                raise ValueError(f"{text}, action and observation.NAME")


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What the fields of recordings were understood as."""

    selections: dict[str, ColumnSelection]
    """Columns of each quantity, by role; their keys are fields."""
    decisions: dict[str, UnitDecision]
    """Unit of each quantity."""
    joint_names: tuple[str, ...] = ()
    kept: dict[str, tuple[tuple[Place, ...], tuple[str, ...]]] = field(default_factory=dict)
    """Feature of the dataset -> columns that are kept as recorded, and their names there."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Camera -> field."""
    time: str = ""
    """Field of the stamps; "" if there is none."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Field -> reason."""
    notes: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    """Quantities whose unit the caller or the file gives."""
    warnings: tuple[str, ...] = ()
    """Doubts that may have changed the values."""

    @property
    def main(self) -> str:
        """Field whose frames are those of the state."""
        for role in ("joint_position", "position", *ORIENTATION_ROLES, *self.selections):
            if role in self.selections:
                return self.selections[role].columns[0][0]
        return self.kept["observation.state"][0][0][0]

    def lines(self, first: Recording) -> Iterator[str]:
        """The preview: one line for each quantity, and one for each field left out."""
        rows = [("fields", "understood as", "unit", "sure", "evidence")]
        for role, selection in self.selections.items():
            decision = self.decisions[role]
            units = ", ".join(dict.fromkeys(decision.units or (decision.unit,)))
            sure = f"{100 * decision.confidence:.0f} %"
            text = f"{role} of {len(selection.columns)}"
            evidence = decision.evidence or ("given" if role in self.given else "by its name")
            rows.append((_range(selection.columns), text, units, sure, evidence))
        for key, (places, _) in self.kept.items():
            rows.append((_range(places), f"{key}, as recorded", "?", "-", "no unit is known"))
        for camera, name in self.cameras.items():
            size = "x".join(map(str, first.fields[name].shape[1:3])) or "encoded"
            rows.append((name, f"camera {camera}", "px", "100 %", f"images ({size})"))
        if self.time:
            rows.append((self.time, "time", "s", "100 %", "by its name"))
        yield from aligned(rows)
        for reason in dict.fromkeys(self.left_out.values()):
            names = [name for name, why in self.left_out.items() if why == reason]
            yield f"left out: {', '.join(names)} ({reason})"
        yield from (f"note: {note}" for note in self.notes)

    def template(self) -> str:
        """The content of a mapping file (JSON) that says the same."""
        columns = {role: _tokens(s.columns) for role, s in self.selections.items()}
        columns |= {key: _tokens(places) for key, (places, _) in self.kept.items()}
        units = {role: decision.unit for role, decision in self.decisions.items()}
        content = {
            "columns": columns,
            "units": units,
            "images": self.cameras,
            "time": self.time,
            "joint_names": self.joint_names,
        }
        return json.dumps(content, indent=2) + "\n"


def _range(places: Sequence[Place]) -> str:
    return ", ".join(_tokens(places))


def _tokens(places: Sequence[Place]) -> list[str]:
    """Fields and ranges of fields that name the columns."""
    tokens: list[str] = []
    runs: list[tuple[str, int, int]] = []
    for name, index in places:
        if runs and runs[-1][0] == name and runs[-1][2] == index:
            runs[-1] = (name, runs[-1][1], index + 1)
        else:
            runs.append((name, index, index + 1))
    for name, start, stop in runs:
        tokens.append(str(name) if start == 0 and stop == 1 else f"{name}[{start}:{stop}]")
    return tokens


def understand(recordings: Sequence[Recording], options: ImportOptions) -> Meaning:
    """Find the quantities among the fields of recordings, and their units.

    Fields that the recordings do not have in common may only be ones without a meaning.

    Args:
        recordings: Episodes of one robot.
        options: The caller's word, which comes before names and values.

    Raises:
        DatasetError: A named field does not exist, nothing was understood, a quantity has a
            wrong number of columns, or its unit is too doubtful to convert.
    """
    first = recordings[0]
    meaning, search = _by_name(first, options)
    alike = {_signature(first)}
    for other in recordings[1:]:
        if (signature := _signature(other)) in alike:
            continue
        alike.add(signature)
        theirs, _ = _by_name(other, options)
        for what, one, two in (
            ("joints", meaning.joint_names, theirs.joint_names),
            ("arrays", _content(meaning), _content(theirs)),
        ):
            if one != two:
                text = f"{other.file} and {first.file} do not fit into one dataset: {what}"
                raise ValueError(f"{text} {', '.join(two)} and {', '.join(one)}")
    meaning = _with_units(meaning, options, recordings)
    named = "command_position" in options.columns
    return _with_commands(_with_reasons(meaning, first.fields), recordings, named, search)


def _signature(recording: Recording) -> frozenset[tuple[str, str, int]]:
    fields = recording.fields.items()
    return frozenset((n, f.kind, f.width if f.kind == "number" else 0) for n, f in fields)


def _content(meaning: Meaning) -> tuple[str, ...]:
    return (*meaning.selections, *meaning.kept, *meaning.cameras)


def _by_name(first: Recording, options: ImportOptions) -> "tuple[Meaning, _Search]":
    """Meaning of the fields of one episode by the caller's word and by their names."""
    fields = first.fields
    explicit = {
        role: _named_places(first, role, [tokens] if isinstance(tokens, str) else tokens)
        for role, tokens in options.columns.items()
    }
    explicit = {_encoding(role, len(places)): places for role, places in explicit.items()}
    given = {place[0] for places in explicit.values() for place in places}
    search = _Search(first, options.hinted)
    search.add_fields(
        {
            name: one
            for name, one in fields.items()
            if one.kind == "number" and name not in given and not is_time(name, one)
        }
    )
    found = map_columns(search.features, Sidecar())
    taken = replaced_roles(dict.fromkeys(explicit))
    selections = {
        role: search.located(selection)
        for role, selection in found.selections.items()
        if role not in taken
    }
    kept = {}
    for role, places in explicit.items():
        if role in ROLES:
            selections[role] = _selection(first, role, places)
        else:
            kept[role] = (tuple(places), _column_names(first, places))
    left_out = {n: _LEFT_OUT[one.kind] for n, one in fields.items() if one.kind in _LEFT_OUT}
    meaning = Meaning(
        selections=selections,
        decisions={},
        kept=kept,
        cameras=_cameras(first, options),
        left_out=left_out | search.left_out | {n + q: "name it" for n, q in search.unclear},
        notes=tuple(search.explained(n) for n in found.notes if "left among" not in n),
    )
    meaning = _with_fingers(_with_bare_vectors(meaning, search), search)
    if not meaning.selections and "observation.state" not in meaning.kept:
        there = ", ".join(name for name, one in fields.items() if one.kind == "number")
        text = f"name the arrays of joints or poses (joints, position); it holds {there}"
        raise first.error(text)
    meaning = replace(meaning, time=_time_field(first, options, meaning.main))
    return _with_joints(meaning, options, first), search


_LEFT_OUT = {
    "depth": "depth images are not written",
    "text": "text",
    "other": "neither numbers of frames nor images",
}


def _named_places(first: Recording, role: str, tokens: Sequence[str]) -> list[Place]:
    """Columns that the caller names for a quantity."""
    places: list[Place] = []
    for token in tokens:
        match = re.fullmatch(r"(.+)\[(\d+)(?::(\d+))?\]", token)
        name = _known(first, token)
        if name is None and match and (name := _known(first, match[1])) is not None:
            start = int(match[2])
            stop = int(match[3]) if match[3] else start + 1
            if not start < stop <= first.fields[name].width:
                text = f"{token} is no range of its {first.fields[name].width} components"
                raise first.error(text, role)
            places += [(name, index) for index in range(start, stop)]
        elif name is not None:
            places += [(name, index) for index in range(first.fields[name].width)]
        else:
            named = [
                (key, one.names.index(token))
                for key, one in first.fields.items()
                if one.names and token in one.names
            ]
            if len(named) != 1:
                there = ", ".join(first.fields)
                raise first.error(
                    f"there is no array {token!r} for {role}; it holds {there}", role
                )
            places += named
    return places


def _encoding(role: str, width: int) -> str:
    """Role of an orientation whose columns show that it is no quaternion."""
    others = {3: "rotation_vector", 6: "rotation_6d", 16: "pose_matrix"}
    return others.get(width, role) if role.startswith("quaternion") else role


def _known(first: Recording, token: str) -> str | None:
    """Field of this name, or the only one whose path ends so."""
    if token in first.fields:
        return token
    ends = [name for name in first.fields if name.endswith("/" + token)]
    return ends[0] if len(ends) == 1 else None


_TIME_WORDS = {"sec": "s", "secs": "s", "seconds": "s", "msec": "ms", "millis": "ms"}
_TIME_WORDS |= {"usec": "us", "micros": "us", "nsec": "ns", "nanos": "ns"}


def time_unit_in(name: str) -> str:
    """Unit that the name of stamps tells; "" if none."""
    match = _TIME.fullmatch(name.split("/")[-1].lower())
    unit = (match and match["unit"]) or ""
    return _TIME_WORDS.get(unit, unit)


def is_time(name: str, one: Field) -> bool:
    """True if the field holds stamps by its name."""
    last = name.split("/")[-1].lower()
    is_name = _TIME.fullmatch(last) and not _NO_CLOCK.search(last)
    return one.kind == "number" and one.width == 1 and bool(is_name)


def clock_of(recording: Recording, name: str, preferred: str = "") -> str:
    """Field that holds the stamps of another field; "" if there is none of as many frames.

    It is one that is named after the field, then one of the same group, then of a group around.
    """
    group, _, last = name.rpartition("/")
    word = re.split(r"[_\d]", last)[0]
    word = "\0" if word in ("actual", "target") else word

    def rank(other: str) -> tuple:
        parent, _, leaf = other.rpartition("/")
        named = leaf.startswith(word) and leaf != last
        around = group.startswith(parent)
        return (not named, parent != group, not around, other != preferred, len(other))

    frames = recording.fields[name].frames
    fields = recording.fields.items()
    stamps = [n for n, one in fields if one.frames == frames and n != name and is_time(n, one)]
    return min(stamps, key=rank, default="")


def _time_field(first: Recording, options: ImportOptions, main: str) -> str:
    """Field of the stamps of the state; "" if there is none."""
    if not options.time:
        return "" if options.duration is not None else clock_of(first, main)
    name = _known(first, options.time)
    if name is None:
        there = ", ".join(first.fields)
        text = f"there is no array {options.time!r} for time; it holds {there}"
        raise first.error(text, "time")
    return name


def _cameras(first: Recording, options: ImportOptions) -> dict[str, str]:
    """Cameras and the fields of their images."""
    if options.images is not None:
        named = {camera: _known(first, name) for camera, name in options.images.items()}
        for camera, name in named.items():
            if name is None or first.fields[name].kind not in ("image", "encoded"):
                text = f"there are no images {options.images[camera]!r}"
                raise first.error(f"{text}; it holds {', '.join(first.fields)}", camera)
        return {camera: name for camera, name in named.items() if name is not None}
    found: dict[str, str] = {}
    for name, one in first.fields.items():
        if one.kind in ("image", "encoded") and not _LATER.search(name):
            last = re.sub(r"_(?:image|rgb|img|color)$", "", name.split("/")[-1])
            plain = re.sub(r"\W+", "_", last).strip("_")
            found[plain if plain not in found else re.sub(r"\W+", "_", name)] = name
    return found


class _Search:
    """Fields presented as the features of a dataset, so that its conventions apply."""

    def __init__(self, first: Recording, hinted: bool):
        self._first, self._hinted = first, hinted
        self.features: dict[str, Feature] = {}
        self._places: dict[str, list[Place]] = {}
        self.states: list[str] = []
        """Vectors that are named as a state, but not by their content."""
        self.actions: list[str] = []
        self.fingers: list[tuple[bool, str, Place]] = []
        """For each finger among the joints: True in a command, name, column."""
        self.left_out: dict[str, str] = {}
        self.unclear: list[tuple[str, str]] = []
        """Parts of fields that only the caller can tell, and the question."""

    def add_fields(self, fields: Mapping[str, Field]) -> None:
        """Add fields of numbers."""
        table = {n: one for n, one in fields.items() if one.width == 1 and "/" not in n}
        aloha = all(
            any(n.split("/")[-1] == name and one.width == 14 for n, one in fields.items())
            for name in ("qpos", "action")
        )
        for name, one in fields.items():
            last = name.split("/")[-1].lower()
            reason = next((r for p, r in _IGNORED.items() if re.fullmatch(p, last)), None)
            if _LATER.search(name):
                reason = "the next frame's observation"
            if reason:
                self.left_out[name] = reason
            elif name not in table:
                self._add_vector(name, one, _ALOHA if aloha and one.width == 14 else one.names)
        self._add_table([name for name in table if name not in self.left_out])

    def _add(self, key: str, places: list[Place], names: tuple[str, ...] | None) -> None:
        while key in self.features:
            key = key.replace(".", ".other.", 1)
        shape = (len(places),)
        self.features[key] = Feature(key=key, dtype="float32", shape=shape, names=names)
        self._places[key] = places

    def _add_vector(self, name: str, one: Field, names: tuple[str, ...] | None) -> None:
        *parents, last = re.split(r"[/.]", name.lower())
        command = any(_COMMAND.search(part) for part in (*parents, last))
        bare = _COMMAND.sub("", last).strip("_. ")
        places = [(name, index) for index in range(one.width)]
        canonical = re.sub(r"^(?:robot|arm)\d*_(?=\w)", "", bare)
        canonical = _KEYS.get(canonical, canonical)
        is_pose = one.shape[1:] == (4, 4) or (one.width == 16 and "pose" in canonical)
        if canonical in ("pos", "position", "positions", "xyz"):
            joints = one.width != 3 or "/".join([*parents, "effort"]) in self._first.fields
            canonical = (
                "qpos" if joints and one.width > 3 else "eef_pos" if not joints else "state"
            )
        if one.shape[1:] == (3, 3) and re.search(r"rot|orient|^r$|mat", canonical):
            # The first two columns of a matrix, row by row.
            places, canonical = [places[i] for i in (0, 3, 6, 1, 4, 7)], "eef_rot6d"
        if is_pose:
            if re.search(r"cam|extrinsic|intrinsic|object|obj_|goal|start", name.lower()):
                self.left_out[name] = "transforms of another frame than the hand's"
                return
            canonical = "tcp_pose"
        elif canonical in ("tcp_pose", "ee", "eef", "cartesian_position") and one.width == 6:
            places, canonical = places[:3], "eef_pos"
            self.unclear.append((name, "[3:6]: angles of euler_xyz, or a rotation_vector?"))
        if names and (
            command or role_of_key(canonical) in JOINT_FIELDS or _STATE.fullmatch(last)
        ):
            arm = [i for i, label in enumerate(names) if not is_hand(label)]
            hands = [i for i in range(len(names)) if i not in arm]
            if role_of_key(canonical) in ("joint_position", None):
                self.fingers += [(command, joint_of(names[i]), places[i]) for i in hands]
            places, names = [places[i] for i in arm], tuple(names[i] for i in arm)
        elif not names and command and not bare:
            self.actions.append(name)
            return
        elif not names and not is_pose and (_STATE.fullmatch(canonical) or name == UNNAMED):
            self.states.append(name)
            return
        group = ".".join(part for part in parents if not _COMMAND.search(part))
        prefix = "action" if command else "observation"
        whole = canonical if role_of_key(canonical) else "state" if names else canonical
        key = ".".join(part for part in (prefix, group, whole) if part)
        if names and not role_of_key(canonical):
            key = "action" if command else "observation.state"
        self._add(key, places, names)

    def _add_table(self, columns: Sequence[str]) -> None:
        """Add the columns of a table, those that count as one vector."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name in columns:
            plain = _MEASURED.sub("", name.strip().lstrip("%").strip())
            command = bool(_COMMAND.search(plain.lower()))
            if command:
                kept = _COMMAND.sub("", plain.lower()).strip("_. ")
                plain = kept if kept and not kept.isdigit() else plain
            match = _INDEXED.fullmatch(plain)
            stem = (match[1] if match else plain).lower().strip("_. ")
            stem = _KEYS.get(re.sub(r"^(?:robot|arm)\d*_", "", stem), stem)
            prefix = "action" if command else "observation"
            if stem == "actual_tcp_pose" and match:  # of UR: a rotation vector
                role, slot = divmod(int(match[2]), 3)
                name_of = ("ee.{}", "ee.w{}")[role].format("xyz"[slot])
                groups.setdefault("observation.ee", []).append((name, name_of))
            elif role_of_key(stem) and not _is_single(stem):
                groups.setdefault(f"{prefix}.{stem}", []).append((name, plain))
            elif (
                meaning_of_component(plain)
                or _JOINT_NAME.fullmatch(plain.lower())
                or self._hinted
            ):
                key = "action" if command else "observation.state"
                groups.setdefault(key, []).append((name, plain))
            else:
                self.left_out[name] = "its name says nothing"
        for key, members in groups.items():
            # Names that only count, as q_0 and target_q_0, say no more than their order.
            named = tuple(plain for _, plain in members)
            counted = role_of_key(key) and all(map(_INDEXED.fullmatch, named))
            self._add(key, [(n, 0) for n, _ in members], None if counted else named)

    def explained(self, note: str) -> str:
        """A note of the reader about the field instead of the feature."""
        key, colon, text = note.partition(": ")
        return f"{self._places[key][0][0]}{colon}{text}" if key in self._places else note

    def located(self, selection: ColumnSelection) -> ColumnSelection:
        """The selection with fields for features."""
        columns = tuple(self._places[key][index] for key, index in selection.columns)
        return replace(selection, columns=columns)


def _is_single(stem: str) -> bool:
    role = role_of_key(stem)
    return role is None or ROLES[role].width == 1 if role in ROLES else False


def _column_names(first: Recording, places: Sequence[Place]) -> tuple[str, ...]:
    """A name for each column that is kept as recorded."""
    names = []
    for name, index in places:
        one, last = first.fields[name], name.split("/")[-1]
        if one.names:
            names.append(one.names[index])
        else:
            names.append(last if one.width == 1 else f"{last}_{index}")
    return tuple(names)


def _selection(first: Recording, role: str, places: Sequence[Place]) -> ColumnSelection:
    """Columns that the caller names for a quantity."""
    width = ROLES[role].width
    if width is not None and len(places) != width and not (role, len(places)) == ("gripper", 2):
        raise first.error(f"{role} takes {width} columns, not {len(places)}", role)
    names = _column_names(first, places)
    numbered = any(first.fields[n].width > 1 and not first.fields[n].names for n, _ in places)
    labels = tuple(joint_of(name) for name in names)
    return ColumnSelection(role=role, columns=tuple(places), labels=labels, numbered=numbered)


def _with_bare_vectors(meaning: Meaning, search: _Search) -> Meaning:
    """Keep vectors whose names tell no content as recorded, as state and action."""
    first, kept, left_out = search._first, dict(meaning.kept), dict(meaning.left_out)
    selections, notes = dict(meaning.selections), list(meaning.notes)
    for name in search.states:
        places = [(name, index) for index in range(first.fields[name].width)]
        if name == UNNAMED and not selections:
            selections |= _of_unnamed(first, places, notes)
        elif selections.keys() & {"joint_position", "position"} or "observation.state" in kept:
            left_out[name] = "a state of unknown content; name it: observation.NAME"
        else:
            kept["observation.state"] = (tuple(places), _column_names(first, places))
            notes.append(f"{name} is kept as recorded: its name tells no quantity")
    return replace(
        meaning, kept=kept, left_out=left_out, selections=selections, notes=tuple(notes)
    )


def _of_unnamed(
    first: Recording, places: list[Place], notes: list[str]
) -> dict[str, ColumnSelection]:
    """Joints of an array without a name, unless some of its columns are quaternions."""
    values = first.fields[UNNAMED].numbers()
    for start in range(values.shape[1] - 3):
        norms = np.linalg.norm(values[:, start : start + 4], axis=1)
        if len(values) > 1 and np.abs(norms - 1).max() < 1e-3:
            text = (
                f"columns {start} to {start + 3} are unit quaternions: name the columns, as in"
            )
            raise first.error(f"{text} --columns px py pz qw qx qy qz", UNNAMED)
    notes.append("nothing names the columns: taken for joints (--columns names them)")
    selection = _selection(first, "joint_position", places)
    return {"joint_position": replace(selection, numbered=True)}


def _with_fingers(meaning: Meaning, search: _Search) -> Meaning:
    """Add grippers that were found among the joints, or as two fingers."""
    selections, kept = dict(meaning.selections), dict(meaning.kept)
    for command in (False, True):
        fingers = [(name, place) for c, name, place in search.fingers if c == command]
        if not command and len(fingers) == 1 and "gripper" not in selections:
            one = ColumnSelection(role="gripper", columns=(fingers[0][1],), labels=("gripper",))
            selections["gripper"] = one
        elif fingers:
            key = "action" if command else "observation.state"
            names = tuple(f"{name}.pos" for name, _ in fingers)
            kept[key] = (tuple(place for _, place in fingers), names)
    for key, feature in search.features.items():
        known = selections.get("gripper")
        free = known is None or len(known.columns) == 1
        if free and role_of_key(key) == "gripper" and feature.width == 2:
            whole = ColumnSelection(
                role="gripper", columns=((key, 0), (key, 1)), labels=("a", "b")
            )
            selections["gripper"] = search.located(whole)
    return replace(meaning, selections=selections, kept=kept)


def _with_joints(meaning: Meaning, options: ImportOptions, first: Recording) -> Meaning:
    """Give the joints their names, and check that all quantities have as many."""
    chosen = {r: s for r, s in meaning.selections.items() if r in JOINT_FIELDS}
    if not chosen:
        return meaning
    main = chosen.get("joint_position") or next(iter(chosen.values()))
    width = len(main.columns)
    names = options.joint_names or (
        tuple(f"joint{i + 1}" for i in range(width)) if main.numbered else main.labels
    )
    if len(names) != width:
        raise first.error(
            f"{len(names)} joint names for {width} columns of joints", "joint_names"
        )
    selections, left_out = dict(meaning.selections), dict(meaning.left_out)
    for role, selection in chosen.items():
        if len(selection.columns) == width:
            selections[role] = replace(selection, labels=names)
        else:
            text = f"{len(selection.columns)} columns for {width} joints"
            left_out |= {name: text for name, _ in selection.columns}
            del selections[role]
    return replace(meaning, joint_names=names, selections=selections, left_out=left_out)


def read_columns(
    recording: Recording, places: Sequence[Place]
) -> Float64[np.ndarray, "_frames _columns"]:
    """Values of the columns in one episode, as recorded.

    Raises:
        DatasetError: The fields differ in their numbers of frames.
    """
    read = {
        name: recording.fields[name].numbers() for name in dict.fromkeys(n for n, _ in places)
    }
    lengths = {name: len(values) for name, values in read.items()}
    if len({*lengths.values()}) > 1:
        text = f"columns of one quantity differ in their numbers of frames: {lengths}"
        raise recording.error(text)
    return np.stack([read[name][:, index] for name, index in places], axis=1)


def _with_units(
    meaning: Meaning, options: ImportOptions, recordings: Sequence[Recording]
) -> Meaning:
    """Decide on the unit of each quantity; doubtful ones are refused."""
    for role, unit in options.units.items():
        unit_factor(role, unit)
    selections, first = meaning.selections, recordings[0]
    if not selections:
        return meaning
    declared = {}
    for role, selection in selections.items():
        units = [_declared(first.fields[name].unit) for name, _ in selection.columns]
        if all(units):
            declared[role] = units

    def episodes() -> Iterator[tuple[EpisodeEntry, dict[str, np.ndarray]]]:
        for index, one in enumerate(recordings):
            values = {r: read_columns(one, s.columns) for r, s in selections.items()}
            length = len(next(iter(values.values())))
            entry = EpisodeEntry(
                index=index, length=length, tasks=(), file=str(one.file), start=0
            )
            yield entry, values

    given = {role: unit for role, unit in options.units.items() if role in selections}
    decisions, faults = units_from_episodes(selections, episodes(), 1.0, declared, given)
    for fault in faults:
        raise fault
    warned: list[str] = []
    for role, decision in decisions.items():
        # Lengths in mm and in cm look alike, and a transform in mm like one in m.
        length = role in ("position", "pose_matrix") and role not in (*given, *declared)
        far = (
            role == "pose_matrix"
            and _largest(recordings, selections[role], (3, 7, 11)) > _REACH
        )
        if decision.confidence < _DOUBTFUL or (length and (decision.converts or far)):
            raise first.error(
                f"its unit is doubtful: {decision.evidence or 'its translation is large'}; "
                f"give it, as in --units {role} {'mm' if length else decision.unit}",
                _range(selections[role].columns),
            )
        if decision.converts:
            said = f"{decision.evidence}: taken for {decision.unit} and converted"
            warned.append(
                f"{role}: no unit is declared, {said}; overrule with --units {role} ..."
            )
        elif role in given and given[role] == "rad":
            largest = _largest(recordings, selections[role])
            if largest > 4 * np.pi:
                warned.append(
                    f"{role}: rad are given, but values reach {largest:.4g}: degrees?"
                )
    stated = (*given, *declared)
    return replace(meaning, decisions=decisions, warnings=tuple(warned), given=stated)


_REACH = 5.0
"""Beyond the reach of any arm on a fixed base [m]."""


def _largest(
    recordings: Sequence[Recording], selection: ColumnSelection, columns: Sequence[int] = ()
) -> float:
    """Largest absolute value of some columns of a quantity in the first episode."""
    places = [selection.columns[i] for i in columns] if columns else selection.columns
    return float(np.nanmax(np.abs(read_columns(recordings[0], places))))


_UNIT_WORDS = {
    **dict.fromkeys(("radian", "radians", "rads"), "rad"),
    **dict.fromkeys(("degree", "degrees", "degs", "°"), "deg"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("second", "seconds", "sec"), "s"),
    **dict.fromkeys(("nm", "n*m", "n.m", "newton meter"), "N m"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetres"), "mm"),
    "percent": "%",
}


def _declared(unit: str) -> str:
    """Unit in the words of `read.units`; "" if the file declares none."""
    plain = unit.strip()
    return _UNIT_WORDS.get(plain.lower(), plain)


def _with_reasons(meaning: Meaning, shared: Mapping[str, Field]) -> Meaning:
    """List every field that was not understood."""
    used = {name for s in meaning.selections.values() for name, _ in s.columns}
    used |= {name for places, _ in meaning.kept.values() for name, _ in places}
    used |= {*meaning.cameras.values(), meaning.time, *meaning.left_out}
    more = {
        name: "stamps" if is_time(name, one) else "not understood; to keep it: observation.NAME"
        for name, one in shared.items()
        if name not in used
    }
    return replace(meaning, left_out=meaning.left_out | more)


def _with_commands(
    meaning: Meaning,
    recordings: Sequence[Recording],
    named: bool,
    search: _Search,
) -> Meaning:
    """Take a recorded action for commands of the joints if the joints follow it."""
    selections, kept = dict(meaning.selections), dict(meaning.kept)
    decisions, left_out = dict(meaning.decisions), dict(meaning.left_out)
    notes, first = list(meaning.notes), recordings[0]
    joints = selections.get("joint_position")
    if "command_position" in selections and joints and not named:
        command = selections["command_position"]
        if not _followed(recordings, command.columns, joints.columns):
            del selections["command_position"], decisions["command_position"]
            kept.setdefault("action", (command.columns, _column_names(first, command.columns)))
            notes.append("the joints do not follow the recorded action: kept as recorded")
    for name in search.actions:
        places = [(name, index) for index in range(first.fields[name].width)]
        left_out.pop(name, None)
        if "command_position" in selections or "action" in kept:
            left_out[name] = "another action"
            continue
        width = len(joints.columns) if joints else 0
        arm, rest = places[:width], places[width:]
        fits = joints and len(rest) <= 1 and len(arm) == width
        if joints and fits and _followed(recordings, arm, joints.columns):
            command = replace(joints, role="command_position", columns=tuple(arm))
            selections["command_position"] = command
            unit, why = decisions["joint_position"], "the joints follow it"
            decisions["command_position"] = replace(unit, role=command.role, evidence=why)
            if rest:
                kept["action"] = (tuple(rest), ("gripper.pos",))
            continue
        kept["action"] = (tuple(places), _column_names(first, places))
        if joints:
            notes.append(f"the joints do not follow {name}: it is kept as recorded")
    return replace(
        meaning,
        selections=selections,
        decisions=decisions,
        kept=kept,
        left_out=left_out,
        notes=tuple(notes),
    )


_CHECKED_EPISODES = 5
_CHECK_RATE = 20.0
"""Frame rate at which a command is compared [1/s]: delays of up to 30 frames are found."""
_SLOPES = (0.5, 2.0)
"""Change of the joints per change of the command, if both are in the same unit."""


def _followed(
    recordings: Sequence[Recording], command: Sequence[Place], state: Sequence[Place]
) -> bool:
    """True if the joints move as the command does, in the same unit."""
    votes = []
    step = max(1, len(recordings) // _CHECKED_EPISODES)
    for one in recordings[::step]:
        given, measured = read_columns(one, command), read_columns(one, state)
        count = min(len(given), len(measured))
        given, measured = given[:count], measured[:count]
        tracking = track(given, measured, _CHECK_RATE)
        span = np.ptp(measured, axis=0)
        near = np.median(np.abs(given - measured), axis=0) <= 0.1 + 0.5 * span
        if tracking is None:
            votes.append(bool(near.all()))
            continue
        moving = np.isfinite(tracking.slope) & (span > 0.02 * span.max())
        fits = tracking.fit[moving] > 0.5
        slopes = (tracking.slope[moving] > _SLOPES[0]) & (tracking.slope[moving] < _SLOPES[1])
        votes.append(bool(np.mean(fits & slopes) > 0.5 and near.mean() > 0.5))
    return bool(np.mean(votes) > 0.5)
