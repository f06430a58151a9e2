"""What a run of the collaboration has to reach, measured."""

from collections.abc import Mapping

import numpy as np
import torch

from ..kinematics import panda
from ..sim import Touch, World
from ..viz.report import Measurement
from .collaboration import RELEASE
from .recording import Deviation, span
from .simulated_job import SimulatedJob
from .station import Station


def evaluate(job: SimulatedJob, fit: Mapping[str, float]) -> list[Measurement]:
    """Compare a run with its targets.

    Success is read from the simulator's contacts and poses, not from what the task believes.

    Args:
        job: The run.
        fit: Metrics of the fitted primitives.

    Raises:
        ValueError: If the run failed; there is nothing to measure then.
    """
    if job.result is None:
        raise ValueError(f"the job failed, so there is nothing to measure: {job.failure}")
    station, world, result = job.station, job.world, job.result
    distance, angle = result.goal_error
    deviation = Deviation.of(station.log)
    touches = world.cabinet_contacts.touches + _carried_touches(station, world)
    placed = world.rests_on(job.item.name, f"board_{job.shelf}")
    at_most = [
        ("reproduction of the demonstrations, NRMSE", fit["joint_nrmse_median"], "", 1e-3),
        ("time to aim", result.grasp.aim_time, "s", None),
        ("pixel error when the hand goes down", result.grasp.pixel_error, "px", 5.0),
        ("goal error at the shelf", 1e3 * distance, "mm", 2.0),
        ("goal error at the shelf, angle", _degrees(angle), "deg", 0.5),
        ("joint limit violations", limit_violations(station), "steps", 0),
        ("collisions with the cabinet", len(touches), "", 0),
        ("collisions with the table", len(world.table_contacts.touches), "", 0),
        ("collisions of the arm with itself", len(world.self_contacts.touches), "", 0),
    ]
    at_least = [("object stands on the shelf", float(placed), "", 1.0)]
    if bool((station.log["human_effort"] != 0).any()):
        moved, turned = 1e3 * deviation.most_moved, _degrees(deviation.most_turned)
        at_most.append(("end effector moved by the person", moved, "mm", 1.0))
        at_most.append(("end effector turned by the person", turned, "deg", 0.2))
        at_least.append(("elbow moved by the person", deviation.elbow_most_moved, "m", 0.1))
    return [
        Measurement(name=name, value=value, unit=unit, target=target, at_least=rows is at_least)
        for rows in (at_most, at_least)
        for name, value, unit, target in rows
    ]


def _degrees(angle: float) -> float:
    return float(np.rad2deg(angle))


def limit_violations(station: Station) -> int:
    """Steps in which a joint was measured outside its range of position or velocity."""
    q = torch.from_numpy(station.log["joint_position"])
    v = torch.from_numpy(station.log["joint_velocity"])
    limits = panda.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def _carried_touches(station: Station, world: World) -> list[Touch]:
    """Touches of the cabinet by the object before it was let go."""
    release, _ = span(station.log, RELEASE)
    return [touch for touch in world.object_contacts.touches if touch.start < release]
