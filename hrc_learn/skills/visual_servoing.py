"""Image-based visual servoing to an object with an uncalibrated camera.

`ServoTarget` determines the goals of the adaptive controller. `ServoStep` is a pure step
`(state, reading, target) -> (command, state)` that calls the controller. `VisualServo` repeats
this step in a work cell until the end effector's marker is at its target pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import (
    AdaptiveController,
    Command,
    ControllerState,
    Goals,
    Observation,
    SafetyState,
)
from hrc_learn.controller.joint_path import changed_rate
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.jacobian import CameraEstimator, CameraSpread
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.regions import OrientationRegion
from hrc_learn.skills.drawn_goals import DrawnGoals, DrawnGoalsConfig, DrawnGoalsState
from hrc_learn.skills.marker_sensor import MarkerConsistency, SeenFeature
from hrc_learn.skills.step_report import vision_columns
from hrc_learn.skills.visual_skill import MarkerAngle
from hrc_learn.skills.visual_target import VisualTarget, object_heading
from hrc_learn.skills.work_cell import (
    CellReading,
    HiddenMarkerError,
    MissedGraspError,
    WorkCell,
)
from hrc_learn.vision.camera_model import IMAGE_SIZE

# Fractions of the probe height. They are tried in turn until the marker's target pixel at that
# height is well within the image.
_PROBE_FRACTIONS = np.array([1.0, 0.75, 0.5])
# Largest predicted error above the object at which the gripper turns to align with the object
# [m]. With a larger error, the camera's estimated orientation may be entirely wrong.
_LOST = 0.03
_NOT_SEEN = np.full(2, np.nan)
_NOT_FOUND = SeenFeature(_NOT_SEEN, np.nan)


@dataclass(frozen=True, kw_only=True)
class VisualServoConfig:
    """Tolerances, time limits and regions of visual servoing.

    The end effector moves in a flat box above the table. A probe is a motion from above the box
    down into the box; the end effector probes while the estimate of the camera is uncertain.
    """

    tolerance: float = 1.5
    """Distance of the feature from the target that counts as reached [px]."""
    dwell: float = 0.3
    """Time at the target until it counts as reached [s]."""
    height_tolerance: float = 0.01
    """Height error of the end effector that counts as reached [m]."""
    turn_tolerance: float = 0.03
    """Orientation error of the end effector that counts as reached [rad]."""
    timeout: float = 40.0
    """Give up after this long [s]."""
    occlusion_timeout: float = 10.0
    """Give up after the end effector's marker is undetected for this long [s]."""
    object_error: float = 0.0025
    """Largest predicted error above the object with which the gripper may descend to grasp [m]:
    one standard deviation in the plane. With a larger error, the end effector probes."""
    probe: float = 0.06
    """Height above the box from which a probe descends [m]. The descent shows how the marker's
    pixel depends on height."""
    probe_tolerance: float = 30.0
    """Distance of the feature from the target at which a probe begins its descent [px]."""
    probe_aside: float = 0.0
    """Distance by which all probes but the first are shifted, roughly towards the middle of the
    image [px]. Motions across the image and in depth together show the camera's tilt."""
    max_probes: int = 6
    """Largest number of probes."""
    border: float = 80.0
    """Smallest distance of the target from the border of the image [px]; a marker closer than
    50 px is cut off."""
    turn_border: float = 60.0
    """If the marker is closer than this to the border of the image, the gripper does not turn
    in a way that would move the marker even closer [px]."""
    turn_rate: float = 0.8
    """Highest angular speed at which the gripper turns to align with the object [rad/s]. A turn
    moves the marker by 0.15 m per radian. At this speed, the marker stays within 10 px of its
    target even with delayed images."""
    marker_tolerance: float = 1.5
    """While the end effector is held, the marker counts as half hidden if it deviates from its
    predicted pixel by more than this [px]: three times the noise of pixel and prediction."""
    lost_after: float = 1.0
    """Time without detection after which a marker last seen near the border counts as out of
    view, not as occluded [s]. The end effector then returns to the middle of the box."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Half edges of the box in which vision feedback acts [m]. The box is flat: the image shows
    little about height, and an object has to be grasped at the demonstrated height."""
    acquisition_half_size: tuple[float, float, float] = (0.03, 0.03, 0.003)
    """Half edges of the box until the marker is first detected [m]. A camera that was moved may
    not see the whole box, but will see the middle of the box."""
    angle: float = 0.01
    """Half angle of the tolerated cone of orientations [rad]. The paper's cone of 7.6 degrees
    would shift the marker by 1 cm."""
    rate: float = 4.0
    """Rate at which the end effector returns into the box and into the cone [1/s]."""
    rest_rate: float = 1.0
    """Rate at which the null space returns to the posture above the table [1/s]."""
    drawn: DrawnGoalsConfig = field(default_factory=DrawnGoalsConfig)
    """Effect of a person's drawing on the goals."""

    unbounded = "timeout", "occlusion_timeout", "lost_after"

    def __post_init__(self) -> None:
        positive = "tolerance", "height_tolerance", "turn_tolerance", "max_probes", "turn_rate"
        not_negative = *self.unbounded, "probe", "rest_rate"
        check_settings(self, positive=(*positive, "angle", "rate"), not_negative=not_negative)

    def scaled(self, size: float) -> "VisualServoConfig":
        """The same settings, with the lengths above the table scaled to the size of a hand.

        Args:
            size: Size of the hand relative to the Franka hand.
        """
        (a, b, c), (d, e, f) = self.half_size, self.acquisition_half_size
        return replace(
            self,
            height_tolerance=size * self.height_tolerance,
            probe=size * self.probe,
            half_size=(size * a, size * b, c),
            acquisition_half_size=(size * d, size * e, f),
        )

    def within(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest pixel at least `border` pixels away from the border of the image [px]."""
        return np.clip(pixel, self.border, np.array(IMAGE_SIZE) - 1 - self.border)

    def goals(
        self, above: Pose, target: Float[np.ndarray, "2"], *, detected: bool = True
    ) -> Goals:
        """Goals of the controller.

        Args:
            above: Middle of the box above the table, and orientation of the end effector.
            target: Target of the end effector's marker [px]. A target outside the image may be
                due to a wrong image Jacobian. It is moved to the border, and the motion towards
                it corrects the image Jacobian.
            detected: False until the end effector's marker is first detected.
        """
        half_size = self.half_size if detected else self.acquisition_half_size
        goals = Goals.at(
            above.position,
            above.orientation,
            torch.from_numpy(self.within(target)),
            half_size=half_size,
        )
        # Just outside a region, the distance from its wall decays at the rate 4 k_c / h^2 for
        # positions (stiffness k_c, half edge h) and k_o (alpha_o / 2)^2 for orientations
        # (stiffness k_o, sharpness alpha_o). With the paper's k_c = 4e-4, an arm whose marker
        # has left the image would move on until it is fully stretched.
        walls = tuple(self.rate / 4 * h**2 for h in half_size)
        sharpness = 2 / self.angle
        return replace(
            goals,
            # This region attracts from anywhere in the image, unlike the paper's region.
            vision=replace(goals.vision, formulation="saturated"),
            position=replace(goals.position, stiffness=walls),
            orientation=OrientationRegion(
                goal=above.orientation,
                sharpness=sharpness,
                stiffness=4 * self.rate / sharpness**2,
            ),
        )


@dataclass(frozen=True, kw_only=True)
class ServoTarget:
    """Pose that the end effector servos to, and the data that determine its marker's pixel."""

    config: VisualServoConfig
    above: Pose
    """Middle of the box above the table, and orientation of the end effector."""
    posture: Float[Tensor, " joints"] | None
    """Joint positions at `above`, approached in joint space [rad]; None: the Cartesian regions
    guide the approach."""
    visual: VisualTarget
    """Position of the object's marker in the tool frame."""
    item: Float[np.ndarray, "2"]
    """Pixel of the object's marker [px]."""
    angle: float | None = None
    """Direction of the object's marker in the image [rad]; None: the gripper does not turn."""
    turn_range: tuple[float, float] = (0.0, 0.0)
    """Smallest and largest turn of the gripper about the vertical [rad]."""
    orientation: Float[Tensor, "4"] | None = None
    """Orientation of the end effector, aligned with the object; None: the orientation of
    `above`."""
    rest: Float[Tensor, " joints"] | None = None
    """Posture to which the null space returns [rad]; None: the null space does not return."""
    raised: float = 0.0
    """Height of the goal above the box [m], for probes."""
    kept_camera: Float[Tensor, "13"] | None = None
    """Fixed estimate of the camera that determines the target pixel, so that the target stays
    in place while the estimate changes. None: the present estimate determines the target
    pixel."""

    def goals(self, camera: Float[Tensor, "13"], pose: Pose, *, detected: bool) -> Goals:
        """Goals from an estimate of the camera, for the present pose of the end effector."""
        # A camera that was moved may not see the space above the box: do not raise the goal
        # until the marker is detected.
        offset = torch.tensor([0.0, 0.0, self.raised if detected else 0.0], dtype=torch.float64)
        above = Pose(self.above.position + offset, self.tool_orientation)
        goals = self.config.goals(above, self.pixel(camera, pose), detected=detected)
        return goals.approached_by(self.posture)

    def pixel(self, camera: Float[Tensor, "13"], pose: Pose) -> Float[np.ndarray, "2"]:
        """Target of the marker with the end effector at its present height [px].

        At any height, the target is the pixel of a marker right above the object. Therefore a
        height error of some millimetres does not move the gripper sideways.
        """
        camera = camera if self.kept_camera is None else self.kept_camera
        lower_wall = float(self.above.position[2]) - self.config.half_size[2]
        height = pose.position[2].clamp(min=lower_wall)
        return self.visual(
            camera, torch.from_numpy(self.item), self.demonstrated, height
        ).numpy()

    def uncertainty(
        self, cameras: CameraSpread, image_jacobian: Float[np.ndarray, "2 6"]
    ) -> float:
        """Predicted error above the object: standard deviation in the horizontal plane [m]."""
        item = torch.from_numpy(self.item)
        return self.visual.uncertainty(cameras, image_jacobian, item, self.demonstrated)

    def heading(self, camera: Float[Tensor, "13"]) -> float | None:
        """Heading of the object's marker in the base frame [rad]; None without a direction."""
        if self.angle is None:
            return None
        offset = quaternion.rotate(self.tool_orientation, torch.from_numpy(self.visual.offset))
        height = float(self.above.position[2] + offset[2])
        return object_heading(camera, torch.from_numpy(self.item), self.angle, height)

    @property
    def demonstrated(self) -> Pose:
        """Pose at the height where demonstrations end, with the `tool_orientation`."""
        return Pose(self.above.position, self.tool_orientation)

    @property
    def tool_orientation(self) -> Float[Tensor, "4"]:
        """Orientation of the end effector: aligned with the object, or as in `above`."""
        return self.above.orientation if self.orientation is None else self.orientation


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """State of visual servoing between two steps."""

    controller: ControllerState
    """State of the controller, with its estimate of the image Jacobian."""
    drawn: DrawnGoalsState
    """A person's drawing and turn."""
    camera: Float[Tensor, "13"]
    """Estimate of the camera and of the marker's position on the tool (see
    `jacobian.perspective`)."""
    image_jacobian: Float[np.ndarray, "2 6"]
    """Estimated image Jacobian at the pose of the newest image [px/m, px/rad]."""
    chosen_turn: float | None = None
    """Turn chosen for the present target [rad]; None: no turn so far."""
    image_jacobian_time: float = np.nan
    """Time of the image to which `image_jacobian` belongs [s]."""
    wanted_orientation: Float[Tensor, "4"] | None = None
    """Orientation that suits the object in the newest image; None: the target's orientation."""
    goal_orientation: Float[Tensor, "4"] | None = None
    """Present goal, on the way to `wanted_orientation`; None: the target's orientation."""
    last_image: float = -np.inf
    """Time of the last image used [s]."""
    last_detection: float = -np.inf
    """Time of the last detection of the marker [s]."""
    last_pixel: Float[np.ndarray, "2"]
    """Last detected pixel of the marker [px]."""
    detected: bool = False
    """True once the marker has been detected."""
    arrived: bool = False
    """True once the joint-space approach is over."""
    held: MarkerConsistency | None = None
    """Test that the marker moves with the held end effector; None: the end effector is not
    held."""
    posture_gain_scale: float = 1.0
    """Scale of the speed at which the null space returns, 0 while a person pushes it."""


class ServoCommand(NamedTuple):
    """Result of one step of visual servoing."""

    command: Command
    """Command of the controller."""
    goals: Goals
    """Goals of the controller."""
    feature: Float[np.ndarray, "2"]
    """Pixel of the marker used in this step [px]; NaN: no pixel."""
    approach: float
    """Fraction of a joint-space approach in the command, 0 to 1."""
    remark: str
    """Message to the person; empty: no message."""


class ServoStep:
    """Pure step of visual servoing with the adaptive controller."""

    def __init__(
        self,
        controller: AdaptiveController,
        marker: int,
        config: VisualServoConfig | None = None,
        angle: MarkerAngle | None = None,
        refusal: Callable[[Pose], str] = lambda pose: "",
    ):
        """Prepare the step.

        Args:
            controller: The adaptive controller.
            marker: ArUco number of the end effector's marker.
            config: Tolerances and regions.
            angle: Demonstrated turn relative to the object; None: the gripper does not turn.
            refusal: Function that returns the reason why the arm cannot go to a pose that a
                person requests. The reason is a text for this person; it is empty if the arm
                can go there.

        Raises:
            ValueError: The controller estimates no camera.
        """
        if not isinstance(controller.estimator, CameraEstimator):
            raise ValueError(
                "servoing to an object needs the camera: give the controller a CameraEstimator."
            )
        self.controller, self.chain = controller, controller.chain
        self.marker, self.config = marker, config or VisualServoConfig()
        self._angle = angle
        self._drawn = DrawnGoals(self.config.drawn, refusal)

    def initial_state(self, joints: Float[Tensor, " joints"]) -> ServoState:
        """State of an arm at rest at the joint positions `joints` [rad]."""
        controller = self.controller.initial_state(joints)
        return ServoState(
            controller=controller,
            drawn=self._drawn.initial_state(),
            camera=controller.estimator.best,
            image_jacobian=np.zeros((2, 6)),
            last_pixel=_NOT_SEEN,
        )

    def restarted(self, state: ServoState, time: float, motion: SafetyState) -> ServoState:
        """State for a new target; the camera may have been moved since the last image.

        Args:
            state: State at the end of the last motion.
            time: Present time [s].
            motion: Present motion of the arm, from the safety filter of the loop that has moved
                the arm since the last target.
        """
        controller, pause = state.controller, time - state.last_image
        if 0 < pause < np.inf:
            resumed = self.controller.estimator.resumed(controller.estimator, pause)
            controller = replace(controller, estimator=resumed)
        counts = controller.safety.counts
        controller = replace(controller, safety=replace(motion, counts=counts))
        return replace(
            state,
            controller=controller,
            drawn=self._drawn.restarted(state.drawn),
            chosen_turn=None,
            wanted_orientation=None,
            goal_orientation=None,
            detected=False,
            arrived=False,
            held=None,  # an error may have ended a hold
        )

    def observed(self, state: ServoState, reading: CellReading) -> ServoState:
        """State with the camera and the image Jacobian estimated for the newest image."""
        if reading.markers.time == state.image_jacobian_time:
            return state
        pose, estimate = self.chain.forward(reading.image_joints), state.controller.estimator
        return replace(
            state,
            camera=estimate.best,
            image_jacobian=self.controller.estimator.jacobian(estimate, pose).numpy(),
            image_jacobian_time=reading.markers.time,
        )

    def step(
        self, state: ServoState, reading: CellReading, target: ServoTarget
    ) -> tuple[ServoCommand, ServoState]:
        """Take one step.

        Args:
            state: State after the last step.
            reading: Measurements and requests.
            target: Target of this step.

        Returns:
            The command and the next state.
        """
        state = self.observed(state, reading)
        state, feature = self._visible_feature(state, reading)
        visible, image = bool(np.isfinite(feature).all()), reading.markers
        new = image.time > state.last_image
        if new and state.held is None:
            state = self._with_wanted_orientation(state, reading, target)
        state = self._turned_further(state, target, feature, reading.dt)
        drawn = self._drawn.turned(
            state.drawn, reading.human.turn, self.config.turn_rate * reading.dt
        )
        state = replace(state, drawn=drawn, last_image=image.time)
        if visible:
            state = replace(state, last_detection=image.time, detected=True, last_pixel=feature)
        goals, state, remark = self._goals(state, reading, target)
        command, controller = self.controller.step(
            state.controller,
            Observation(
                joint_position=reading.joints,
                feature=torch.from_numpy(feature),
                feature_visible=torch.tensor(visible),
                feature_new=torch.tensor(new),
                feature_age=torch.tensor(reading.time - image.time, dtype=torch.float64),
                image_joint_position=image.joints,
                nullspace_input=torch.from_numpy(reading.effort),
                goals=goals,
                dt=reading.dt,
                distances=reading.distances,
            ),
        )
        level = float(controller.task_level)
        approach = 0.0 if goals.posture is None else 1.0 - level
        state = replace(state, controller=controller, arrived=state.arrived or level == 1.0)
        return ServoCommand(command, goals, feature, approach, remark), state

    def tool_target(self, state: ServoState, target: ServoTarget) -> ServoTarget:
        """The target in the wanted orientation, turned further by the person."""
        return self._oriented(state, target, state.wanted_orientation)

    def pixel_error(
        self, state: ServoState, reading: CellReading, target: ServoTarget
    ) -> float:
        """Distance of the marker from its target [px]; NaN if the marker is not detected."""
        pixel = self.tool_target(state, target).pixel(state.camera, reading.pose)
        return float(np.linalg.norm(self.feature(reading) - pixel))

    def uncertainty(self, state: ServoState, target: ServoTarget) -> float:
        """Predicted error above the object: standard deviation in the horizontal plane [m]."""
        spread: CameraSpread = state.controller.estimator.spread()
        return self.tool_target(state, target).uncertainty(spread, state.image_jacobian)

    def turn_error(self, state: ServoState, pose: Pose, target: ServoTarget) -> float:
        """Angle between the end effector's orientation and the wanted orientation [rad]."""
        goal = self.tool_target(state, target).tool_orientation
        return float(quaternion.angle(pose.orientation, goal))

    def probe_height(self, state: ServoState, target: ServoTarget) -> float:
        """Largest height of a probe at which the marker is well within the image [m]."""
        turned = self.tool_target(state, target)
        for height in self.config.probe * _PROBE_FRACTIONS:
            up = torch.tensor([0.0, 0.0, float(height)], dtype=torch.float64)
            raised = Pose(turned.above.position + up, turned.tool_orientation)
            pixel = turned.pixel(state.camera, raised)
            if np.array_equal(self.config.within(pixel), pixel):
                return float(height)
        return float(self.config.probe * _PROBE_FRACTIONS[-1])

    def out_of_view(self, state: ServoState, time: float) -> bool:
        """True if the marker has left the image, as opposed to being occluded."""
        border = 2 * self.config.border
        inside = state.last_pixel > border
        inside &= state.last_pixel < np.array(IMAGE_SIZE) - border
        missing = time - state.last_detection
        return missing > self.config.lost_after and not inside.all()

    def feature(self, reading: CellReading) -> Float[np.ndarray, "2"]:
        """Pixel of the end effector's marker [px]; NaN if the marker is not detected."""
        return reading.markers.features.get(self.marker, _NOT_FOUND).pixel

    def _visible_feature(
        self, state: ServoState, reading: CellReading
    ) -> tuple[ServoState, Float[np.ndarray, "2"]]:
        """Next state, and pixel of the marker [px].

        While the end effector is held, the pixel is NaN if the marker is half hidden.
        """
        feature = self.feature(reading)
        if state.held is None:
            return state, feature
        held = state.held.updated(
            reading.markers.time,
            feature,
            self.chain.forward(reading.image_joints),
            state.image_jacobian,
        )
        return replace(state, held=held), feature if held.consistent else _NOT_SEEN

    def _with_wanted_orientation(
        self, state: ServoState, reading: CellReading, target: ServoTarget
    ) -> ServoState:
        """State with the orientation that suits the object in a new image."""
        if self._angle is None or target.angle is None or not state.detected:
            return state
        if self.uncertainty(state, target) > _LOST:
            return state
        heading, reference = target.heading(state.camera), target.above.orientation
        assert heading is not None
        now = turn_about_vertical(reading.pose.orientation, reference)
        chosen = self._angle.turn(heading, reference, now, target.turn_range, state.chosen_turn)
        about = quaternion.exp(reference.new_tensor([0.0, 0.0, chosen]))
        wanted = quaternion.multiply(about, reference)
        return replace(state, chosen_turn=chosen, wanted_orientation=wanted)

    def _turned_further(
        self, state: ServoState, target: ServoTarget, feature: Float[np.ndarray, "2"], dt: float
    ) -> ServoState:
        """State with the goal turned further towards the wanted orientation.

        The goal does not turn if the marker would leave the image.
        """
        wanted = state.wanted_orientation
        if wanted is None or not np.isfinite(feature).all():
            return state
        now = state.goal_orientation
        now = target.above.orientation if now is None else now
        turn = Pose(target.above.position, now).twist_to(Pose(target.above.position, wanted))
        swing, border = state.image_jacobian @ turn.numpy(), self.config.turn_border
        leaves = (feature < border) & (swing < 0)
        leaves |= (feature > np.array(IMAGE_SIZE) - 1 - border) & (swing > 0)
        if leaves.any():
            return state
        most = self.config.turn_rate * dt
        fraction = most / turn.norm().clamp(min=most)
        return replace(state, goal_orientation=quaternion.slerp(now, wanted, fraction))

    def _goals(
        self, state: ServoState, reading: CellReading, target: ServoTarget
    ) -> tuple[Goals, ServoState, str]:
        """Goals of the controller, next state, and message to the person (empty: no message).

        The goals combine the target, the resting posture and the drawing of the person.
        """
        target = self._oriented(state, target, state.goal_orientation)
        if state.arrived:
            # A person's pull, or a turn that aligns the gripper with the object, may move the
            # joints far from the posture. The approach must not start again then, even with the
            # marker out of view.
            target = replace(target, posture=None)
        planned = target.goals(state.camera, reading.pose, detected=state.detected)
        pushed = reading.effort.any()
        scale = float(changed_rate(state.posture_gain_scale, float(not pushed), reading.dt))
        if scale > 0:
            planned = planned.resting_at(
                target.rest,
                rate=scale * self.config.rest_rate,
                speed=scale * reading.return_speed,
            )
        drawn, remark = self._drawn.read(state.drawn, reading.human, planned, reading.time)
        goals, drawn = self._drawn.applied(drawn, planned, reading.pose.position)
        held = state.held
        if held is not None and drawn.away:
            # The marker moves with the guided end effector: restart the test.
            held = MarkerConsistency(tolerance=self.config.marker_tolerance)
        state = replace(state, posture_gain_scale=scale, drawn=drawn, held=held)
        return goals, state, remark

    def _oriented(
        self, state: ServoState, target: ServoTarget, orientation: Tensor | None
    ) -> ServoTarget:
        """The target in an orientation (None: `above`), turned further by the person."""
        tool = replace(target, orientation=orientation).tool_orientation
        return replace(target, orientation=quaternion.multiply(state.drawn.turn, tool))


def _towards_middle(pixel: Float[np.ndarray, "2"], side: float) -> Float[np.ndarray, "2"]:
    """Image direction 40 degrees to one side (1 or -1) of the direction to the middle."""
    u, v = np.array(IMAGE_SIZE) / 2 - pixel
    angle = np.arctan2(v, u) + 0.7 * side
    return np.array([np.cos(angle), np.sin(angle)])


class VisualServo:
    """Runs visual servoing in a work cell until the marker is at its target.

    Attributes:
        state: State of the servoing; its estimate of the image Jacobian persists between
            targets.
    """

    def __init__(self, cell: WorkCell, law: ServoStep):
        """Prepare servoing.

        Args:
            cell: Work cell with the arm, the camera and the person.
            law: Step of visual servoing.
        """
        self._cell, self._law, self._config = cell, law, law.config
        self._override_time = 0.0  # time during which a person guided the end effector [s]
        self.state = law.initial_state(cell.joints)

    def servo_to(self, target: ServoTarget) -> float:
        """Bring the marker to the target, and probe until the target is known well enough.

        Returns:
            Duration [s].

        Raises:
            HiddenMarkerError: The marker stays undetected.
            MissedGraspError: The timeout is over, or the predicted error above the object
                stays too large.
        """
        begun, start, config = self._cell.time, self._clock, self._config
        self.state = self._law.restarted(self.state, begun, self._cell.loop_state.safety)
        for k in range(config.max_probes):
            # If the camera is not known well, the gripper first passes a higher point. After
            # the first probe, this point is also shifted sideways, to alternating sides.
            self._read()
            if self._law.uncertainty(self.state, target) > config.object_error:
                aside = config.probe_aside * min(k, 1) * _towards_middle(target.item, (-1) ** k)
                height = self._law.probe_height(self.state, target)
                item = config.within(target.item + aside)
                self._pass(replace(target, item=item, raised=height), start)
            reached = self._converge(target, start)
            error = self._law.uncertainty(self.state, target)
            if error <= config.object_error:
                return reached - begun
        raise MissedGraspError(
            f"visual servoing: after {config.max_probes} probes the end effector may still be "
            f"{1e3 * error:.1f} mm off the object; {1e3 * config.object_error:.1f} mm are "
            "allowed. Check that the camera does not move and the marker is in view."
        )

    def hold(self, target: ServoTarget, duration: float) -> None:
        """Keep the end effector at its place in the image while a person moves the null space.

        Args:
            target: Target reached before.
            duration: Duration [s].
        """
        end = self._cell.time + duration
        # New images improve the camera estimate, but must not move the target during the hold.
        # A turn by the person still moves the target.
        self._read()
        held = replace(target, kept_camera=self.state.camera)
        self.state = replace(
            self.state,
            wanted_orientation=self.state.goal_orientation,
            held=MarkerConsistency(tolerance=self._config.marker_tolerance),
        )
        while self._cell.time < end:
            self._step(held)
        self.state = replace(self.state, held=None)

    def error(self, target: ServoTarget) -> float:
        """Distance of the marker from its target [px]; NaN if the marker is not detected."""
        return self._law.pixel_error(self.state, self._read(), target)

    def orientation(self, unturned: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
        """Orientation of the end effector aligned with the object, turned by the person.

        Args:
            unturned: Orientation to use if the gripper is not aligned with an object.
        """
        wanted = self.state.wanted_orientation
        return quaternion.multiply(
            self.state.drawn.turn, unturned if wanted is None else wanted
        )

    def _pass(self, target: ServoTarget, start: float) -> None:
        """Step until marker and height are near the target, in any orientation."""
        self.state = replace(self.state, last_detection=self._cell.time)
        while not self._near(target, self._config.probe_tolerance):
            self._step_within(target, start)

    def _converge(self, target: ServoTarget, start: float) -> float:
        """Step until marker, height and orientation have stayed at the target.

        Returns:
            Time of arrival [s].
        """
        cell, config, law = self._cell, self._config, self._law
        reached = cell.time
        self.state = replace(self.state, last_detection=reached)
        while cell.time - reached < config.dwell:
            self._step_within(target, start)
            turned = law.turn_error(self.state, cell.pose, target) < config.turn_tolerance
            if not (turned and self._near(target, config.tolerance)):
                reached = cell.time
        return reached

    def _near(self, target: ServoTarget, tolerance: float) -> bool:
        """True if the marker is within a tolerance [px] of its target, at the right height.

        The result is False while a person's drawing keeps the end effector away.
        """
        reading = self._read()
        height = float(reading.pose.position[2] - target.above.position[2])
        at_height = abs(height - target.raised) < self._config.height_tolerance
        on_target = self._law.pixel_error(self.state, reading, target) < tolerance
        return at_height and on_target and not self.state.drawn.away

    def _step_within(self, target: ServoTarget, start: float) -> None:
        """Take a step; raise if the timeout is over or the marker stays undetected."""
        if self._law.out_of_view(self.state, self._cell.time):
            self.state = replace(self.state, detected=False)
        self._step(target)
        if self.state.drawn.away:
            self.state = replace(self.state, last_detection=self._cell.time)
            return
        config, spent = self._config, self._clock - start
        if self._cell.time - self.state.last_detection > config.occlusion_timeout:
            raise HiddenMarkerError(
                f"visual servoing: the end effector's marker {self._law.marker} was not "
                f"detected for {config.occlusion_timeout:.0f} s. Remove what hides it, or move "
                "the object nearer to the middle of the image."
            )
        if spent > config.timeout:
            raise MissedGraspError(
                f"visual servoing: after {spent:.0f} s the marker is still "
                f"{self.error(target):.1f} px from its target (NaN: not detected)."
            )

    def _step(self, target: ServoTarget) -> None:
        """Take one step and execute its command."""
        cell, clock = self._cell, self._cell.task_time
        result, self.state = self._law.step(self.state, self._read(), target)
        if result.remark:
            cell.tell(result.remark)
        explained = result.approach == 0
        columns = vision_columns(*result[:4], self.state.drawn)
        cell.execute(
            result.command, result.goals.position, explained=explained, columns=columns
        )
        if self.state.drawn.away:
            self._override_time += cell.task_time - clock

    def _read(self) -> CellReading:
        """Present reading of the cell; also updates the state from the newest image."""
        reading = self._cell.reading
        self.state = self._law.observed(self.state, reading)
        return reading

    @property
    def _clock(self) -> float:
        """Task time, without the time in which a person guided the end effector [s]."""
        return self._cell.task_time - self._override_time
