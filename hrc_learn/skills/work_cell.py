"""A work cell: arm, gripper, camera and person, driven by one control loop."""

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hrc_learn.controller import Command, Distances, SafetyConfig
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmReading,
    ArmRequest,
    FollowPath,
    MoveJoints,
    TrackPose,
)
from hrc_learn.controller.joint_path import JointPaths, changed_rate, deviation_ratio
from hrc_learn.controller.null_space_motion import Clearance
from hrc_learn.controller.task_pace import TaskPace
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import Arm as ArmModel
from hrc_learn.kinematics import GraspedBox
from hrc_learn.log import Event, StepLog
from hrc_learn.protocols import Arm, ArmState, Gripper, Human, HumanInput
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.arm_motion import StraightLine
from hrc_learn.skills.marker_sensor import (
    DelayedDetection,
    FeatureSensor,
    LatencyConfig,
    MarkerObservation,
)
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.skills.step_report import (
    NO_VISION,
    PersonFeedback,
    contact_force,
    separation_columns,
    step_columns,
)

# Longest time for the joints to return at the end of a path [s].
_LONGEST_RETURN = 5.0
# Distance of the end effector from its path at which an unknown object holds it [m]: five times
# that of an arm of 1 m whose servos lag by 0.03 rad, as at the speed of transfers.
_HELD = 0.15
# Time at the end of a straight line in which the pose error decays at the rate `pose_gain` [s].
_SETTLING_TIME = 0.4
# Longest total time for which a straight line waits for a lagging end effector [s]: the goal
# may be out of reach.
_LONGEST_LAG = 5.0
# `_AVERAGED`: number of torque readings that are averaged. `_GETTING_UNDER_WAY`: number of
# steps until the arm has overcome friction.
_AVERAGED, _GETTING_UNDER_WAY = 5, 25
# `_LEAVING`: time after a search for contact in which contacts are still expected [s]: the
# fingers open and the gripper retreats. `_COMING_TO_REST`: longest time for a stopped arm to
# come to rest [s].
_LEAVING, _COMING_TO_REST = 1.0, 1.0
_STILL = torch.zeros(6, dtype=torch.float64)


class TaskFailedError(RuntimeError):
    """A task failed; the message says in which phase and why."""


Mishap = Literal[
    "object not detected", "marker occluded", "missed grasp", "dropped object", "blocked path"
]
"""Kinds of failures from which a job recovers."""


class MissedGraspError(TaskFailedError):
    """A grasp failed; another attempt may succeed."""

    mishap: Mishap = "missed grasp"


class HiddenMarkerError(MissedGraspError):
    """The end effector's marker stayed undetected."""

    mishap = "marker occluded"


class StoppedByPersonError(TaskFailedError):
    """A person or a contact has stopped the arm; the arm is at rest."""


class BlockedPathError(TaskFailedError):
    """A planned motion would collide, or leave the limits of the arm."""


@dataclass(frozen=True, kw_only=True)
class WorkCellConfig(ArmLoopConfig):
    """Settings of the control loop and of its camera."""

    detect_every: int = 4
    """Control steps between two detections while markers are tracked."""
    keep_image_every: int = 40
    """Control steps between two images kept for the recording; 0: no images are kept."""
    latency: LatencyConfig = field(default_factory=LatencyConfig)
    """Delay and loss of the camera's images."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_settings(self, positive=["detect_every"], not_negative=["keep_image_every"])


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptImage:
    """An image kept for the recording."""

    time: float
    """Time at which the image was taken [s]."""
    image: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CellReading:
    """Measurements, and requests of the person, for one control step."""

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


class WorkCell:
    """Control loop of a work cell: read, command, let time pass, detect, log.

    `ArmLoop` computes the commands. This class connects it to drivers, a clock, a camera, a
    person and a log. Skills move the arm through a work cell and need not know any drivers. A
    callable lets time pass: it steps a simulator, or waits for real hardware.

    Attributes:
        chain: Kinematics and hand of the arm.
        config: Settings of the loop.
        gripper: Driver of the gripper.
        state: Newest reading of the arm.
        loop_state: State of the control loop: safety filter, pace, null space, path.
        human: Person near the arm; may be replaced between two steps.
        human_input: Newest input of the person, with a smoothed null-space effort.
        observation: Newest detection of markers that has arrived.
        load: Object in the gripper; it keeps its distance from people, too. None: no object.
        tracked_markers: Markers detected every `detect_every` steps; empty: no markers.
        region: Position region of the last command, if it came from the adaptive controller;
            else None.
        plan: Joint path being followed [rad]; None: no path.
        log: Columns of every step so far, and the phases of the task.
        remarks: Messages to the person, with their times [s].
        images: Images kept for the recording.
    """

    load: GraspedBox | None
    state: ArmState
    _reading: ArmReading

    def __init__(
        self,
        *,
        chain: ArmModel,
        arm: Arm,
        gripper: Gripper,
        sensor: FeatureSensor | None = None,
        human: Human,
        advance: Callable[[float], None],
        config: WorkCellConfig | None = None,
        on_phase: Callable[[str, float], None] = lambda phase, time: None,
        rng: np.random.Generator | None = None,
        clearance: Clearance | None = None,
        watch: PersonWatch | None = None,
    ):
        """Connect the parts.

        Args:
            chain: Kinematics and hand of the arm.
            arm: Driver of the arm.
            gripper: Driver of its gripper.
            sensor: Fixed camera with its marker detector; None if the task needs no camera.
            human: Person near the arm.
            advance: Function that lets a given time pass [s].
            config: Settings of the loop.
            on_phase: Function that is called with the name of each phase of the task and its
                start time [s].
            rng: Random generator that decides which images are lost.
            clearance: Function from joint positions [rad] to the distance of the arm from
                itself and its surroundings [m]; None: a push can move the arm anywhere within
                its limits.
            watch: Source of the distances from tracked people; the arm slows down or waits near
                people. None: people are not tracked.
        """
        self.config = config or WorkCellConfig()
        self.chain, self.gripper, self.human = chain, gripper, human
        self._arm, self._advance, self._on_phase = arm, advance, on_phase
        self._watch, self.load = watch, None
        loop_config = replace(self.config, safety=self.watchful(self.config.safety))
        self._loop = ArmLoop(chain, loop_config, clearance)
        self._feedback = PersonFeedback(chain)
        self._markers = DelayedDetection(
            sensor, self.config.latency, self.config.dt, rng or np.random.default_rng(0)
        )
        self.observation = MarkerObservation()
        self.tracked_markers: Collection[int] = ()
        self.region: PositionRegion | None = None
        self.plan: Float[np.ndarray, "steps joints"] | None = None
        self.log = StepLog()
        self.images: list[KeptImage] = []
        self.remarks: list[Event] = []
        self._stopping = False
        # Contacts are expected until this time, because the task searches for a contact [s].
        self._contact_expected = -math.inf
        state = arm.read()
        asked = human.read(state)
        self.human_input = replace(asked, nullspace_input=np.zeros(len(chain.joint_names)))
        self._sense(state, self.human_input)
        self.loop_state = self._loop.initial_state(
            self.joints, state.time, torch.from_numpy(state.joint_velocity.copy())
        )

    # Readings.

    @property
    def time(self) -> float:
        """Clock of the arm [s]."""
        return self.state.time

    @property
    def joints(self) -> Float[Tensor, " joints"]:
        """Measured joint positions [rad]."""
        return self._reading.joint_position

    @property
    def pose(self) -> Pose:
        """Pose of the end effector, from the measured joints."""
        return self._reading.pose

    @property
    def jacobian(self) -> Float[Tensor, "6 joints"]:
        """Geometric Jacobian of the end effector, at the measured joints."""
        return self._reading.jacobian

    @property
    def distances(self) -> Distances | None:
        """Distances from people that a safety filter keeps; None: people are not tracked."""
        return None if self._reading.people is None else self._reading.people.distances

    @property
    def reading(self) -> CellReading:
        """Measurements and requests that a camera-based control law needs for its next step."""
        return CellReading(
            time=self.time,
            dt=self.config.dt,
            joints=self.joints,
            pose=self.pose,
            markers=self.observation,
            human=self.human_input,
            return_speed=self.config.return_speed,
            distances=self.distances,
        )

    @property
    def pace(self) -> TaskPace:
        """Pace of the task; people near the arm, and pauses, slow it down."""
        return self.loop_state.pace

    @property
    def task_time(self) -> float:
        """Time spent on the task [s], without the time lost to people and pauses."""
        return float(self.pace.time)

    def watchful(self, safety: SafetyConfig) -> SafetyConfig:
        """Settings of a safety filter, changed to keep the distance from tracked people."""
        return safety if self._watch is None else self._watch.watchful(safety)

    # Messages and images.

    def begin_phase(self, phase: str) -> None:
        """Begin another phase of the task, and log it as an event."""
        self.log.event(self.time, phase)
        self._on_phase(phase, self.time)

    def tell(self, words: str) -> None:
        """Show a message to the person near the arm."""
        self.remarks.append(Event(self.time, words))

    def detect(self, ids: Collection[int] | None = None) -> None:
        """Take an image and detect markers in it; the result may arrive late, or be lost.

        Args:
            ids: Markers to detect; None: all.
        """
        self._markers.detect(self.time, self.joints, ids)
        self.observation = self._markers.newest(self.time) or self.observation

    def wait_for_detection(self) -> MarkerObservation:
        """Hold still until an image taken after this call has arrived; return its markers."""
        now = self.time
        self.detect()
        while self.observation.time < now:
            self.hold_pose(self.config.detect_every * self.config.dt)
            self.detect()
        return self.observation

    # Motions.

    def step(self, joint_velocity: Float[Tensor, " joints"]) -> None:
        """Send a joint velocity [rad/s] through the safety filter, and let one step pass."""
        self._act(MoveJoints(joint_velocity=joint_velocity))

    def execute(
        self,
        command: Command,
        region: PositionRegion,
        *,
        explained: bool = True,
        columns: dict[str, Any] = NO_VISION,
    ) -> None:
        """Send a command of the adaptive controller, which has its own safety filter.

        Args:
            command: Command of the controller.
            region: Region of the end effector's position.
            explained: Tell the person how much the safety filter reduces a push.
            columns: Columns of the controller for the log.
        """
        self._act(command, explained=explained, region=region, columns=columns)

    def track_pose(self, goal: Pose, twist: Float[Tensor, "6"]) -> None:
        """Track a moving pose for one step; the null space yields to the person.

        Args:
            goal: Pose that the end effector should have.
            twist: Velocity of this pose (linear [m/s], angular [rad/s]).
        """
        self._act(TrackPose(pose=goal, twist=twist))

    def hold_pose(self, duration: float) -> None:
        """Hold the pose of the end effector for a duration [s]; the null space yields."""
        self._settle(self.pose, duration)

    def move_straight(self, goal: Pose, speed: float = 0.15) -> None:
        """Move the end effector to a pose on a straight line, and let it settle.

        The motion slows down while the end effector lags behind, for example at a joint limit
        to which a person pushed the arm. This makes the motion at most 5 s longer.

        Args:
            goal: Pose at the end.
            speed: Mean speed [m/s].
        """
        line, passed, lag, rate = StraightLine(self.pose, goal, speed), 0.0, 0.0, 1.0
        while passed < line.duration:
            before = self.task_time
            pose, twist = self._track_line(line, passed, rate)
            behind = float(deviation_ratio(self.pose.twist_to(pose), twist))
            wanted = 2.0 - behind if lag < _LONGEST_LAG else 1.0
            passed += rate * (self.task_time - before)
            lag += (1.0 - rate) * self.config.dt
            rate = float(changed_rate(rate, wanted, self.config.dt))
        self._settle(goal, _SETTLING_TIME)

    def move_until_contact(
        self, goal: Pose, speed: float = 0.02, force: float = 12.0
    ) -> Pose | None:
        """Move on a straight line until the end effector meets something.

        The motion waits while a person pushes the null space: friction then changes with the
        direction of the joint motion, and the change would look like a contact.

        Args:
            goal: Pose at the end, if nothing is met.
            speed: Mean speed [m/s]. Choose a low speed: after the contact, the arm presses
                until it has stopped.
            force: Contact force against the motion that counts as a contact [N]. The force is
                measured relative to its value after the arm got under way, because the estimate
                also contains friction and an unknown load.

        Returns:
            Pose of the end effector at the contact; None if there was no contact, or if the arm
            does not estimate external torques.

        Raises:
            TaskFailedError: The null space was pushed for longer than `longest_wait`.
        """
        along = goal.position - self.pose.position
        along = (along / along.norm().clamp(min=1e-9)).numpy()
        felt: deque[float] = deque(maxlen=_AVERAGED)
        before: deque[Pose] = deque(maxlen=_AVERAGED)
        free, moving, waited = None, 0, 0.0
        line, begun = StraightLine(self.pose, goal, speed), self.task_time
        while (passed := self.task_time - begun) < line.duration:
            self._contact_expected = self.time + _LEAVING
            if self.loop_state.pushed:
                self._feedback.note("task_waits", mention=True)
                self.track_pose(line.at(passed)[0], _STILL)
                begun, moving = self.task_time - passed, 0
                waited += self.config.dt
                busy = "while the gripper searched for a contact, the null space was pushed"
                self._give_up_after(waited, busy, "release the arm")
                continue
            self._track_line(line, passed)
            force_now = contact_force(self.jacobian, self.state)
            felt.append(0.0 if force_now is None else -float(force_now @ along))
            before.append(self.pose)
            # After a wait for people, the arm has to overcome friction again.
            moving = moving + 1 if self.pace.at_full_speed else 0
            if moving <= _AVERAGED + _GETTING_UNDER_WAY:
                free = None
                continue
            # Friction opposes the motion, so the reference is the force while moving.
            now = float(np.mean(felt))
            free = now if free is None else free
            if now - free > force:
                # The arm moved on while readings were averaged: the contact began at before[0].
                self.hold_pose(_AVERAGED * self.config.dt)
                return before[0]
        return None

    def follow_path(
        self, path: Float[np.ndarray, "steps joints"], until: Callable[[], bool] = lambda: False
    ) -> int:
        """Move the joints along a path sampled at the control step, yielding to the person.

        While a person pushes, the end effector keeps to the poses of the path, and the null
        space yields. The path waits where an arm that was pushed aside cannot follow: before a
        collision, before a singularity of the path, and where the joints might be unable to
        return. After a push, the joints return to the path, even at the end of the path, or
        stay aside (`WorkCellConfig.after_push`).

        Args:
            path: Joint positions [rad].
            until: Function called before each step; the motion ends if it returns True.

        Returns:
            Number of samples that were tracked.

        Raises:
            BlockedPathError: The arm was pushed aside and cannot return to the waiting path
                without a collision.
            TaskFailedError: A person holds the arm aside while the path waits, or blocks the
                arm, for longer than `longest_wait`; or the arm does not follow the path.
        """
        if not len(path):
            return 0
        paths = JointPaths.of(self.chain, [path], self.config.dt)
        request = FollowPath(paths=paths, path=torch.tensor(0))
        self.loop_state = self._loop.path_law.begin(self.loop_state, self.joints, request)
        self.plan = path
        try:
            while not self.loop_state.path.finished:
                if until():
                    return int(self.loop_state.path.progress)
                self._act(request)
            deadline = self.time + _LONGEST_RETURN
            while (
                self.config.after_push == "return"
                and (self.loop_state.aside and not self.loop_state.pushed)
                and self.time < deadline
            ):
                self._act(request)
        finally:
            self.plan = None
        return len(path)

    def _track_line(
        self, line: StraightLine, passed: float, rate: float = 1.0
    ) -> tuple[Pose, Float[Tensor, "6"]]:
        """Take one step along a line; return the pose and the twist that were tracked.

        Args:
            line: The line.
            passed: Time since the start of the line [s].
            rate: Speed relative to the line's own speed, 0 to 1.
        """
        now = min(passed + self.config.dt, line.duration)
        pose, _ = line.at(now)
        _, twist = line.at(min(now + self.config.command_delay, line.duration))
        twist = rate * self.pace.speed_override * twist
        self.track_pose(pose, twist)
        return pose, twist

    def _settle(self, goal: Pose, duration: float) -> None:
        for _ in range(round(duration / self.config.dt)):
            self.track_pose(goal, _STILL)

    # One step.

    def _act(
        self,
        request: ArmRequest,
        *,
        explained: bool = True,
        region: PositionRegion | None = None,
        columns: dict[str, Any] = NO_VISION,
    ) -> None:
        """Turn a request into a joint velocity, send it, let one step pass, and read again.

        Args:
            request: Requested motion.
            explained: Tell the person how much the safety filter reduces a push.
            region: Region of the controller's command.
            columns: Further columns for the log.
        """
        reading = self._reading
        velocity, self.loop_state, report = self._loop.act(self.loop_state, reading, request)
        self._give_up_if_blocked()
        self.region = region
        self._feedback.note_step(report, filtered=explained)
        if (watched := reading.people) is not None:
            separation, scale = self.config.safety.separation, float(self.pace.people_scale)
            columns = columns | separation_columns(watched, separation, velocity, scale)
        feedback = self._feedback.end_step(
            self.state,
            self.jacobian,
            pushed=reading.explain,
            person_distance=None if watched is None else float(watched.nearest),
            pace=float(self.pace.people_scale),
            load=self.load,
            contact_expected=self.time < self._contact_expected,
        )
        effort = self.human_input.effort(len(self.joints))
        self.log.append(
            **step_columns(self.state, velocity, effort, report, feedback), **columns
        )
        self._arm.command(velocity.numpy())
        self.human.tell(feedback)
        self._advance(self.config.dt)
        self._read()

    def _read(self) -> None:
        """Read the arm, its person and the tracked people; take images; stop if requested."""
        state = self._arm.read()
        self._markers.remember(state.time, state.joint_position)
        asked = self.human.read(state)
        self._sense(state, asked)
        before = self.pace.speed_override
        self.loop_state, limitations = self._loop.observe(self.loop_state, self._reading)
        self._feedback.note_limitations(limitations)
        smooth = self.config.damping * self.loop_state.null_velocity
        self.human_input = replace(asked, nullspace_input=smooth.numpy())
        self.observation = self._markers.newest(self.time) or self.observation
        self._take_images()
        if self._stopping:
            return
        if asked.stop:
            self._come_to_rest()
            raise StoppedByPersonError(f"stopped: {asked.stop}")
        self._tell_of_pause(asked.pause, before)
        held = float(self.loop_state.path.held)
        self._give_up_after(held, "while its path waited, the arm was held aside", "release it")

    def _sense(self, state: ArmState, asked: HumanInput) -> None:
        """Store a reading of the arm with its kinematics and the people near it."""
        joints = torch.from_numpy(state.joint_position)
        people = None
        if self._watch is not None:
            people = self._watch.look(state.time, joints, self.load)
        push, way = asked.effort(len(joints)), self.config.way_making
        pose, jacobian = self.chain.forward_and_jacobian(joints)
        self.state = state
        self._reading = ArmReading(
            joint_position=joints,
            pose=pose,
            jacobian=jacobian,
            nullspace_input=torch.from_numpy(push),
            pause=torch.tensor(asked.pause),
            load=None if self.load is None else joints.new_tensor(self.load.end),
            people=people,
            explain=bool(push.any()) and (way is None or way.expert),
        )

    def _take_images(self) -> None:
        """Detect markers and keep images at their configured intervals."""
        step = len(self.log)
        if self.tracked_markers and step % self.config.detect_every == 0:
            self.detect(self.tracked_markers)
        every = self.config.keep_image_every
        if every and step % every == 0 and (image := self._markers.image()) is not None:
            self.images.append(KeptImage(time=self.time, image=image))

    def _give_up_if_blocked(self) -> None:
        """Raise if people block the arm for too long, or if objects block it or its return."""
        blocked, path = "a person has been in the way of the arm", self.loop_state.path
        self._give_up_after(float(self.pace.blocked_for), blocked, "clear its path")
        off = float((path.pose.position - self.pose.position).norm())
        on_path = path.followed and not path.finished and not self.loop_state.aside
        if on_path and off > _HELD:
            raise TaskFailedError(f"the arm is {off:.2f} m off its path: an object holds it.")
        if path.direct_return.blocked:
            raise BlockedPathError(
                "path: the arm was pushed aside and cannot return without a collision with its "
                "surroundings."
            )

    def _give_up_after(self, waited: float, blocked: str, cure: str) -> None:
        """Raise if the task has waited for longer than `longest_wait`.

        Args:
            waited: Time for which the task has waited [s].
            blocked: Reason for the wait, as the start of the message.
            cure: Action of a person that ends the wait.
        """
        if waited > self.config.longest_wait:
            raise TaskFailedError(
                f"{blocked} for {waited:.0f} s: {cure}, or raise longest_wait."
            )

    def _come_to_rest(self) -> None:
        """Brake until the arm is at rest, whatever the person asks for meanwhile."""
        self._stopping, deadline = True, self.time + _COMING_TO_REST
        self.step(torch.zeros_like(self.joints))
        while self.loop_state.safety.velocity.any() and self.time < deadline:
            self.step(torch.zeros_like(self.joints))
        self._stopping = False

    def _tell_of_pause(self, pause: bool, before: Tensor) -> None:
        """Notify the person that the task waits or goes on."""
        full, now = self.config.speed, self.pace.speed_override
        if pause and before == full:
            self.tell("The task waits.")
        if now == full and before < full:
            self.tell("The task goes on.")
