"""Write new motions as episodes that have the same columns as the original demonstrations.

Columns whose meaning is known (joints, commands, tool, gripper, objects) get the values of the
new motion. All other columns are copied from corresponding frames of a demonstration. Every
episode stores its provenance, so that an interrupted job continues where it stopped.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import DemonstrationSource
from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.dataset_assembly import begin, discard, finish
from hrc_learn.demos.dataset_views import DatasetArm
from hrc_learn.demos.read.columns import column_places
from hrc_learn.demos.read.contract import Sidecar, read_sidecar
from hrc_learn.demos.read.dataset_folder import staging_folder
from hrc_learn.demos.read.frames import read_frames
from hrc_learn.demos.read.metadata import INDEX_FEATURES
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm
from hrc_learn.learning.multiply_motions import NewMotion
from hrc_learn.store import Claim, json_text, parse_json

# Names of the components of an object's pose: NAME.x, NAME.y and NAME.z, and likewise wx to wz
# of a rotation vector or qw to qz of a quaternion.
_AXES = re.compile(r"(?P<name>.+?)[._](?P<axis>[xyz]|w[xyz]|q[wxyz])(?:[._]pos)?$")
_POSE = ("x", "y", "z", "wx", "wy", "wz", "qw", "qx", "qy", "qz")
_JOINTS = ("joint_position", "joint_velocity", "command_position", "command_velocity")
_TOOL = ("position", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw")
# Quantities that a new motion does not have: image features, efforts, and the recorder's clock.
_LEFT_OUT = ("feature", "feature_visible", "human_effort", "joint_effort", "time")
# A column with at most this many distinct values is a switch, which is not interpolated.
_LEVELS = 5
# Largest distance of recorded tool positions from forward kinematics that counts as noise [m].
_APART = 5e-3
# `_MOVED`: distance from its first position beyond which an object has certainly moved [m].
# `_STILL`: distance up to which the object has not begun to move [m].
_MOVED, _STILL = 1e-2, 1e-3


type Place = tuple[str, int]
"""Place of one number in a frame: name of a feature, and index within this feature."""


class _Lead(NamedTuple):
    """Lead of commands over measured positions.

    An arm lags behind its commands by some frames, and deviates from them by an offset. The
    offset is a linear function of the position, limited to the range of offsets in the
    demonstrations.
    """

    frames: int = 1
    slope: Float[np.ndarray, "n n"] | float = 0.0
    """Change of the offset with the position."""
    offset: tuple[Any, Any, Any] = (0.0, 0.0, 0.0)
    """Offset at the origin, smallest and largest offset."""

    @classmethod
    def fit(cls, shown: Sequence[Any], most: float) -> Self:
        """Least-squares fit to measured and commanded positions of demonstrations.

        Args:
            shown: Measured and commanded positions of each demonstration, (T, n).
            most: Largest lead that is tried [frames].
        """
        found: list[tuple[float, int, Self]] = []
        for frames in range(1 + round(min(most, min(len(q) for q, _ in shown) / 2))):
            ahead = np.concatenate([cls(frames).commands(q) for q, _ in shown])
            x = ahead - ahead.mean(0)
            y = np.concatenate([c for _, c in shown]) - ahead
            # Directions with little variation (3 % of the largest) do not change the offset.
            slope = np.linalg.lstsq(x, y - y.mean(0), 0.03)[0]
            lead = cls(frames, slope, ((y - ahead @ slope).mean(0), y.min(0), y.max(0)))
            found.append((float((y - x @ slope).var(0).sum()), abs(frames - 1), lead))
        return min(found, key=lambda each: each[:2])[2]

    def commands(self, reached: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
        """Commands that lead to measured positions."""
        ahead = reached[(np.arange(len(reached)) + self.frames).clip(max=len(reached) - 1)]
        return ahead + np.clip(self.offset[0] + np.dot(ahead, self.slope), *self.offset[1:])


class MultipliedColumns:
    """Makes the columns of new episodes from a motion and the original demonstrations.

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
            taught: Arm of the demonstrations.
            robot: Arm of the new motions.
            objects: Name of an object -> columns of its pose as FEATURE[FIRST:STOP]; only
                needed for objects that cannot be found by the names of the columns.

        Raises:
            ValueError: Columns in `objects` do not exist, or do not form a pose.
        """
        self._source, self._taught, self._robot = source, taught, robot
        self._same = robot.name == taught.arm.name
        made = DatasetArm(robot, tuple(range(robot.joints)), taught.joints)
        self._made = taught if self._same else made
        selections = source.columns.selections
        self._places = {role: [*selections[role].columns] for role in selections}
        for role in filter(self._places.__contains__, _JOINTS):
            self._places[role] = [self._places[role][column] for column in taught.columns]
        lost = {key for r in _LEFT_OUT if r in self._places for key, _ in self._places[r]}
        known = {key: f for key, f in source.folder.features.items() if f.numeric}
        self._old = {key: f for key, f in known.items() if key not in (*INDEX_KEYS, *lost)}
        names = {k: f.names or () for k, f in self._old.items()}
        self._named = [(k, i, name) for k in names for i, name in enumerate(names[k])]
        self._frames = [f for _, f in read_frames(source.folder, source.entries, [*self._old])]
        self.objects: dict[str, Pose] = {}
        for name, places in self._object_columns(objects).items():
            self._places[f"object {name}"] = places
            first = np.stack([self._first(places, main) for main in range(len(source))])
            self.objects[name] = pose_of(torch.from_numpy(first))
        # Actions with the names of tool columns are commanded tool poses. They lead the tool
        # poses, as in the demonstrations (see `_Lead`).
        shown = {
            self._old[k].component(i): (r, n)
            for r in _TOOL
            for n, (k, i) in enumerate(self._places.get(r, ()))
        }
        self._actions = [named for named in self._named if named[0].startswith("action")]
        self._next = [(key, i, *shown[name]) for key, i, name in self._actions if name in shown]
        self._refuse_changes()
        self._lead, self._lag = self._find_lead(), self._gripper_lag()
        self._tool = self._recorded_tool()
        names = {k: np.array([f.names or [""] * f.width], object) for k, f in self._old.items()}
        if not self._same:
            self._rename(names)
        self.features = {}
        for key, feature in self._old.items():
            width, named = names[key].shape[1], feature.names and names[key][0].tolist()
            shape = list(feature.shape) if width == feature.width else [width]
            self.features[key] = {"dtype": feature.dtype, "shape": shape, "names": named}

    def _recorded_tool(self) -> Float[torch.Tensor, "3"]:
        """Origin of the recorded tool in the frame of the arm's tool [m]."""
        if not {"position", "joint_position"} <= self._places.keys():
            return torch.zeros(3).double()
        demos: Any = [*self._source]
        q = np.concatenate([self._taught.positions(demo.joint_position) for demo in demos])
        tool = self._taught.arm.forward(torch.from_numpy(q))
        away = tool.inverse().apply(np.concatenate([demo.position for demo in demos]))
        found = away.median(0).values
        if (apart := float((away - found).norm(dim=-1).median())) > _APART:
            arm, root = self._taught.arm.name, self._source.folder.root
            raise ValueError(
                f"{root}: the recorded tool is {1000 * apart:.0f} mm from where the joints of "
                f"{arm} move it: give it in the arm's base frame (hrc check finds wrong zeros)"
            )
        return found if found.norm() > _APART else torch.zeros_like(found)

    def _refuse_changes(self) -> None:
        """Check that actions named like the tool's position hold positions, not changes."""
        for key, i, role, n in self._next:
            (shown, k), parts = self._places[role][n], self._frames
            apart = np.concatenate([p[key][:-1, i] - p[shown][1:, k] for p in parts])
            span = np.ptp(np.concatenate([p[shown][:, k] for p in parts]))
            if role == "position" and np.median(np.abs(apart)) > span / 2:
                text = "holds changes, not commanded poses: hrc multiply needs absolute actions"
                raise ValueError(f"{key} ({self._old[key].component(i)}) {text}")

    def _find_lead(self) -> _Lead:
        """Lead of commanded tool positions; one frame if another arm was demonstrated."""
        sent = {n: (key, i) for key, i, role, n in self._next if role == "position"}
        if not self._same or len(sent) < 3:
            return _Lead()
        places = self._places["position"], [sent[n] for n in range(3)]
        pairs = [[np.array([p[k][:, i] for k, i in x]).T for x in places] for p in self._frames]
        return _Lead.fit(pairs, self._source.fps)

    @property
    def _gripper_commands(self) -> list[Place]:
        return [(key, i) for key, i, name in self._actions if "gripper" in name.lower()]

    def _gripper_lag(self) -> int:
        """Frames by which the gripper's opening lags behind its command."""
        sent, read = self._gripper_commands[:1], self._places.get("gripper", ())[:1]
        pairs = [[p[k][:, i] for k, i in (*sent, *read)] for p in self._frames]
        if len(pairs[0]) < 2:
            return 0
        scores, opening = [], np.concatenate([m for _, m in pairs])
        for lag in range(1 + min(round(self._source.fps), *(len(c) // 2 for c, _ in pairs))):
            c = np.concatenate([c[(np.arange(len(c)) - lag).clip(min=0)] for c, _ in pairs])
            scores.append(abs(np.cov(c, opening)[0, 1]) / max(float(c.std()), 1e-9))
        return int(np.argmax(scores))

    def _gripper_phase(self, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """Fractional frames of gripper commands.

        Commands precede the opening by the lag of the gripper, which stays the same in a slower
        motion.
        """
        later = np.arange(len(phase)) + self._lag
        beyond = (later - len(phase) + 1).clip(min=0)
        return (phase[later - beyond] + beyond - self._lag).clip(min=phase[0])

    def _object_columns(self, given: Mapping[str, str]) -> dict[str, list[Place]]:
        """Places of the numbers of each object's pose, by name of the object."""
        taken = {place for places in self._places.values() for place in places}
        found: dict[str, dict[str, Place]] = {}
        for key, i, name in self._named:
            match = _AXES.match(name)
            if match and (key, i) not in taken and not key.startswith("action"):
                found.setdefault(match["name"], {})[match["axis"]] = (key, i)
        places = {
            name: [axes[axis] for axis in _POSE if axis in axes]
            for name, axes in found.items()
            if {"x", "y", "z"} <= axes.keys() and len(axes) in (3, 6, 7)
        }
        for name, text in given.items():
            option, root = f"objects.{name}.columns", self._source.folder.root
            places[name] = column_places(option, text, self._old, root)
            if len(places[name]) not in (3, 6, 7):
                raise ValueError(f"{option}={text!r} must have 3, 6 or 7 columns")
        return places

    def _first(self, places: Sequence[Place], main: int) -> Float[np.ndarray, " numbers"]:
        return np.array([float(self._frames[main][key][0, i]) for key, i in places])

    def _rename(self, names: dict[str, np.ndarray]) -> None:
        """Replace the demonstrated arm's joint names, in place, by those of the new arm."""
        old, new = self._taught.arm.joint_names[0], self._robot.joint_names
        patterns = {}
        for role in filter(self._places.__contains__, _JOINTS):
            key, first = self._places[role][0]
            pattern = str(names[key][0, first]).replace(old, "{}")
            patterns[role] = np.array([[pattern.format(name) for name in new]], object)
        self._put_joints(names, patterns)

    def _put_joints(
        self, made: dict[str, np.ndarray], values: Mapping[str, np.ndarray]
    ) -> None:
        """Replace the joint columns in place; `values` holds the new arm's values by role."""
        # Begin with the last columns: the number of joints may change, which shifts columns
        # further back.
        for role in sorted(values, key=lambda role: self._places[role][0], reverse=True):
            key, columns = self._places[role][0][0], [i for _, i in self._places[role]]
            if self._same:
                made[key][:, columns] = values[role]
                continue
            at = [min(columns)] * values[role].shape[1]
            made[key] = np.insert(np.delete(made[key], columns, 1), at, values[role], axis=1)

    def gripper(self, main: int, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """Opening of the gripper in a demonstration: commanded, else measured, else zero.

        Args:
            main: Index of the demonstration.
            phase: Fractional frames of the demonstration.
        """
        for key, i in self._gripper_commands:
            return self._along(main, key, self._gripper_phase(phase))[:, i]
        for key, i in self._places.get("gripper", ()):
            return self._along(main, key, phase)[:, i]
        return np.zeros(len(phase))

    def _along(
        self, main: int, key: str, phase: Float[np.ndarray, " T"]
    ) -> Float[np.ndarray, "T _components"]:
        """A feature of a demonstration at fractional frames; switches are not interpolated."""
        values, made = self._frames[main][key].astype(float), []
        for column in values.T:
            smooth = len(np.unique(column)) > _LEVELS
            at = np.interp(phase, np.arange(len(column)), column)
            made.append(at if smooth else column[np.rint(phase).astype(int)])
        return np.stack(made, axis=1)

    def departures(self) -> list[list[int]]:
        """Frames at which objects begin to move, by demonstration."""
        places = [self._places[f"object {name}"][:3] for name in self.objects]
        paths = [
            [np.stack([shown[key][:, i] for key, i in at], axis=1) for at in places]
            for shown in self._frames
        ]
        return [[_departure(torch.from_numpy(path)) for path in each] for each in paths]

    def object_paths(
        self, made: NewMotion, scene: Mapping[str, Float[np.ndarray, "7"]]
    ) -> dict[str, Float[np.ndarray, "T 7"]]:
        """Pose of each object over time.

        An object moves with the tool while the demonstrated object moves.

        Args:
            made: Motion in a new scene.
            scene: Pose of each object at the start.
        """
        main, phase, tool = made.source, made.phase.numpy(), self._robot.forward(made.joints)
        paths = {name: np.tile(at, (len(phase), 1)) for name, at in scene.items()}
        joints = self._source[main].joint_position
        assert joints is not None
        q = self._taught.positions(joints)
        q = np.stack([np.interp(phase, np.arange(len(q)), angle) for angle in q.T], axis=1)
        hand = self._taught.arm.forward(torch.from_numpy(q)).inverse()
        for name in paths.keys() & self.objects:
            x = [self._along(main, k, phase)[:, i] for k, i in self._places[f"object {name}"]]
            shown = pose_of(torch.from_numpy(np.stack(x, axis=1)))
            first, held = _departure(shown.position), hand @ shown
            last = len(phase) - 1 - _departure(shown.position.flip(0))
            grip = tool[first].inverse() @ pose_of(torch.from_numpy(paths[name][0]))
            path = tool @ grip @ held[first].inverse() @ held
            moved = torch.cat([path.position, path.orientation], -1).numpy()
            paths[name][first:] = moved[np.arange(first, len(q)).clip(max=max(first, last))]
        return paths

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
            main: Index of the demonstration from which the other columns are copied.
            phase: Fractional frame of that demonstration for each new frame.
            joints: Joint positions [rad].
            sent: Commanded joint positions [rad].
            gripper: Measured opening of the gripper; None: copied from the demonstration.
            objects: Pose of each object over time: position [m] and quaternion (w, x, y, z).
        """
        tool = self._robot.forward(torch.from_numpy(joints))
        tool = Pose(tool.apply(self._tool), tool.orientation)
        made = {key: self._along(main, key, phase) for key in self._old}
        for key, i in self._gripper_commands:
            made[key][:, i] = self._along(main, key, self._gripper_phase(phase))[:, i]
        new = {role: self._pose_columns(role, tool, main) for role in _TOOL}
        if gripper is not None:
            new["gripper"] = gripper[:, None]
        new = {r: x / self._source.units[r].factor for r, x in new.items() if r in self._places}
        for name in objects.keys() & self.objects:
            role, pose = f"object {name}", pose_of(torch.from_numpy(objects[name]))
            width = len(self._places[role])
            turned = "quaternion_wxyz" if width == 7 else "rotation_vector"
            columns = [self._pose_columns(x, pose, main, role) for x in ("position", turned)]
            new[role] = np.concatenate(columns, axis=1)[:, :width]
        for role, columns in new.items():
            for (key, i), column in zip(self._places[role], columns.T, strict=True):
                made[key][:, i] = column
        for key, i, role, number in self._next:
            lead = self._lead if role == "position" else _Lead(self._lead.frames)
            made[key][:, i] = lead.commands(new[role])[:, number]
        rates = [np.gradient(q, 1 / self._source.fps, axis=0) for q in (joints, sent)]
        moved = dict(zip(_JOINTS, (joints, rates[0], sent, rates[1]), strict=True))
        moved = {r: self._on_disk(r, x) for r, x in moved.items() if r in self._places}
        self._put_joints(made, moved)
        return made

    def _pose_columns(
        self, role: str, pose: Pose, main: int, of: str = ""
    ) -> Float[np.ndarray, "T _numbers"]:
        """Numbers of the poses of the tool or of an object, in the representation of a role.

        Args:
            role: One of `_TOOL`.
            pose: Poses over time, (T,).
            main: Index of the demonstration.
            of: Role of an object; empty for the tool.
        """
        if role == "position":
            return pose.position.numpy()
        q = quaternion.continuous(pose.orientation)
        if role != "rotation_vector":
            return q.numpy() if role == "quaternion_wxyz" else q.roll(-1, -1).numpy()
        # Near half a turn, two rotation vectors describe one orientation: choose the one close
        # to the first vector of the demonstration.
        places = self._places.get(of, ())[3:6] if of else self._places.get(role, ())
        near = torch.from_numpy(self._first(places, main) if len(places) == 3 else np.zeros(3))
        vectors = torch.cat([near[None], quaternion.log(q)])
        return quaternion.unwrap_log(vectors)[1:].numpy()

    def _on_disk(self, role: str, values: np.ndarray) -> np.ndarray:
        """Convert joint values [rad] to the dataset's units, zeros and directions.

        This is the inverse of `DatasetArm.positions`.
        """
        count = max(self._made.columns) + 1
        zero, one = self._made.positions(np.stack([np.zeros(count), np.ones(count)]))
        if role.endswith("position"):
            values = values - zero
        factor = np.ravel(self._source.units[role].factor)
        own = self._same and len(factor) > 1
        chosen = factor[list(self._made.columns)] if own else factor[0]
        return values / (one - zero) / chosen


def _departure(position: Float[torch.Tensor, "T 3"]) -> int:
    """Last frame before an object begins to move; the last frame of all if it never moves."""
    away = (position - position[0]).norm(dim=-1)
    moved = int((away > _MOVED).int().argmax())
    if not moved:
        return len(away) - 1
    # In simulation, an object first settles: it then rests near its median position.
    before = position[:moved]
    settled = (before - before.median(0).values).norm(dim=-1) <= _STILL
    still = settled if 2 * int(settled.sum()) > moved else away[:moved] <= _STILL
    return int(still.nonzero().max())


def pose_of(values: Float[torch.Tensor, "*batch numbers"]) -> Pose:
    """Pose from a position (3 numbers), alone or with rotation vector (6) or quaternion (7)."""
    turned = values[..., 3:]
    if turned.shape[-1] == 4:
        return Pose(values[..., :3], quaternion.normalize(turned))
    turned = turned if turned.shape[-1] else torch.zeros_like(values)
    return Pose(values[..., :3], quaternion.exp(turned))


class MultipliedWriter:
    """Writes episodes, and continues an interrupted recording where it stopped.

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
        """Prepare the description of the dataset; nothing is written before `claimed`.

        Args:
            root: Folder of the dataset.
            robot_type: LeRobot's name for the robot of the new episodes.
            columns: Columns of the new episodes.
            source: Demonstrations.
            made_by: Settings of the job; an interrupted recording with the same settings is
                continued.
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

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Lock the folder and begin or continue the recording; on exit, complete the dataset.

        Raises:
            BusyError: Another process writes to the folder.
            FileExistsError: The folder exists, or an interrupted recording has other settings.
        """
        self.root.parent.mkdir(parents=True, exist_ok=True)
        with Claim(self.root) as claim:
            if any(self._staging.glob("episode_*.parquet")) and not self.root.exists():
                self._continue()
            else:
                begin(self.root, None)
            try:
                yield
            except BaseException:
                if not self.provenance:
                    discard(self._staging)
                raise
            finish(self.root, claim)

    def _continue(self) -> None:
        """Count the episodes of an interrupted recording."""
        for path in recorded.staged_paths(self._staging):
            staged, table = recorded.read_episode(path)
            if staged.header.sidecar.details != self.header.sidecar.details:
                raise FileExistsError(
                    f"{self._staging} holds an interrupted recording with other settings: "
                    "continue it with those, remove it, or choose another --out"
                )
            self._add(staged.provenance, staged.tasks[0], len(table))

    def _add(self, provenance: str, task: str, frames: int) -> None:
        self.provenance.append(parse_json(provenance))
        self._tasks.setdefault(task, len(self._tasks))
        self._frames += frames

    def write(
        self, values: Mapping[str, np.ndarray], task: str, provenance: Mapping[str, Any]
    ) -> None:
        """Write one episode to disk before the method returns."""
        path = recorded.episode_path(self._staging, len(self.provenance))
        frames = len(next(iter(values.values())))
        index = np.full(frames, self._tasks.get(task, len(self._tasks)))
        origin = json_text(provenance, indent=False).strip()
        recorded.write_episode(
            path, self.header, values, ([task], index), self._frames, provenance=origin
        )
        self._add(origin, task, frames)
