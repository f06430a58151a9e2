"""Grasping an object with an uncalibrated camera, and what to do when that fails.

    look -> aim -> grasp -> lift

An object out of sight is waited for. A grasp that missed, or an aim that did not get there,
is begun anew from home.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from ..controller import AdaptiveController, ControllerConfig, Goals
from ..geometry import Pose
from ..jacobian import ImageJacobianEstimator, KalmanEstimator
from ..sim import HAND_MARKER, ObjectConfig
from .aiming import Aimer, AimingConfig
from .failure import MissedGraspError, TaskFailedError
from .fit_aiming import AimingSkill
from .motion import joint_line
from .placing import Plan
from .station import Station
from .workplace import Workplace

OPEN, CLOSED = 0.08, 0.0
"""Widths the gripper is told to take [m]."""


@dataclass(frozen=True, kw_only=True)
class GraspingConfig:
    """How objects are grasped."""

    aiming: AimingConfig = field(default_factory=AimingConfig)
    controller: ControllerConfig = field(
        default_factory=lambda: ControllerConfig(hold_rate=10.0)
    )
    """Settings of the adaptive controller; it holds the hand firmly against the drift that
    steps of 10 ms leave."""
    patience: float = 5.0
    """How long an object that is not seen is waited for [s]."""
    lift: float = 0.20
    """How far an object is lifted [m]."""
    attempts: int = 3
    """Grasps tried."""


@dataclass(frozen=True, kw_only=True)
class GraspResult:
    """How an object was grasped."""

    aim_time: float
    """From the start of aiming until the target was reached [s]."""
    pixel_error: float
    """When the hand went down [px]."""
    setbacks: tuple[str, ...] = ()
    """Why earlier attempts failed."""

    @property
    def attempts(self) -> int:
        """Grasps tried."""
        return len(self.setbacks) + 1


class Grasping:
    """Grasps objects; `grasp` does it all, the other methods are its steps.

    Attributes:
        aimer: Runs the controller; its estimate of the image Jacobian goes on from grasp to
            grasp.
    """

    def __init__(
        self,
        station: Station,
        workplace: Workplace,
        aiming: AimingSkill,
        config: GraspingConfig | None = None,
        *,
        estimator: ImageJacobianEstimator | None = None,
        check: Callable[[Plan], None] = lambda plan: None,
    ):
        """Bring station and skill together.

        Args:
            station: Arm, gripper, camera and person.
            workplace: Where things are, roughly: the region over the table, home.
            aiming: Learned image Jacobian and visual target.
            config: How objects are grasped.
            estimator: Of the image Jacobian; None: a Kalman filter that starts from the
                learned one.
            check: Raises if a plan may not be carried out.
        """
        self._station = station
        self._workplace = workplace
        self._aiming = aiming
        self._config = config = config or GraspingConfig()
        self._check = check
        controller = AdaptiveController(
            station.chain,
            estimator or KalmanEstimator(aiming.jacobian.double()),
            config.aiming.goals(workplace.hover(), None),
            config=config.controller,
        )
        self.aimer = Aimer(station, controller, HAND_MARKER, config.aiming)

    def grasp(
        self, item: ObjectConfig, on_aimed: Callable[[Goals], None] = lambda goals: None
    ) -> GraspResult:
        """Grasp an object and lift it.

        Args:
            item: What to grasp.
            on_aimed: What else is to be done once the hand stands above the object for the
                first time.

        Raises:
            TaskFailedError: If the object is not found, or all attempts fail.
        """
        self._station.gripper.move(OPEN)
        setbacks: list[str] = []
        while True:
            goals = self.goals_above(item)
            try:
                aim_time = self.aim(goals)
                if not setbacks:
                    on_aimed(goals)
                pixel_error = self.aimer.error(goals)
                self.close_on(item)
            except MissedGraspError as error:
                setbacks.append(str(error))
                if len(setbacks) == self._config.attempts:
                    raise
                self.start_over()
            else:
                self.rise()
                return GraspResult(
                    aim_time=aim_time, pixel_error=pixel_error, setbacks=tuple(setbacks)
                )

    def goals_above(self, item: ObjectConfig) -> Goals:
        """Goals that bring the hand above an object, from a look at it.

        Raises:
            TaskFailedError: If the object is not seen, or lies where the hand above it would
                not be.
        """
        target = self.look_for(item)
        try:
            goals = self._config.aiming.goals(self._workplace.hover(), target)
        except ValueError as error:
            raise TaskFailedError(
                f"look: {item.name!r} lies where the camera would not see the hand above it: "
                "put it nearer to the middle of the image."
            ) from error
        return goals.approached_by(self._workplace.hover_joints())

    def look_for(self, item: ObjectConfig) -> Float[np.ndarray, "2"]:
        """Pixel to aim at, from a look at the table before the arm is over it.

        Raises:
            TaskFailedError: If the object's marker stays out of sight.
        """
        self._station.enter("look")
        give_up = self._station.time + self._config.patience
        while (pixel := self._station.look().pixels.get(item.marker.id)) is None:
            if self._station.time >= give_up:
                raise TaskFailedError(
                    f"look: the camera does not see marker {item.marker.id} of "
                    f"{item.name!r}. Put it into the camera's view, and the arm out of it."
                )
            self._station.stay(self._station.config.look_every * self._station.config.dt)
        return self._aiming.target_of(pixel)

    def aim(self, goals: Goals) -> float:
        """Bring the hand above the object; the time it took [s].

        Raises:
            MissedGraspError: If it takes too long.
        """
        self._station.enter("aim")
        self._station.watching = True
        return self.aimer.aim(goals)

    def close_on(self, item: ObjectConfig) -> None:
        """Go down and close the fingers.

        Raises:
            MissedGraspError: If there is nothing between them.
        """
        self._station.enter("grasp")
        self._station.watching = False
        position = self._station.pose.position.clone()
        position[2] = item.half_size[2]
        down = Pose(position, self._workplace.hover().orientation)
        self._station.move_straight(down, speed=0.08)
        self._station.gripper.move(CLOSED)
        self._station.stay(0.7)
        if self._station.state.gripper_width <= item.half_size[0]:
            raise MissedGraspError(
                f"grasp: the fingers closed on nothing. Is {item.name!r} where its marker says?"
            )

    def rise(self) -> None:
        """Lift the hand straight up."""
        self._station.enter("lift")
        pose = self._station.pose
        up = torch.tensor([0.0, 0.0, self._config.lift], dtype=torch.float64)
        self._station.move_straight(Pose(pose.position + up, pose.orientation))

    def go_home(self) -> None:
        """Move the joints home.

        Raises:
            BlockedPathError: If the way is not free.
        """
        self._station.enter("home")
        home = self._workplace.home_joints()
        dt = self._station.config.dt
        path = joint_line(self._station.joints, home, speed=0.6, dt=dt)
        plan = Plan(goal=self._workplace.home(), dt=dt, path=path.numpy())
        self._check(plan)
        self._station.play(plan.path)

    def start_over(self) -> None:
        """Open the fingers and go home, clear of the table and of the camera's view."""
        self._station.watching = False
        self._station.gripper.move(OPEN)
        self._station.stay(0.3)
        if self._station.pose.position[2] < self._workplace.hover_height:
            self.rise()
        self.go_home()
