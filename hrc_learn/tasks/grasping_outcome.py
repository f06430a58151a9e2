"""What came of a grasp, as MuJoCo's contacts and poses tell it, whatever the task believes."""

import math
from dataclasses import asdict, dataclass

import numpy as np
import torch

from ..geometry import Pose
from ..kinematics import panda
from .evaluation import limit_violations
from .recording import span
from .simulated_grasp import SimulatedGrasp

LIFTED = 0.10
"""Height above the table at which an object counts as lifted [m]."""


@dataclass(frozen=True, kw_only=True)
class GraspOutcome:
    """Measured after the arm went home with the object. Lengths [m], angles [rad], times [s].

    What was never reached is NaN.
    """

    held: bool
    """Whether the object is between both fingers."""
    height: float
    """Of the object above where it lay."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    touches: int
    """Of the arm with table, cabinet and itself."""
    attempts: int
    """Grasps tried."""
    duration: float
    """From the start until home."""
    aim_time: float
    """Of the last attempt, from remote until above the object."""
    vision_time: float
    """Of that, since the camera took over for the first time."""
    pixel_error: float
    """From the hand's marker to its target as the hand goes down [px]."""
    target_error: float
    """From that target to where the marker should truly have been [px]."""
    place_error: float
    """From the hand to right above the object as the hand goes down, horizontally."""
    angle_error: float
    """Of the hand from pointing straight down, then."""
    failure: str
    """Why it is no success; empty if it is."""

    @classmethod
    def of(cls, run: SimulatedGrasp) -> "GraspOutcome":
        """Measure."""
        world, log, result = run.world, run.station.log, run.result
        touches = [
            touch
            for monitor in (world.table_contacts, world.cabinet_contacts, world.self_contacts)
            for touch in monitor.touches
        ]
        held = world.holds(run.item.name)
        height = float(world.object_pose(run.item.name)[2, 3] - run.setting.object_pose[2, 3])
        violations = limit_violations(run.station) if len(log) else 0
        failure = run.failure
        if not failure and not (held and height > LIFTED):
            failure = f"the object is not held {1e3 * LIFTED:.0f} mm above the table"
        if not failure and violations:
            failure = f"joint limits were left in {violations} steps"
        if not failure and touches:
            failure = str(touches[0])
        return cls(
            held=held,
            height=height,
            violations=violations,
            touches=len(touches),
            attempts=0 if result is None else result.attempts,
            duration=run.station.time,
            aim_time=math.nan if result is None else result.aim_time,
            pixel_error=math.nan if result is None else result.pixel_error,
            failure=failure,
            **_at_descent(run),
        )

    def values(self) -> dict[str, float]:
        """All but the failure, as numbers."""
        return {k: float(v) for k, v in asdict(self).items() if k != "failure"}


def _at_descent(run: SimulatedGrasp) -> dict[str, float]:
    """What the last descent began with."""
    log = run.station.log
    descents = [event.time for event in log.events if event.text == "grasp"]
    unknown = ("vision_time", "target_error", "place_error", "angle_error")
    if not descents:
        return dict.fromkeys(unknown, math.nan)
    aiming = span(log, "aim")
    time = log["time"]
    last = int(np.searchsorted(time, descents[-1])) - 1
    hand = panda.forward(torch.from_numpy(log["joint_position"][last]))
    above = Pose(hand.position, run.setting.workplace.hover().orientation)
    off = hand.position[:2].numpy() - run.setting.object_pose[:2, 3]
    seen = (time >= aiming[0]) & (log["vision_activation"] > 0)
    taken_over = time[seen][0] if seen.any() else math.nan
    target = log["target"][last] - run.setting.true_target(run.world)
    return {
        "vision_time": min(aiming[1], descents[-1]) - taken_over,
        "target_error": float(np.linalg.norm(target)),
        "place_error": float(np.linalg.norm(off)),
        "angle_error": float(hand.twist_to(above)[3:].norm()),
    }
