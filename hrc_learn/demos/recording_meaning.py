"""Meaning of the fields of recordings, from the caller's options, their names and their values.

Names and units are judged as for datasets (`read.columns`, `read.units`). Fields that are not
understood are left out and listed. Only a state or an action that is not understood is kept as
recorded.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.read.columns import ColumnSelection, map_columns, replaced_roles
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.naming import joint_of
from hrc_learn.demos.read.profiles import are_positions, track
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, ROLES
from hrc_learn.demos.read.units import UnitDecision, unit_factor, units_from_episodes
from hrc_learn.demos.recording_files import UNNAMED, Recording, is_time, read_stamps
from hrc_learn.demos.recording_names import (
    FieldSearch,
    ImportOptions,
    Place,
    column_names,
    find_cameras,
)

_REACH = 5.0
"""Distance beyond the reach of any arm on a fixed base [m]."""
_ANGLES = re.compile(r"(?:^|[._])r_?x$", re.IGNORECASE)
_CHECKED_EPISODES, _CHECK_RATE = 5, 20.0
"""`_CHECKED_EPISODES`: approximate number of episodes in which commands are compared with
joints. `_CHECK_RATE`: frame rate of the comparison [1/s] for topics, and for recordings whose
rate is unknown."""
_ALIKE = 0.3
"""Bound on a ratio: the distance from a joint to the nearest unnamed command, divided by the
distance to the second nearest. The order of the commands is clear if every joint stays below
the bound."""


@dataclass(kw_only=True)
class Meaning:
    """Meaning of the fields of recordings, found step by step."""

    selections: dict[str, ColumnSelection]
    """Role -> columns of the quantity; each column names a field instead of a feature."""
    decisions: dict[str, UnitDecision] = field(default_factory=dict)
    """Role -> unit of the quantity."""
    joint_names: tuple[str, ...] = ()
    kept: dict[str, tuple[tuple[Place, ...], tuple[str, ...]]] = field(default_factory=dict)
    """Feature of the dataset -> columns kept as recorded, and their names in the feature."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Camera -> field."""
    time: str = ""
    """Field of the stamps; "" if there is none."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Field -> reason."""
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    """Doubtful decisions that may have changed the values."""

    @property
    def main(self) -> str:
        """Field of the state, which determines the frames of the episode."""
        for role in ("joint_position", "position", *ORIENTATION_ROLES, *self.selections):
            if role in self.selections:
                return self.selections[role].columns[0][0]
        return self.kept["observation.state"][0][0][0]

    @property
    def fields(self) -> list[str]:
        """Fields that are understood or kept, each once."""
        columns = [s.columns for s in self.selections.values()]
        columns += [places for places, _ in self.kept.values()]
        names = [name for places in columns for name, _ in places]
        return [*dict.fromkeys([*names, *self.cameras.values()])]


def understand(
    recordings: Sequence[Recording], options: ImportOptions, hinted: bool = False
) -> Meaning:
    """Find the quantities among the fields of recordings, and their units.

    Args:
        recordings: Episodes of one robot.
        options: The caller's options, which take precedence over names and values.
        hinted: True if the caller named the columns of a file: unknown columns are then joints.

    Raises:
        DatasetError: A named field does not exist, nothing was understood, a quantity has a
            wrong number of columns, or its unit is too doubtful to convert.
        ValueError: The recordings hold different quantities.
    """
    first = recordings[0]
    meaning, search = _by_name(first, options, hinted)
    alike = {_signature(first)}
    for other in recordings[1:]:
        if (signature := _signature(other)) in alike:
            continue
        alike.add(signature)
        theirs, found = _by_name(other, options, hinted)
        pairs = (meaning, search), (theirs, found)
        contents = [sorted([*m.selections, *m.kept, *m.cameras, *s.actions]) for m, s in pairs]
        used = [*meaning.fields, *search.actions, *filter(None, [meaning.time])]
        for what, one, two in (
            ("joints", meaning.joint_names, theirs.joint_names),
            ("arrays", *contents),
            ("fields", _shapes(first, used), _shapes(other, used)),
        ):
            if one != two:
                text = f"{other.file} and {first.file} do not fit into one dataset: {what}"
                raise ValueError(f"{text} {', '.join(two)} and {', '.join(one)}")
    _decide_units(meaning, options, recordings)
    _decide_commands(meaning, recordings, options, search.actions)
    used = {*meaning.fields, meaning.time, *meaning.left_out}
    meaning.left_out |= {
        name: "stamps" if is_time(name, one) else "not understood; to keep it: observation.NAME"
        for name, one in first.fields.items()
        if name not in used
    }
    return meaning


def _signature(recording: Recording) -> frozenset[tuple[str, str, int]]:
    fields = recording.fields.items()
    return frozenset((n, f.kind, f.width if f.kind == "number" else 0) for n, f in fields)


def _shapes(recording: Recording, names: Sequence[str]) -> list[str]:
    """Names of the existing fields; fields of numbers with their number of components."""
    fields = ((name, recording.fields[name]) for name in names if name in recording.fields)
    return [f"{n} ({one.width})" if one.kind == "number" else n for n, one in fields]


def _by_name(
    first: Recording, options: ImportOptions, hinted: bool
) -> tuple[Meaning, FieldSearch]:
    """Meaning of the fields of one episode, from the caller's options and their names."""
    explicit = _explicit(first, options)
    given = {place[0] for places in explicit.values() for place in places}
    search = FieldSearch(first, hinted)
    numbers = {n: f for n, f in first.fields.items() if f.kind == "number" and n not in given}
    search.add_fields({n: f for n, f in numbers.items() if not is_time(n, f)})
    found = map_columns(search.features)
    taken = replaced_roles(dict.fromkeys(explicit))
    chosen = {r: search.located(s) for r, s in found.selections.items() if r not in taken}
    # The preview already shows what the other notes say.
    notes = [n for n in found.notes if "left among" not in n and "assumed" not in n]
    meaning = Meaning(selections=chosen, left_out=search.left_out)
    meaning.cameras = find_cameras(first, options.images)
    meaning.notes += map(search.explained, notes)
    for role, places in explicit.items():
        if role in ROLES:
            meaning.selections[role] = _selection(first, role, places)
        else:
            meaning.kept[role] = (tuple(places), column_names(first, places))
    turn = meaning.selections.get("rotation_vector")
    if turn and "rotation_vector" not in explicit and _ANGLES.search(turn.columns[0][0]):
        text = "rx, ry, rz are taken for a rotation vector; if they are angles about x, y, z,"
        meaning.notes.append(f"{text} name them euler_xyz")
    _add_bare_vectors(meaning, first, search.states)
    _add_fingers(meaning, search)
    states = {"joint_position", "position", *ORIENTATION_ROLES}
    if not meaning.selections.keys() & states and "observation.state" not in meaning.kept:
        there = ", ".join(name for name, one in first.fields.items() if one.kind == "number")
        text = "name the arrays of joints or poses (joints, position); there are"
        raise first.error(f"{text} {there or 'none'}")
    if options.time:
        meaning.time = first.places(options.time, "time")[0][0]
    elif options.duration is None:
        meaning.time = first.clock_of(meaning.main)
    _name_joints(meaning, options.joint_names, first)
    return meaning, search


def _explicit(first: Recording, options: ImportOptions) -> dict[str, list[Place]]:
    """Columns that the caller names, by role or feature."""
    explicit = {}
    for role, tokens in options.columns.items():
        words = [tokens] if isinstance(tokens, str) else tokens
        places = [place for word in words for place in first.places(word, role)]
        # Orientations of three, six or sixteen columns are no quaternions.
        others = {3: "rotation_vector", 6: "rotation_6d", 16: "pose_matrix"}
        is_turn = role.startswith("quaternion")
        explicit[others.get(len(places), role) if is_turn else role] = places
    return explicit


def _selection(first: Recording, role: str, places: Sequence[Place]) -> ColumnSelection:
    """Columns that the caller names for a quantity."""
    width = ROLES[role].width
    if width is not None and len(places) != width and (role, len(places)) != ("gripper", 2):
        raise first.error(f"{role} needs {width} columns, not {len(places)}", role)
    numbered = any(first.fields[n].width > 1 and not first.fields[n].names for n, _ in places)
    labels = tuple(map(joint_of, column_names(first, places)))
    return ColumnSelection(role=role, columns=tuple(places), labels=labels, numbered=numbered)


def _add_bare_vectors(meaning: Meaning, first: Recording, states: Sequence[str]) -> None:
    """Keep a state of unknown content as recorded; an unnamed array is taken for joints."""
    for name in states:
        places = first.places(name, "state")
        if name == UNNAMED and not meaning.selections:
            meaning.notes.append(
                "the columns have no names: taken for joints (--columns names them)"
            )
            joints = _selection(first, "joint_position", places)
            meaning.selections["joint_position"] = replace(joints, numbered=True)
        elif (
            meaning.selections.keys() & {"joint_position", "position"}
            or "observation.state" in meaning.kept
        ):
            meaning.left_out[name] = "a state of unknown content; to keep it: observation.NAME"
        else:
            meaning.kept["observation.state"] = (tuple(places), column_names(first, places))
            meaning.notes.append(f"{name} is kept as recorded: its name states no content")


def _add_fingers(meaning: Meaning, search: FieldSearch) -> None:
    """Add grippers that were found among the joints, or as two fingers."""
    for command, key in ((False, "observation.state"), (True, "action")):
        fingers = [(name, place) for c, name, place in search.fingers if c == command]
        if not command and len(fingers) == 1 and "gripper" not in meaning.selections:
            meaning.selections["gripper"] = ColumnSelection(
                role="gripper", columns=(fingers[0][1],), labels=("gripper",)
            )
        elif fingers:
            names = tuple(f"{name}.pos" for name, _ in fingers)
            meaning.kept[key] = (tuple(place for _, place in fingers), names)
    if name := search.two_fingers:
        meaning.selections["gripper"] = ColumnSelection(
            role="gripper", columns=((name, 0), (name, 1)), labels=("left", "right")
        )


def _name_joints(meaning: Meaning, given: tuple[str, ...], first: Recording) -> None:
    """Give the joints their names; quantities with fewer or more joints are left out."""
    chosen = {r: s for r, s in meaning.selections.items() if r in JOINT_FIELDS}
    if not chosen:
        return
    main = chosen.get("joint_position") or next(iter(chosen.values()))
    width = len(main.columns)
    counted = tuple(f"joint{i + 1}" for i in range(width))
    names = given or (counted if main.numbered else main.labels)
    if len(names) != width:
        raise first.error(f"{len(names)} joint names for {width} columns of joints", "joints")
    meaning.joint_names = names
    for role, selection in chosen.items():
        meaning.selections[role] = replace(selection, labels=names)
        if len(selection.columns) != width:
            del meaning.selections[role]
            text = f"{len(selection.columns)} columns for {width} joints"
            meaning.left_out |= {name: text for name, _ in selection.columns}


def read_columns(
    recording: Recording, places: Sequence[Place]
) -> Float64[np.ndarray, "_frames _columns"]:
    """Values of the columns in one episode, as recorded.

    Raises:
        DatasetError: A field holds no numbers, or the fields differ in their numbers of frames.
    """
    names = dict.fromkeys(name for name, _ in places)
    for name in names:
        if recording.fields[name].kind in ("text", "other"):
            raise recording.error("holds no real numbers: save it as numbers", name)
    read = {name: recording.fields[name].numbers() for name in names}
    lengths = {name: len(values) for name, values in read.items()}
    if len({*lengths.values()}) > 1:
        text = f"columns of one quantity differ in their numbers of frames: {lengths}"
        raise recording.error(text)
    return np.stack([read[name][:, index] for name, index in places], axis=1)


def _decide_units(
    meaning: Meaning, options: ImportOptions, recordings: Sequence[Recording]
) -> None:
    """Decide on the unit of each quantity; a doubtful unit is an error."""
    for role, unit in options.units.items():
        unit_factor(role, unit)
    selections, first = meaning.selections, recordings[0]
    declared = {}
    for role, selection in selections.items():
        units = [first.fields[name].unit for name, _ in selection.columns]
        if all(units):
            declared[role] = units

    def episodes() -> Iterator[tuple[EpisodeEntry, dict[str, np.ndarray]]]:
        for index, one in enumerate(recordings):
            values = {r: read_columns(one, s.columns) for r, s in selections.items()}
            length = len(next(iter(values.values()), ()))
            place = {"tasks": (), "file": str(one.file), "start": 0}
            yield EpisodeEntry(index=index, length=length, **place), values

    given = {role: unit for role, unit in options.units.items() if role in selections}
    decisions, faults = units_from_episodes(selections, episodes(), 1.0, declared, given)
    for fault in faults:
        raise fault
    meaning.decisions, warned = decisions, meaning.warnings
    for role, decision in decisions.items():
        stated = role in given or role in declared
        doubt = None if stated else decision.doubt
        largest = _largest(first, selections[role], (3, 7, 11) if role == "pose_matrix" else ())
        if role == "pose_matrix" and not stated and largest > _REACH:
            doubt = f"{role} in m or mm? It reaches {largest:.4g}: give --units {role} mm, or m"
        if doubt is not None:
            doubt = doubt.partition(", or leave columns")[0]  # an option of other commands
            if role == "joint_position" and "gripper" not in selections:
                doubt = "; ".join([doubt, *_gripper_among(first, selections[role])])
            fields = ", ".join(dict.fromkeys(n for n, _ in selections[role].columns))
            raise first.error(f"the unit is doubtful: {doubt}", fields)
        if decision.converts:
            text = f"taken for {decision.unit} and converted; overrule with --units {role} ..."
            warned.append(f"{role}: no unit is declared, {decision.evidence}: {text}")
        elif given.get(role) == "rad" and largest > 4 * np.pi:
            warned.append(f"{role}: rad are given, but values reach {largest:.4g}: degrees?")
    if "joint_position" in selections and "gripper" not in selections:
        warned += _gripper_among(first, selections["joint_position"])


def _gripper_among(first: Recording, joints: ColumnSelection) -> list[str]:
    """One question, in a list, if the last columns are unnamed and behave like a gripper."""
    values = read_columns(first, joints.columns)
    if len(values) < 2:
        return []
    inside = np.all((values >= -0.01) & (values <= 1.05), axis=0)
    # A gripper rests at its ends; two fingers move alike.
    rests = np.mean(np.diff(values, axis=0) == 0, axis=0) > 0.5
    alike = values.shape[1] > 7 and np.allclose(values[:, -1], values[:, -2])
    count = 2 if alike and inside[-2:].all() else int(inside[-1] and rests[-1])
    if not joints.numbered or not count or rests[:-count].any():
        return []
    (name, index), width = joints.columns[-count], len(joints.columns)
    text = f"the last {count} of {width} columns of {name} behave as a gripper: if they are no"
    return [f"{text} joints, give --joints {name}[0:{index}] --gripper {name}[{index}:{width}]"]


def _largest(first: Recording, selection: ColumnSelection, columns: Sequence[int]) -> float:
    places = [selection.columns[i] for i in columns] or selection.columns
    values = np.abs(read_columns(first, places))
    return float(np.max(values, where=np.isfinite(values), initial=0.0))


def _decide_commands(
    meaning: Meaning,
    recordings: Sequence[Recording],
    options: ImportOptions,
    actions: Sequence[str],
) -> None:
    """Interpret a recorded action as commands of the joints if the joints follow it.

    Args:
        meaning: Receives the commands.
        recordings: Episodes.
        options: The caller's options.
        actions: Fields that hold an action, but do not name its content.
    """
    selections, kept, first = meaning.selections, meaning.kept, recordings[0]
    joints, command = selections.get("joint_position"), selections.get("command_position")

    def followed(places: Sequence[Place]) -> bool:
        rate = _rate_of(first, meaning, options)
        return joints is not None and _followed(recordings, places, joints.columns, rate)

    named = "command_position" in options.columns
    if command is not None and joints is not None and not named:
        if command.numbered:
            columns = _in_order(first, command.columns, joints.columns)
            selections["command_position"] = command = replace(command, columns=columns)
        if not followed(command.columns):
            del selections["command_position"], meaning.decisions["command_position"]
            kept.setdefault("action", (command.columns, column_names(first, command.columns)))
            text = "the joints do not follow the recorded action: kept as recorded"
            meaning.notes.append(text)
    for name in actions:
        if "command_position" in selections or "action" in kept:
            meaning.left_out[name] = "another action"
            continue
        places = tuple(first.places(name, "action"))
        width = len(joints.columns) if joints else 0
        arm, rest = places[:width], places[width:]
        fits = len(arm) == width and (not rest or (len(rest) == 1 and "gripper" in selections))
        arm = _in_order(first, arm, joints.columns) if joints and fits else arm
        if joints and fits and followed(arm):
            role, unit = "command_position", meaning.decisions["joint_position"]
            selections[role] = replace(joints, role=role, columns=arm)
            meaning.decisions[role] = replace(unit, role=role, evidence="the joints follow it")
            if rest:
                kept["action"] = (rest, ("gripper.pos",))
            continue
        kept["action"] = (places, column_names(first, places))
        if joints:
            meaning.notes.append(f"the joints do not follow {name}: it is kept as recorded")


def _rate_of(first: Recording, meaning: Meaning, options: ImportOptions) -> float | int:
    """Frame rate at which commands are compared with joints [1/s]."""
    frames, lasts = first.fields[meaning.main].frames, options.duration
    if first.streams:
        return _CHECK_RATE
    if meaning.time and first.fields[meaning.time].frames == frames > 1:
        unit, rate = options.units.get("time", ""), options.fps or first.fps
        time = read_stamps(first, meaning.time, unit, rate)
        return 1 / float(np.median(np.diff(time)))
    return frames / lasts if lasts else options.fps or first.fps or _CHECK_RATE


def _matched(
    one: Recording, command: Sequence[Place], state: Sequence[Place]
) -> tuple[Float64[np.ndarray, "times _commands"], Float64[np.ndarray, "times _joints"]]:
    """Values of commands and of joints at the same times."""
    given, measured = read_columns(one, command), read_columns(one, state)
    if one.streams:  # each topic has its own rate
        own = [one.fields[places[0][0]].clock for places in (command, state)]
        times = [one.fields[clock].numbers()[:, 0] for clock in own]
        first, last = max(t[0] for t in times), min(t[-1] for t in times)
        ticks = np.arange(first, last, 1 / _CHECK_RATE)
        if not len(ticks):
            text = f"the clocks of {command[0][0]} and of {state[0][0]} do not overlap"
            raise one.error(text)
        at = [np.searchsorted(t, ticks, side="right") - 1 for t in times]
        given, measured = given[at[0]], measured[at[1]]
    count = min(len(given), len(measured))
    return given[:count], measured[:count]


def _in_order(
    first: Recording, command: tuple[Place, ...], joints: Sequence[Place]
) -> tuple[Place, ...]:
    """Unnamed commands in the order of the joints, if the motion shows this order clearly.

    Controllers may order the joints differently.
    """
    if not len(command) == len(joints) > 1:
        return command
    given, measured = _matched(first, command, joints)
    apart = np.abs(given[:, :, None] - measured[:, None]).mean(axis=0)
    order = apart.argmin(axis=0)
    nearest, second = np.partition(apart, 1, axis=0)[:2]
    clear = len({*order}) == len(order) and (nearest < _ALIKE * second).all()
    return tuple(command[k] for k in order) if clear else command


def _followed(
    recordings: Sequence[Recording],
    command: Sequence[Place],
    state: Sequence[Place],
    rate: float | int,
) -> bool:
    """True if the joints follow the command in the same unit; `rate`: frame rate [1/s]."""
    votes = []
    for one in recordings[:: max(1, len(recordings) // _CHECKED_EPISODES)]:
        given, measured = _matched(one, command, state)
        apart = np.median(np.abs(given - measured), axis=0)
        near = apart <= 0.1 + 0.5 * np.ptp(measured, axis=0)
        tracking = track(given, measured, rate)
        known = [] if tracking is None else [{"command_position": tracking}]
        votes.append(near.mean() > 0.5 and are_positions(known, rate))
    return bool(np.mean(votes) > 0.5)
