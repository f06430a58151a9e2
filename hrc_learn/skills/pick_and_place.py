"""Pick and place beside a person: grasp, carry to the cabinet, put on a shelf.

    detect -> servo -> interact -> grasp -> home -> transfer -> release -> retreat -> over
      ^         |                    |       |         |
      +---------+--- start over -----+-------+---------+-- put back -> over

In the paper's words: detect and servo are the approach and the vision-based control, interact
is what the person needs, home to release is the placing, retreat the way back. Each phase is a
method that does its work and names the next one. Failures are recovered from, logged and
counted:

- the end effector's marker is occluded: the controller holds the end effector and continues
  when the marker is detected again; after a timeout the arm goes home and starts over;
- the object is not detected: it is waited for;
- a missed grasp, an object dropped over the table: again, from home;
- a blocked path: another height, via point or arm angle, then waiting; at last the object is
  put back where it was.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

from hrc_learn.geometry import Pose
from hrc_learn.skills.failures import BlockedPathError, MissedGraspError, TaskFailedError
from hrc_learn.skills.grasping import (
    DESCENT_SPEED,
    OPEN,
    Grasping,
    GraspingConfig,
    holds,
    joint_plan,
    move_fingers,
    raised,
)
from hrc_learn.skills.marker_sensor import longest_occlusion
from hrc_learn.skills.path_following import follow_path
from hrc_learn.skills.placing import PlacingSkill, Plan, PlanningSpace, plan_candidates
from hrc_learn.skills.receiving import Receipt, Receiving
from hrc_learn.skills.visual_servoing import ServoTarget
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.skills.workplace import GraspObject, Workplace

Mishap = Literal[
    "object not detected", "marker occluded", "missed grasp", "dropped object", "blocked path"
]
"""What a job recovers from."""


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Something went wrong, and the job went on."""

    time: float
    """[s]"""
    mishap: Mishap
    what: str
    """What happened, and what was done about it."""


@dataclass(kw_only=True)
class PickPlaceJob:
    """One object's way from the table to its shelf: what phases hand on, and the result."""

    item: GraspObject
    shelf: str
    goal: Pose
    """Of the end effector at the release, if the object is held in the middle."""
    time_for_person: float = 0.0
    """How long to keep servoing while a person reaches under the arm [s]."""
    target: ServoTarget | None = None
    """Where the object was detected last."""
    servo_time: float = float("nan")
    """From the start of the last visual servoing until its target was reached [s]."""
    pixel_error: float = float("nan")
    """At the start of the descent [px]."""
    picked_up: Pose | None = None
    """Of the end effector when it grasped the object."""
    plan: Plan | None = None
    """The path to the shelf."""
    release: Pose | None = None
    """Of the end effector when it released the object on the shelf."""
    failure: str = ""
    """Why the job was given up."""
    attempts: int = 1
    """Times it was started."""
    recoveries: list[Recovery] = field(default_factory=list)
    receipt: Receipt | None = None
    """How a person handed the object over; None: it lay on the table."""
    span: tuple[float, float] = (0.0, 0.0)
    """Start and end [s]."""

    @property
    def delivered(self) -> bool:
        """Whether the object was released at its shelf, as the robot sees it."""
        return self.release is not None and not self.failure


class Phase(StrEnum):
    """What the robot is doing; the start of a phase is an event of the log."""

    DETECT = "detect"
    RECEIVE = "receive"
    SERVO = "servo"
    INTERACT = "interact"
    GRASP = "grasp"
    HOME = "home"
    TRANSFER = "transfer"
    RELEASE = "release"
    RETREAT = "retreat"
    PUT_BACK = "put back"
    OVER = "over"


RECEIVE, INTERACT, HOME = Phase.RECEIVE, Phase.INTERACT, Phase.HOME
TRANSFER, RELEASE = Phase.TRANSFER, Phase.RELEASE
"""Phases that others look up in the log."""

# Delays and occlusions up to this are no recovery [s]: a few lost images, or a blink.
_NEGLIGIBLE = 0.3
RELEASE_TIME = 0.8
"""For the fingers to open and for the released object to come to rest, at least [s]."""
# Straight way back along the end effector's own axis, until nothing of the object is between
# the fingers [m]; and its speed: at the usual one the shoulder comes near its limits [m/s].
_CLEARANCE, _RETREAT_SPEED = 0.08, 0.08


@dataclass(frozen=True, kw_only=True)
class PickAndPlaceConfig:
    """How the jobs are done."""

    grasping: GraspingConfig = field(default_factory=GraspingConfig)
    """How objects are grasped."""
    interaction: float = 11.0
    """How long the robot keeps servoing while the person reaches under its arm [s]."""
    interactions: int = 1
    """For how many objects, the first ones, the person is given that time."""
    speed: float = 1.5
    """How many times faster than demonstrated the object is carried to the shelf."""
    planning: PlanningSpace = "pose"
    """Space in which the path to the shelf is planned; "joint" is the paper's, which bends the
    path into shelves that were not demonstrated."""
    waits: int = 3
    """How often to wait for a blocked path to become free."""
    wait: float = 2.0
    """How long each time [s]."""


def place_along(cell: WorkCell, plan: Plan, goal: Pose, lowering: float) -> float:
    """Carry what is in the hand along a plan, put it down and back out.

    Args:
        cell: Arm, gripper and person.
        plan: To the goal.
        goal: Of the end effector where it begins to put down, as the arm is to read it.
        lowering: How far to go down if nothing is met [m].

    Returns:
        When it began to put down [s].
    """
    cell.begin_phase(Phase.TRANSFER)
    follow_path(cell, plan.path)
    # The arm follows late: at the end of the path it is not quite there.
    cell.move_straight(goal)
    cell.begin_phase(Phase.RELEASE)
    begun = cell.time
    _put_down(cell, goal, lowering)
    cell.begin_phase(Phase.RETREAT)
    clear = goal.apply(goal.position.new_tensor([0.0, 0.0, -_CLEARANCE]))
    cell.move_straight(Pose(clear, goal.orientation), speed=_RETREAT_SPEED)
    return begun


def _put_down(cell: WorkCell, goal: Pose, lowering: float) -> Pose:
    """Lower what is in the hand until it stands, and let go; where that was."""
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
        jobs: One for each object so far.
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
        """Prepare.

        Args:
            cell: Arm, gripper, camera and person.
            workplace: The region over the table, home, and the shelves.
            servoing: Learned image Jacobian and visual target.
            placing: Learned placing motion.
            check: Raises if a plan must not be executed.
            config: How the jobs are done.
            receiving: How objects are taken from a person's hand, by their names; the others
                lie on the table.
        """
        self._receiving = dict(receiving or {})
        self.jobs: list[PickPlaceJob] = []
        self._cell = cell
        self._workplace = workplace
        self._placing = placing
        self._check = check
        self._config = config = config or PickAndPlaceConfig()
        self._grasping = Grasping(cell, workplace, servoing, config.grasping, check=check)
        self._work: dict[Phase, Callable[[PickPlaceJob], Phase]] = {
            Phase.DETECT: self._detect,
            Phase.RECEIVE: self._receive,
            Phase.SERVO: self._servo,
            Phase.INTERACT: self._interact,
            Phase.GRASP: self._grasp,
            Phase.HOME: self._home,
            Phase.TRANSFER: self._transfer,
            Phase.RELEASE: self._release,
            Phase.RETREAT: self._retreat,
            Phase.PUT_BACK: self._put_back,
        }

    def run(
        self,
        orders: Sequence[tuple[GraspObject, str]],
        before: Callable[[int], None] = lambda number: None,
    ) -> list[PickPlaceJob]:
        """Deliver objects one after the other.

        An object that cannot be delivered is left on the table, and the next one is started.
        Only where the arm cannot go home, everything ends.

        Args:
            orders: What to grasp, and the shelf to put it on.
            before: Called with the number of each object, from 0, before it is started.

        Raises:
            ValueError: If there is no such shelf, or the arm cannot reach it.
        """
        # All goals are checked before anything moves.
        for number, job in enumerate([self._new_job(*order) for order in orders]):
            before(number)
            self.jobs.append(job)
            if number < self._config.interactions:
                job.time_for_person = self._config.interaction
            try:
                self._deliver(job)
            except TaskFailedError as error:
                job.failure = str(error)
                break
        self._cell.begin_phase("done")
        return self.jobs

    def _new_job(self, item: GraspObject, shelf: str) -> PickPlaceJob:
        goal = self._workplace.shelf(shelf, item.half_size)
        self._placing.robot.inverse(goal, near=self._placing.joint.goal)
        return PickPlaceJob(item=item, shelf=shelf, goal=goal)

    def _deliver(self, job: PickPlaceJob) -> None:
        start = self._cell.time
        self._cell.gripper.move(OPEN)
        phase = Phase.RECEIVE if job.item.name in self._receiving else Phase.DETECT
        try:
            while phase is not Phase.OVER:
                phase = self._work[phase](job)
        finally:
            job.span = start, self._cell.time

    def _receive(self, job: PickPlaceJob) -> Phase:
        """Take the object from a person's hand, wherever they hand it over."""
        receiving, robot = self._receiving[job.item.name], self._workplace.robot
        job.receipt = receiving.receipt
        posture = robot.inverse(receiving.wait, near=self._workplace.hover_joints())
        plan = joint_plan(self._cell, self._cell.joints, posture)
        self._check(plan)
        follow_path(self._cell, plan.path)
        self._cell.begin_phase(Phase.RECEIVE)
        try:
            receiving.receive(job.item)
        except MissedGraspError as error:
            job.failure = str(error)
            self._grasping.start_over()
            return Phase.OVER
        receiving.wait_until_away()
        job.picked_up = self._cell.pose
        return Phase.HOME

    def _detect(self, job: PickPlaceJob) -> Phase:
        start = self._cell.time
        try:
            job.target = self._grasping.locate(job.item)
        except TaskFailedError as error:
            job.failure = str(error)
            return Phase.OVER
        waited = self._cell.time - start
        if waited > _NEGLIGIBLE:
            self._note(job, "object not detected", f"waited {waited:.1f} s for its marker")
        return Phase.SERVO

    def _servo(self, job: PickPlaceJob) -> Phase:
        assert job.target is not None
        start = self._cell.time
        try:
            job.servo_time = self._grasping.servo_to(job.target)
        except MissedGraspError as error:
            return self._start_over(job, "marker occluded", str(error))
        occluded = longest_occlusion(
            self._cell.log, self._workplace.hover(), start, self._cell.chain
        )
        if occluded > _NEGLIGIBLE:
            self._note(job, "marker occluded", f"held the end effector for {occluded:.1f} s")
        return Phase.INTERACT if job.time_for_person > 0 else Phase.GRASP

    def _interact(self, job: PickPlaceJob) -> Phase:
        """Keep servoing while the person reaches under the arm."""
        assert job.target is not None
        self._cell.begin_phase(Phase.INTERACT)
        servo = self._grasping.servo
        servo.hold(job.target, job.time_for_person)
        job.time_for_person = 0.0
        # The person's push may leave twice the tolerance; beyond that the target is lost.
        on_target = servo.error(job.target) < 2 * self._config.grasping.servo.tolerance
        job.target = replace(job.target, posture=None)
        return Phase.GRASP if on_target else Phase.SERVO

    def _grasp(self, job: PickPlaceJob) -> Phase:
        assert job.target is not None
        job.pixel_error = self._grasping.servo.error(job.target)
        try:
            self._grasping.close_on(job.item)
        except MissedGraspError as error:
            return self._start_over(job, "missed grasp", str(error))
        job.picked_up = self._cell.pose
        self._grasping.lift()
        return Phase.HOME

    def _home(self, job: PickPlaceJob) -> Phase:
        if not holds(self._cell, job.item):
            return self._start_over(job, "dropped object", "lost on the way up")
        for _ in range(1 + self._config.waits):
            try:
                self._grasping.go_home()
            except BlockedPathError as error:
                self._note(job, "blocked path", f"waited: {error}")
                self._cell.hold_pose(self._config.wait)
            else:
                return Phase.TRANSFER
        job.failure = "home: the path stayed blocked"
        return Phase.PUT_BACK

    def _transfer(self, job: PickPlaceJob) -> Phase:
        """Carry to the shelf along the learned motion."""
        if not holds(self._cell, job.item):
            return self._start_over(job, "dropped object", "lost on the way home")
        self._cell.begin_phase(Phase.TRANSFER)
        plan = self._free_plan(job)
        if plan is None:
            job.failure = f"transfer: all paths to the {job.shelf} shelf stayed blocked"
            return Phase.PUT_BACK
        job.plan = plan
        tracked = follow_path(
            self._cell, plan.path, until=lambda: not holds(self._cell, job.item)
        )
        if tracked < len(plan.path):
            follow_path(self._cell, plan.path[:tracked][::-1])
            return self._start_over(job, "dropped object", "lost on the way to the shelf")
        self._cell.move_straight(plan.goal)
        return Phase.RELEASE

    def _free_plan(self, job: PickPlaceJob) -> Plan | None:
        """The first candidate that is free, now or after a while."""
        for wait in range(1 + self._config.waits):
            if wait:
                self._cell.hold_pose(self._config.wait)
            candidates = plan_candidates(
                job.goal,
                self._cell.joints,
                self._placing,
                self._workplace,
                space=self._config.planning,
                dt=self._cell.config.dt,
                speed=self._config.speed,
            )
            for candidate in candidates:
                try:
                    self._check(candidate.plan)
                except BlockedPathError as error:
                    if candidate.name == "as learned":
                        self._note(job, "blocked path", str(error))
                else:
                    return candidate.plan
        return None

    def _release(self, job: PickPlaceJob) -> Phase:
        self._cell.begin_phase(Phase.RELEASE)
        lowering = self._workplace.lowering(job.item.half_size)
        job.release = _put_down(self._cell, job.goal, lowering)
        return Phase.RETREAT

    def _retreat(self, job: PickPlaceJob) -> Phase:
        """Back out along the same path: what was free then is free now."""
        assert job.plan is not None
        self._cell.begin_phase(Phase.RETREAT)
        follow_path(self._cell, job.plan.path[::-1])
        return Phase.OVER

    def _put_back(self, job: PickPlaceJob) -> Phase:
        """Lay the object where it was, and go home."""
        assert job.picked_up is not None
        if job.receipt is not None:
            return Phase.OVER  # it was in a hand: the arm keeps it
        self._cell.begin_phase(Phase.PUT_BACK)
        plan = joint_plan(self._cell, self._cell.joints, self._workplace.hover_joints())
        self._check(plan)
        follow_path(self._cell, plan.path)
        self._cell.move_straight(raised(job.picked_up, self._config.grasping.lift))
        self._cell.move_straight(job.picked_up, speed=DESCENT_SPEED)
        self._grasping.start_over()
        return Phase.OVER

    def _start_over(self, job: PickPlaceJob, mishap: Mishap, what: str) -> Phase:
        """From home, unless it has been tried often enough."""
        self._note(job, mishap, what)
        self._grasping.start_over()
        if job.receipt is not None:
            job.failure = what  # what a person has given lies nobody knows where
            return Phase.OVER
        if job.attempts == self._config.grasping.attempts:
            job.failure = what
            return Phase.OVER
        job.attempts += 1
        return Phase.DETECT

    def _note(self, job: PickPlaceJob, mishap: Mishap, what: str) -> None:
        job.recoveries.append(Recovery(time=self._cell.time, mishap=mishap, what=what))
