"""Arm-angle ablation: the same motion demonstrated with and without a null-space posture.

What it is worth that the expert moves the elbow along with the end effector.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from hrc_learn.experiments.metric_table import Metric, total
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    demonstrate_placing,
)

_COLLIDES = "the 4th link collides with the cabinet"
_AVOIDED = "the collision is avoided"


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedDemonstration:
    """One demonstration, with an arm that a cabinet in the way stops."""

    time: Float[np.ndarray, " frames"]
    """[s]"""
    joint_position: Float[np.ndarray, "frames 7"]
    """[rad]"""
    contacts: tuple[Touch, ...]
    """Of the arm, or of what it carried, with the cabinet."""
    goal_error: float
    """Distance of the end effector from its goal at the end [m]."""

    @property
    def arm_contacts(self) -> list[Touch]:
        """Those of links of the arm."""
        return [touch for touch in self.contacts if touch.first.startswith("link")]


@dataclass(frozen=True, kw_only=True, eq=False)
class Ablation:
    """The same motion of the end effector, demonstrated in both ways."""

    with_posture: SimulatedDemonstration
    """The expert also moves the elbow."""
    without_posture: SimulatedDemonstration
    """Nobody moves the elbow."""

    @classmethod
    def run(cls, workplace: Workplace, shelf: str, seed: int) -> "Ablation":
        """Demonstrate the motion to a shelf.

        The end effector moves alike in both: the seed draws its tremor and where it starts.
        """
        world = World(workplace.scene)
        with_posture, without_posture = (
            _demonstrate(world, workplace, shelf, moves_elbow, seed)
            for moves_elbow in (True, False)
        )
        return cls(with_posture=with_posture, without_posture=without_posture)


def _demonstrate(
    world: World, workplace: Workplace, shelf: str, moves_elbow: bool, seed: int
) -> SimulatedDemonstration:
    lesson = PlacingDemonstrationConfig(pull_elbow=moves_elbow)
    rng = np.random.default_rng(seed)
    frames, touches = demonstrate_placing(world, workplace, shelf, lesson, rng)
    goal = workplace.shelf(shelf).position.numpy()
    return SimulatedDemonstration(
        time=np.array([frame["time"] for frame in frames]),
        joint_position=np.array([frame["joint_position"] for frame in frames]),
        contacts=tuple(touches),
        goal_error=float(np.linalg.norm(frames[-1]["position"] - goal)),
    )


@dataclass(frozen=True, kw_only=True)
class AblationTrial:
    """The ablation once for each seed."""

    shelf: str
    """Where the motion leads."""
    robot: ArmChoice = field(default_factory=ArmChoice)
    """The arm."""

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Values by name; a failure if the motion with the posture was not free."""
        ablation = Ablation.run(Workplace.of(self.robot.work_arm()), self.shelf, seed)
        taught, untaught = ablation.with_posture, ablation.without_posture
        return {
            "with_posture_hit": int(bool(taught.contacts)),
            "with_posture_goal_error_mm": 1e3 * taught.goal_error,
            "without_posture_hit": int(bool(untaught.arm_contacts)),
            "without_posture_goal_error_mm": 1e3 * untaught.goal_error,
            "failure": "; ".join(map(str, taught.contacts)),
        }


METRICS: Sequence[Metric[Ablation]] = (
    Metric(
        "demonstration without null-space posture, contacts of the arm with the cabinet",
        lambda ablation: len(ablation.without_posture.arm_contacts),
        at_least=1,
        claim=_COLLIDES,
    ),
    Metric(
        "demonstration with null-space posture, contacts with the cabinet",
        lambda ablation: len(ablation.with_posture.contacts),
        at_most=0,
        claim=_AVOIDED,
    ),
)
"""Of one ablation."""

TRIAL_METRICS: Sequence[Metric[Sequence[Trial]]] = (
    Metric("paired demonstrations", len),
    Metric(
        "paired demonstrations, the arm hit the cabinet without null-space posture",
        total("without_posture_hit"),
        claim=_COLLIDES,
    ),
    Metric(
        "paired demonstrations, something hit the cabinet with null-space posture",
        total("with_posture_hit"),
        at_most=0,
        claim=_AVOIDED,
    ),
)
"""Of many."""
