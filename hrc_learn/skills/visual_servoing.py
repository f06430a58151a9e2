"""Image-based visual servoing to an object with an uncalibrated camera.

`ServoStep` is a pure step `(state, reading, target) -> (command, state)` that calls the
adaptive controller; `VisualServo` runs it in a work cell until the marker is at its target.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import (
    AdaptiveController,
    Command,
    ControllerState,
    Distances,
    Goals,
    Observation,
    SafetyState,
)
from hrc_learn.controller.joint_path import changed_rate
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraEstimator, CameraSpread
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.protocols import HumanInput
from hrc_learn.skills.drawn_goals import DrawnGoals, DrawnGoalsState
from hrc_learn.skills.marker_sensor import MarkerConsistency, MarkerObservation, SeenFeature
from hrc_learn.skills.servo_target import ServoTarget, VisualServoConfig
from hrc_learn.skills.visual_skill import MarkerAngle
from hrc_learn.skills.work_cell import MissedGraspError, WorkCell
from hrc_learn.vision.camera_model import IMAGE_SIZE

# Fractions of the probe height. They are tried in turn until the marker's target pixel at that
# height is well within the image.
_PROBE_FRACTIONS = np.array([1.0, 0.75, 0.5])
# Largest predicted error above the object with which the gripper turns for the object [m]. With
# a larger error, the camera's estimated orientation may be entirely wrong.
_LOST = 0.03
_NOT_SEEN = np.full(2, np.nan)
_NOT_FOUND = SeenFeature(_NOT_SEEN, np.nan)


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoReading:
    """Measurements, and requests of the person, for one step of visual servoing."""

    time: float
    """Time [s]."""
    dt: float
    """Time until the next step [s]."""
    joints: Float[Tensor, " joints"]
    """Measured joint positions [rad]."""
    pose: Pose
    """Pose of the end effector."""
    markers: MarkerObservation
    """Markers in the newest image."""
    human: HumanInput
    """Input of the person."""
    return_speed: float
    """Highest speed at which the null space returns to its posture [rad/s]."""
    distances: Distances | None = None
    """Distances from people that the controller keeps; None: people are not tracked."""

    @property
    def effort(self) -> Float[np.ndarray, " joints"]:
        """Null-space effort of the person on each joint [N m]."""
        return self.human.effort(len(self.joints))

    @property
    def image_joints(self) -> Float[Tensor, " joints"]:
        """Joint positions when the newest image was taken [rad]."""
        return self.joints if self.markers.joints is None else self.markers.joints


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """State of visual servoing between two steps."""

    controller: ControllerState
    """State of the controller, with its estimate of the image Jacobian."""
    drawn: DrawnGoalsState
    """A person's drawing and turn."""
    camera: Float[Tensor, "13"]
    """Estimate of the camera and its marker (see `jacobian.perspective`)."""
    image_jacobian: Float[np.ndarray, "2 6"]
    """Estimated image Jacobian at the pose of the newest image [px/m, px/rad]."""
    chosen_turn: float | None = None
    """Turn chosen for the present target [rad]; None: none so far."""
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
    """Test that the marker moves with the held end effector; None: servoing does not hold."""
    posture_gain_scale: float = 1.0
    """Scale of the speed at which the null space returns, 0 while a person pushes it."""


class ServoCommand(NamedTuple):
    """Result of one step of visual servoing."""

    command: Command
    """Command of the controller."""
    goals: Goals
    """Goals of the controller."""
    feature: Float[np.ndarray, "2"]
    """Pixel of the marker that was used; NaN: none [px]."""
    approach: float
    """Fraction of a joint-space approach in the command, 0 to 1."""
    remark: str
    """Message to the person; empty: none."""

    def columns(self, drawn: DrawnGoalsState) -> dict[str, Any]:
        """Columns of the log."""
        command, region = self.command, self.goals.position
        return {
            "feature": self.feature,
            "target": self.goals.vision.target.numpy(),
            "image_jacobian": command.image_jacobian.numpy(),
            "weight_norm": float(command.weight_norm),
            "potential": float(command.potential),
            "potential_rate": float(command.potential_rate),
            "vision_activation": float(command.vision_level),
            "approach": self.approach,
            "region": torch.cat([region.centre, region.half_size]).numpy(),
            "drawn": bool(drawn.active),
            "turn": quaternion.log(drawn.turn).numpy(),
        }


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
            refusal: Function that returns why the arm cannot go to a pose requested by a
                person, as a text for that person; empty if it can.

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
        )

    def observed(self, state: ServoState, reading: ServoReading) -> ServoState:
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
        self, state: ServoState, reading: ServoReading, target: ServoTarget
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
        self, state: ServoState, reading: ServoReading, target: ServoTarget
    ) -> float:
        """Distance of the marker from its target [px]; NaN if the marker is not detected."""
        pixel = self.tool_target(state, target).pixel(state.camera, reading.pose)
        return float(np.linalg.norm(self.feature(reading) - pixel))

    def uncertainty(self, state: ServoState, target: ServoTarget) -> float:
        """Predicted error above the object: standard deviation in the horizontal plane [m]."""
        spread: CameraSpread = state.controller.estimator.spread()
        return self.tool_target(state, target).uncertainty(spread, state.image_jacobian)

    def turn_error(self, state: ServoState, pose: Pose, target: ServoTarget) -> float:
        """Angle between the end effector's orientation and the wanted one [rad]."""
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

    def feature(self, reading: ServoReading) -> Float[np.ndarray, "2"]:
        """Pixel of the end effector's marker [px]; NaN if the marker is not detected."""
        return reading.markers.features.get(self.marker, _NOT_FOUND).pixel

    def _visible_feature(
        self, state: ServoState, reading: ServoReading
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
        self, state: ServoState, reading: ServoReading, target: ServoTarget
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
        self, state: ServoState, reading: ServoReading, target: ServoTarget
    ) -> tuple[Goals, ServoState, str]:
        """Goals of the controller, next state, and message to the person (empty: none).

        The goals combine the target, the resting posture and the drawing of the person.
        """
        target = self._oriented(state, target, state.goal_orientation)
        if state.arrived:
            # A person's pull, or a turn for the object, may move the joints far from the
            # posture. The approach must not start again then, even with the marker out of view.
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
    """Direction 40 degrees to one side (1 or -1) of that to the middle of the image."""
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
            MissedGraspError: The timeout is over, the marker stays undetected, or the predicted
                error above the object stays too large.
        """
        begun, start, config = self._cell.time, self._clock, self._config
        self.state = self._law.restarted(self.state, begun, self._cell.loop_state.safety)
        for k in range(config.max_probes):
            # If the camera is not known well, the gripper first passes a point higher up, and
            # after the first probe aside, to either side in turn.
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
            f"{1e3 * error:.1f} mm off the object, more than {1e3 * config.object_error:.1f}: "
            "check that the camera stands still and the marker is in view."
        )

    def hold(self, target: ServoTarget, duration: float) -> None:
        """Keep the end effector at its place in the image while a person moves the null space.

        Args:
            target: Target reached before.
            duration: Duration [s].
        """
        end = self._cell.time + duration
        # The camera estimate keeps learning, but must not move the target during the hold. A
        # turn by the person still moves the target.
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
        """Orientation of the end effector for the object, turned further by the person.

        Args:
            unturned: Orientation of an end effector that is not turned for an object.
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
            raise MissedGraspError(
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
        columns = result.columns(self.state.drawn)
        cell.execute(
            result.command, result.goals.position, explained=explained, columns=columns
        )
        if self.state.drawn.away:
            self._override_time += cell.task_time - clock

    def _read(self) -> ServoReading:
        """Present reading of the cell; also updates the state from the newest image."""
        cell = self._cell
        reading = ServoReading(
            time=cell.time,
            dt=cell.config.dt,
            joints=cell.joints,
            pose=cell.pose,
            markers=cell.observation,
            human=cell.human_input,
            return_speed=cell.config.return_speed,
            distances=cell.distances,
        )
        self.state = self._law.observed(self.state, reading)
        return reading

    @property
    def _clock(self) -> float:
        """Task time, without the time in which a person guided the end effector [s]."""
        return self._cell.task_time - self._override_time
