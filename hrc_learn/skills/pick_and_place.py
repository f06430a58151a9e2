"""The whole job: grasp beside a person, carry to the cabinet, put on a shelf."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import torch

from hrc_learn.geometry import Pose
from hrc_learn.sim import ObjectConfig
from hrc_learn.sim.workplace import Workplace, nearest_configuration
from hrc_learn.skills.cartesian_motion import joint_line
from hrc_learn.skills.grasping import OPEN, Grasping, GraspingConfig
from hrc_learn.skills.marker_sensor import longest_unseen
from hrc_learn.skills.placing import PlacingSkill, Plan, PlanningSpace, Way, ways_to
from hrc_learn.skills.visual_servoing import Aim, AimingSkill
from hrc_learn.skills.work_cell import (
    BlockedPathError,
    MissedGraspError,
    Station,
    TaskFailedError,
)

# One object on its way from the table to its shelf.

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


# The whole job: grasp beside a person, carry to the cabinet, put on a shelf.
#
#     look -> aim -> interact -> grasp -> home -> transfer -> release -> retreat -> over
#      ^       |                   |       |         |
#      +-------+--- begin again ---+-------+---------+-- put back -> over
#
# In the paper's words: look and aim are the approach and the vision-based control, interact is
# what the person needs, home to release is the placing, retreat the way back. Each phase is a
# method that does its work and names the next one. What goes wrong is recovered from, noted and
# counted:
#
# - the hand's marker is out of sight: the controller holds the hand where it is and goes on
# when
#   it sees it again; if it stays unseen, the arm goes home and looks anew;
# - the object is out of sight: it is waited for;
# - a missed grasp, an object dropped over the table: again, from home;
# - a blocked way: another height, via point or arm angle, then waiting; at last the object is
#   put back where it was.


class Phase(StrEnum):
    """What the robot is about; begun phases are events of the log."""

    LOOK = "look"
    AIM = "aim"
    INTERACT = "interact"
    GRASP = "grasp"
    HOME = "home"
    TRANSFER = "transfer"
    RELEASE = "release"
    RETREAT = "retreat"
    PUT_BACK = "put back"
    OVER = "over"


INTERACT, TRANSFER, RELEASE = Phase.INTERACT, Phase.TRANSFER, Phase.RELEASE
"""Phases that others look for in the log."""

_BLINK = 0.3
"""Longer than this out of sight is worth a note [s]."""


@dataclass(frozen=True, kw_only=True)
class CollaborationConfig:
    """How the job is done."""

    grasping: GraspingConfig = field(default_factory=GraspingConfig)
    """How objects are grasped."""
    interaction: float = 11.0
    """How long the robot goes on aiming while the person reaches under its arm [s]."""
    interactions: int = 1
    """For how many objects, the first ones, the person is given that time."""
    speed: float = 1.5
    """How many times faster than demonstrated the object is carried to the shelf."""
    planning: PlanningSpace = "pose"
    """Space in which the way to the shelf is planned; "joint" is the paper's, which bends the
    way into shelves that were not demonstrated."""
    waits: int = 3
    """How often to wait for a blocked way to become free."""
    wait: float = 2.0
    """How long each time [s]."""


class Collaboration:
    """Grasps objects and puts them on shelves.

    Attributes:
        errands: What became of each object so far.
    """

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
        self.errands: list[Errand] = []
        self._station = station
        self._workplace = workplace
        self._placing = placing
        self._check = check
        self._config = config = config or CollaborationConfig()
        self._grasping = Grasping(station, workplace, aiming, config.grasping, check=check)
        self._work: dict[Phase, Callable[[Errand], Phase]] = {
            Phase.LOOK: self._look,
            Phase.AIM: self._aim,
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
        orders: Sequence[tuple[ObjectConfig, str]],
        before: Callable[[int], None] = lambda number: None,
    ) -> list[Errand]:
        """Do the whole job, object by object.

        An object that cannot be delivered is left on the table, and the next one is begun
        with. Only where the arm cannot go home, the job ends.

        Args:
            orders: What to grasp, and the shelf to put it on.
            before: Told the number of each object, from 0, before it is begun with.

        Raises:
            ValueError: If there is no such shelf, or the arm cannot reach it.
        """
        waiting = [self._errand(*order) for order in orders]  # all, before anything moves
        for number, errand in enumerate(waiting):
            before(number)
            self.errands.append(errand)
            if number < self._config.interactions:
                errand.time_for_person = self._config.interaction
            try:
                self._deliver(errand)
            except TaskFailedError as error:
                errand.failure = str(error)
                break
        self._station.enter("done")
        return self.errands

    def _errand(self, item: ObjectConfig, shelf: str) -> Errand:
        goal = self._workplace.shelf(shelf, item)
        nearest_configuration(goal, near=self._placing.joint.goal)
        return Errand(item=item, shelf=shelf, goal=goal)

    def _deliver(self, errand: Errand) -> None:
        begin = self._station.time
        self._station.gripper.move(OPEN)
        phase = Phase.LOOK
        try:
            while phase is not Phase.OVER:
                phase = self._work[phase](errand)
        finally:
            errand.span = begin, self._station.time

    def _look(self, errand: Errand) -> Phase:
        begin = self._station.time
        try:
            errand.aim = self._grasping.look_for(errand.item)
        except TaskFailedError as error:
            errand.failure = str(error)
            return Phase.OVER
        waited = self._station.time - begin
        if waited > _BLINK:
            self._note(errand, "object out of sight", f"waited {waited:.1f} s for its marker")
        return Phase.AIM

    def _aim(self, errand: Errand) -> Phase:
        assert errand.aim is not None
        begin = self._station.time
        try:
            errand.aim_time = self._grasping.aim(errand.aim)
        except MissedGraspError as error:
            return self._begin_again(errand, "marker out of sight", str(error))
        unseen = longest_unseen(self._station.log, self._workplace.hover(), begin)
        if unseen > _BLINK:
            self._note(errand, "marker out of sight", f"held the hand for {unseen:.1f} s")
        return Phase.INTERACT if errand.time_for_person > 0 else Phase.GRASP

    def _interact(self, errand: Errand) -> Phase:
        assert errand.aim is not None
        self._station.enter(Phase.INTERACT)
        self._grasping.aimer.hold(errand.aim, errand.time_for_person)
        errand.time_for_person = 0.0
        aimed = (
            self._grasping.aimer.error(errand.aim) < 2 * self._config.grasping.aiming.tolerance
        )
        return Phase.GRASP if aimed else Phase.AIM

    def _grasp(self, errand: Errand) -> Phase:
        assert errand.aim is not None
        errand.pixel_error = self._grasping.aimer.error(errand.aim)
        try:
            self._grasping.close_on(errand.item)
        except MissedGraspError as error:
            return self._begin_again(errand, "missed grasp", str(error))
        errand.picked_up = self._station.pose
        self._grasping.rise()
        return Phase.HOME

    def _home(self, errand: Errand) -> Phase:
        if self._dropped(errand.item):
            return self._begin_again(errand, "dropped object", "lost on the way up")
        for _ in range(1 + self._config.waits):
            try:
                self._grasping.go_home()
            except BlockedPathError as error:
                self._note(errand, "blocked way", f"waited: {error}")
                self._station.stay(self._config.wait)
            else:
                return Phase.TRANSFER
        errand.failure = "home: the way stayed blocked"
        return Phase.PUT_BACK

    def _transfer(self, errand: Errand) -> Phase:
        """Carry to the shelf along the learned motion."""
        if self._dropped(errand.item):
            return self._begin_again(errand, "dropped object", "lost on the way home")
        self._station.enter(Phase.TRANSFER)
        way = self._free_way(errand)
        if way is None:
            errand.failure = f"transfer: all ways to the {errand.shelf} shelf stayed blocked"
            return Phase.PUT_BACK
        errand.plan = plan = way.plan
        played = self._station.play(plan.path, until=lambda: self._dropped(errand.item))
        if played < len(plan.path):
            self._station.play(plan.path[:played][::-1])
            return self._begin_again(errand, "dropped object", "lost on the way to the shelf")
        self._station.move_straight(plan.goal)
        return Phase.RELEASE

    def _free_way(self, errand: Errand) -> Way | None:
        """The first way that is free, now or after a while."""
        for wait in range(1 + self._config.waits):
            if wait:
                self._station.stay(self._config.wait)
            for way in self._ways(errand.goal):
                try:
                    self._check(way.plan)
                except BlockedPathError as error:
                    if way.name == "as learned":
                        self._note(errand, "blocked way", str(error))
                else:
                    return way
        return None

    def _ways(self, goal: Pose) -> Iterator[Way]:
        return ways_to(
            goal,
            self._station.joints,
            self._placing,
            self._workplace,
            space=self._config.planning,
            dt=self._station.config.dt,
            speed=self._config.speed,
        )

    def _release(self, errand: Errand) -> Phase:
        self._station.enter(Phase.RELEASE)
        errand.release = self._station.pose
        self._station.gripper.move(OPEN)
        self._station.stay(0.8)
        return Phase.RETREAT

    def _retreat(self, errand: Errand) -> Phase:
        """Back out the way the hand went in: what was free then is free now."""
        assert errand.plan is not None
        self._station.enter(Phase.RETREAT)
        self._station.play(errand.plan.path[::-1])
        return Phase.OVER

    def _put_back(self, errand: Errand) -> Phase:
        """Lay the object where it was, and go home."""
        assert errand.picked_up is not None
        self._station.enter(Phase.PUT_BACK)
        joints, above = self._station.joints, self._workplace.hover_joints()
        path = joint_line(joints, above, speed=0.6, dt=self._station.config.dt)
        plan = Plan(goal=self._workplace.hover(), dt=self._station.config.dt, path=path.numpy())
        self._check(plan)
        self._station.play(plan.path)
        self._station.move_straight(_raised(errand.picked_up, self._config.grasping.lift))
        self._station.move_straight(errand.picked_up, speed=0.08)
        self._grasping.start_over()
        return Phase.OVER

    def _begin_again(self, errand: Errand, mishap: Mishap, what: str) -> Phase:
        """From home, unless it has been tried often enough."""
        self._note(errand, mishap, what)
        self._grasping.start_over()
        if errand.attempts == self._config.grasping.attempts:
            errand.failure = what
            return Phase.OVER
        errand.attempts += 1
        return Phase.LOOK

    def _dropped(self, item: ObjectConfig) -> bool:
        """Whether the fingers have closed further than the object lets them."""
        return self._station.state.gripper_width <= item.half_size[0]

    def _note(self, errand: Errand, mishap: Mishap, what: str) -> None:
        errand.recoveries.append(Recovery(time=self._station.time, mishap=mishap, what=what))


def _raised(pose: Pose, height: float) -> Pose:
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return Pose(pose.position + up, pose.orientation)
