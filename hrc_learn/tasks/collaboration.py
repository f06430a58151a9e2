"""The whole job: grasp beside a person, carry to the cabinet, put on a shelf.

    look -> aim -> interact -> grasp -> lift -> home -> transfer -> release -> retreat

`run` reads like this list. A missed grasp goes back to looking.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from ..geometry import Pose
from ..sim import ObjectConfig
from .aiming import Aim
from .fit_aiming import AimingSkill
from .grasping import OPEN, Grasping, GraspingConfig, GraspResult
from .placing import PlacingSkill, Plan, PlanningSpace
from .station import Station
from .workplace import Workplace, nearest_configuration

INTERACT, TRANSFER, RELEASE = "interact", "transfer", "release"
"""Phases that others look for in the log."""


@dataclass(frozen=True, kw_only=True)
class CollaborationConfig:
    """How the job is done."""

    grasping: GraspingConfig = field(default_factory=GraspingConfig)
    """How objects are grasped."""
    interaction: float = 11.0
    """How long the robot goes on aiming while the person reaches under its arm [s]."""
    speed: float = 1.5
    """How many times faster than demonstrated the object is carried to the shelf."""
    planning: PlanningSpace = "pose"
    """Space in which the way to the shelf is planned; "joint" is the paper's, which bends the
    way into shelves that were not demonstrated."""


@dataclass(frozen=True, kw_only=True)
class CollaborationResult:
    """What happened, as the robot's own sensors tell it."""

    grasp: GraspResult
    plan: Plan
    """The way to the shelf."""
    release: Pose
    """Pose of the hand when it let go."""

    @property
    def goal_error(self) -> tuple[float, float]:
        """Of the hand when it let go [m, rad]."""
        twist = self.release.twist_to(self.plan.goal)
        return float(twist[:3].norm()), float(twist[3:].norm())


class Collaboration:
    """Grasps objects and puts them on shelves."""

    def __init__(
        self,
        station: Station,
        workplace: Workplace,
        aiming: AimingSkill,
        placing: PlacingSkill,
        check: Callable[[Plan], None] = lambda plan: None,
        config: CollaborationConfig | None = None,
    ):
        """Bring station and skills together.

        Args:
            station: Arm, gripper, camera and person.
            workplace: Where things are, roughly: the region over the table, home, the shelves.
            aiming: Learned image Jacobian and visual target.
            placing: Learned placing motion.
            check: Raises if a plan may not be carried out.
            config: How the job is done.
        """
        self._station = station
        self._workplace = workplace
        self._placing = placing
        self._check = check
        self._config = config = config or CollaborationConfig()
        self._grasping = Grasping(station, workplace, aiming, config.grasping, check=check)

    def run(self, item: ObjectConfig, shelf: str) -> CollaborationResult:
        """Do the whole job for one object.

        Args:
            item: What to grasp.
            shelf: Where to put it.

        Raises:
            ValueError: If there is no such shelf, or the arm cannot reach it.
            TaskFailedError: If the object is not found, not reached or not grasped.
            BlockedPathError: If a planned way is not free.
        """
        goal = self._workplace.shelf(shelf, item)
        nearest_configuration(goal, near=self._placing.joint.goal)  # before anything moves
        grasp = self._grasping.grasp(item, on_aimed=self._interact)
        self._grasping.go_home()
        plan, release = self._transfer(goal)
        self._retreat(plan)
        return CollaborationResult(grasp=grasp, plan=plan, release=release)

    def _interact(self, aim: Aim) -> None:
        self._station.enter(INTERACT)
        self._grasping.aimer.hold(aim, self._config.interaction)

    def _transfer(self, goal: Pose) -> tuple[Plan, Pose]:
        """Carry to the shelf along the learned motion; the plan, and where the hand let go."""
        self._station.enter(TRANSFER)
        plan = self._placing.plan(
            self._station.joints,
            goal,
            space=self._config.planning,
            dt=self._station.config.dt,
            speed=self._config.speed,
        )
        self._check(plan)
        self._station.play(plan.path)
        self._station.move_straight(goal)
        self._station.enter(RELEASE)
        release = self._station.pose
        self._station.gripper.move(OPEN)
        self._station.stay(0.8)
        return plan, release

    def _retreat(self, plan: Plan) -> None:
        """Back out the way the hand went in: what was free then is free now."""
        self._station.enter("retreat")
        self._station.play(plan.path[::-1])
        self._station.enter("done")
