"""Names of the fields of recordings, and the caller's options.

Fields are treated as features of a dataset, so that the naming conventions of datasets apply.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from hrc_learn.demos.demonstration import JOINT_FIELDS
from hrc_learn.demos.read import naming
from hrc_learn.demos.read.columns import ColumnSelection, feature_key
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.quantities import ROLES
from hrc_learn.demos.recording_files import UNNAMED, Field, Recording
from hrc_learn.geometry.numerics import check_settings

Place = tuple[str, int]
"""Field and component."""

_WORDS = naming.WORDS["recordings"]
_COMMAND, _STATE, _IGNORED, _JOINT_NAME, _MEASURED, _NO_CAMERA, _OTHER_FRAME = (
    re.compile(_WORDS[name])
    for name in ("command", "state", "ignored", "joint", "measured", "no_camera", "other_frame")
)
_KEYS = {name: key for key, names in _WORDS["synonyms"].items() for name in names.split()}
"""Names of whole fields in recordings -> the names that datasets use."""
_INDEXED = re.compile(r"(.*?)[_.\[ ]?(\d+)\]?")
# ALOHA's `qpos`, `qvel`, `effort` and `action`: github.com/tonyzhaozh/act, record_episodes.py.
_ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_ALOHA = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in _ARM)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """The caller's options for recordings; also the content of a mapping file."""

    columns: dict[str, str | list[str]] = field(default_factory=dict)
    """Quantity of `demos.ROLES`, "action" or "observation.NAME" -> fields, ranges of fields
    ("qpos[0:6]") or columns."""
    images: dict[str, str] | None = None
    """Camera -> field; None for all images."""
    units: dict[str, str] = field(default_factory=dict)
    """Quantity -> its unit."""
    time: str = ""
    """Field of the stamps."""
    joint_names: tuple[str, ...] = ()
    """Joint names."""
    fps: float | int | None = None
    """Frame rate [1/s]. Without stamps, it determines the times. With stamps, it is stored in
    the dataset, and topics with a higher rate are thinned to it."""
    duration: float | int | None = None
    """Duration of each episode [s] where there are no stamps."""
    task: str | None = None
    """Task in words."""

    def __post_init__(self) -> None:
        check_settings(self, positive=("duration", "fps"))
        for name in self.columns:
            if name not in ROLES and name != "action" and not name.startswith("observation."):
                known = ", ".join([*ROLES, "action"])
                text = f"columns name the unknown quantity {name!r}; known are {known}"
                raise ValueError(f"{text} and observation.NAME")


def column_names(first: Recording, places: Sequence[Place]) -> tuple[str, ...]:
    """A name for each column."""
    names = []
    for name, index in places:
        one, last = first.fields[name], name.split("/")[-1]
        counted = last if one.width == 1 else f"{last}_{index}"
        names.append(one.names[index] if one.names else counted)
    return tuple(names)


def find_cameras(first: Recording, named: Mapping[str, str] | None) -> dict[str, str]:
    """Cameras and the fields of their images: those that the caller names, or else all images.

    Raises:
        DatasetError: A named field does not exist, or holds no images.
    """
    found: dict[str, str] = {}
    if named is not None:
        found = {
            camera: feature_key(camera, name, first.fields, first.file)
            for camera, name in named.items()
        }
        for camera, name in found.items():
            if first.fields[name].kind not in ("image", "encoded"):
                raise first.error(f"{name} holds no images", camera)
        return found
    for name, one in first.fields.items():
        if one.kind in ("image", "encoded") and not re.search(r"(?:^|/)next_", name):
            parts = [p for p in name.split("/") if not _NO_CAMERA.fullmatch(p)]
            last = ((first.streams and parts) or name.split("/"))[-1]
            last = re.sub(r"_(?:image|rgb|img|color)$", "", last)
            plain = re.sub(r"\W+", "_", last).strip("_")
            found[plain if plain not in found else re.sub(r"\W+", "_", name)] = name
    return found


class FieldSearch:
    """Features made of the numeric fields of an episode; other fields are left out.

    Attributes:
        features: Features by key.
        states: Fields that hold a state, but do not name its content.
        actions: Fields that hold an action, but do not name its content.
        fingers: Fingers among the joints, each as (True for a command, name, column).
        two_fingers: Field with the positions of a gripper's two fingers, "" if there is none.
        left_out: Field that is left out -> reason.
    """

    def __init__(self, first: Recording, hinted: bool):
        """
        Args:
            first: The episode.
            hinted: True if the caller named the columns: unknown columns are then joints.
        """
        self._first, self._hinted = first, hinted
        self.features: dict[str, Feature] = {}
        self._places: dict[str, list[Place]] = {}
        self.states: list[str] = []
        self.actions: list[str] = []
        self.fingers: list[tuple[bool, str, Place]] = []
        self.two_fingers = ""
        kinds = {"depth": "depth images are not written", "text": "text", "other": "no frames"}
        kinds["pose"] = "its name is not that of a tool; to use it: --orientation"
        kept = first.fields.items()
        self.left_out = {name: kinds[one.kind] for name, one in kept if one.kind in kinds}

    def add_fields(self, fields: Mapping[str, Field]) -> None:
        """Add fields of numbers."""
        wide = {n.split("/")[-1] for n, one in fields.items() if one.width == len(_ALOHA)}
        table = []
        for name, one in fields.items():
            parts = name.lower().split("/")
            if _IGNORED.fullmatch(parts[-1]) or any(part.startswith("next_") for part in parts):
                self.left_out[name] = "a counter, a reward, or the next frame"
            elif one.width == 1 and len(parts) == 1:
                table.append(name)
            else:
                aloha = {"qpos", "action"} <= wide and one.width == len(_ALOHA)
                self._add_vector(name, one, _ALOHA if aloha else one.names)
        self._add_table(table)

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
        plain = re.sub(r"^(?:robot|arm)\d*_(?=\w)", "", bare)
        key = self._canonical(name, _KEYS.get(plain, plain), one)
        places = [(name, index) for index in range(one.width)]
        if name in self.left_out:
            return
        if key == "tcp_pose" and str(one.width) in _WORDS["turns"]:
            # The encoding and its order are unknown.
            self.left_out[f"{name}[3:{one.width}]"] = _WORDS["turns"][str(one.width)]
            key, places = "eef_pos", places[:3]
        # Only robosuite is known to write x, y, z, w.
        if naming.role_of_key(key) == "quaternion_xyzw" and not re.match(r"robot\d_", bare):
            self.left_out[name] = _WORDS["turns"]["7"]
            return
        if (
            naming.role_of_key(key) == "gripper"
            and one.width < 3
            and (command or one.width == 2)
        ):
            self.two_fingers = self.two_fingers if command else name
            self.fingers += [(True, "gripper", places[0])] if command else []
            return
        of_joints = naming.role_of_key(key) in JOINT_FIELDS
        if names and (command or of_joints or _STATE.fullmatch(bare)):
            hands = [i for i, label in enumerate(names) if naming.is_hand(label)]
            if naming.role_of_key(key) in ("joint_position", None):
                self.fingers += [(command, naming.joint_of(names[i]), places[i]) for i in hands]
            arm = [i for i in range(len(names)) if i not in hands]
            places, names = [places[i] for i in arm], tuple(names[i] for i in arm)
        elif not names and command and not bare:
            self.actions.append(name)
            return
        elif not names and (_STATE.fullmatch(key) or key == UNNAMED):
            self.states.append(name)
            return
        prefix = "action" if command else "observation"
        group = [part for part in parents if not _COMMAND.search(part)]
        whole = ".".join([prefix, *group, key])
        if names and not naming.role_of_key(key):
            whole = "action" if command else "observation.state"
        self._add(whole, places, names)

    def _canonical(self, name: str, key: str, one: Field) -> str:
        """Name that datasets use for a whole field."""
        if one.shape[1:] == (4, 4) or (one.width == 16 and "pose" in key):
            if _OTHER_FRAME.search(name.lower()):
                self.left_out[name] = "transforms of a frame other than the hand"
            return "tcp_pose"
        if one.shape[1:] == (3, 3) and re.search(r"rot|orient|^r$|mat", key):
            return "eef_rotation_matrix"
        beside = f"{name.rpartition('/')[0]}/effort".lstrip("/")
        if key == "eef_pos" and (one.width != 3 or beside in self._first.fields):
            return "qpos" if one.width >= 3 else "state"  # ROS: position, velocity, effort
        if key in ("ee", "eef", "cartesian_position", "end_effector", "end_effector_pose"):
            return "tcp_pose"
        return key

    def _add_table(self, columns: Sequence[str]) -> None:
        """Add the columns of a table; columns of one quantity become a vector."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name in columns:
            plain = _MEASURED.sub("", name.strip().lstrip("%").strip())
            command = bool(_COMMAND.search(plain.lower()))
            if command:
                rest = _COMMAND.sub("", plain.lower()).strip("_. ")
                plain = rest if rest and not rest.isdigit() else plain
            match = _INDEXED.fullmatch(naming.without_unit(plain)[0])
            stem = (match[1] if match else plain).lower().strip("_. ").rpartition(".")[2]
            stem = "qpos" if match and stem in ("pos", "position", "positions") else stem
            key = _KEYS.get(re.sub(r"^(?:robot|arm)\d*_", "", stem), stem)
            prefix = "action" if command else "observation"
            if stem == "actual_tcp_pose" and match:  # UR: a rotation vector
                turn, slot = divmod(int(match[2]), 3)
                plain = f"ee.{'w' if turn else ''}{'xyz'[slot]}"
                groups.setdefault("observation.ee", []).append((name, plain))
            elif command and naming.is_hand(plain):
                self.fingers.append((True, naming.joint_of(plain), (name, 0)))
            elif naming.role_of_key(key) in JOINT_FIELDS:
                groups.setdefault(f"{prefix}.{key}", []).append((name, plain))
            elif self._hinted or _names_joint(plain):
                whole = "action" if command else "observation.state"
                groups.setdefault(whole, []).append((name, plain))
            else:
                self.left_out[name] = "its name is unknown"
        for key, members in groups.items():
            names = tuple(plain for _, plain in members)
            # Names that only number the columns, such as q_0, say no more than their order.
            counted = naming.role_of_key(key) and all(map(_INDEXED.fullmatch, names))
            self._add(key, [(n, 0) for n, _ in members], None if counted else names)

    def explained(self, note: str) -> str:
        """A note of the reader, with the field's name instead of the feature's."""
        key, colon, text = note.partition(": ")
        return f"{self._places[key][0][0]}{colon}{text}" if key in self._places else note

    def located(self, selection: ColumnSelection) -> ColumnSelection:
        """The selection with fields in place of features."""
        columns = tuple(self._places[key][index] for key, index in selection.columns)
        return replace(selection, columns=columns)


def _names_joint(name: str) -> bool:
    plain = naming.without_unit(name)[0].lower()
    return naming.meaning_of_component(name) is not None or bool(_JOINT_NAME.fullmatch(plain))
