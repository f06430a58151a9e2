"""Pick and place near a person: grasp, carry to the cabinet, put on a shelf.

    pick -> home -> transfer -> release -> retreat -> over
      ^      |         |
      +------+---------+-- put back -> over

Phase "pick" is `Grasping.grasp`, or a hand-over by a person; the phases from "home" to
"release" place the object. Each phase is a method that does its work and returns the next
phase. In addition to the recoveries of grasping, these recoveries are noted in the job:

- dropped object: the arm starts over from home, up to a number of attempts;
- blocked path: the arm tries another height, via point or arm angle, then waits; finally it
  puts the object back.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.skills.grasping import (
    DESCENT_SPEED,
    OPEN,
    Grasping,
    GraspingConfig,
    GraspJob,
    UndetectedObjectError,
    holds,
    move_fingers,
    raised,
)
from hrc_learn.skills.placing import GraspObject, PlacingSkill, Plan, Workplace, plan_candidates
from hrc_learn.skills.receiving import Receipt, Receiving
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import (
    BlockedPathError,
    MissedGraspError,
    TaskFailedError,
    WorkCell,
)

RECEIVE, HOME, TRANSFER, RELEASE = "receive", "home", "transfer", "release"
"""Names of phases that other modules look up in the log."""
RELEASE_TIME = 0.8
"""Shortest time for the fingers to open and the released object to come to rest [s]."""
# `_CLEARANCE`: length of the straight retreat, along the end effector's z axis, that frees the
# fingers [m]. `_RETREAT_SPEED`: speed of the retreat [m/s]; at the usual speed, the shoulder
# comes near its limits.
_CLEARANCE, _RETREAT_SPEED = 0.08, 0.08


@dataclass(kw_only=True)
class PickPlaceJob(GraspJob):
    """Job of one object from the table to its shelf, with its results."""

    shelf: str
    """Name of the object's shelf."""
    goal: Pose
    """Pose of the end effector at the release, if the object is held in the middle."""
    plan: Plan | None = None
    """Path to the shelf."""
    release: Pose | None = None
    """Pose of the end effector at the release on the shelf."""
    failure: str = ""
    """Reason why the job was given up."""
    receipt: Receipt | None = None
    """Hand-over of the object by a person; None: the object lay on the table."""
    span: tuple[float, float] = (0.0, 0.0)
    """Start and end of the job [s]."""


type Phase = Callable[[PickPlaceJob], Phase | None]
"""Phase of a job; it returns the next phase, or None if the job is over."""


@dataclass(frozen=True, kw_only=True)
class PickAndPlaceConfig:
    """Settings of the jobs."""

    grasping: GraspingConfig = field(default_factory=GraspingConfig)
    """Settings of grasping."""
    interaction: float = 11.0
    """Time for which the robot keeps servoing while a person pulls its elbow [s]."""
    interactions: int = 1
    """Number of objects, counted from the first, at which a person may pull the elbow."""
    speed: float = 1.5
    """Speed of the transfer relative to the demonstration."""
    waits: int = 3
    """Number of waits for a blocked path to become free."""
    wait: float = 2.0
    """Duration of each wait [s]."""

    def __post_init__(self) -> None:
        not_negative = "interaction", "interactions", "waits"
        check_settings(self, positive=("speed", "wait"), not_negative=not_negative)


def place_along(cell: WorkCell, plan: Plan, goal: Pose, lowering: float, size: float) -> float:
    """Carry the grasped object along a plan, put it down and retreat.

    Args:
        cell: Arm, gripper and person.
        plan: Plan to the goal.
        goal: Pose of the end effector from which the object is lowered, as measured by the arm.
        lowering: Largest distance to lower the object, if there is no contact [m].
        size: Size of the hand relative to the Franka hand, to which the retreat is scaled.

    Returns:
        Time at which the lowering began [s].
    """
    cell.begin_phase(TRANSFER)
    cell.follow_path(plan.path)
    # The arm lags behind: at the end of the path, it has not quite reached the goal.
    cell.move_straight(goal)
    cell.begin_phase(RELEASE)
    begun = cell.time
    _put_down(cell, goal, lowering)
    cell.begin_phase("retreat")
    clear = goal.apply(goal.position.new_tensor([0.0, 0.0, -size * _CLEARANCE]))
    cell.move_straight(Pose(clear, goal.orientation), speed=_RETREAT_SPEED)
    return begun


def _put_down(cell: WorkCell, goal: Pose, lowering: float) -> Pose:
    """Lower the grasped object until it stands, and release it.

    Args:
        cell: Arm, gripper and person.
        goal: Pose of the end effector from which the object is lowered.
        lowering: Largest distance to lower the object, if there is no contact [m].

    Returns:
        Pose of the end effector at the release.
    """
    below = Pose(goal.position.clone(), goal.orientation)
    below.position[2] -= lowering
    cell.move_until_contact(below)
    released = cell.pose
    cell.load = None
    move_fingers(cell, OPEN, RELEASE_TIME)
    return released


class PickAndPlace:
    """Grasps objects and puts them on shelves.

    Attributes:
        jobs: Jobs so far, one for each object.
    """

    def __init__(
        self,
        cell: WorkCell,
        workplace: Workplace,
        servoing: VisualServoSkill,
        placing: PlacingSkill,
        check: Callable[[Plan], None] = lambda plan: None,
        config: PickAndPlaceConfig | None = None,
        receiving: Mapping[str, Receiving] | None = None,
    ):
        """Prepare the jobs.

        Args:
            cell: Arm, gripper, camera and person.
            workplace: Region above the table, home, and the shelves.
            servoing: Learned image Jacobian and visual target.
            placing: Learned placing motion.
            check: Function that raises if a plan must not be executed.
            config: Settings of the jobs.
            receiving: Skills for objects that a person hands over, by object name; the other
                objects lie on the table.
        """
        self._receiving = dict(receiving or {})
        self.jobs: list[PickPlaceJob] = []
        self._cell = cell
        self._workplace = workplace
        self._placing = placing
        self._check = check
        self._config = config = config or PickAndPlaceConfig()
        self._grasping = Grasping(cell, workplace, servoing, config.grasping, check=check)

    def run(
        self,
        orders: Sequence[tuple[GraspObject, str]],
        before: Callable[[int], None] = lambda number: None,
    ) -> list[PickPlaceJob]:
        """Deliver objects one after the other.

        If an object cannot be delivered, the next one is started. The run ends early if a job
        fails with an error, for example because the arm cannot go home or a person stops it.

        Args:
            orders: Objects, each with the name of its shelf.
            before: Function called before each object with the number of the object, from 0.

        Raises:
            ValueError: There is no such shelf, or the arm cannot reach it.
        """
        # All goals are checked before the arm moves.
        for number, job in enumerate([self._new_job(*order) for order in orders]):
            before(number)
            self.jobs.append(job)
            if number < self._config.interactions:
                job.time_for_person = self._config.interaction
            try:
                self._deliver(job)
            except TaskFailedError as error:
                job.failure = f"{job.failure}; then {error}" if job.failure else str(error)
                break
        self._cell.begin_phase("done")
        return self.jobs

    def _new_job(self, item: GraspObject, shelf: str) -> PickPlaceJob:
        goal = self._workplace.shelf(shelf, item.half_size)
        self._placing.robot.inverse(goal, near=self._placing.joint.goal)
        return PickPlaceJob(item=item, shelf=shelf, goal=goal)

    def _deliver(self, job: PickPlaceJob) -> None:
        start = self._cell.time
        received = job.item.name in self._receiving
        phase: Phase | None = self._receive if received else self._pick
        try:
            while phase is not None:
                phase = phase(job)
        finally:
            job.span = start, self._cell.time

    def _receive(self, job: PickPlaceJob) -> Phase | None:
        """Take the object from a person's hand."""
        receiving, robot = self._receiving[job.item.name], self._workplace.robot
        self._cell.gripper.move(OPEN)
        posture = robot.inverse(receiving.wait, near=self._workplace.hover_joints())
        self._grasping.move_joints(posture)
        self._cell.begin_phase(RECEIVE)
        try:
            receiving.receive(job.item)
        except MissedGraspError as error:
            job.failure = str(error)
            self._grasping.start_over()
            return None
        finally:
            job.receipt = receiving.receipt
        receiving.wait_until_away()
        job.picked_up = self._cell.pose
        return self._home

    def _pick(self, job: PickPlaceJob) -> Phase | None:
        """Grasp the object and lift it."""
        try:
            self._grasping.grasp(job)
        except (UndetectedObjectError, MissedGraspError) as error:
            job.failure = str(error)
            if isinstance(error, MissedGraspError):
                self._grasping.start_over()
            return None
        return self._home

    def _home(self, job: PickPlaceJob) -> Phase | None:
        if not holds(self._cell, job.item):
            return self._dropped(job, "lost on the way up")
        for _ in range(1 + self._config.waits):
            try:
                self._grasping.go_home()
            except BlockedPathError as error:
                self._grasping.note(job, "blocked path", f"waited: {error}")
                self._cell.hold_pose(self._config.wait)
            else:
                return self._transfer
        job.failure = "home: the path stayed blocked"
        return self._put_back

    def _transfer(self, job: PickPlaceJob) -> Phase | None:
        """Carry to the shelf along the learned motion."""
        if not holds(self._cell, job.item):
            return self._dropped(job, "lost on the way home")
        self._cell.begin_phase(TRANSFER)
        plan = self._free_plan(job)
        if plan is None:
            job.failure = f"transfer: all paths to the {job.shelf} shelf stayed blocked"
            return self._put_back
        job.plan = plan
        tracked = self._cell.follow_path(
            plan.path, until=lambda: not holds(self._cell, job.item)
        )
        if tracked < len(plan.path):
            self._cell.follow_path(plan.path[:tracked][::-1])
            return self._dropped(job, "lost on the way to the shelf")
        self._cell.move_straight(plan.goal)
        return self._release

    def _free_plan(self, job: PickPlaceJob) -> Plan | None:
        """The first candidate with a free path, now or after a wait."""
        for wait in range(1 + self._config.waits):
            if wait:
                self._cell.hold_pose(self._config.wait)
            candidates = plan_candidates(
                job.goal,
                self._cell.joints,
                self._placing,
                self._workplace,
                dt=self._cell.config.dt,
                speed=self._config.speed,
            )
            for number, plan in enumerate(candidates):
                try:
                    self._check(plan)
                except BlockedPathError as error:
                    if number == 0:  # the learned plan
                        self._grasping.note(job, "blocked path", str(error))
                else:
                    return plan
        return None

    def _release(self, job: PickPlaceJob) -> Phase | None:
        self._cell.begin_phase(RELEASE)
        lowering = self._workplace.lowering(job.item.half_size)
        job.release = _put_down(self._cell, job.goal, lowering)
        return self._retreat

    def _retreat(self, job: PickPlaceJob) -> Phase | None:
        """Retreat along the path of the transfer, which was free before."""
        assert job.plan is not None
        self._cell.begin_phase("retreat")
        self._cell.follow_path(job.plan.path[::-1])
        return None

    def _put_back(self, job: PickPlaceJob) -> Phase | None:
        """Put the object back where it was picked up, and go home."""
        assert job.picked_up is not None
        if job.receipt is not None:
            return None  # a received object has no place on the table: the arm keeps it
        self._cell.begin_phase("put back")
        self._grasping.move_joints(self._workplace.hover_joints())
        self._cell.move_straight(
            raised(job.picked_up, self._workplace.robot.hand_size * self._config.grasping.lift)
        )
        self._cell.move_straight(job.picked_up, speed=DESCENT_SPEED)
        self._grasping.start_over()
        return None

    def _dropped(self, job: PickPlaceJob, what: str) -> Phase | None:
        """Start over from home, unless the number of attempts is reached."""
        self._grasping.note(job, "dropped object", what)
        # If an object from a person's hand is lost, its position is unknown.
        if job.receipt is not None or job.attempts == self._config.grasping.attempts:
            job.failure = what
        self._grasping.start_over()
        if job.failure:
            return None
        job.attempts += 1
        return self._pick
