"""A person pulls at the elbow at random moments while a policy guides the end effector.

A LeRobot policy executes a scenario on the simulated Panda with nominal imperfections, from
many starts, with and without a person. Reported are the success rates of both, contacts, the
displacement of the elbow, and two deviations of the end effector. The first is the distance,
measured by the encoders, from the poses that the policy requests. The second is the true
distance from the path of the run without the person that has the same start.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from elbow_margin import elbow_margin
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

from hrc_learn import cli
from hrc_learn.experiments.run_measures import path_distance
from hrc_learn.kinematics import panda

# LeRobot takes ten seconds to import, so it is imported only when needed.
if TYPE_CHECKING:
    from hrc_learn.lerobot.episode_recording import CheckpointPolicy
    from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig
    from hrc_learn.teleoperation import ScriptedForce

_ELBOW = 3
"""Index of the joint at the elbow, from 0."""
HELD_OUT = 1000
"""Number of the first start that the policy was not trained on."""
_AFTER = 1.0
"""Time after the end of a pull that counts as part of the pull [s]: the arm returns."""
_WANTED = 0.150
"""Wanted displacement of the elbow, if kinematics allow it [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    data: Path
    """Folder of the demonstrations and the policy, which are made if they are missing."""
    policy: Path | None = None
    """Checkpoint of a LeRobot policy for this task and rate, its folder `pretrained_model`.
    None: `dmp` in closed form, from 10 demonstrations."""
    task: Literal["placing", "grasping"] = "placing"
    """Task of the policy."""
    rollouts: int = 50
    """Number of rollouts with the person, and of rollouts without."""
    first: int = HELD_OUT
    """Number of the first start."""
    imperfections: float = 1.0
    """Size of the imperfections of arm, calibration and workplace, relative to the nominal
    ones."""
    observed: Literal["posture", "joints"] = "posture"
    """Joints that the policy observes: its own posture, or the measured joints."""
    after_push: Literal["return", "stay"] = "return"
    """Motion of the joints after release."""
    fps: int = 25
    """Actions per second."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Done:
    """One rollout."""

    success: bool
    contacts: int
    """Contacts of the arm with furniture and with itself."""
    waited: float
    """Time for which the motion waited [s]."""
    time: Float[np.ndarray, " T"]
    joints: Float[np.ndarray, "T 7"]
    """Joint positions measured by the encoders [rad]."""
    posture: Float[np.ndarray, "T 7"]
    """Joint positions requested by the policy [rad]."""
    hand: Float[np.ndarray, "T 3"]
    """True position of the end effector [m]."""


@dataclass(frozen=True, kw_only=True)
class Pulled:
    """Effect of one pull."""

    elbow: float
    """Displacement of the elbow [m]."""
    margin: float
    """Displacement that joint limits, furniture and the direction of the pull allow [m]."""


def main(args: Args) -> None:
    from hrc_learn.lerobot.episode_recording import CheckpointPolicy
    from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig
    from hrc_learn.lerobot.person import PersonConfig, scripted_pulls

    torch.set_num_threads(1)
    config = MujocoArmRobotConfig(
        scenario=args.task,
        fps=float(args.fps),
        pixels=args.task == "grasping",
        seed=args.first,
    )
    policy = args.policy or _fitted(args, config)
    kinds: tuple[Literal["none", "scripted"], ...] = ("none", "scripted")
    robots, done = [], []
    for kind in kinds:
        person = PersonConfig(kind=kind, observed=args.observed, after_push=args.after_push)
        robot = MujocoArmRobot(
            replace(config, imperfections=args.imperfections, person=person, id=kind)
        )
        robot.connect()
        leader = CheckpointPolicy(policy, robot)
        seeds = range(args.first, args.first + args.rollouts)
        done.append([_do(robot, leader, seed) for seed in track(seeds, f"Person: {kind}")])
        robots.append(robot)
    free, beside = done
    pulls = [scripted_pulls(args.first + k) for k in range(args.rollouts)]
    effects = [
        effect
        for run, of_run in zip(beside, pulls, strict=True)
        for effect in _effects(run, of_run, robots[1])
    ]
    figures = _figures(free, beside, pulls, effects)
    table = Table("figure", "value")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)
    for robot in robots:
        robot.disconnect()


def _fitted(args: Args, config: MujocoArmRobotConfig) -> Path:
    """The policy `dmp`, fitted in closed form to ten demonstrations without imperfections."""
    from hrc_learn.lerobot.episode_recording import record_expert
    from hrc_learn.lerobot.policy.dmp_policy import write_closed_form_policy

    dataset = args.data / f"{args.task}_{args.fps}hz"
    policy = args.data / f"{args.task}_{args.fps}hz_policy"
    if not dataset.exists():
        shown = record_expert(dataset, replace(config, seed=0), 10)
        for _ in track(shown, "Demonstrations", total=10):
            pass
    if not policy.exists():
        policy.mkdir(parents=True)
        write_closed_form_policy(dataset, policy, n_basis=50)
    return policy


def _do(robot: MujocoArmRobot, leader: CheckpointPolicy, seed: int) -> Done:
    from hrc_learn.lerobot.episode_recording import roll_out

    rows: list[tuple[Any, ...]] = []
    waited, complement = 0.0, robot.complement
    for _, action in roll_out(robot, leader, seed):
        state, asked = (
            robot.arm.read(),
            np.array([action[name] for name in robot.values.joints]),
        )
        if complement is not None and complement.posture is not None:
            asked, waited = complement.posture.numpy(), waited + robot.dt * complement.waits
        hand = robot.world.arm.tcp_pose()[:3, 3]
        rows.append((state.time, state.joint_position, asked.copy(), hand.copy()))
    time, joints, posture, hand = (np.array(column) for column in zip(*rows, strict=True))
    return Done(
        success=robot.run.succeeded(),
        contacts=_contacts(robot),
        waited=waited,
        time=time,
        joints=joints,
        posture=posture,
        hand=hand,
    )


def _contacts(robot: MujocoArmRobot) -> int:
    world = robot.world
    monitors = (world.cabinet_contacts, world.self_contacts, world.table_contacts)
    return sum(len(monitor.touches) for monitor in monitors)


def _effects(run: Done, pulls: Sequence[ScriptedForce], robot: MujocoArmRobot) -> list[Pulled]:
    """Effects of all pulls that ended before the rollout."""
    joints, posture = torch.from_numpy(run.joints), torch.from_numpy(run.posture)
    elbow = _elbow(joints) - _elbow(posture)
    effects = []
    for pull in pulls:
        rows = (run.time >= pull.start) & (run.time < pull.end)
        if pull.end > run.time[-1]:
            continue
        during = posture[torch.from_numpy(rows)]
        margins = [
            elbow_margin(q, pull, panda, clearance=robot.clearance)
            for q in during[:: len(during) // 3]
        ]
        effects.append(
            Pulled(
                elbow=float(elbow[torch.from_numpy(rows)].norm(dim=-1).max()),
                margin=float(np.median(margins)),
            )
        )
    return effects


def _elbow(joints: Float[torch.Tensor, "*T 7"]) -> Float[torch.Tensor, "*T 3"]:
    return panda.joint_origins(joints)[..., _ELBOW, :]


def _figures(
    free: Sequence[Done],
    beside: Sequence[Done],
    pulls: Sequence[Sequence[ScriptedForce]],
    effects: Sequence[Pulled],
) -> dict[str, float]:
    off, undisturbed, true = [], [], []
    for run, alone, of_run in zip(beside, free, pulls, strict=True):
        rows = np.zeros(len(run.time), dtype=bool)
        for pull in of_run:
            rows |= (run.time >= pull.start) & (run.time < pull.end + _AFTER)
        off.append(_off_path(run)[rows])
        undisturbed.append(_off_path(alone))
        true.append(_from_line(run.hand[rows], alone.hand))
    moved = np.array([effect.elbow for effect in effects])
    possible = np.array([effect.margin >= _WANTED for effect in effects])
    return {
        "rollouts": len(beside),
        "success_without": float(np.mean([run.success for run in free])),
        "success_with": float(np.mean([run.success for run in beside])),
        "contacts_without": sum(run.contacts for run in free),
        "contacts_with": sum(run.contacts for run in beside),
        "pulls": len(effects),
        "elbow_median_mm": 1e3 * float(np.median(moved)),
        "pulls_with_room": int(possible.sum()),
        "of_them_elbow_150_mm": float(np.mean(moved[possible] >= _WANTED)),
        "of_them_elbow_p5_mm": 1e3 * float(np.quantile(moved[possible], 0.05)),
        "of_them_elbow_median_mm": 1e3 * float(np.median(moved[possible])),
        "off_path_p95_mm": 1e3 * float(np.quantile(np.concatenate(off), 0.95)),
        "off_path_max_mm": 1e3 * float(np.max(np.concatenate(off))),
        "off_path_without_p95_mm": 1e3 * float(np.quantile(np.concatenate(undisturbed), 0.95)),
        "true_deviation_p95_mm": 1e3 * float(np.quantile(np.concatenate(true), 0.95)),
        "waited_median_s": float(np.median([run.waited for run in beside])),
        "waited_max_s": float(np.max([run.waited for run in beside])),
    }


def _off_path(run: Done) -> Float[np.ndarray, " T"]:
    """Distance of the end effector, measured by the encoders, from the recently requested poses
    [m].
    """
    hand, goal = (
        panda.forward(torch.from_numpy(q)).position.numpy() for q in (run.joints, run.posture)
    )
    return path_distance(hand, goal, run.time)


def _from_line(
    points: Float[np.ndarray, "n 3"], line: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, " n"]:
    """Distance of points from the nearest segment of a line [m]."""
    start, way = line[:-1], np.diff(line, axis=0)
    square = np.maximum((way**2).sum(axis=1), 1e-12)
    from_start = points[:, None] - start
    share = np.clip((from_start * way).sum(axis=-1) / square, 0.0, 1.0)
    return np.linalg.norm(from_start - share[..., None] * way, axis=-1).min(axis=1)


if __name__ == "__main__":
    cli.run(main, Args)
