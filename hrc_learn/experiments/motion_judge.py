"""Motions of an arm judged in physics: in the work cell, or in any MuJoCo scene.

A judge puts the objects in their places, lets the arm follow joint positions at the rate of the
frames, and asks for success at the end: MuJoCo's contacts in the work cell, a Python function
for other scenes.
"""

from __future__ import annotations

import importlib
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import PhysicsError
from hrc_learn.teleoperation.scenarios import SCENARIOS, ScenarioRun, make_scenario

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One motion to be judged."""

    joints: Float[np.ndarray, "T joints"]
    """Joint positions [rad]."""
    gripper: Float[np.ndarray, " T"]
    """Commanded opening of the gripper, in the unit of the dataset."""
    objects: Mapping[str, Float[np.ndarray, "7"]]
    """Pose of each object at the start: position [m] and quaternion (w, x, y, z)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """What happened."""

    joints: Float[np.ndarray, "T joints"]
    """Measured joint positions [rad]."""
    sent: Float[np.ndarray, "T joints"]
    """Commanded joint positions, to be reached when the next frame is due [rad]."""
    gripper: Float[np.ndarray, " T"] | None
    """Measured opening; None: as planned."""
    objects: Mapping[str, Float[np.ndarray, "T 7"]]
    """Pose of each object."""
    failure: str = ""
    """Reason of a failure, empty after a success."""


@dataclass(frozen=True, kw_only=True)
class JudgeConfig:
    """Physics in which motions are judged."""

    scene: str = ""
    """"grasping" or "placing" of our work cell, or an MJCF file with position actuators on the
    arm's joints; "none": no physics. Default: our work cell if it was demonstrated there."""
    shelf: str = "middle"
    """Shelf of placing."""
    success: str = ""
    """Function of an MJCF scene as MODULE:FUNCTION, which takes model and data at the end and
    returns True after a success."""
    gripper: tuple[str, ...] = ()
    """Actuators of the gripper in an MJCF scene. Default: all that move no arm joint."""
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base in an MJCF scene [m]."""
    processes: int = 2
    """Processes that judge."""

    def open(self, robot: ArmChoice, fps: float, widest: float) -> "CellJudge | SceneJudge":
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
        return SceneJudge(self, robot, fps, widest)


class CellJudge:
    """Grasping or placing in our work cell, laid out for the arm."""

    def __init__(self, config: JudgeConfig, robot: ArmChoice, fps: float):
        """Build the work cell."""
        scenario = make_scenario(config.scene, config.shelf, robot.work_arm())
        self.run = ScenarioRun(scenario, fps)
        self._holds = config.scene == "placing"

    def replay(self, trial: Trial) -> Replay:
        """Carry out a motion with the first object of the scene."""
        world, item = self.run.world, self.run.scenario.workplace.scene.objects[0].name
        name = next(iter(trial.objects), "")
        if self._holds:
            world.hold(item, trial.joints[0])
        else:
            at = torch.from_numpy(trial.objects[name])
            world.reset(trial.joints[0], {item: Pose(at[:3], at[3:]).matrix().numpy()})
        self.run.servo.restart()
        states, sent, poses, failure = [], [], [], ""
        ahead = np.concatenate([trial.joints[1:], trial.joints[-1:]])
        for joints, width in zip(ahead, trial.gripper, strict=True):
            states.append(world.arm.read())
            poses.append(world.object_pose(item))
            try:
                sent.append(self.run.command(joints, float(width)))
            except PhysicsError as error:
                sent.append(joints)
                failure = f"physics: {error}"
                break
        if touched := world.touched_since(0.0):
            failure = touched[0]
        elif not failure and not self.run.succeeded():
            failure = "the task was not done in simulation"
        pose = Pose.from_matrix(np.stack(poses))
        moved = torch.cat([pose.position, pose.orientation], -1).numpy()
        still = {key: np.tile(at, (len(poses), 1)) for key, at in trial.objects.items()}
        return Replay(
            joints=np.stack([state.joint_position for state in states]),
            sent=np.stack(sent),
            gripper=np.array([state.gripper_width for state in states]),
            objects=still | ({name: moved} if name else {}),
            failure=failure,
        )


class SceneJudge:
    """An MJCF scene with position actuators, and a success function in Python."""

    def __init__(self, config: JudgeConfig, robot: ArmChoice, fps: float, widest: float):
        """Read the scene."""
        if not Path(config.scene).is_file():
            raise FileNotFoundError(
                f"no scene {config.scene!r}: there are {', '.join(SCENARIOS)}, or an MJCF file"
            )
        self.model = mujoco.MjModel.from_xml_path(config.scene)
        self.data = mujoco.MjData(self.model)
        self.succeeded = _function(config.success)
        self._config, self._widest = config, widest or 1.0
        self._steps = max(1, round(1 / fps / self.model.opt.timestep))
        names = robot.arm().joint_names
        known = {self.model.joint(i).name: i for i in range(self.model.njnt)}
        if missing := [name for name in names if name not in known]:
            raise ValueError(f"{config.scene} has no joints {', '.join(missing)}")
        ids = [known[name] for name in names]
        self._q = self.model.jnt_qposadr[ids]
        joint = mujoco.mjtTrn.mjTRN_JOINT
        # The force of a position actuator falls with the position.
        drives = {
            int(self.model.actuator_trnid[a, 0]): a
            for a in np.flatnonzero(self.model.actuator_biasprm[:, 1] < 0).tolist()
            if self.model.actuator_trntype[a] == joint
        }
        if undriven := [n for n, i in zip(names, ids, strict=True) if i not in drives]:
            raise ValueError(
                f"{config.scene}: no position actuator moves {', '.join(undriven)}"
            )
        self._arm = [drives[i] for i in ids]
        at = [int(self.model.actuator_trnid[a, 0]) for a in range(self.model.nu)]
        rest = [a for a in range(self.model.nu) if at[a] not in ids]
        self._hand = [self.model.actuator(n).id for n in config.gripper] or rest
        self._range = self.model.actuator_ctrlrange[self._hand].copy()
        for k, a in enumerate(self._hand):
            if not self.model.actuator_ctrllimited[a]:
                self._range[k] = self.model.jnt_range[at[a]]

    def replay(self, trial: Trial) -> Replay:
        """Carry out a motion; bodies with the objects' names are put in their places."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        data.qpos[self._q] = data.ctrl[self._arm] = trial.joints[0]
        for name, pose in trial.objects.items():
            self._put(name, pose)
        mujoco.mj_forward(model, data)
        joints, ahead = [], np.concatenate([trial.joints[1:], trial.joints[-1:]])
        places: dict[str, list[np.ndarray]] = {name: [] for name in trial.objects}
        low, high = self._range.T
        for wanted, width in zip(ahead, trial.gripper, strict=True):
            joints.append(data.qpos[self._q].copy())
            for name, found in places.items():
                body = data.body(name)
                found.append(np.concatenate([body.xpos - self._config.base, body.xquat]))
            data.ctrl[self._arm] = wanted
            data.ctrl[self._hand] = low + (high - low) * float(width) / self._widest
            mujoco.mj_step(model, data, self._steps)
        done = bool(self.succeeded(model, data))
        return Replay(
            joints=np.stack(joints),
            sent=ahead,
            gripper=None,
            objects={name: np.stack(found) for name, found in places.items()},
            failure="" if done else f"{self._config.success} says no",
        )

    def _put(self, name: str, pose: Float[np.ndarray, "7"]) -> None:
        """Put a body somewhere: its free joint, its mocap pose, or its place in its parent."""
        try:
            body = self.model.body(name)
        except KeyError:
            raise ValueError(f"{self._config.scene} has no body {name!r}") from None
        there = np.concatenate([pose[:3] + self._config.base, pose[3:]])
        first = int(body.jntadr[0])
        if first >= 0 and self.model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
            at = int(self.model.jnt_qposadr[first])
            self.data.qpos[at : at + 7] = there
        elif body.mocapid[0] >= 0:
            self.data.mocap_pos[body.mocapid[0]] = there[:3]
            self.data.mocap_quat[body.mocapid[0]] = there[3:]
        else:
            self.model.body_pos[body.id], self.model.body_quat[body.id] = there[:3], there[3:]


def _function(text: str) -> Callable[[Any, Any], bool]:
    """Function named as MODULE:FUNCTION, from the current folder or an installed package.

    Raises:
        ValueError: There is none.
    """
    module, _, name = text.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"judge.success={text!r} is no MODULE:FUNCTION that can be imported ({error})"
        ) from None
    finally:
        sys.path.pop(0)


_JUDGE: list[CellJudge | SceneJudge] = []
"""Judge of this process."""


def _begin(config: JudgeConfig, robot: ArmChoice, fps: float, widest: float) -> None:
    torch.set_num_threads(1)
    _JUDGE[:] = [config.open(robot, fps, widest)]


def _replay(trial: Trial) -> Replay:
    return _JUDGE[0].replay(trial)


class Judges:
    """Judges in several processes."""

    def __init__(self, config: JudgeConfig, robot: ArmChoice, fps: float, widest: float):
        """Start them; arguments and errors as for `JudgeConfig.open`."""
        self._given = (config, robot, fps, widest)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Judges:
        config = self._given[0]
        # Opened here first, so that a mistake is one error of this process.
        _begin(*self._given)
        if config.processes > 1:
            self._pool = ProcessPoolExecutor(
                config.processes,
                multiprocessing.get_context("spawn"),
                initializer=_begin,
                initargs=self._given,
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def replays(self, trials: Sequence[Trial]) -> Iterator[Replay]:
        """Replays in the order of the motions."""
        return map(_replay, trials) if self._pool is None else self._pool.map(_replay, trials)
