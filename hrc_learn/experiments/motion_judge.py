"""Judges that replay motions of an arm: in the work cell, a MuJoCo scene, or an environment.

A judge puts the objects in their places, lets the arm follow joint positions at the frame rate,
and checks for success at the end. MuJoCo's contacts decide in the work cell, a Python function
in MJCF scenes. An environment of gymnasium executes the actions of the planned episode instead,
and its observations replace the planned observations.
"""

from __future__ import annotations

import importlib.util
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.distributed import ByValue, worker_pool
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim.step_checks import PhysicsError, PhysicsWatch
from hrc_learn.teleoperation.scenarios import SCENARIOS, ScenarioRun, make_scenario

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

# Names of LeRobot's environments for features of its datasets.
_NAMES = {
    "agent_pos": "observation.state",
    "environment_state": "observation.environment_state",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One motion to be judged."""

    joints: Float[np.ndarray, "T joints"]
    """Joint positions [rad]."""
    gripper: Float[np.ndarray, " T"]
    """Commanded opening of the gripper, in the unit of the dataset."""
    objects: Mapping[str, Float[np.ndarray, "7"]]
    """Pose of each object at the start: position [m] and quaternion (w, x, y, z)."""
    columns: Mapping[str, Float[np.ndarray, "T _components"]] = field(default_factory=dict)
    """Planned columns of the episode by feature, for an environment."""
    seed: int = 0
    """Seed of the environment."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """Course and outcome of a judged motion."""

    joints: Float[np.ndarray, "T joints"]
    """Measured joint positions [rad]."""
    sent: Float[np.ndarray, "T joints"]
    """Commanded joint positions, to be reached when the next frame is due [rad]."""
    gripper: Float[np.ndarray, " T"] | None = None
    """Measured opening of the gripper; None: it is as planned."""
    objects: Mapping[str, Float[np.ndarray, "T 7"]] = field(default_factory=dict)
    """Pose of each object."""
    failure: str = ""
    """Reason of a failure, empty after a success."""
    columns: Mapping[str, Float[np.ndarray, "_T _components"]] = field(default_factory=dict)
    """All columns of the episode, if an environment executed it; else empty."""


@dataclass(frozen=True, kw_only=True)
class JudgeConfig:
    """Physics in which motions are judged."""

    scene: str = ""
    """Scene: "grasping" or "placing" in hrc_learn's work cell; an MJCF file with position
    actuators on the arm's joints; an environment in Python as FILE.py:FUNCTION or
    MODULE:FUNCTION; "none": no physics. Default: the work cell if the demonstrations come
    from it."""
    shelf: str = "middle"
    """Shelf for placing."""
    success: str = ""
    """Success function for an MJCF scene, as FILE.py:FUNCTION or MODULE:FUNCTION. It takes
    model and data at the end of a motion and returns True after a success."""
    gripper: tuple[str, ...] = ()
    """Actuators of the gripper in an MJCF scene. Default: all actuators that move no joint of
    the arm."""
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base in an MJCF scene [m]."""
    processes: int = 2
    """Number of processes that judge motions."""

    @property
    def is_environment(self) -> bool:
        """True if the scene is an environment that a Python function makes."""
        return ":" in self.scene and not Path(self.scene).exists()

    def open(self, robot: ArmChoice, fps: float, widest: float) -> AnyJudge:
        """The judge for an arm.

        Args:
            robot: The arm.
            fps: Frames per second.
            widest: Largest opening of the gripper in the dataset.

        Raises:
            ValueError: The scene does not fit the arm, or there is no such function.
            FileNotFoundError: There is no such file.
        """
        if self.scene in SCENARIOS:
            return CellJudge(self, robot, fps)
        if self.is_environment:
            return EnvironmentJudge(self.scene, fps)
        return SceneJudge(self, robot, fps, widest)


class CellJudge:
    """Grasping or placing in hrc_learn's work cell, laid out for the arm."""

    def __init__(self, config: JudgeConfig, robot: ArmChoice, fps: float):
        """Build the work cell."""
        scenario = make_scenario(config.scene, config.shelf, robot.work_arm())
        self.run, self._holds = ScenarioRun(scenario, fps), config.scene == "placing"
        self._item = scenario.workplace.scene.objects[0].name

    def begin(self, trial: Trial) -> None:
        """Put the first object on the table, or into the gripper if it is to be placed.

        The other objects of the trial mark places, which the simulation does not need.
        """
        self._names, self._places = [*trial.objects], dict(trial.objects)
        if self._holds or not self._names:
            self.run.world.hold(self._item, trial.joints[0])
        else:
            at = torch.from_numpy(trial.objects[self._names[0]])
            pose = Pose(at[:3], at[3:]).matrix().numpy()
            self.run.world.reset(trial.joints[0], {self._item: pose})
        self.run.servo.restart()

    def read(self) -> tuple[np.ndarray, float, dict[str, np.ndarray]]:
        """Readings of the simulated sensors, and the true pose of the object."""
        state = self.run.world.arm.read()
        pose = Pose.from_matrix(self.run.world.object_pose(self._item))
        moved = torch.cat([pose.position, pose.orientation]).numpy()
        here = self._places | dict.fromkeys(self._names[:1], moved)
        return state.joint_position, state.gripper_width, here

    def command(self, joints: np.ndarray, width: float) -> np.ndarray:
        """Track the joints within the limits of the arm."""
        return self.run.command(joints, width)

    def failure(self) -> str:
        """First unwanted contact, or a note that the task was not done."""
        touched = self.run.world.touched_since(0.0)
        done = "" if self.run.succeeded() else "the task was not done in simulation"
        return touched[0] if touched else done


class SceneJudge:
    """An MJCF scene with position actuators, and a success function in Python."""

    def __init__(self, config: JudgeConfig, robot: ArmChoice, fps: float, widest: float):
        """Read the scene."""
        if not Path(config.scene).is_file():
            known = f"there are {', '.join(SCENARIOS)}, an MJCF file, or FILE.py:FUNCTION"
            raise FileNotFoundError(f"no scene {config.scene!r}: {known}")
        self.model = model = mujoco.MjModel.from_xml_path(config.scene)
        self.data, self._config = mujoco.MjData(model), config
        self._watch = PhysicsWatch(model, self.data)
        self.succeeded, self._widest = _function("success", config.success), widest or 1.0
        self._steps = max(1, round(1 / fps / model.opt.timestep))
        known = {model.joint(i).name: i for i in range(model.njnt)}
        # Joint that each actuator moves; tendons and sites are numbered separately.
        joint = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
        direct = np.isin(model.actuator_trntype, joint)
        at = np.where(direct, model.actuator_trnid[:, 0], -1)
        # The force of a position actuator decreases with the position.
        servos = np.flatnonzero(direct & (model.actuator_biasprm[:, 1] < 0))
        drives = {int(at[a]): int(a) for a in servos}
        names = robot.arm().joint_names
        if missing := [name for name in names if known.get(name) not in drives]:
            raise ValueError(f"{config.scene}: no position actuator moves {', '.join(missing)}")
        ids = [known[name] for name in names]
        self._q, self._arm = model.jnt_qposadr[ids], [drives[i] for i in ids]
        rest = np.flatnonzero(~np.isin(at, ids)).tolist()
        self._hand = [model.actuator(name).id for name in config.gripper] or rest
        self._range = model.actuator_ctrlrange[self._hand].copy()
        for k, a in enumerate(self._hand):
            if direct[a] and not model.actuator_ctrllimited[a]:
                self._range[k] = model.jnt_range[at[a]]

    def begin(self, trial: Trial) -> None:
        """Put bodies with the objects' names in their places."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._q] = self.data.ctrl[self._arm] = trial.joints[0]
        self._names = [*trial.objects]
        for name, pose in trial.objects.items():
            self._put(name, np.concatenate([pose[:3] + self._config.base, pose[3:]]))
        mujoco.mj_forward(self.model, self.data)
        self._watch.restart()

    def read(self) -> tuple[np.ndarray, float, dict[str, np.ndarray]]:
        """Joint positions, NaN for the gripper's opening, and poses of the objects."""
        bodies = {name: self.data.body(name) for name in self._names}
        objects = {
            name: np.concatenate([body.xpos - self._config.base, body.xquat])
            for name, body in bodies.items()
        }
        return self.data.qpos[self._q].copy(), np.nan, objects

    def command(self, joints: np.ndarray, width: float) -> np.ndarray:
        """Set the actuators."""
        low, high = self._range.T
        self.data.ctrl[self._arm] = joints
        self.data.ctrl[self._hand] = low + (high - low) * width / self._widest
        mujoco.mj_step(self.model, self.data, self._steps)
        self._watch.after_step()
        self._watch.check()
        return joints

    def failure(self) -> str:
        """Failure according to the success function."""
        done = bool(self.succeeded(self.model, self.data))
        return "" if done else f"{self._config.success} returned False"

    def _put(self, name: str, pose: Float[np.ndarray, "7"]) -> None:
        """Set the pose of a body: by its free joint, as a mocap body, or within its parent."""
        body = self.model.body(name)
        first, mocap = int(body.jntadr[0]), int(body.mocapid[0])
        if first >= 0 and self.model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
            at = int(self.model.jnt_qposadr[first])
            self.data.qpos[at : at + 7] = pose
        elif mocap >= 0:
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = pose[:3], pose[3:]
        else:
            self.model.body_pos[body.id], self.model.body_quat[body.id] = pose[:3], pose[3:]


class EnvironmentJudge:
    """An environment of gymnasium that executes the actions of new episodes.

    `reset(seed=..., options=...)` puts the objects in their places. `options["objects"]` has
    the pose of each object by name (x, y, z [m] and quaternion w, x, y, z), and
    `options["joint_position"]` has the first joint positions [rad]. Observations are a
    dictionary of the dataset's features, or of LeRobot's `agent_pos` and `environment_state`.
    `step` takes the feature `action`, or a dictionary if there are several actions. The last
    step reports the outcome: `info["is_success"]` or `info["success"]`, and after a failure
    `info["failure"]` with the reason. `reset` may also return `info["failure"]`, which rejects
    the scene.
    """

    def __init__(self, function: str, fps: float):
        """Make the environment.

        Args:
            function: Function without arguments, as FILE.py:FUNCTION or MODULE:FUNCTION.
            fps: Frames per second of the dataset.
        """
        self._name, self._env = function, _function("scene", function)()
        for method in ("reset", "step"):
            if not callable(getattr(self._env, method, None)):
                kind = type(self._env).__name__
                raise ValueError(f"{function} makes a {kind} without the method {method}")
        own = (getattr(self._env, "metadata", None) or {}).get("render_fps") or fps
        if round(own) != round(fps):
            text = f"actions per second (metadata['render_fps']), but the dataset has {fps:g}"
            raise ValueError(f"{function} takes {own:g} {text}: choose a dataset of its rate")

    def replay(self, trial: Trial) -> Replay:
        """Execute the actions of a planned episode.

        Raises:
            ValueError: An observation of the dataset is missing or has another size, or the
                environment does not report success.
        """
        scene = {"objects": dict(trial.objects), "joint_position": trial.joints[0]}
        seen, info = self._env.reset(seed=trial.seed, options=scene)
        rows, ended = [], bool(info.get("failure"))
        while not ended and len(rows) < len(trial.joints):
            row = {key: x[len(rows)] for key, x in trial.columns.items()}
            rows.append(row | self._observed(seen, row))
            sent = {key: np.float32(x) for key, x in row.items() if key.startswith("action")}
            action = sent["action"] if [*sent] == ["action"] else sent
            seen, _, *ends, info = self._env.step(action)
            ended = any(ends)
        columns = {key: np.array([row[key] for row in rows]) for key in trial.columns}
        failure, done = info.get("failure"), info.get("is_success", info.get("success"))
        if not failure and done is None:
            text = "step returns neither info['is_success'] nor info['success']"
            raise ValueError(f"{self._name}: {text}")
        failure = failure or ("" if done else f"{self._name} reported no success")
        if not all(np.isfinite(x).all() for x in columns.values()):
            failure = f"{self._name} returned numbers that are not finite"
        return Replay(joints=trial.joints, sent=trial.joints, failure=failure, columns=columns)

    def _observed(self, seen: Any, planned: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Observations of one frame by feature of the dataset."""
        found = seen if isinstance(seen, Mapping) else {"observation.state": seen}
        named = {_NAMES.get(key, key): np.ravel(x) for key, x in found.items()}
        wanted = {key: x.size for key, x in planned.items() if key.startswith("observation")}
        sizes = {key: x.size for key, x in named.items()}
        for key, width in wanted.items():
            if sizes.get(key) != width:
                text = f"returns {sizes}, but {key} has {width} numbers in the dataset"
                raise ValueError(f"{self._name} {text}")
        return {key: named[key].astype(float) for key in wanted}


def replay(judge: CellJudge | SceneJudge, trial: Trial) -> Replay:
    """Carry out a motion in simulation."""
    judge.begin(trial)
    read, sent, failure = [], [], ""
    ahead = np.concatenate([trial.joints[1:], trial.joints[-1:]])
    try:
        for joints, width in zip(ahead, trial.gripper, strict=True):
            read.append(judge.read())
            sent.append(judge.command(joints, float(width)))
    except PhysicsError as error:
        failure = f"physics: {error}"
    gripper = np.array([width for _, width, _ in read])
    return Replay(
        joints=np.stack([joints for joints, _, _ in read]),
        sent=np.stack(sent or [ahead[0]]),
        gripper=gripper if np.isfinite(gripper).all() else None,
        objects={n: np.stack([o[n] for _, _, o in read]) for n in trial.objects},
        failure=failure or judge.failure(),
    )


def _function(option: str, text: str) -> Callable[..., Any]:
    """Function named as FILE.py:FUNCTION, or as MODULE:FUNCTION.

    Modules are imported from the current folder or from an installed package.

    Raises:
        ValueError: There is no such function.
    """
    place, _, name = text.rpartition(":")
    is_file = place.endswith(".py")
    sys.path.insert(0, str(Path(place).resolve().parent if is_file else Path.cwd()))
    try:
        return getattr(_module(place), name) if is_file else pkgutil.resolve_name(text)
    except (ImportError, AttributeError, ValueError, OSError) as error:
        raise ValueError(
            f"judge.{option}={text!r} is not a MODULE:FUNCTION or FILE.py:FUNCTION: {error}"
        ) from None
    finally:
        sys.path.pop(0)


def _module(file: str) -> ModuleType:
    """Module from a file, which may have the same name as an installed package."""
    spec = importlib.util.spec_from_file_location(file, file)
    assert spec is not None
    assert spec.loader is not None
    made = sys.modules[file] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


type AnyJudge = CellJudge | SceneJudge | EnvironmentJudge
_JUDGE: list[AnyJudge] = []
"""Judge of this process."""


def _begin(config: JudgeConfig, robot: ArmChoice, fps: float, widest: float) -> None:
    torch.set_num_threads(1)
    _JUDGE[:] = [config.open(robot, fps, widest)]


def _replay(trial: Trial) -> Replay:
    (judge,) = _JUDGE
    return judge.replay(trial) if isinstance(judge, EnvironmentJudge) else replay(judge, trial)


type Judge = Callable[[Sequence[Trial]], Iterator[Replay]]
"""Function that replays motions, in their order."""


@contextmanager
def judging(
    config: JudgeConfig, robot: ArmChoice, fps: float, widest: float
) -> Iterator[Judge]:
    """Judge in several processes, with the arguments and errors of `JudgeConfig.open`."""
    given = (config, robot, fps, widest)
    # The judge is opened here first, so that a wrong setting raises one error in this process.
    _begin(*given)
    if config.processes <= 1:
        yield partial(map, _replay)
        return
    with worker_pool(config.processes, _begin, *given) as pool:
        yield lambda trials: pool.map(_replay, map(ByValue, trials))
