"""What a run of the collaboration has to reach, measured, once or for each seed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from hrc_learn.experiments.collaboration.experiment import (
    PULLS,
    Disturbances,
    SimulatedJob,
    simulate_collaboration,
    with_objects,
)
from hrc_learn.experiments.pose_randomization import THREE_OBJECTS
from hrc_learn.experiments.run_recording import Deviation, spans
from hrc_learn.kinematics import panda
from hrc_learn.sim import Touch
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import RELEASE, PickAndPlaceConfig, PickPlaceJob
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.viz.report import Measurement

# What a run of the collaboration has to reach, measured.


def evaluate(job: SimulatedJob, fit: Mapping[str, float]) -> list[Measurement]:
    """Compare a run with its targets; of several objects the worst counts.

    Success is read from the simulator's contacts and poses, not from what the task believes.

    Args:
        job: The run.
        fit: Metrics of the fitted primitives.

    Raises:
        ValueError: If no object was released on a shelf; there is nothing to measure then.
    """
    released = [pick for pick in job.picks if pick.release is not None]
    if not released:
        raise ValueError(f"the job failed, so there is nothing to measure: {job.failure}")
    objects = len(job.workplace.scene.objects)
    distance, angle = np.max([pick.goal_error for pick in released], axis=0)
    at_most = [
        ("reproduction of the demonstrations, NRMSE", fit["joint_nrmse_median"], "", 1e-3),
        ("time to aim", max(pick.servo_time for pick in released), "s", None),
        (
            "pixel error when the hand goes down",
            max(pick.pixel_error for pick in released),
            "px",
            5.0,
        ),
        ("goal error at the shelf", 1e3 * distance, "mm", 2.0),
        ("goal error at the shelf, angle", _degrees(angle), "deg", 0.5),
        ("joint limit violations", limit_violations(job.cell), "steps", 0),
        *((f"collisions {what}", n, "", 0) for what, n in collisions(job).items()),
        ("time of the whole job", job.cell.time, "s", None),
    ]
    at_most += [
        (f"recovered from: {mishap}", times, "", None)
        for mishap, times in recoveries(job).items()
    ]
    stand = float(len(standing(job)))
    at_least = [("objects that stand on their shelf", stand, "", float(objects))]
    if bool((job.cell.log["human_effort"] != 0).any()):
        deviation = Deviation.of(job.cell.log)
        moved, turned = 1e3 * deviation.most_moved, _degrees(deviation.most_turned)
        at_most.append(("end effector moved by the person", moved, "mm", 1.0))
        at_most.append(("end effector turned by the person", turned, "deg", 0.2))
        at_least.append(("elbow moved by the person", deviation.elbow_most_moved, "m", 0.1))
    return [
        Measurement(
            name=name,
            value=value,
            unit=unit,
            target=target,
            at_least=rows is at_least,
            claim=_CLAIMS.get(name, ""),
        )
        for rows in (at_most, at_least)
        for name, value, unit, target in rows
    ]


_CLAIMS = {
    "objects that stand on their shelf": "three objects, one after the other (Experiment 3)",
    "end effector moved by the person": "main task not affected (Experiment 3)",
    "end effector turned by the person": "main task not affected (Experiment 3)",
    "elbow moved by the person": "joint 4 dragged forward for 7 s, backward for 4 s",
    "time of the whole job": "the first object on its shelf after 68 s (snapshots)",
}
"""What the paper says, by name of the measurement."""


def standing(job: SimulatedJob) -> list[PickPlaceJob]:
    """Errands whose object stands on its shelf, touching nothing of the arm."""
    return [
        pick for pick in job.picks if job.world.rests_on(pick.item.name, f"board_{pick.shelf}")
    ]


def collisions(job: SimulatedJob) -> dict[str, int]:
    """Touches that there should not have been, by what was met."""
    world = job.world
    return {
        "with the cabinet": len(world.cabinet_contacts.touches) + len(_carried_touches(job)),
        "with the table": len(world.table_contacts.touches),
        "of the arm with itself": len(world.self_contacts.touches),
    }


def recoveries(job: SimulatedJob) -> Counter[str]:
    """How often the task recovered from each kind of mishap."""
    return Counter(note.mishap for pick in job.picks for note in pick.recoveries)


def limit_violations(cell: WorkCell) -> int:
    """Steps in which a joint was measured outside its range of position or velocity."""
    q = torch.from_numpy(cell.log["joint_position"])
    v = torch.from_numpy(cell.log["joint_velocity"])
    limits = panda.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def _carried_touches(job: SimulatedJob) -> list[Touch]:
    """Touches of the cabinet by an object that had not been let go yet."""
    released = [pick.item.name for pick in job.picks if pick.release is not None]
    let_go = dict(zip(released, spans(job.cell.log, RELEASE), strict=True))
    return [
        touch
        for touch in job.world.object_contacts.touches
        if touch.start < let_go.get(touch.first, (np.inf, np.inf))[0]
    ]


def _degrees(angle: float) -> float:
    return float(np.rad2deg(angle))


# The collaboration once for each seed, judged by MuJoCo's contacts and poses.


@dataclass(frozen=True, kw_only=True)
class CollaborationTrials:
    """Runs the job with a seed; for `repeat`."""

    aiming: Path
    """Folder of the aiming skill."""
    placing: Path
    """Folder of the placing skill."""
    shelves: tuple[str, ...]
    """One for each of up to three objects."""
    shelf_x: float = Workplace.shelf_x
    """Where along the boards objects are put [m]."""
    shelf_depth: float = Workplace.shelf_depth
    """How far behind the boards' front edge [m]."""
    person: bool = True
    """Whether the scripted person pulls the elbow."""
    disturbances: Disturbances = field(default_factory=Disturbances)
    cell: WorkCellConfig = field(default_factory=lambda: WorkCellConfig(keep_image_every=0))
    config: PickAndPlaceConfig = field(default_factory=PickAndPlaceConfig)

    def workplace(self) -> Workplace:
        """With as many objects as there are shelves named.

        Raises:
            ValueError: If there are more shelves named than objects known.
        """
        return workplace_for(self.shelves, self.shelf_x, self.shelf_depth)

    def __call__(self, seed: int) -> dict[str, float | str]:
        job = simulate_collaboration(
            VisualServoSkill.load(self.aiming),
            PlacingSkill.load(self.placing),
            self.shelves,
            workplace=self.workplace(),
            camera="synthetic",
            pulls=PULLS if self.person else (),
            disturbances=self.disturbances,
            config=self.config,
            cell_config=self.cell,
            seed=seed,
        )
        values: dict[str, float | str] = {**measured(job)}
        if failure := verdict(job):
            values["failure"] = failure
        return values


def workplace_for(shelves: Sequence[str], shelf_x: float, shelf_depth: float) -> Workplace:
    """A workplace with an object for each shelf.

    Raises:
        ValueError: If there are too many, or none.
    """
    if not 1 <= len(shelves) <= len(THREE_OBJECTS):
        raise ValueError(
            f"there are 1 to {len(THREE_OBJECTS)} objects to put on shelves, but "
            f"{len(shelves)} shelves are named."
        )
    workplace = Workplace(shelf_x=shelf_x, shelf_depth=shelf_depth)
    return with_objects(workplace, THREE_OBJECTS[: len(shelves)])


def measured(job: SimulatedJob) -> dict[str, float]:
    """Figures of a run, successful or not."""
    deviation = Deviation.of(job.cell.log)
    released = [pick for pick in job.picks if pick.release is not None]
    values = {
        "standing": float(len(standing(job))),
        "time_s": job.cell.time,
        "limit_violations": float(limit_violations(job.cell)),
        "collisions": float(sum(collisions(job).values())),
        "moved_by_person_mm": 1e3 * deviation.most_moved,
        "elbow_moved_mm": 1e3 * deviation.elbow_most_moved,
    }
    if released:
        values |= {
            "aim_time_s": max(pick.servo_time for pick in released),
            "pixel_error_px": max(pick.pixel_error for pick in released),
            "goal_error_mm": 1e3 * max(pick.goal_error[0] for pick in released),
        }
    return values | {
        f"recovered_{mishap.replace(' ', '_')}": float(times)
        for mishap, times in recoveries(job).items()
    }


def verdict(job: SimulatedJob) -> str:
    """Why a run does not count as a success; empty if it does."""
    reasons = [job.failure] if job.failure else []
    stand = [pick.item.name for pick in standing(job)]
    fallen = [item.name for item in job.workplace.scene.objects if item.name not in stand]
    if fallen:
        reasons.append(f"not on their shelf: {', '.join(fallen)}")
    reasons += [f"{n} collisions {what}" for what, n in collisions(job).items() if n]
    if violations := limit_violations(job.cell):
        reasons.append(f"joint limits left in {violations} steps")
    return "; ".join(reasons)
