"""What one placing motion came to, in numbers, and whether that is good enough."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..demos import Demonstration
from ..geometry import Pose
from ..kinematics import panda
from .evaluation import limit_violations
from .insertion import Insertion
from .placing_run import PlacingRun
from .reproduction_error import dimensionless_jerk
from .workplace import Workplace

GOAL_DISTANCE, GOAL_ANGLE, BEND = 2e-3, float(np.deg2rad(0.5)), 12e-3
"""Bounds of what is good enough [m], [rad], [m]."""


@dataclass(frozen=True, kw_only=True)
class PlacingFigures:
    """Of one run."""

    bend: float
    """Largest distance of the way in from the demonstrated one, moved to the goal [m]."""
    goal_distance: float
    """Of the hand when it let go [m]."""
    goal_angle: float
    """The same, of its orientation [rad]."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    touches: Sequence[str]
    """What was met that should not have been, in words."""
    peak_speed: float
    """Largest joint velocity, as a share of that joint's limit."""
    jerk: float
    """Dimensionless jerk of the hand's path, as a share of the demonstration's."""
    placed: bool
    """Whether the thing stands on its board afterwards."""

    @property
    def faults(self) -> list[str]:
        """Why this is not good enough; none if it is."""
        tested = {
            f"{len(self.touches)} contacts, first {next(iter(self.touches), '')}": bool(
                self.touches
            ),
            f"{self.violations} steps beyond a joint limit": self.violations > 0,
            "the thing does not stand on the board": not self.placed,
            f"goal missed by {1e3 * self.goal_distance:.1f} mm": (
                self.goal_distance > GOAL_DISTANCE
            ),
            f"goal missed by {np.rad2deg(self.goal_angle):.2f} deg": (
                self.goal_angle > GOAL_ANGLE
            ),
            f"way in bent by {1e3 * self.bend:.1f} mm": self.bend > BEND,
        }
        return [fault for fault, found in tested.items() if found]

    def row(self) -> dict[str, float | int]:
        """As plain numbers, in the units that their names say."""
        return {
            "bend_mm": 1e3 * self.bend,
            "goal_error_mm": 1e3 * self.goal_distance,
            "goal_error_deg": float(np.rad2deg(self.goal_angle)),
            "limit_violations": self.violations,
            "contacts": len(self.touches),
            "peak_speed_share": self.peak_speed,
            "jerk_share": self.jerk,
            "placed": int(self.placed),
        }


def placing_figures(
    run: PlacingRun, workplace: Workplace, demonstration: Demonstration
) -> PlacingFigures:
    """Measure a run against a demonstration of any shelf."""
    miss = run.released.twist_to(run.plan.goal)
    speed = np.abs(run.station.log["joint_velocity"]) / panda.limits.velocity.numpy()
    return PlacingFigures(
        bend=way_in(run.path, run.plan.goal, workplace).bend(
            demonstrated_way_in(demonstration, workplace)
        ),
        goal_distance=float(miss[:3].norm()),
        goal_angle=float(miss[3:].norm()),
        violations=limit_violations(run.station),
        touches=[str(touch) for touch in run.touches],
        peak_speed=float(speed.max()),
        jerk=jerk_left(run, demonstration),
        placed=run.placed,
    )


def way_in(path: Float[np.ndarray, "steps 3"], goal: Pose, workplace: Workplace) -> Insertion:
    """What of a path of the hand lies behind the boards' front edge."""
    return Insertion.of(path, goal.position.numpy(), _edge(workplace))


def demonstrated_way_in(demonstration: Demonstration, workplace: Workplace) -> Insertion:
    """What was shown there, relative to where it ended.

    Raises:
        ValueError: If the hand was never led into the cabinet.
    """
    path = hand_path(demonstration)
    shown = Insertion.of(path, path[-1], _edge(workplace))
    if not len(shown.offset):
        raise ValueError(
            f"demonstration {demonstration.episode} ends at y = {path[-1, 1]:.3f} m, in front "
            f"of the cabinet at {_edge(workplace):.3f} m: give demonstrations of placing."
        )
    return shown


def _edge(workplace: Workplace) -> float:
    """Where along y the hand is when what it carries crosses the boards' front edge [m]."""
    return workplace.scene.cabinet.front + workplace.scene.objects[0].half_size[2]


def hand_path(demonstration: Demonstration) -> Float[np.ndarray, "frames 3"]:
    """Of the tool centre point, from the demonstrated joints [m].

    Raises:
        ValueError: If the demonstration holds no joints of a Panda.
    """
    joints = demonstration.joint_position
    if joints is None or demonstration.joint_names != panda.joint_names:
        raise ValueError(
            f"the demonstrations hold the joints {demonstration.joint_names}, but the arm has "
            f"{panda.joint_names}: give demonstrations of this arm."
        )
    return panda.forward(torch.from_numpy(joints)).position.numpy()


def jerk_left(run: PlacingRun, demonstration: Demonstration) -> float:
    """Dimensionless jerk of the hand's path over that of the demonstration."""
    done, shown = (
        dimensionless_jerk(torch.from_numpy(time), torch.from_numpy(path))
        for time, path in ((run.time, run.path), (demonstration.time, hand_path(demonstration)))
    )
    return float(done / shown)
