"""Run the whole job near a person through the driver, sockets and cycles of the real arm.

One object is grasped, carried and placed while a person pushes the elbow and, if requested, a
worker comes to the table. The simulation in MuJoCo has the nominal imperfections of a
laboratory. It stands behind the network protocol of the arm (franky-sim) and waits for each
answer. Packets can be dropped. Afterwards, franka-sim's limit checker judges the velocity
commanded in each cycle, including the extrapolation of a control box that receives no answer,
against the Panda's limits. The checker runs in its own environment (tools/make_franka_sim.sh).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import itertools
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from served_cycles import CycleLog, DrivenCycle, LossyLink

from hrc_learn import cli
from hrc_learn.experiments.collaboration_metrics import collaboration_metrics
from hrc_learn.experiments.collaboration_trial import (
    NULL_SPACE_FORCES,
    CollaborationScenario,
    simulate_collaboration,
)
from hrc_learn.experiments.simulated_cell import access_by
from hrc_learn.hardware import DriverError
from hrc_learn.hardware.protocol_server import ArmServer, serve_world
from hrc_learn.kinematics import panda
from hrc_learn.sim import Imperfections, World
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".venv-franka-sim" / "bin" / "python"
SHELF = "middle"
REPORTED = {
    "place error": "off its place [mm]",
    "end effector deviation": "hand off its path, at most [mm]",
    "elbow moved": "elbow moved [mm]",
    "joint limit violations": "steps outside limits",
    "separation violations": "steps too near the worker",
    "min distance": "smallest distance of the worker [mm]",
    "contacts with the worker": "contacts with the worker",
}
"""Metrics of the job, by the headings of their columns."""


@dataclass(frozen=True, kw_only=True)
class Args:
    models: Path
    """Folder of `hrc demo`, with `aiming` and `placing`."""
    driver: Literal["franky", "franka"] = "franka"
    """Driver: franky's own motion generator, or our 1 kHz loop."""
    first_seed: int = 0
    """First seed of object places, images and imperfections."""
    jobs: int = 50
    """Number of jobs, with successive seeds."""
    loss: float = 0.0
    """Fraction of packets that are lost, the same for states and answers."""
    pulls: Literal["scripted", "random"] = "scripted"
    """Time of the pushes at the elbow: while the arm waits for them, or any time."""
    worker: bool = False
    """True if an unannounced worker comes to the table."""
    config: PickAndPlaceConfig = field(default_factory=PickAndPlaceConfig)
    """Settings of the job."""
    json: Path | None = None
    """File that receives one row per job, immediately; seeds that it contains are not repeated.
    """


def main(args: Args) -> None:
    """Run the jobs one after another."""
    if not PYTHON.exists():
        raise ValueError("tools/make_franka_sim.sh makes the environment of the checker first")
    aiming = VisualServoSkill.load(args.models / "aiming")
    placing = PlacingSkill.load(args.models / "placing", panda)
    rows = _done_before(args.json)
    for seed in range(args.first_seed, args.first_seed + args.jobs):
        if any(row["seed"] == seed for row in rows):
            continue
        row = {"seed": seed} | job(aiming, placing, seed, args)
        rows.append(row)
        Console().print(row)
        if args.json is not None:
            with args.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    show(rows)


def _done_before(path: Path | None) -> list[dict[str, Any]]:
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def job(
    aiming: VisualServoSkill, placing: PlacingSkill, seed: int, args: Args
) -> dict[str, Any]:
    """Run one job and return its row."""
    served: list[tuple[ArmServer, LossyLink, CycleLog]] = []

    @contextmanager
    def serve(world: World) -> Iterator[ArmServer]:
        with serve_world(world) as server:
            served.append((server, LossyLink(server, args.loss), CycleLog(server)))
            yield server

    begun = time.monotonic()
    try:
        run = simulate_collaboration(
            aiming,
            placing,
            (SHELF,),
            CollaborationScenario(
                camera="synthetic",
                forces=NULL_SPACE_FORCES if args.pulls == "scripted" else "random",
                config=args.config,
                imperfections=Imperfections.nominal(),
                worker=args.worker,
            ),
            access=access_by(args.driver, panda, serve=serve),
            seed=seed,
        )
    except DriverError as error:
        row: dict[str, Any] = {"failure": f"driver: {error}"}
    else:
        row = {"failure": run.failure, "time": float(run.cell.log["time"][-1])}
        measured = {m.name: m.of(run) for m in collaboration_metrics(1, 0.0)}
        row |= {name: measured[name] for name in REPORTED if name in measured}
        row["placed"] = run.world.rests_on(
            run.workplace.scene.objects[0].name, f"board_{SHELF}"
        )
        row["contacts"] = sum(
            len(monitor.touches)
            for monitor in (
                run.world.cabinet_contacts,
                run.world.table_contacts,
                run.world.self_contacts,
            )
        )
    server, link, cycles = served[-1]
    # A cycle whose packet was dropped is missed, too.
    gaps = itertools.groupby(cycles, lambda cycle: cycle.answered)
    longest = max((len([*gap]) for answered, gap in gaps if not answered), default=0)
    counts = {"missed": server.missed, "lost": link.lost, "longest_gap": longest}
    return row | counts | judged(cycles) | {"wall": time.monotonic() - begun}


def judged(cycles: list[DrivenCycle]) -> dict[str, Any]:
    """Findings of the checker on all cycles."""
    if not cycles:
        return {"ticks": 0, "findings": 0, "shown": []}
    limits = panda.limits
    arrays = {
        "motion": np.array([cycle.motion for cycle in cycles]),
        "velocity": np.array([cycle.velocity for cycle in cycles])[:, None],
        "position": np.array([cycle.position for cycle in cycles])[:, None],
        "max_velocity": limits.velocity.numpy(),
    }
    for name in ("lower", "upper", "acceleration", "jerk"):
        arrays[name] = getattr(limits, name).numpy()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sent.npz"
        np.savez(path, **arrays)
        command = [PYTHON, ROOT / "tools" / "motion_limit_checker.py", "--sent", path]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def show(rows: list[dict[str, Any]]) -> None:
    """Print the results of all jobs."""
    table = Table("", "", title=f"{len(rows)} jobs")
    done = [row for row in rows if not row["failure"]]
    table.add_row("done", f"{len(done)}")
    table.add_row("placed", f"{sum(row['placed'] for row in done)}")
    for name in ("contacts", "missed", "lost", "ticks", "findings"):
        table.add_row(name, f"{sum(row.get(name, 0) for row in rows):,}")
    table.add_row("longest gap", f"{max(row['longest_gap'] for row in rows)}")
    for name, head in REPORTED.items():
        values = [row[name] for row in done if row.get(name) is not None]
        if values:
            median, p95 = np.percentile(values, [50, 95])
            table.add_row(escape(f"{head}, median and p95"), f"{median:.1f}, {p95:.1f}")
    table.add_row(
        escape("wall time of a job, median [s]"), f"{np.median([r['wall'] for r in rows]):.0f}"
    )
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
