"""Image-based visual servoing to an object with an uncalibrated camera.

`VisualServo` runs the adaptive controller in a work cell until the marker is at its target, and
turns the gripper for the object. What it needs from demonstrations is in `visual_skill`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import AdaptiveController, ControllerState, Goals, Observation
from hrc_learn.controller.joint_path import changed_rate
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import Measurement
from hrc_learn.regions import OrientationRegion
from hrc_learn.skills.drawn_goals import DrawnGoals, DrawnGoalsConfig
from hrc_learn.skills.failures import MissedGraspError
from hrc_learn.skills.marker_angle import AngleServo, MarkerAngle
from hrc_learn.skills.marker_sensor import HeldMarker
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.vision.camera_model import IMAGE_SIZE

# Parts of a probe's height that are tried until its upper end is well within the image.
_PROBE_SHARES = np.array([1.0, 0.75, 0.5])
_NO_TURN = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class VisualServoConfig:
    """When the target counts as reached, and when servoing is given up."""

    tolerance: float = 2.0
    """Distance of the feature from the target at which it counts as reached [px]."""
    dwell: float = 0.4
    """How long it has to stay there [s]."""
    height_tolerance: float = 0.01
    """How far above or below the middle of the box the end effector may then be [m]."""
    turn_tolerance: float = 0.03
    """Angle between the end effector's orientation and its goal then [rad]."""
    timeout: float = 40.0
    """After which servoing is given up [s]."""
    occlusion_timeout: float = 10.0
    """How long the end effector's marker may stay undetected [s]."""
    probe: float = 0.06
    """Height above the box from which the end effector descends into it, along the line from
    the object's marker to its own [m]. From this motion the controller learns how that line
    looks to a camera that may have been moved, and so where on it the marker has to be. Four
    times as long a way leads on to the object, and what the probe errs by counts as often.
    0: none."""
    probe_speed: float = 0.05
    """Speed of that descent [m/s]: no faster than the camera can guide it along the line."""
    probe_tolerance: float = 10.0
    """Distance of the feature from the target at which the descent begins [px]."""
    probe_reach: float = 0.003
    """How far what was learned from a descent moves the end effector for the probe to be
    repeated from there [m]: half the error of the hand above an object that is asked for."""
    probe_aside: float = 0.012
    """The same of the first descent's sideways deviation from the line [m]: a motion in another
    direction tells less of how the line looks."""
    max_probes: int = 5
    """Descents at most."""
    border: float = 80.0
    """Distance that the target keeps from the edge of the image [px]: within 50 px
    a marker is cut off."""
    turn_border: float = 60.0
    """The same of the marker while the gripper is turned [px]; nearer, a turn that takes it
    still nearer waits."""
    turn_rate: float = 0.4
    """Fastest turn of the gripper for the object [rad/s]. The marker swings by 0.15 m a radian,
    and the camera, which is late, has to lead it meanwhile: at twice this rate, markers of two
    objects in a hundred left the image, or went behind the forearm."""
    half_hidden: float = 1.5
    """How far from where the joints tell that it is a marker may be seen while the end effector
    is held, before it counts as half hidden [px]: three times the noise of both."""
    lost_after: float = 1.0
    """Time after which a marker that was last seen near the edge of the image counts as out of
    view, not as occluded: the end effector returns to the middle of the box [s]."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Box in which the camera takes over [m]. Flat: the image tells little about height, and
    an object has to be met at the height of the demonstrations."""
    acquisition_half_size: tuple[float, float, float] = (0.03, 0.03, 0.003)
    """The same until the marker has been detected: a camera that was moved may not see all of
    the box, but will see its middle [m]."""
    angle: float = 0.01
    """Half angle of the tolerated cone of orientations [rad]. The paper's cone of 7.6 degrees
    would leave the marker 1 cm off its demonstrated place."""
    rate: float = 4.0
    """How fast the end effector returns into the box and into the cone [1/s]."""
    rest_rate: float = 1.0
    """How fast the null space goes back to the posture above the table [1/s]."""
    drawn: DrawnGoalsConfig = field(default_factory=DrawnGoalsConfig)
    """How what a person draws acts on the goals."""

    def within(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """A pixel, or the nearest one that keeps its distance from the edge of the image."""
        return np.clip(pixel, self.border, np.array(IMAGE_SIZE) - 1 - self.border)

    def goals(
        self, above: Pose, target: Float[np.ndarray, "2"], *, detected: bool = True
    ) -> Goals:
        """Goals of the controller.

        Args:
            above: Middle of the box above the table, and orientation of the end effector.
            target: Where in the image its marker should be [px]. A target outside the image is
                moved to the border: on the way there the image Jacobian is learned, whose
                error may have put it outside.
            detected: Whether the end effector's marker has been detected yet.
        """
        half_size = self.half_size if detected else self.acquisition_half_size
        goals = Goals.at(
            above.position,
            above.orientation,
            torch.from_numpy(self.within(target)),
            half_size=half_size,
        )
        # Near the border of a region its excess decays at 4 k_c / h^2 and k_o (alpha_o / 2)^2.
        # The paper's 4e-4 to the sides would let a marker that has left the image be followed
        # until the arm is stretched.
        walls = tuple(self.rate / 4 * h**2 for h in half_size)
        sharpness = 2 / self.angle
        return replace(
            goals,
            # Pulls from wherever the marker is seen; the paper's region may leave it outside.
            vision=replace(goals.vision, formulation="saturated"),
            position=replace(goals.position, stiffness=walls),
            orientation=OrientationRegion(
                goal=above.orientation,
                sharpness=sharpness,
                stiffness=4 * self.rate / sharpness**2,
            ),
        )


def no_perspective(
    jacobian: Float[np.ndarray, "2 6"], pixel: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3"]:
    """Depth is taken to be the same everywhere: its gradient is zero [1/m]."""
    return np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class ServoTarget:
    """What to servo to. Where that is in the image depends on what is known of the camera."""

    config: VisualServoConfig
    above: Pose
    """Middle of the box above the table, and orientation of the end effector."""
    posture: Float[Tensor, " joints"] | None
    """Joint positions there, approached in joint space [rad]; None: approached by the
    Cartesian regions."""
    target: Callable[
        [Float[np.ndarray, "2 6"], Float[Tensor, "4"], Float[np.ndarray, "3"]],
        Float[np.ndarray, "2"],
    ]
    """Where the end effector's marker should be [px], given the image Jacobian there, the end
    effector's orientation, and how far it is to be from right above the object [m]."""
    lines: Callable[[Float[Tensor, "4"]], Float[np.ndarray, "3"]]
    """From the end effector's orientation to the direction from the object's marker to the end
    effector's, base frame; it leads up."""
    depth_gradient: Callable[
        [Float[np.ndarray, "2 6"], Float[np.ndarray, "2"]], Float[np.ndarray, "3"]
    ] = no_perspective
    """From image Jacobian and pixel of the end effector's marker to the relative change of its
    depth with its place [1/m]; none: perspective is left out."""
    angle: float | None = None
    """Direction of the object's marker in the image [rad]; None: the gripper does not turn."""
    allowed: tuple[float, float] = (0.0, 0.0)
    """Least and greatest turn of the gripper about the vertical [rad]."""
    orientation: Float[Tensor, "4"] | None = None
    """Of the end effector, turned for the object; None: that of `above`."""
    rest: Float[Tensor, " joints"] | None = None
    """Joint positions near which the null space keeps [rad]; None: it stays where it is."""
    raised: float = 0.0
    """Height above the box to servo at for now, further along the line [m]."""

    def goals(
        self, image_jacobian: Float[np.ndarray, "2 6"], pose: Pose, *, detected: bool = True
    ) -> Goals:
        """Goals by an estimate of the image Jacobian, at a pose of the end effector."""
        # A camera that was moved may not see as far up; where it was watching before, it does.
        offset = torch.from_numpy(self._offset(self.raised if detected else 0.0))
        above = Pose(self.above.position + offset, self.upright)
        goals = self.config.goals(above, self.pixel(image_jacobian, pose), detected=detected)
        return goals.approached_by(self.posture)

    def pixel(
        self, image_jacobian: Float[np.ndarray, "2 6"], pose: Pose
    ) -> Float[np.ndarray, "2"]:
        """Where the marker should be for the end effector to be on the line at its height."""
        # Within the box the gripper goes on straight down, not along the line: a few
        # millimetres that are left of the height must not lead aside.
        height = float(pose.position[2] - self.above.position[2]) - self.config.half_size[2]
        pixel = self.raised_pixel(image_jacobian, min(max(height, 0.0), self.config.probe))
        return self.config.within(pixel) if self.raised else pixel

    def raised_pixel(
        self, image_jacobian: Float[np.ndarray, "2 6"], height: float
    ) -> Float[np.ndarray, "2"]:
        """Where the marker should be for the end effector to be on the line at a height [m]."""
        return self.target(image_jacobian, self.upright, self._offset(height))

    def deviation(self, pose: Pose, before: Pose) -> float:
        """Sideways distance of a pose from the line through an earlier one [m]."""
        moved = (pose.position - before.position).numpy()
        return float(np.linalg.norm((moved - self._offset(moved[2]))[:2]))

    @property
    def upright(self) -> Float[Tensor, "4"]:
        """Orientation of the end effector."""
        return self.above.orientation if self.orientation is None else self.orientation

    def _offset(self, height: float) -> Float[np.ndarray, "3"]:
        """Way along the line to a height above its beginning [m]."""
        line = self.lines(self.upright)
        return height / line[2] * line


class VisualServo:
    """Runs the controller in a work cell until the marker is at its target.

    Attributes:
        state: Of the controller; its estimate of the image Jacobian persists between targets.
    """

    def __init__(
        self,
        cell: WorkCell,
        controller: AdaptiveController,
        marker: int,
        config: VisualServoConfig | None = None,
        angle: MarkerAngle | None = None,
        refusal: Callable[[Pose], str] = lambda pose: "",
    ):
        """Prepare.

        Args:
            cell: Where.
            controller: The adaptive controller.
            marker: ArUco number of the end effector's marker.
            config: When the target counts as reached.
            angle: How the marker turns in the image; None: the gripper is not turned.
            refusal: Why the arm cannot go to a pose that a person asks for, in words for them;
                empty if it can.
        """
        self._cell = cell
        self._controller = controller
        self._marker = marker
        self._config = config or VisualServoConfig()
        self._last_image = self._last_detection = -np.inf
        self._cached = (np.nan, np.zeros((2, 6)))  # time of an image, and the Jacobian at it
        self._detected = False
        self._angle = None if angle is None else AngleServo(angle)
        # Orientation wanted by the newest image, and the goal now, on the way there.
        self._turned: Tensor | None = None
        self._turning: Tensor | None = None
        self._last_pixel = np.full(2, np.nan)
        self._arrived = False
        self._at_rest: Measurement | None = None  # mean of what was seen at the last rest
        self._held: HeldMarker | None = None
        self._drawn = DrawnGoals(self._config.drawn, refusal, cell.tell)
        self._rests = 1.0  # share of its speed with which the null space goes back
        self._led = 0.0  # time for which a person has led the end effector away [s]
        self._above = _NO_TURN  # orientation of the last target that is not turned
        self.state: ControllerState = controller.initial_state(cell.joints)

    def servo_to(self, target: ServoTarget) -> float:
        """Bring the marker to the target, first from higher up, along a line.

        Returns:
            Time it took [s].

        Raises:
            MissedGraspError: If it takes too long, or the marker stays undetected.
        """
        begun, start, config = self._cell.time, self._clock, self._config
        self._detected = self._arrived = False
        self._resume()
        if config.probe == 0:
            return self._converge(target, config.tolerance, start) - begun
        reached = begun
        for probe in range(config.max_probes):
            raised = replace(target, raised=self._probe_height(target))
            self._converge(raised, config.probe_tolerance, start)
            above, high = self._cell.pose, self._at_rest
            self._descend(raised)
            self._converge(target, config.tolerance, start)
            before, low = self._cell.pose, self._at_rest
            if high is not None and low is not None:
                self._learn(target, high, low)
            reached = self._converge(target, config.tolerance, start)
            # Along the line of the turned tool, which leads elsewhere than when not turned.
            turned = self._turned_by_person(target, self._turned)
            moved = self._cell.pose.position - before.position
            along = probe > 0 or turned.deviation(before, above) < config.probe_aside
            if along and float(moved[:2].norm()) < config.probe_reach:
                break
        return reached - begun

    def _learn(self, target: ServoTarget, high: Measurement, low: Measurement) -> None:
        """How the line looks at its lower end, from both ends of a descent."""
        way = (high.pose.position - low.pose.position).numpy()
        gradient = target.depth_gradient(self._image_jacobian(), low.feature.numpy())
        # As far apart as both would be seen without perspective.
        apart = (1 + float(gradient @ way)) * (high.feature - low.feature)
        high = replace(high, feature=low.feature + apart)
        estimator = self._controller.estimator
        learned = estimator.compared(self.state.estimator, high, low)
        self.state = replace(self.state, estimator=learned)
        self._cached = (np.nan, self._cached[1])

    def _resume(self) -> None:
        """Tell the estimator how long no image was taken: the camera may have been moved."""
        pause = self._cell.time - self._last_image
        if 0 < pause < np.inf:
            estimator = self._controller.estimator
            resumed = estimator.resumed(self.state.estimator, pause)
            self.state = replace(self.state, estimator=resumed)
        if self._angle is not None:
            self._angle.restart()
        self._turned = self._turning = None
        self._drawn.restart()

    def _converge(self, target: ServoTarget, tolerance: float, start: float) -> float:
        """Step until marker and height have stayed at the target; when they got there [s]."""
        reached = self._last_detection = self._cell.time
        seen: dict[float, tuple[Pose, Tensor]] = {}
        while self._cell.time - reached < self._config.dwell:
            if self._out_of_view():
                self._detected = False
            self.step(target)
            height = float(self._cell.pose.position[2] - target.above.position[2])
            at_height = abs(height - target.raised) < self._config.height_tolerance
            turned = self.turn_error(target) < self._config.turn_tolerance
            on_target = self.error(target) < tolerance and not self._drawn.away
            if not (on_target and at_height and turned):
                reached = self._cell.time
                seen.clear()
            elif (image := self._cell.observation).joints is not None:
                feature = torch.from_numpy(self._feature())
                seen[image.time] = self._cell.chain.forward(image.joints), feature
            self._check_timeouts(target, self._clock - start)
        self._at_rest = _mean(list(seen.values()))
        return reached

    def _probe_height(self, target: ServoTarget) -> float:
        """From as high up as the marker is expected well within the image [m]."""
        config = self._config
        turned = self._turned_by_person(target, self._turned)
        for height in config.probe * _PROBE_SHARES:
            pixel = turned.raised_pixel(self._image_jacobian(), float(height))
            if np.array_equal(config.within(pixel), pixel):
                return float(height)
        return float(config.probe * _PROBE_SHARES[-1])

    def _descend(self, target: ServoTarget) -> None:
        """Along the line, from as high up as it is raised."""
        begun, speed = self._clock, self._config.probe_speed
        while (height := target.raised - speed * (self._clock - begun)) > 0:
            self.step(replace(target, raised=height))

    def hold(self, target: ServoTarget, duration: float) -> None:
        """Keep the end effector where it is in the image for a while [s], whatever the person
        does to the null space.
        """
        end = self._cell.time + duration
        # What is learned meanwhile of image Jacobian and turn must not move the target.
        self._turned = self._turning
        image_jacobian = self._image_jacobian()
        # What the person adds to the turn must.
        held = replace(
            target,
            target=lambda _, orientation, further: target.target(
                image_jacobian, orientation, np.zeros(3)
            ),
        )
        self._held = HeldMarker(self._config.half_hidden)
        while self._cell.time < end:
            self.step(held)
        self._held = None

    def error(self, target: ServoTarget) -> float:
        """Distance of the feature from its target [px]; NaN if it is not detected."""
        target = self._turned_by_person(target, self._turned)
        pixel = target.pixel(self._image_jacobian(), self._cell.pose)
        return float(np.linalg.norm(self._feature() - pixel))

    def step(self, target: ServoTarget) -> None:
        """One step of the controller."""
        observation = self._cell.observation
        feature = torch.from_numpy(self._feature())
        if self._held is not None and not self._held.fits(
            observation.time,
            feature.numpy(),
            self._cell.chain.forward(self._joints()),
            self._image_jacobian(),
        ):
            feature = torch.full_like(feature, torch.nan)
        visible = torch.tensor(bool(torch.isfinite(feature).all()))
        new = torch.tensor(observation.time > self._last_image)
        if new and self._held is None:
            self._find_turn(target)
        self._turn_on(target, feature.numpy())
        asked, clock = self._cell.human_input, self._cell.task_time
        self._drawn.turn_on(asked.turn, self._config.turn_rate * self._cell.config.dt)
        self._above = target.above.orientation
        target = self._turned_by_person(target, self._turning)
        if self._arrived:
            # A person's pull or a turn for the object takes the joints far from the posture:
            # that must not call the arm back, not even while the marker is out of sight.
            target = replace(target, posture=None)
        self._last_image = observation.time
        if visible:
            self._last_detection, self._detected = observation.time, True
            self._last_pixel = feature.numpy()
        planned = target.goals(self._image_jacobian(), self._cell.pose, detected=self._detected)
        planned = self._resting(planned, target.rest)
        self._drawn.read(asked, planned, self._cell.time)
        goals = self._drawn.applied(planned, self._cell.pose.position)
        age = torch.tensor(self._cell.time - observation.time, dtype=torch.float64)
        command, self.state = self._controller.step(
            self.state,
            Observation(
                joint_position=self._cell.joints,
                feature=feature,
                feature_visible=visible,
                feature_new=new,
                feature_age=age,
                image_joint_position=observation.joints,
                nullspace_input=torch.from_numpy(asked.effort(len(self._cell.joints))),
                goals=goals,
                dt=self._cell.config.dt,
                distances=self._cell.distances,
            ),
        )
        self._arrived = self._arrived or float(self.state.task_level) == 1.0
        approach = 0.0 if goals.posture is None else 1.0 - float(self.state.task_level)
        self._cell.execute(
            command,
            goals.vision.target.numpy(),
            feature.numpy(),
            approach,
            region=goals.position,
            drawn=bool(self._drawn.leads),
            turn=quaternion.log(self._drawn.turn).numpy(),
        )
        if self._drawn.away:
            self._led += self._cell.task_time - clock
            if self._held is not None:  # the marker goes with an end effector that is led
                self._held = HeldMarker(self._config.half_hidden)

    def _resting(self, goals: Goals, rest: Float[Tensor, " joints"] | None) -> Goals:
        """The goals with a null space that goes back, but while a person pushes it."""
        pushed = self._cell.human_input.effort(len(self._cell.joints)).any()
        self._rests = float(changed_rate(self._rests, float(not pushed), self._cell.config.dt))
        if self._rests == 0:
            return goals
        rate, speed = self._config.rest_rate, self._cell.config.return_speed
        return goals.resting_at(rest, rate=self._rests * rate, speed=self._rests * speed)

    def _out_of_view(self) -> bool:
        """Whether the marker has left the image, rather than being occluded."""
        missing = self._cell.time - self._last_detection
        border = 2 * self._config.border
        inside = (self._last_pixel > border) & (
            self._last_pixel < np.array(IMAGE_SIZE) - border
        )
        return missing > self._config.lost_after and not inside.all()

    def _turn_on(self, target: ServoTarget, feature: Float[np.ndarray, "2"]) -> None:
        """Turn the goal a little further, unless the marker would leave the image [px]."""
        if self._turned is None or not np.isfinite(feature).all():
            return
        now = target.above.orientation if self._turning is None else self._turning
        turn = Pose(target.above.position, now).twist_to(
            Pose(target.above.position, self._turned)
        )
        swing, border = self._image_jacobian() @ turn.numpy(), self._config.turn_border
        leaves = (feature < border) & (swing < 0)
        leaves |= (feature > np.array(IMAGE_SIZE) - 1 - border) & (swing > 0)
        if leaves.any():
            return
        most = self._config.turn_rate * self._cell.config.dt
        share = most / turn.norm().clamp(min=most)
        self._turning = quaternion.slerp(now, self._turned, share)

    def _find_turn(self, target: ServoTarget) -> None:
        """Find from a new image how the gripper has to be turned for the object."""
        observation = self._cell.observation
        angle = observation.angles.get(self._marker)
        if self._angle is None or target.angle is None or angle is None:
            return
        pose = self._cell.chain.forward(self._joints())
        elapsed = observation.time - self._last_image
        self._angle.update(pose, angle, elapsed if math.isfinite(elapsed) else 0.0)
        self._turned = self._angle.turned(
            pose, angle, target.angle, target.above.orientation, target.allowed
        )

    def turn_error(self, target: ServoTarget) -> float:
        """Angle between the end effector's orientation and the one it should have [rad]."""
        goal = self._turned_by_person(target, self._turned).upright
        return float(quaternion.angle(self._cell.pose.orientation, goal))

    @property
    def orientation(self) -> Float[Tensor, "4"] | None:
        """Of the end effector above the object, as images and people have it; else None."""
        if self._turned is None and float(quaternion.angle(self._drawn.turn, _NO_TURN)) == 0:
            return None
        return self._with_turn(self._above if self._turned is None else self._turned)

    def _turned_by_person(
        self, target: ServoTarget, orientation: Float[Tensor, "4"] | None
    ) -> ServoTarget:
        """The target in an orientation, by default its own, and with the person's turn."""
        upright = replace(target, orientation=orientation).upright
        return replace(target, orientation=self._with_turn(upright))

    def _with_turn(self, orientation: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
        return quaternion.multiply(self._drawn.turn, orientation)

    @property
    def _clock(self) -> float:
        """Time of the task without that in which a person led the end effector away [s]."""
        return self._cell.task_time - self._led

    def _image_jacobian(self) -> Float[np.ndarray, "2 6"]:
        """Estimate at the pose of the newest image [px/m, px/rad], computed once an image."""
        observation = self._cell.observation
        if observation.time != self._cached[0]:
            pose = self._cell.chain.forward(self._joints())
            estimate = self._controller.estimator.jacobian(self.state.estimator, pose)
            self._cached = observation.time, estimate.numpy()
        return self._cached[1]

    def _joints(self) -> Float[Tensor, " joints"]:
        """Joint positions when the newest image was taken [rad]."""
        joints = self._cell.observation.joints
        return self._cell.joints if joints is None else joints

    def _check_timeouts(self, target: ServoTarget, spent: float) -> None:
        if self._drawn.away:
            self._last_detection = self._cell.time
            return
        if self._cell.time - self._last_detection > self._config.occlusion_timeout:
            raise MissedGraspError(
                f"visual servoing: the end effector's marker {self._marker} was not detected "
                f"for {self._config.occlusion_timeout:.0f} s. If nothing occludes it, put the "
                "object nearer to the middle of the image."
            )
        if spent > self._config.timeout:
            raise MissedGraspError(
                f"visual servoing: after {spent:.0f} s the marker is still "
                f"{self.error(target):.1f} px from its target (NaN: not detected)."
            )

    def _feature(self) -> Float[np.ndarray, "2"]:
        return self._cell.observation.pixels.get(self._marker, np.full(2, np.nan))


def _mean(seen: Sequence[tuple[Pose, Float[Tensor, "2"]]]) -> Measurement | None:
    """Of frames at rest; None where the feature was not seen in one."""
    known = [(pose, feature) for pose, feature in seen if bool(feature.isfinite().all())]
    if not known:
        return None
    poses, features = zip(*known, strict=True)
    # At rest the orientations differ by less than their noise matters.
    pose = Pose(torch.stack([p.position for p in poses]).mean(0), poses[-1].orientation)
    none = torch.zeros(6, dtype=pose.position.dtype)
    return Measurement(
        pose=pose,
        feature=torch.stack(features).mean(0),
        valid=torch.tensor(True),
        dt=0.0,
        xi_x=none[:2],
        xi_r=none,
    )
