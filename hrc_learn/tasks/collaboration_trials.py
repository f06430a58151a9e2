"""The collaboration once for each seed, judged by MuJoCo's contacts and poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .collaboration import CollaborationConfig
from .evaluation import collisions, limit_violations, recoveries, standing
from .fit_aiming import AimingSkill
from .placing import PlacingSkill
from .recording import Deviation
from .scattering import THREE_OBJECTS
from .simulated_job import (
    PULLS,
    Disturbances,
    SimulatedJob,
    simulate_collaboration,
    with_objects,
)
from .station import StationConfig
from .workplace import Workplace


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
