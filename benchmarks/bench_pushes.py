"""A person pushes the arm itself: displacement of the elbow, and pauses by pushes at the hand.

The arm, with the nominal imperfections of a laboratory in MuJoCo, holds an object and moves
back and forth along a random joint path. For some seconds a force acts on its elbow, in the
direction in which the null space can yield, or on its hand, in a random direction. Only the
torques of the joints show the force.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from elbow_margin import elbow_margin
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from hrc_learn import cli
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import StoppedByPersonError, WorkCell, WorkCellConfig, joint_line
from hrc_learn.teleoperation import Touch, TouchConfig
from hrc_learn.teleoperation.scripted_expert import ScriptedForce

ELBOW = 4
"""Joint whose origin is the elbow, counted from 1."""
BEGIN, RISE = 1.0, 0.3
"""Start of a push, and time for which its force rises and falls [s]."""
LASTS = {"elbow": 4.0, "hand": 1.6}
"""Duration of a push [s]."""
WAY, TIME = 0.3, 4.0
"""Largest displacement of a joint [rad], and the time for the way there, and again for the way
back [s]."""
ENOUGH = 0.15
"""Displacement of an elbow that counts as moved out of the way [m]."""
NOMINAL = Imperfections.nominal()


@dataclass(frozen=True, kw_only=True)
class Args:
    pushes: int = 50
    """Number of pushes at the elbow, and of pushes at the hand."""
    first_seed: int = 0
    """First seed of path, push and imperfections."""
    force: float = 20.0
    """Force of a push [N]."""
    config: TouchConfig = field(default_factory=TouchConfig)
    """Thresholds of a touch."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Listener(Human):
    """Touch that records when the task was paused."""

    def __init__(self, touch: Touch):
        self._touch = touch
        self.paused: list[float] = []
        self.elbow_felt: list[float] = []

    def read(self, state: ArmState) -> HumanInput:
        """Input requested by the touch."""
        asked = self._touch.read(state)
        if asked.pause:
            self.paused.append(state.time)
        if self._touch.place == "elbow":
            self.elbow_felt.append(state.time)
        return asked

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to the touch."""
        self._touch.tell(feedback)


def main(args: Args) -> None:
    """Push, print a table, and write the measured values."""
    figures: dict[str, float] = {}
    seeds = range(args.first_seed, args.first_seed + args.pushes)
    for where in ("elbow", "hand"):
        rows = [push(where, seed, args) for seed in track(seeds, where)]
        figures |= (summary_of_elbow if where == "elbow" else summary_of_hand)(rows)
    table = Table("", "")
    for name, value in figures.items():
        table.add_row(escape(name.replace("_", " ")), f"{value:.4g}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def push(where: Literal["elbow", "hand"], seed: int, args: Args) -> dict[str, Any]:
    """Results of one push, in SI units."""
    rng = np.random.default_rng([seed, 0])
    workplace = Workplace()
    world = World(workplace.scene, NOMINAL.draw(np.random.default_rng(seed)))
    home = workplace.home_joints()
    world.hold(workplace.scene.objects[0].name, home.numpy())
    human = Listener(Touch(panda, args.config))
    far = home + torch.from_numpy(rng.uniform(-WAY, WAY, len(home)))
    force = rng.standard_normal(3)
    if where == "elbow":
        J, J_elbow = panda.jacobian(home), panda.joint_jacobian(home, ELBOW)[:3]
        null = torch.linalg.svd(J)[2][-1]
        force = (J_elbow @ null).numpy() * np.sign(rng.standard_normal())
    force *= args.force / np.linalg.norm(force)

    def advance(duration: float) -> None:
        apply(world, where, force)
        world.advance(duration)

    config = WorkCellConfig(
        safety=NOMINAL.plant(WorkCellConfig().safety), command_delay=NOMINAL.following_delay
    )
    cell = WorkCell(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=human,
        advance=advance,
        config=config,
        clearance=workplace.arm_clearance,
    )
    stopped = ""
    try:
        for end in (far, home):
            speed = 1.875 * float((far - home).abs().max()) / TIME
            cell.follow_path(joint_line(cell.joints, end, speed, config.dt).numpy())
    except StoppedByPersonError as error:
        stopped = str(error)
    elbow, hand = aside(cell)
    start = panda.joint_origins(home)[ELBOW - 1]
    pull = ScriptedForce(
        start=0.0,
        duration=LASTS[where],
        towards=tuple((start.numpy() + force).tolist()),
        joint=ELBOW,
    )
    return {
        "stopped": stopped,
        "room": elbow_margin(home, pull, panda, workplace.arm_clearance),
        "elbow": float(elbow.max()),
        "hand": float(np.percentile(hand, 95)),
        "hand_most": float(hand.max()),
        "paused": human.paused[0] - BEGIN if human.paused else None,
        "resumed": human.paused[-1] - BEGIN - LASTS[where] if human.paused else None,
        "felt": human.elbow_felt[0] - BEGIN if human.elbow_felt else None,
    }


def apply(world: World, where: str, force: np.ndarray) -> None:
    """Apply the force to its body, at its present strength."""
    data, body = world.data, world.model.body({"elbow": "link4", "hand": "hand"}[where]).id
    edge = min(data.time - BEGIN, BEGIN + LASTS[where] - data.time) / RISE
    at = data.xpos[body] if where == "elbow" else data.site("tcp").xpos
    data.xfrc_applied[body, :3] = np.clip(edge, 0.0, 1.0) * force
    moment = np.cross(at - data.xipos[body], data.xfrc_applied[body, :3])
    data.xfrc_applied[body, 3:] = moment


def aside(cell: WorkCell) -> tuple[np.ndarray, np.ndarray]:
    """Distances of elbow and hand from the path at each step [m]."""
    on = np.isfinite(cell.log["path_joints"][:, 0])
    q, path = (
        torch.from_numpy(cell.log[name][on]) for name in ("joint_position", "path_joints")
    )
    elbow = (panda.joint_origins(q) - panda.joint_origins(path))[:, ELBOW - 1]
    hand = panda.forward(q).position - panda.forward(path).position
    return elbow.norm(dim=-1).numpy(), hand.norm(dim=-1).numpy()


def summary_of_elbow(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Displacements of elbows and hands."""
    roomy = [row for row in rows if row["room"] >= ENOUGH]
    return {
        "elbow_pushes": float(len(rows)),
        "elbow_felt": float(sum(row["felt"] is not None for row in rows)),
        "elbow_stopped": float(sum(bool(row["stopped"]) for row in rows)),
        "with_room_for_150_mm": float(len(roomy)),
        "of_these_moved_150_mm": float(sum(row["elbow"] >= ENOUGH for row in roomy)),
        "of_these_moved_median_mm": 1e3 * float(np.median([row["elbow"] for row in roomy])),
        "others_moved_least_mm": 1e3
        * min((row["elbow"] for row in rows if row["room"] < ENOUGH), default=np.nan),
        "hand_off_path_p95_most_mm": 1e3 * max(row["hand"] for row in rows),
        "hand_off_path_most_mm": 1e3 * max(row["hand_most"] for row in rows),
        "task_paused_by_elbow": float(sum(row["paused"] is not None for row in rows)),
    }


def summary_of_hand(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Number of pushes that paused the task, and the times of the pauses."""
    paused = [row for row in rows if row["paused"] is not None and not row["stopped"]]
    return {
        "hand_pushes": float(len(rows)),
        "task_paused": float(len(paused)),
        "hand_stopped": float(sum(bool(row["stopped"]) for row in rows)),
        "paused_after_median_s": float(np.median([row["paused"] for row in paused])),
        "paused_after_most_s": max(row["paused"] for row in paused),
        "resumed_after_median_s": float(np.median([row["resumed"] for row in paused])),
    }


if __name__ == "__main__":
    cli.run(main, Args)
