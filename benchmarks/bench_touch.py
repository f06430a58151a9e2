"""False touches: how often an untouched arm detects a touch during its job.

The whole job with one object, with the nominal imperfections of a laboratory, commanded
directly in MuJoCo. `Touch` reads the torques during the job, as on a real arm, but its requests
are not executed. Each job runs once with a scripted person who guides the elbow without
touching the arm, and once without a person.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.experiments.collaboration_trial import (
    NULL_SPACE_FORCES,
    CollaborationScenario,
    simulate_collaboration,
)
from hrc_learn.experiments.simulated_cell import Observer
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.sim import Imperfections, MotionLog, World
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation.touch import Touch, TouchConfig


@dataclass(frozen=True, kw_only=True)
class Args:
    models: Path
    """Folder of `hrc demo`, with `aiming` and `placing`."""
    first_seed: int = 0
    """First seed of object place, images and imperfections."""
    jobs: int = 50
    """Number of seeds; each job runs with and without the person."""
    config: TouchConfig = field(default_factory=TouchConfig)
    """Thresholds of a touch."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Listener(Human):
    """The person of the job, together with the detection of touches."""

    def __init__(self, person: Human, touch: Touch):
        self._person, self._touch = person, touch
        self._before: tuple[str, bool, bool] = ("nothing", False, False)
        self.felt: Counter[str] = Counter()
        """Number of detected pushes at the elbow, pauses and stops."""

    def read(self, state: ArmState) -> HumanInput:
        """Input of the person."""
        asked = self._touch.read(state)
        now = (self._touch.place, asked.pause, bool(asked.stop))
        self.felt["elbow pushed"] += now[0] == "elbow" != self._before[0]
        self.felt["task paused"] += now[1] and not self._before[1]
        self.felt["arm stopped"] += now[2] and not self._before[2]
        self._before = now
        return self._person.read(state)

    def tell(self, feedback: Feedback) -> None:
        """Pass the feedback to both."""
        self._touch.tell(feedback)
        self._person.tell(feedback)


def main(args: Args) -> None:
    """Run the jobs and count."""
    aiming = VisualServoSkill.load(args.models / "aiming")
    placing = PlacingSkill.load(args.models / "placing", panda)
    table = Table("", "jobs done", "hours", "elbow pushed", "task paused", "arm stopped")
    figures: dict[str, float] = {}
    for name, forces in (("nobody", ()), ("a person leads the elbow", NULL_SPACE_FORCES)):
        felt: Counter[str] = Counter()
        done, hours = 0, 0.0
        for seed in range(args.first_seed, args.first_seed + args.jobs):
            listeners: list[Listener] = []

            @contextmanager
            def listen(
                cell: WorkCell, world: World, motion: MotionLog, listeners: list = listeners
            ) -> Iterator[None]:
                cell.human = listener = Listener(cell.human, Touch(panda, args.config))
                listeners.append(listener)
                yield

            run = simulate_collaboration(
                aiming,
                placing,
                ("middle",),
                CollaborationScenario(
                    camera="synthetic", forces=forces, imperfections=Imperfections.nominal()
                ),
                seed=seed,
                observer=Observer(view=listen),
            )
            done += not run.failure
            hours += float(run.cell.log["time"][-1]) / 3600
            felt.update(listeners[0].felt)
            Console().print(name, seed, run.failure, dict(listeners[0].felt))
            del run
            gc.collect()  # half a gigabyte of images, which refer to each other's world
        kinds = ("elbow pushed", "task paused", "arm stopped")
        table.add_row(name, str(done), f"{hours:.2f}", *(str(felt[kind]) for kind in kinds))
        key = name.replace(" ", "_")
        figures |= {f"{key}_done": float(done), f"{key}_hours": hours}
        figures |= {f"{key}_{kind.replace(' ', '_')}": float(felt[kind]) for kind in kinds}
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
