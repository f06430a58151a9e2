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
from hrc_learn.skills.pick_and_place import RELEASE, CollaborationConfig, Errand
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_servoing import AimingSkill
from hrc_learn.skills.work_cell import Station, StationConfig
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
    released = [errand for errand in job.errands if errand.release is not None]
    if not released:
        raise ValueError(f"the job failed, so there is nothing to measure: {job.failure}")
    objects = len(job.workplace.scene.objects)
    distance, angle = np.max([errand.goal_error for errand in released], axis=0)
    at_most = [
        ("reproduction of the demonstrations, NRMSE", fit["joint_nrmse_median"], "", 1e-3),
        ("time to aim", max(errand.aim_time for errand in released), "s", None),
        (
            "pixel error when the hand goes down",
            max(errand.pixel_error for errand in released),
            "px",
            5.0,
        ),
        ("goal error at the shelf", 1e3 * distance, "mm", 2.0),
        ("goal error at the shelf, angle", _degrees(angle), "deg", 0.5),
        ("joint limit violations", limit_violations(job.station), "steps", 0),
        *((f"collisions {what}", n, "", 0) for what, n in collisions(job).items()),
        ("time of the whole job", job.station.time, "s", None),
    ]
    at_most += [
        (f"recovered from: {mishap}", times, "", None)
        for mishap, times in recoveries(job).items()
    ]
    stand = float(len(standing(job)))
    at_least = [("objects that stand on their shelf", stand, "", float(objects))]
    if bool((job.station.log["human_effort"] != 0).any()):
        deviation = Deviation.of(job.station.log)
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


def standing(job: SimulatedJob) -> list[Errand]:
    """Errands whose object stands on its shelf, touching nothing of the arm."""
    return [
        errand
        for errand in job.errands
        if job.world.rests_on(errand.item.name, f"board_{errand.shelf}")
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
    return Counter(note.mishap for errand in job.errands for note in errand.recoveries)


def limit_violations(station: Station) -> int:
    """Steps in which a joint was measured outside its range of position or velocity."""
    q = torch.from_numpy(station.log["joint_position"])
    v = torch.from_numpy(station.log["joint_velocity"])
    limits = panda.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def _carried_touches(job: SimulatedJob) -> list[Touch]:
    """Touches of the cabinet by an object that had not been let go yet."""
    released = [errand.item.name for errand in job.errands if errand.release is not None]
    let_go = dict(zip(released, spans(job.station.log, RELEASE), strict=True))
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
    station: StationConfig = field(default_factory=lambda: StationConfig(keep_every=0))
    config: CollaborationConfig = field(default_factory=CollaborationConfig)

    def workplace(self) -> Workplace:
        """With as many objects as there are shelves named.

        Raises:
            ValueError: If there are more shelves named than objects known.
        """
        return workplace_for(self.shelves, self.shelf_x, self.shelf_depth)

    def __call__(self, seed: int) -> dict[str, float | str]:
        job = simulate_collaboration(
            AimingSkill.load(self.aiming),
            PlacingSkill.load(self.placing),
            self.shelves,
            workplace=self.workplace(),
            camera="synthetic",
            pulls=PULLS if self.person else (),
            disturbances=self.disturbances,
            config=self.config,
            station_config=self.station,
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
    deviation = Deviation.of(job.station.log)
    released = [errand for errand in job.errands if errand.release is not None]
    values = {
        "standing": float(len(standing(job))),
        "time_s": job.station.time,
        "limit_violations": float(limit_violations(job.station)),
        "collisions": float(sum(collisions(job).values())),
        "moved_by_person_mm": 1e3 * deviation.most_moved,
        "elbow_moved_mm": 1e3 * deviation.elbow_most_moved,
    }
    if released:
        values |= {
            "aim_time_s": max(errand.aim_time for errand in released),
            "pixel_error_px": max(errand.pixel_error for errand in released),
            "goal_error_mm": 1e3 * max(errand.goal_error[0] for errand in released),
        }
    return values | {
        f"recovered_{mishap.replace(' ', '_')}": float(times)
        for mishap, times in recoveries(job).items()
    }


def verdict(job: SimulatedJob) -> str:
    """Why a run does not count as a success; empty if it does."""
    reasons = [job.failure] if job.failure else []
    stand = [errand.item.name for errand in standing(job)]
    fallen = [item.name for item in job.workplace.scene.objects if item.name not in stand]
    if fallen:
        reasons.append(f"not on their shelf: {', '.join(fallen)}")
    reasons += [f"{n} collisions {what}" for what, n in collisions(job).items() if n]
    if violations := limit_violations(job.station):
        reasons.append(f"joint limits left in {violations} steps")
    return "; ".join(reasons)
