"""Episodes of new motions in the columns of the demonstrations they were made of.

Columns whose meaning is known (joints, commands, tool, gripper, objects) get the values of the
new motion; all others are carried along from the demonstration. Every episode keeps its
provenance in the list of episodes, so that an interrupted job goes on where it stopped.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import DemonstrationSource
from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.dataset_arm import DatasetArm
from hrc_learn.demos.dataset_assembly import begin, finish
from hrc_learn.demos.read.dataset_folder import staging_folder
from hrc_learn.demos.read.frames import RawFrames, read_frames
from hrc_learn.demos.read.metadata import INDEX_FEATURES, Sidecar, read_sidecar
from hrc_learn.demos.read.metadata import episode_statistics as statistics
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm
from hrc_learn.store import Claim, json_text, parse_json

# Components that are the pose of an object: NAME.x, NAME.y, NAME.z, and its orientation.
_AXES = re.compile(r"(?P<name>.+?)[._](?P<axis>[xyz]|w[xyz]|q[wxyz])(?:[._]pos)?$")
_POSE = ("x", "y", "z", "wx", "wy", "wz", "qw", "qx", "qy", "qz")
_JOINTS = ("joint_position", "joint_velocity", "command_position", "command_velocity")
_TOOL = ("position", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw")
# Quantities that a new motion does not have: images, forces, and the recorder's own clock.
_LEFT_OUT = ("feature", "feature_visible", "human_effort", "joint_effort", "time")
# Values up to which a column is one of switches, which are not interpolated.
_LEVELS = 5

type Place = tuple[str, int]
"""Feature and number of a component."""


class MultipliedColumns:
    """Columns of new episodes.

    Attributes:
        features: Features of the new dataset, without LeRobot's index columns.
        objects: Pose of each object at the start of each demonstration, (n).
    """

    def __init__(
        self,
        source: DemonstrationSource,
        taught: DatasetArm,
        robot: Arm,
        objects: Mapping[str, str],
    ):
        """Find the meaning of each column.

        Args:
            source: Demonstrations.
            taught: Their arm.
            robot: Arm of the new motions.
            objects: Columns of objects that names do not tell, as FEATURE[FIRST:LAST].

        Raises:
            ValueError: Such columns do not exist, or are no pose.
        """
        self._source, self._taught, self._robot = source, taught, robot
        self._same = robot.name == taught.arm.name
        folder, self._selections = source.folder, source.columns.selections
        lost = {k for r in _LEFT_OUT if r in self._selections for k, _ in self._places(r)}
        known = {key: f for key, f in folder.features.items() if f.numeric}
        self._old = {k: f for k, f in known.items() if k not in (*INDEX_KEYS, *lost)}
        self._frames: list[RawFrames] = [
            frames for _, frames in read_frames(folder, source.entries, [*self._old])
        ]
        self._objects = self._object_columns(objects)
        self.objects = {name: self._first(places) for name, places in self._objects.items()}
        self.features = {
            key: {"dtype": f.dtype, "shape": list(f.shape), "names": f.names}
            for key, f in self._old.items()
        }
        if not self._same:
            self._rename()

    def _places(self, role: str) -> list[Place]:
        """Components of a quantity, of joints those of the arm in its order."""
        places = self._selections[role].columns
        return [places[c] for c in self._taught.columns] if role in _JOINTS else [*places]

    def _object_columns(self, given: Mapping[str, str]) -> dict[str, list[Place]]:
        """Components of the pose of each object."""
        taken = {place for role in self._selections for place in self._places(role)}
        found: dict[str, dict[str, Place]] = {}
        for key, feature in self._old.items():
            for i, name in enumerate(feature.names or ()):
                match = _AXES.match(name)
                if match and (key, i) not in taken and not key.startswith("action"):
                    found.setdefault(match["name"], {})[match["axis"]] = (key, i)
        places = {
            name: [axes[axis] for axis in _POSE if axis in axes]
            for name, axes in found.items()
            if {"x", "y", "z"} <= axes.keys() and len(axes) in (3, 6, 7)
        }
        for name, text in given.items():
            match = re.fullmatch(r"(.+)\[(\d+):(\d+)\]", text)
            numbers = range(int(match[2]), int(match[3])) if match else range(0)
            if not match or match[1] not in self._old or len(numbers) not in (3, 6, 7):
                raise ValueError(
                    f"objects.{name}.columns={text!r} must be FEATURE[FIRST:LAST] of 3, 6 or 7 "
                    f"columns; features are {', '.join(self._old)}"
                )
            places[name] = [(match[1], i) for i in numbers]
        return places

    def _first(self, places: Sequence[Place]) -> Pose:
        rows = [[float(frames[key][0, i]) for key, i in places] for frames in self._frames]
        return pose_of(torch.tensor(rows, dtype=torch.float64))

    def _rename(self) -> None:
        """Name and count the joints of another arm."""
        names = {k: np.array([f.names or [""] * f.width], object) for k, f in self._old.items()}
        old, new = self._taught.arm.joint_names[0], self._robot.joint_names
        for role in filter(self._selections.__contains__, _JOINTS):
            key, first = self._places(role)[0]
            pattern = str(names[key][0, first]).replace(old, "{}")
            self._replace(
                names, role, np.array([[pattern.format(name) for name in new]], object)
            )
        for key, row in names.items():
            listed = None if self._old[key].names is None else row[0].tolist()
            self.features[key] |= {"shape": [row.shape[1]], "names": listed}

    def _replace(self, made: dict[str, np.ndarray], role: str, values: np.ndarray) -> None:
        """Put the joints of this arm in the place of the demonstrated ones."""
        key = self._places(role)[0][0]
        columns = [i for _, i in self._places(role)]
        if self._same:
            made[key][:, columns] = values
            return
        # Joints in front of these have been replaced already, perhaps by fewer or more.
        more = self._robot.joints - self._taught.arm.joints
        before = sum(
            other in self._selections
            and self._places(other)[0] < (key, min(columns))
            and self._places(other)[0][0] == key
            for other in _JOINTS[: _JOINTS.index(role)]
        )
        columns = [i + more * before for i in columns]
        kept = np.delete(made[key], columns, 1)
        made[key] = np.insert(kept, [min(columns)] * values.shape[1], values, axis=1)

    def gripper(self, main: int, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """Commanded opening of the gripper, or the measured one if none was commanded."""
        places = [
            (not key.startswith("action"), key, i)
            for key, feature in self._old.items()
            for i, name in enumerate(feature.names or ())
            if "gripper" in name.lower()
        ]
        if not places:
            return np.zeros(len(phase))
        _, key, i = min(places)
        return self._along(main, key, phase)[:, i]

    def _along(
        self, main: int, key: str, phase: Float[np.ndarray, " T"]
    ) -> Float[np.ndarray, "T _components"]:
        """Columns of a demonstration at frames with fractions; switches stay switches."""
        values, made = self._frames[main][key].astype(float), []
        for column in values.T:
            smooth = len(np.unique(column)) > _LEVELS
            at = np.interp(phase, np.arange(len(column)), column)
            made.append(at if smooth else column[np.rint(phase).astype(int)])
        return np.stack(made, axis=1)

    def values(
        self,
        main: int,
        phase: Float[np.ndarray, " T"],
        joints: Float[np.ndarray, "T joints"],
        sent: Float[np.ndarray, "T joints"],
        gripper: Float[np.ndarray, " T"] | None,
        objects: Mapping[str, Float[np.ndarray, "T 7"]],
    ) -> dict[str, Float[np.ndarray, "T _components"]]:
        """Columns of a new episode in the units on disk.

        Args:
            main: Number of the demonstration whose other columns are carried along.
            phase: Its frame, with fractions, for each new frame.
            joints: Joint positions [rad].
            sent: Commanded joint positions [rad].
            gripper: Measured opening; None: that of the demonstration.
            objects: Pose of each object.
        """
        tool, dt = self._robot.forward(torch.from_numpy(joints)), 1 / self._source.fps
        made = {key: self._along(main, key, phase) for key in self._old}
        tools = self._encoded(tool, "rotation_vector", main)
        new: dict[str, np.ndarray] = dict(zip(_TOOL, tools, strict=True))
        if gripper is not None:
            new["gripper"] = gripper[:, None]
        for role in filter(self._selections.__contains__, new):
            on_disk = new[role] / self._source.units[role].factor
            for (key, i), column in zip(self._places(role), on_disk.T, strict=True):
                made[key][:, i] = column
                name = self._old[key].component(i)
                for other, feature in self._old.items():
                    # A command of the tool is its next pose, as LeRobot's robots take it.
                    names = [*(feature.names or ())] if other.startswith("action") else []
                    if role != "gripper" and name in names:
                        made[other][:, names.index(name)] = np.append(column[1:], column[-1])
        for name, path in objects.items():
            places = self._objects.get(name, ())
            pose = pose_of(torch.from_numpy(path))
            position, vector, turned, _ = self._encoded(pose, name, main)
            shown = np.concatenate([position, turned if len(places) == 7 else vector], axis=1)
            for (key, i), column in zip(places, shown.T, strict=False):
                made[key][:, i] = column
        rates = np.gradient(joints, dt, axis=0), np.gradient(sent, dt, axis=0)
        for role, values in zip(_JOINTS, (joints, rates[0], sent, rates[1]), strict=True):
            if role in self._selections:
                self._replace(made, role, self._on_disk(role, values))
        return made

    def _encoded(self, pose: Pose, of: str, main: int) -> tuple[np.ndarray, ...]:
        """Position, rotation vector and quaternions of poses.

        Rotation vectors continue that of the demonstration: at half a turn there are two.
        """
        places = self._objects.get(of) or []
        places = places[3:6] if len(places) == 6 else []
        if of in self._selections:
            places = self._places(of)
        near = [float(self._frames[main][key][0, i]) for key, i in places] or [0.0, 0.0, 0.0]
        vectors = torch.cat([torch.tensor([near]).double(), quaternion.log(pose.orientation)])
        vectors = quaternion.unwrap_log(vectors)[1:]
        q = quaternion.continuous(pose.orientation)
        return tuple(x.numpy() for x in (pose.position, vectors, q, q.roll(-1, -1)))

    def _on_disk(self, role: str, values: np.ndarray) -> np.ndarray:
        """Joint values as the dataset has them; the inverse of `DatasetArm.positions`."""
        decision, columns = self._source.units[role], list(self._taught.columns)
        factor = np.broadcast_to(decision.factor, len(self._source.joint_names))[columns]
        if not self._same:
            return values / factor[0]
        zero, one = np.zeros((2, len(self._source.joint_names))), np.ones(len(columns))
        if role.endswith("position") and {decision.unit_of(c) for c in columns} & {
            "%",
            "1",
            "tick",
        }:
            zero = self._taught.positions(zero)
            one = self._taught.positions(np.ones((1, zero.shape[1])))[0] - zero[0]
            values = values - zero[0]
        return values / one / factor


def pose_of(values: Float[torch.Tensor, "*batch numbers"]) -> Pose:
    """Pose from a position alone, with a rotation vector, or with a quaternion."""
    turned = values[..., 3:]
    if turned.shape[-1] == 4:
        return Pose(values[..., :3], quaternion.normalize(turned))
    turned = turned if turned.shape[-1] else torch.zeros_like(values)
    return Pose(values[..., :3], quaternion.exp(turned))


class MultipliedWriter:
    """Writer of episodes that goes on where a killed one stopped.

    Attributes:
        provenance: Provenance of each episode written so far.
    """

    def __init__(
        self,
        root: Path,
        robot_type: str,
        columns: MultipliedColumns,
        source: DemonstrationSource,
        made_by: Mapping[str, Any],
    ):
        """Describe the dataset; entering the context claims its folder.

        Args:
            root: Folder of the dataset.
            robot_type: Robot of the new episodes.
            columns: Their columns.
            source: Demonstrations.
            made_by: Settings; an interrupted recording is continued if it has the same.
        """
        before = read_sidecar(source.folder.root)
        units = {role: d.unit for role, d in source.units.items() if not d.units}
        same = robot_type == source.folder.robot_type
        kept = {r: c for r, c in before.columns.items() if same and c.key in columns.features}
        sidecar = Sidecar(
            units=units | before.units,
            columns=kept,
            joint_names=before.joint_names if same else (),
            frames=before.frames,
            details={"multiplied": parse_json(json_text(made_by))},
        )
        self.header = recorded.RecordingHeader(
            fps=source.fps,
            robot_type=robot_type,
            features=columns.features | INDEX_FEATURES,
            sidecar=sidecar,
        )
        self.root, self.provenance, self._frames = root, [], 0
        self._staging, self._tasks = staging_folder(root), {}

    def __enter__(self) -> "MultipliedWriter":
        """Claim the folder, and continue an interrupted recording.

        Raises:
            BusyError: Another process writes there.
            FileExistsError: There is something else.
        """
        self.root.parent.mkdir(parents=True, exist_ok=True)
        self._claim = Claim(self.root)
        try:
            if any(self._staging.glob("episode_*.parquet")) and not self.root.exists():
                self._continue()
            else:
                begin(self.root, None)
        except BaseException:
            self._claim.release()
            raise
        return self

    def _continue(self) -> None:
        for path in recorded.staged_paths(self._staging):
            staged = recorded.read_episode(path)
            if staged.header.sidecar.details != self.header.sidecar.details:
                raise FileExistsError(
                    f"{self._staging} holds an interrupted recording with other settings: "
                    "continue it with those, remove it, or choose another --out"
                )
            self._add(staged)

    def _add(self, staged: recorded.StagedEpisode) -> None:
        self.provenance.append(parse_json(staged.provenance))
        self._tasks.setdefault(staged.tasks[0], len(self._tasks))
        self._frames += len(staged.table)

    def write(
        self, values: Mapping[str, np.ndarray], task: str, provenance: Mapping[str, Any]
    ) -> None:
        """Write one episode; it is on disk when this returns."""
        number, at = len(self.provenance), self._tasks.get(task, len(self._tasks))
        length = len(next(iter(values.values())))
        tasks = np.full(length, at)
        index = recorded.index_columns(self.header.fps, number, self._frames, tasks)
        staged = recorded.StagedEpisode(
            header=self.header,
            tasks=[task],
            statistics=statistics({**values, **index}),
            table=recorded.to_table({**values, **index}, self.header.features),
            provenance=json_text(provenance, indent=False).strip(),
        )
        recorded.write_episode(recorded.episode_path(self._staging, number), staged)
        self._add(staged)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._claim:
            if kind is None:
                finish(self.root, self._claim)
