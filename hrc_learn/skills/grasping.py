"""Grasping an object with an uncalibrated camera, and what to do when that fails.

    look -> aim -> grasp -> lift

An object out of sight is waited for. A grasp that missed, or an aim that did not get there,
is begun anew from home.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianEstimator
from hrc_learn.kinematics import panda_capsules
from hrc_learn.sim import HAND_MARKER, ObjectConfig
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.cartesian_motion import joint_line
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.visual_servoing import Aim, Aimer, AimingConfig, AimingSkill, from_learned
from hrc_learn.skills.visual_target import UP
from hrc_learn.skills.work_cell import (
    BlockedPathError,
    MissedGraspError,
    Station,
    TaskFailedError,
)

OPEN, CLOSED = 0.08, 0.0
# Least distance of the arm's capsules from where things may lie: the plate with the hand's
# marker stands out from them [m].
_CLEAR = 0.06
# Samples of a way of which one is looked at for that.
_EVERY = 5
# Largest distance of a joint from its place at home that counts as there [rad].
_AT_HOME = 0.05
"""Widths the gripper is told to take [m]."""

type TargetLaw = Callable[
    [Float[np.ndarray, "2"], Float[np.ndarray, "2 6"]], Float[np.ndarray, "2"]
]
"""From the object's marker [px] and the image Jacobian to where the hand's should be [px]."""


@dataclass(frozen=True, kw_only=True)
class GraspingConfig:
    """How objects are grasped."""

    aiming: AimingConfig = field(default_factory=AimingConfig)
    controller: ControllerConfig = field(
        default_factory=lambda: ControllerConfig(drift_compensation_rate=10.0)
    )
    """Settings of the adaptive controller; it holds the hand firmly against the drift that
    steps of 10 ms leave."""
    approach: bool = True
    """Whether the table is approached in joint space, along a way that was checked; else the
    Cartesian regions lead from the start, as in the paper."""
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
        target: TargetLaw | None = None,
        check: Callable[[Plan], None] = lambda plan: None,
    ):
        """Bring station and skill together.

        Args:
            station: Arm, gripper, camera and person.
            workplace: Where things are, roughly: the region over the table, home. How the hand
                is turned there it tells; `Workplace.approached` has it turned as was shown.
            aiming: Learned image Jacobian and visual target.
            config: How objects are grasped.
            estimator: Of the image Jacobian; None: a Kalman filter that starts from the
                learned one, wherever the camera may have been moved since.
            target: Where the hand's marker should be; None: as learned.
            check: Raises if a plan may not be carried out.
        """
        self._station = station
        self._workplace = workplace
        self._target = target or aiming.target_of
        self._offset_line = UP if aiming.target is None else aiming.target.line()
        self._config = config = config or GraspingConfig()
        self._check = check
        controller = AdaptiveController(
            station.chain,
            estimator or from_learned(aiming.jacobian),
            Goals.at(workplace.hover().position, workplace.hover().orientation),
            config=config.controller,
        )
        self.aimer = Aimer(station, controller, HAND_MARKER, config.aiming)

    def grasp(
        self, item: ObjectConfig, on_aimed: Callable[[Aim], None] = lambda aim: None
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
            aim = self.look_for(item)
            try:
                aim_time = self.aim(aim)
                if not setbacks:
                    on_aimed(aim)
                pixel_error = self.aimer.error(aim)
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

    def look_for(self, item: ObjectConfig) -> Aim:
        """Where to aim, from a look at the table before the arm is over it.

        An arm that stands elsewhere than at home, and so may hide the object, goes there if it
        is not seen.

        Raises:
            TaskFailedError: If the object's marker stays out of sight.
        """
        pixel = self._find(item)
        if pixel is None and not self._at_home():
            self.go_home()
            pixel = self._find(item)
        if pixel is None:
            raise TaskFailedError(
                f"look: the camera does not see marker {item.marker.id} of {item.name!r}. "
                "Put it into the camera's view, and the arm out of it."
            )
        return Aim(
            config=self._config.aiming,
            above=self._workplace.hover(),
            posture=self._posture() if self._config.approach else None,
            target=partial(self._target, pixel),
            line=self._offset_line,
        )

    def _find(self, item: ObjectConfig) -> Float[np.ndarray, "2"] | None:
        """Pixel of an object's marker; None if it stays out of sight."""
        self._station.enter("look")
        give_up = self._station.time + self._config.patience
        while (pixel := self._station.see().pixels.get(item.marker.id)) is None:
            if self._station.time >= give_up:
                return None
            self._station.stay(self._station.config.look_every * self._station.config.dt)
        return pixel

    def _at_home(self) -> bool:
        away = self._station.joints - self._workplace.home_joints()
        return float(away.abs().max()) < _AT_HOME

    def _posture(self) -> Float[Tensor, " joints"]:
        """Joint positions above the table to which, and home from which, the way is free.

        Where there are none, the arm goes home first. Nobody knows yet where on the table
        things lie, so the way keeps clear of all places where they may.
        """
        postures, home = self._workplace.hover_postures(), self._workplace.home_joints()
        for posture in postures:
            here = self._station.joints
            if self._free(here, posture, _CLEAR) and self._free(posture, home):
                return posture
        self.go_home()
        return postures[0]

    def aim(self, aim: Aim) -> float:
        """Bring the hand above the object; the time it took [s].

        Raises:
            MissedGraspError: If it takes too long.
        """
        self._station.enter("aim")
        self._station.watching = (HAND_MARKER,)
        return self.aimer.aim(aim)

    def close_on(self, item: ObjectConfig) -> None:
        """Go down and close the fingers.

        Raises:
            MissedGraspError: If there is nothing between them.
        """
        self._station.enter("grasp")
        self._station.watching = ()
        self._station.move_straight(self._before(item), speed=0.08)
        self._station.gripper.move(CLOSED)
        self._station.stay(0.7)
        if self._station.state.gripper_width <= item.half_size[0]:
            raise MissedGraspError(
                f"grasp: the fingers closed on nothing. Is {item.name!r} where its marker says?"
            )

    def _before(self, item: ObjectConfig) -> Pose:
        """Hand with its fingers about the object, on from here the way the hand points."""
        position, orientation = self._station.pose.position, self._workplace.hover().orientation
        direction = quaternion.to_matrix(orientation)[:, 2]
        drop = (item.half_size[2] - position[2]) / direction[2]
        return Pose(position + drop * direction, orientation)

    def rise(self) -> None:
        """Lift the hand straight up."""
        self._station.enter("lift")
        pose = self._station.pose
        up = torch.tensor([0.0, 0.0, self._config.lift], dtype=torch.float64)
        self._station.move_straight(Pose(pose.position + up, pose.orientation))

    def go_home(self) -> None:
        """Move the joints home, by way of another posture where the straight way is not free.

        Raises:
            BlockedPathError: If no way is free.
        """
        self._station.enter("home")
        here, home = self._station.joints, self._workplace.home_joints()
        postures = self._workplace.hover_postures()
        for clear in (_CLEAR, None):
            if self._free(here, home, clear):
                break
            ways = (q for q in postures if self._free(here, q, clear) and self._free(q, home))
            if (via := next(ways, None)) is not None:
                self._station.play(self._line(here, via).path)
                break
        plan = self._line(self._station.joints, home)
        self._check(plan)
        self._station.play(plan.path)

    def _free(
        self,
        start: Float[Tensor, " joints"],
        goal: Float[Tensor, " joints"],
        clear: float | None = None,
    ) -> bool:
        """Whether the arm may go straight, and, if asked, this far [m] off things anywhere."""
        plan = self._line(start, goal)
        try:
            self._check(plan)
        except BlockedPathError:
            return False
        if clear is None:
            return True
        path = torch.from_numpy(plan.path[::_EVERY])
        return bool(
            (panda_capsules.box_distance(path, *self._workplace.things()) > clear).all()
        )

    def _line(self, start: Float[Tensor, " joints"], goal: Float[Tensor, " joints"]) -> Plan:
        """A straight line in joint space."""
        dt = self._station.config.dt
        path = joint_line(start, goal, speed=0.6, dt=dt)
        return Plan(goal=self._station.chain.forward(goal), dt=dt, path=path.numpy())

    def start_over(self) -> None:
        """Open the fingers and go home, clear of the table and of the camera's view."""
        self._station.watching = ()
        self._station.gripper.move(OPEN)
        self._station.stay(0.3)
        if self._station.pose.position[2] < self._workplace.hover_height:
            self.rise()
        self.go_home()
