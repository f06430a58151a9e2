"""The whole job: grasp beside a person, carry to the cabinet, put on a shelf.

    look -> aim -> interact -> grasp -> lift -> home -> transfer -> release -> retreat

`run` reads like this list. A missed grasp goes back to looking.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from ..controller import AdaptiveController, ControllerConfig, Goals
from ..geometry import Pose
from ..jacobian import KalmanEstimator
from ..sim import HAND_MARKER, ObjectConfig
from .aiming import Aimer, AimingConfig
from .failure import TaskFailedError
from .fit_aiming import AimingSkill
from .motion import joint_line
from .placing import PlacingSkill, Plan, PlanningSpace
from .station import Station
from .workplace import Workplace, nearest_configuration

OPEN, CLOSED = 0.08, 0.0
"""Widths the gripper is told to take [m]."""

INTERACT, TRANSFER, RELEASE = "interact", "transfer", "release"
"""Phases that others look for in the log."""


@dataclass(frozen=True, kw_only=True)
class CollaborationConfig:
    """How the job is done."""

    aiming: AimingConfig = field(default_factory=AimingConfig)
    controller: ControllerConfig = field(
        default_factory=lambda: ControllerConfig(hold_rate=10.0)
    )
    """Settings of the adaptive controller; it holds the hand firmly against the drift that
    steps of 10 ms leave."""
    interaction: float = 11.0
    """How long the robot goes on aiming while the person reaches under its arm [s]."""
    lift: float = 0.20
    """How far an object is lifted before it is carried off [m]."""
    speed: float = 1.5
    """How many times faster than demonstrated the object is carried to the shelf."""
    planning: PlanningSpace = "pose"
    """Space in which the way to the shelf is planned; "joint" is the paper's, which bends the
    way into shelves that were not demonstrated."""
    attempts: int = 3
    """Grasps tried."""


@dataclass(frozen=True, kw_only=True)
class GraspResult:
    """How an object was grasped."""

    aim_time: float
    """From the start of aiming until the target was reached [s]."""
    pixel_error: float
    """When the hand went down [px]."""
    attempts: int
    """Grasps tried."""


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
        self._aiming = aiming
        self._placing = placing
        self._check = check
        self._config = config = config or CollaborationConfig()
        estimator = KalmanEstimator(aiming.jacobian.double())
        goals = config.aiming.goals(workplace.hover(), None)
        controller = AdaptiveController(
            station.chain, estimator, goals, config=config.controller
        )
        self._aimer = Aimer(station, controller, HAND_MARKER, config.aiming)

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
        grasp = self._grasp(item)
        self._go_home()
        plan, release = self._transfer(goal)
        self._retreat(plan)
        return CollaborationResult(grasp=grasp, plan=plan, release=release)

    def _grasp(self, item: ObjectConfig) -> GraspResult:
        self._station.gripper.move(OPEN)
        for attempt in range(1, self._config.attempts + 1):
            goals = self._goals_above(item)
            aim_time = self._aim(goals)
            if attempt == 1:
                self._interact(goals)
            pixel_error = self._aimer.error(goals)
            if self._close_on(item):
                return GraspResult(
                    aim_time=aim_time,
                    pixel_error=pixel_error,
                    attempts=attempt,
                )
            self._rise()
            self._go_home()
        raise TaskFailedError(
            f"grasp: {self._config.attempts} times the fingers closed on nothing. Is the "
            "object where its marker says?"
        )

    def _goals_above(self, item: ObjectConfig) -> Goals:
        target = self._look_for(item)
        try:
            goals = self._config.aiming.goals(self._workplace.hover(), target)
        except ValueError as error:
            raise TaskFailedError(
                f"look: {item.name!r} lies where the camera would not see the hand above it: "
                "put it nearer to the middle of the image."
            ) from error
        return goals.approached_by(self._workplace.hover_joints())

    def _look_for(self, item: ObjectConfig) -> Float[np.ndarray, "2"]:
        """Pixel to aim at, from a look at the table before the arm is over it."""
        self._station.enter("look")
        pixel = self._station.look().pixels.get(item.marker.id)
        if pixel is None:
            raise TaskFailedError(
                f"look: the camera does not see marker {item.marker.id} of {item.name!r}. Put "
                "it into the camera's view, and the arm out of it."
            )
        return self._aiming.target_of(pixel)

    def _aim(self, goals: Goals) -> float:
        self._station.enter("aim")
        self._station.watching = True
        return self._aimer.aim(goals)

    def _interact(self, goals: Goals) -> None:
        self._station.enter(INTERACT)
        self._aimer.hold(goals, self._config.interaction)

    def _close_on(self, item: ObjectConfig) -> bool:
        """Go down, close the fingers; whether there is something between them."""
        self._station.enter("grasp")
        self._station.watching = False
        hover = self._workplace.hover()
        position = self._station.pose.position.clone()
        position[2] = item.half_size[2]
        self._station.move_straight(Pose(position, hover.orientation), speed=0.08)
        self._station.gripper.move(CLOSED)
        self._station.stay(0.7)
        grasped = self._station.state.gripper_width > item.half_size[0]
        if grasped:
            self._rise()
        else:
            self._station.gripper.move(OPEN)
        return grasped

    def _rise(self) -> None:
        self._station.enter("lift")
        pose = self._station.pose
        up = torch.tensor([0.0, 0.0, self._config.lift], dtype=torch.float64)
        self._station.move_straight(Pose(pose.position + up, pose.orientation))

    def _go_home(self) -> None:
        self._station.enter("home")
        home = self._workplace.home_joints()
        dt = self._station.config.dt
        path = joint_line(self._station.joints, home, speed=0.6, dt=dt)
        plan = Plan(goal=self._workplace.home(), dt=dt, path=path.numpy())
        self._check(plan)
        self._station.play(plan.path)

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
