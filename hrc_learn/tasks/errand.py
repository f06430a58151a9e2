"""One object on its way from the table to its shelf."""

from dataclasses import dataclass, field
from typing import Literal

from ..geometry import Pose
from ..sim import ObjectConfig
from .aiming import Aim
from .placing import Plan

Mishap = Literal[
    "object out of sight",
    "marker out of sight",
    "missed grasp",
    "dropped object",
    "blocked way",
]
"""What a task recovers from."""


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Something went wrong, and the task went on."""

    time: float
    """[s]"""
    mishap: Mishap
    what: str
    """What happened, and what was done about it."""


@dataclass(kw_only=True)
class Errand:
    """What the phases of the task hand on to each other, and in the end its result."""

    item: ObjectConfig
    shelf: str
    goal: Pose
    """Of the hand where it lets go, if the thing is held in the middle."""
    time_for_person: float = 0.0
    """How long to go on aiming while a person reaches under the arm [s]."""
    aim: Aim | None = None
    """Where the object was seen last."""
    aim_time: float = float("nan")
    """From the start of the last aim until the target was reached [s]."""
    pixel_error: float = float("nan")
    """When the hand went down [px]."""
    picked_up: Pose | None = None
    """Of the hand when it took hold of the object."""
    plan: Plan | None = None
    """The way to the shelf."""
    release: Pose | None = None
    """Of the hand when it let go on the shelf."""
    failure: str = ""
    """Why the task was given up."""
    attempts: int = 1
    """Times it was begun with."""
    recoveries: list[Recovery] = field(default_factory=list)
    span: tuple[float, float] = (0.0, 0.0)
    """When it was begun with and when it was over [s]."""

    @property
    def delivered(self) -> bool:
        """Whether the hand let go of the object at its shelf, as the robot sees it."""
        return self.release is not None and not self.failure

    @property
    def goal_error(self) -> tuple[float, float]:
        """Of the hand when it let go [m, rad].

        Raises:
            ValueError: If it never came to that.
        """
        if self.release is None:
            raise ValueError(f"{self.item.name!r} never came to its shelf: {self.failure}")
        goal = self.goal if self.plan is None else self.plan.goal
        twist = self.release.twist_to(goal)
        return float(twist[:3].norm()), float(twist[3:].norm())
