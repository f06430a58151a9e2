"""A work cell: the place skills work in; arm, gripper, camera and person under one clock."""

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hrc_learn.controller import (
    INTERVENTIONS,
    Command,
    Distances,
    SafetyConfig,
    SafetyFilter,
    SafetyReport,
    WayMakingConfig,
    scale_null_space,
    way_making_velocity,
)
from hrc_learn.geometry import Pose
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import GraspedBox, SerialChain
from hrc_learn.log import Event, StepLog
from hrc_learn.protocols import (
    HINDRANCES,
    Arm,
    ArmState,
    Feedback,
    Gripper,
    Human,
    HumanInput,
)
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.arm_motion import (
    StraightLine,
    kept_clear,
    null_space_giving_way,
    null_space_slowdown,
    task_rate,
)
from hrc_learn.skills.failures import StoppedByPersonError, TaskFailedError
from hrc_learn.skills.marker_sensor import (
    DelayedDetection,
    LatencyConfig,
    MarkerObservation,
    MarkerSensor,
)
from hrc_learn.skills.null_space_yielding import (
    NullSpaceYielding,
    YieldingConfig,
    share_of_motion,
)
from hrc_learn.skills.pace import TaskPace, at_people, people_bind
from hrc_learn.skills.person_feedback import (
    Hindrances,
    PersonFeedback,
    contact_force,
    filter_hindrance,
    share_kept,
)
from hrc_learn.skills.person_watch import BESIDE_PEOPLE, PersonWatch

HINDRANCE_COLUMNS = HINDRANCES
"""Names of the components of the log's column "hindered"."""

SAFETY_COLUMNS = INTERVENTIONS
"""Names of the components of the log's column "safety"."""

# At the end of a straight line, for the pose error to decay by pose_gain [s].
_SETTLING_TIME = 0.4
# Readings of the torque that are averaged, and steps in which an arm gets under way: friction
# keeps it back at first.
_FELT, _GETTING_UNDER_WAY = 5, 25
# For which what was felt may still be met: the fingers open, the hand leaves it. And in which
# an arm that is stopped comes to rest [s].
_LEAVING, _COMES_TO_REST = 1.0, 1.0
_NAN = float("nan")
# Logged as the goal of steps without a path.
_NOWHERE = np.full(3, _NAN)
# Logged while the arm follows whoever leads it, or nobody does.
_UNHINDERED = np.zeros(len(HINDRANCE_COLUMNS), dtype=bool)
# Logged by steps in which no camera is in the loop.
_NO_VISION = {
    "feature": np.full(2, _NAN),
    "target": np.full(2, _NAN),
    "image_jacobian": np.full((2, 6), _NAN),
    "weight_norm": _NAN,
    "potential": _NAN,
    "potential_rate": _NAN,
    "vision_activation": _NAN,
    "approach": _NAN,
    "region": np.full(6, _NAN),
    "drawn": False,
    "turn": np.full(3, _NAN),
}


@dataclass(frozen=True, kw_only=True)
class WorkCellConfig(YieldingConfig):
    """How the loop runs."""

    dt: float = 0.01
    """Control step [s]."""
    detect_every: int = 4
    """Control steps from one detection to the next, while markers are tracked."""
    keep_image_every: int = 40
    """Control steps from one image kept for the recording to the next; 0: none is kept."""
    latency: LatencyConfig = field(default_factory=LatencyConfig)
    """Delay and loss of the camera's images."""
    command_delay: float = 0.01
    """From a command until the arm follows it, its servos' lag included [s]: velocities along a
    path are those of then. By default that of the simulated servos; real arms are later, by a
    network and a kernel's scheduler."""
    limit_room: float = 0.1
    """Distance from the margin of the joints' limits beyond which nobody can push the arm
    [rad]: of some centimetres of the end effector, which the task may need."""
    speed: float = 1.0
    """Share of its speed that the task is done with, as for a first run on a real arm, above 0
    to 1. Beside paths the null space is as fast as ever."""
    longest_wait: float = 300.0
    """For which the arm stands still before somebody until the task is given up [s]; of people
    who share a table, who go away some time."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Of the safety filter, which is told what the arm's driver can do."""
    way_making: WayMakingConfig | None = None
    """Whether the null space makes way by itself for people who are watched for, follows the
    person who pushes it, or both; None: it follows the person."""

    def __post_init__(self) -> None:
        if not 0 < self.speed <= 1:
            raise ValueError(f"speed must be in (0, 1], but is {self.speed}.")


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptImage:
    """An image kept for the recording."""

    time: float
    """[s]"""
    image: UInt8[np.ndarray, "height width 3"]


class _Reading:
    """Kinematics of one reading of the arm, computed when they are first asked for."""

    def __init__(self, chain: SerialChain, limits: SafetyFilter, state: ArmState):
        self._chain, self._limits, self.state = chain, limits, state
        self.joints = torch.from_numpy(state.joint_position)

    @cached_property
    def _transform_and_jacobian(self) -> tuple[Tensor, Tensor]:
        return self._chain.transform_and_jacobian(self.joints)

    @cached_property
    def pose(self) -> Pose:
        """Of the end effector."""
        return Pose.from_matrix(self._transform_and_jacobian[0])

    @property
    def jacobian(self) -> Float[Tensor, "6 joints"]:
        """Of the end effector."""
        return self._transform_and_jacobian[1]

    @cached_property
    def room(self) -> tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]]:
        """Lowest and highest velocities that leave the task its room [rad/s]."""
        return self._limits.velocity_bounds(self.joints)


class WorkCell:
    """Runs the control loop: read the human input, command, let time pass, detect, log.

    Skills act through this class and know protocols only. Time passes by a callable that is
    passed in: a simulator's physics, or a clock that waits for real hardware.

    Attributes:
        chain: Kinematics of the arm.
        gripper: Its gripper's driver.
        human: The person beside the arm; may be another from the next step on.
        observation: Newest detection of markers that has arrived.
        watched: Where people beside the arm may be; None: nobody watches for them.
        load: What the arm holds, which people must not be hit with either.
        pace: How fast people let the task go on.
        yielding: How the null space yields to the person, and goes back.
        clearance: Distance of an arm at given joint positions from itself and from what stands
            around [m]; None: people can push it anywhere within its limits.
        human_input: What the person asks for now.
        tracked_markers: Markers detected every `detect_every` steps; empty: no image is taken.
        log: Columns of every step so far, and the phases of the task.
        remarks: What was said to the person beside the arm, and when [s].
        region: To which the last command of a controller led the end effector; None: the last
            command was of no controller.
        plan: Path that the joints follow [rad]; None: they follow none.
        images: Images kept for the recording.
    """

    def __init__(
        self,
        *,
        chain: SerialChain,
        arm: Arm,
        gripper: Gripper,
        sensor: MarkerSensor | None = None,
        human: Human,
        advance: Callable[[float], None],
        config: WorkCellConfig | None = None,
        on_phase: Callable[[str, float], None] = lambda phase, time: None,
        rng: np.random.Generator | None = None,
        clearance: Callable[[Float[Tensor, "*batch joints"]], Float[Tensor, "*batch"]]
        | None = None,
        watch: PersonWatch | None = None,
    ):
        """Connect the parts.

        Args:
            chain: Kinematics of the arm.
            arm: Its driver.
            gripper: Its gripper's driver.
            sensor: The fixed camera with its marker detector; None where a task needs none.
            human: The person beside the arm.
            advance: Lets a given time pass [s].
            config: How the loop runs.
            on_phase: Called with the name of each phase of the task and its start time [s].
            rng: Decides which images are lost.
            clearance: Distance of an arm at given joint positions from itself and from what
                stands around [m]; None: people can push it anywhere within its limits.
            watch: For people, before whom the arm slows down, waits, and goes on where it
                was; None: nobody does.
        """
        self.config = config or WorkCellConfig()
        self.chain = chain
        self.gripper = gripper
        self.tracked_markers: Collection[int] = ()
        self.log = StepLog()
        # Logged as the joints of the path by steps without one.
        self._no_path = np.full(len(chain.joint_names), _NAN)
        self.images: list[KeptImage] = []
        self.remarks: list[Event] = []
        self.region: PositionRegion | None = None
        self.plan: Float[np.ndarray, "steps joints"] | None = None
        self._arm = arm
        self.human = human
        self._advance, self._on_phase = advance, on_phase
        self.clearance = clearance
        safety = self.config.safety
        self._watch, self.load = watch, None
        self._safety = SafetyFilter(chain.limits, self.watchful(safety))
        self._room = SafetyFilter(
            chain.limits, replace(safety, margin=safety.margin + self.config.limit_room)
        )
        self._ticks = 0
        self._reading = _Reading(chain, self._room, arm.read())
        self._feedback, self._pushing = PersonFeedback(chain), False
        self.yielding = NullSpaceYielding(
            chain, self.config.dt, self.config, self._feedback.hindrances
        )
        asked = human.read(self.state)
        self.human_input = replace(asked, nullspace_input=self.yielding.nullspace_input)
        self.observation = MarkerObservation()
        self._markers = DelayedDetection(
            sensor, self.config.latency, self.config.dt, rng or np.random.default_rng(0)
        )
        self._guard = self._safety.initial_state(self.joints)
        self.pace = TaskPace(
            time=self.time,
            dt=self.config.dt,
            speed=self.config.speed,
            longest_wait=self.config.longest_wait,
        )
        # Whether a person has stopped the task, and the arm is coming to rest.
        self._stopping = False
        # Until when something may be met that the task has felt for [s].
        self._contact_expected = -math.inf
        self._look()

    load: GraspedBox | None

    @property
    def joints(self) -> Float[Tensor, " joints"]:
        """Measured joint positions [rad]."""
        return self._reading.joints

    @property
    def pose(self) -> Pose:
        """Pose of the end effector, from the measured joints."""
        return self._reading.pose

    @property
    def jacobian(self) -> Float[Tensor, "6 joints"]:
        """Geometric Jacobian of the end effector, at the measured joints."""
        return self._reading.jacobian

    @property
    def state(self) -> ArmState:
        """Newest reading of the arm."""
        return self._reading.state

    @property
    def hindrances(self) -> Hindrances:
        """What keeps the arm from following the person in this step."""
        return self._feedback.hindrances

    @property
    def commanded_velocity(self) -> Float[Tensor, " joints"]:
        """Of the last step [rad/s]."""
        return self._guard.velocity

    @property
    def time(self) -> float:
        """Clock of the arm [s]."""
        return self.state.time

    def begin_phase(self, phase: str) -> None:
        """Begin another phase of the task: an event of the log."""
        self.log.event(self.time, phase)
        self._on_phase(phase, self.time)

    def tell(self, words: str) -> None:
        """Say something to the person beside the arm."""
        self.remarks.append(Event(self.time, words))

    def detect(self, ids: Collection[int] | None = None) -> None:
        """Take an image and detect markers in it, all by default; it may be late, or lost."""
        self._markers.detect(self.time, self.joints, ids)
        self._receive()

    def wait_for_detection(self) -> MarkerObservation:
        """Hold still until an image taken from now on has arrived; what was detected in it."""
        now = self.time
        self.detect()
        while self.observation.time < now:
            self.hold_pose(self.config.detect_every * self.config.dt)
            self.detect()
        return self.observation

    def step(
        self,
        joint_velocity: Float[Tensor, " joints"],
        goal: Pose | None = None,
        *,
        path_joints: Float[Tensor, " joints"] | None = None,
    ) -> None:
        """Send a command through the safety filter, and let one step pass.

        Args:
            joint_velocity: The command [rad/s].
            goal: Where the end effector should be now, for the log.
            path_joints: Where the joints should be on a path of theirs [rad], for the log.
        """
        safe, self._guard, report = self._safety.step(
            self._guard,
            self.joints,
            self._share * joint_velocity,
            self.config.dt,
            jacobian=self.jacobian,
            distances=self.distances,
        )
        self._keep_pace(self.jacobian @ joint_velocity, safe, report)
        self._note_filter(joint_velocity, safe, report)
        position = _NOWHERE if goal is None else goal.position.numpy()
        self.region = None
        self._send(
            safe,
            safety=report.flags.numpy(),
            goal_position=position,
            path_joints=self._no_path if path_joints is None else path_joints.numpy(),
            **_NO_VISION,
        )

    def execute(
        self,
        command: Command,
        target: Float[np.ndarray, "2"],
        feature: np.ndarray,
        approach: float = 0.0,
        *,
        region: PositionRegion,
        drawn: bool = False,
        turn: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Execute one command of the adaptive controller, which has its own safety filter.

        Args:
            command: Of the controller.
            target: Where the feature should be [px].
            feature: Where it is; NaN if it is not detected [px].
            approach: Fraction of a joint-space approach in the command, 0 to 1.
            region: Of the end effector's position.
            drawn: Whether a person has drawn that region, or a target in it.
            turn: What a person has added to the planned orientation, as a rotation vector
                [rad]; None: nothing.
        """
        velocity = self.pace.led * command.joint_velocity
        self._guard = self._safety.initial_state(self.joints, velocity)
        self.region = region
        self._keep_pace(command.twist, command.joint_velocity, command.safety)
        self._note_controller(command, approach)
        self._send(
            velocity,
            safety=command.safety.flags.numpy(),
            feature=feature,
            target=target,
            image_jacobian=command.image_jacobian.numpy(),
            weight_norm=float(command.weight_norm),
            potential=float(command.potential),
            potential_rate=float(command.potential_rate),
            vision_activation=float(command.vision_level),
            approach=approach,
            goal_position=_NOWHERE,
            path_joints=self._no_path,
            region=torch.cat([region.centre, region.half_size]).numpy(),
            drawn=drawn,
            turn=np.zeros(3) if turn is None else turn,
        )

    def track_pose(
        self,
        goal: Pose,
        twist: Float[Tensor, "6"],
        drift: Float[Tensor, " joints"] | None = None,
        *,
        push_share: float = 1.0,
        path_joints: Float[Tensor, " joints"] | None = None,
    ) -> bool:
        """One step of tracking a moving pose; the null space yields to the person.

        Args:
            goal: Where the end effector should be.
            twist: Its velocity (linear [m/s], angular [rad/s]).
            drift: Joint velocity whose null-space part is wanted besides [rad/s].
            push_share: What is left of the person's own, 0 to 1.
            path_joints: Where the joints should be on a path of theirs [rad], for the log.

        Returns:
            Whether the arm, pushed aside, would meet something if the pose went on.
        """
        joints = self.joints
        # Where the arm will be when it follows: the null space is that of then.
        J = self.chain.jacobian(joints + self.config.command_delay * self._guard.velocity)
        correction = self.config.pose_gain * self.pose.twist_to(goal)
        null_velocity = push_share * self.yielding.null_velocity
        if drift is not None:
            null_velocity = null_velocity + drift
        task = task_rate(J, twist + correction)
        null = null_projection(J, null_velocity)
        if drift is not None:
            # A person may push the way that the path leads: both together bend the null space.
            slowdown = null_space_slowdown(self.chain, joints, null)
            self.hindrances.note("speed", float(slowdown))
            null = null * slowdown
        waits = False
        if self.clearance is not None and bool(null.any()):
            clear = kept_clear(joints, task, null, self.clearance, self.config.clearance)
            distance, kept = 100 * float(clear.distance), share_kept(null, clear.null)
            self.hindrances.note("obstacle", kept, distance=distance)
            null, waits = clear.null, bool(clear.waits)
        null = self._within_limits(J, task, null)
        self.step(task + null, goal, path_joints=path_joints)
        return waits

    def _within_limits(
        self,
        J: Float[Tensor, "6 joints"],
        task: Float[Tensor, " joints"],
        null: Float[Tensor, " joints"],
    ) -> Float[Tensor, " joints"]:
        """The null-space velocity with which the task has room before the joints' limits."""
        gives_way = null_space_giving_way(J, task, null, *self._reading.room)
        if not torch.equal(gives_way, null):
            gives_way = gives_way * null_space_slowdown(self.chain, self.joints, gives_way)
        kept = gives_way
        if bool(gives_way.any()):
            bounds = self._safety.velocity_bounds(self.joints)
            kept = scale_null_space(task, gives_way, *bounds)
        if self._pushing:
            room = self._reading.room
            self.hindrances.note_limits(null, kept, task + null, room)
        return kept

    def hold_pose(self, duration: float) -> None:
        """Keep the end effector where it is for a while [s], yielding to the person."""
        self._settle(self.pose, duration)

    def move_straight(self, goal: Pose, speed: float = 0.15) -> None:
        """Move the end effector to a pose on a straight line, and let it settle.

        Args:
            goal: Where to.
            speed: Mean speed [m/s].
        """
        line, begun = StraightLine(self.pose, goal, speed), self.pace.time
        while (passed := self.pace.time - begun) < line.duration:
            self._track_line(line, passed)
        self._settle(goal, _SETTLING_TIME)

    def _track_line(self, line: StraightLine, passed: float) -> None:
        """One step along a line of which so much time has passed [s]."""
        now = min(passed + self.config.dt, line.duration)
        pose, _ = line.at(now)
        _, twist = line.at(min(now + self.config.command_delay, line.duration))
        self.track_pose(pose, self.pace.led * twist)

    def move_until_contact(
        self, goal: Pose, speed: float = 0.02, force: float = 12.0
    ) -> Pose | None:
        """Move on a straight line, and stop where something is met; where that was.

        It waits while a person pushes the null space: friction turns with the joints, and that
        feels like a contact.

        Args:
            goal: Where to, if nothing is met.
            speed: Mean speed [m/s]: what is met gives way by as much as it takes to stop.
            force: Of the contact against the motion [N]. Friction and an unknown load are felt
                too, so what counts is the change since the motion began.

        Returns:
            Pose of the end effector when it met something; None if it met nothing, also for an
            arm that does not tell external torques.

        Raises:
            TaskFailedError: Somebody has pushed the null space for too long (`longest_wait`).
        """
        along = goal.position - self.pose.position
        along = (along / along.norm().clamp(min=1e-9)).numpy()
        felt: deque[float] = deque(maxlen=_FELT)
        before: deque[Pose] = deque(maxlen=_FELT)
        still = torch.zeros(6, dtype=torch.float64)
        free, moving, waited = None, 0, 0.0
        line, begun = StraightLine(self.pose, goal, speed), self.pace.time
        while (passed := self.pace.time - begun) < line.duration:
            self._contact_expected = self.time + _LEAVING
            if self.yielding.pushed:
                self.hindrances.mention("task_waits")
                self.track_pose(line.at(passed)[0], still)
                begun, moving = self.pace.time - passed, 0
                waited += self.config.dt
                if waited > self.config.longest_wait:
                    raise TaskFailedError(
                        f"the null space was pushed for {waited:.0f} s while the hand felt for "
                        "a contact: let it go, or let the arm wait longer (longest_wait)."
                    )
                continue
            self._track_line(line, passed)
            felt.append(-float(self._contact_force() @ along))
            before.append(self.pose)
            # An arm that waits for somebody gets under way anew.
            moving = moving + 1 if self.pace.undisturbed else 0
            if moving <= _FELT + _GETTING_UNDER_WAY:
                free = None
                continue
            # Friction turns with the motion: what is felt under way is the reference.
            now = float(np.mean(felt))
            free = now if free is None else free
            if now - free > force:
                # As long as it took to be sure, the arm has gone on and pushed.
                self.hold_pose(_FELT * self.config.dt)
                return before[0]
        return None

    def _contact_force(self) -> Float[np.ndarray, "3"]:
        """Estimate of the force on the end effector [N]; zero if the arm tells none."""
        force = contact_force(self.jacobian, self.state)
        return np.zeros(3) if force is None else force

    def _settle(self, goal: Pose, duration: float) -> None:
        still = torch.zeros(6, dtype=torch.float64)
        for _ in range(round(duration / self.config.dt)):
            self.track_pose(goal, still)

    def watchful(self, safety: SafetyConfig) -> SafetyConfig:
        """Settings of a safety filter that keeps its distance from the people watched for."""
        if self._watch is None:
            return safety
        constraints = safety.constraints or BESIDE_PEOPLE
        separation = self.config.safety.separation
        return replace(safety, constraints=constraints, separation=separation)

    @property
    def distances(self) -> Distances | None:
        """From people, for a safety filter to keep; None: nobody watches for them."""
        return None if self.watched is None else self.watched.distances

    @property
    def _share(self) -> float:
        """Of its speed that people who come towards the arm leave it."""
        return 1.0 if self.watched is None else self.watched.share

    def _look(self) -> None:
        """Where people may be now."""
        if self._watch is None:
            self.watched = None
        else:
            self.watched = self._watch.look(self.time, self.joints, self.load)

    def _keep_pace(
        self,
        asked: Float[Tensor, "6"],
        sent: Float[Tensor, " joints"],
        report: SafetyReport,
    ) -> None:
        """Note how much of its twist people beside the arm left the task.

        Raises:
            TaskFailedError: Somebody has been in the way for too long.
        """
        distances, kept, pace = self.distances, report.constraints, 1.0
        if self._share < 1 or (
            distances is not None
            and kept is not None
            and bool(people_bind(distances, sent, kept, self._safety.config))
        ):
            pace = float(share_of_motion(asked, self.jacobian @ sent))
        self.pace.beside(pace)

    def _at_people(self, sent: Float[Tensor, " joints"]) -> bool:
        """Whether a velocity takes the arm towards people as fast as it may [rad/s]."""
        config, distances = self._safety.config, self.distances
        if distances is None or config.constraints is None:
            return False
        return bool(at_people(distances, sent, config))

    def _note_filter(
        self,
        wanted: Float[Tensor, " joints"],
        sent: Float[Tensor, " joints"],
        report: SafetyReport,
    ) -> None:
        """Note what the safety filter takes from the null-space part of a velocity [rad/s]."""
        if not self._pushing:
            return
        slowed = self._share < 1 or self._at_people(sent)
        cause = "person" if slowed else filter_hindrance(report)
        if cause is not None:
            J = self.jacobian
            kept = share_kept(null_projection(J, wanted), null_projection(J, sent))
            self.hindrances.note(cause, kept)

    def _note_controller(self, command: Command, approach: float) -> None:
        """Note what the adaptive controller takes from a push, beside its own gradient."""
        if not self._pushing:
            return
        wanted = self.yielding.null_velocity - command.xi_q / self.config.damping
        wanted = null_projection(self.jacobian, wanted)
        bounds = self._safety.velocity_bounds(self.joints)
        self.hindrances.note_limits(wanted, command.null_velocity, wanted, bounds)
        # A joint-space approach moves the null space as well, by an unknown part of it.
        if approach == 0:
            self._note_filter(command.null_velocity, command.joint_velocity, command.safety)

    def _told(self) -> Feedback:
        """What the person is told of this step."""
        return self._feedback.told(
            self.state,
            self.jacobian,
            pushed=self._pushing,
            person_distance=None if self.watched is None else self.watched.nearest,
            pace=self.pace.share,
            load=self.load,
            contact_expected=self.time < self._contact_expected,
        )

    def _send(self, velocity: Float[Tensor, " joints"], **columns) -> None:
        told = self._told()
        self.log.append(
            time=self.time,
            joint_position=self.state.joint_position,
            joint_velocity=self.state.joint_velocity,
            command_velocity=velocity.numpy(),
            nullspace_input=self.human_input.nullspace_input,
            gripper=self.state.gripper_width,
            followed=told.followed if told.pushed else _NAN,
            hindered=_hindered(told),
            **self._watched_columns(velocity),
            **columns,
        )
        self._arm.command(velocity.numpy())
        self.human.tell(told)
        self._advance(self.config.dt)
        self._ticks += 1
        self._markers.remember(self.time, self.state.joint_position)
        self._reading = _Reading(self.chain, self._room, self._arm.read())
        self._look()
        asked = self.human.read(self.state)
        way = self.config.way_making
        self._pushing = bool(asked.nullspace_input.any()) and (way is None or way.expert)
        push = smooth = self._nullspace_input(asked)
        if push.any() or self.yielding.pushed:
            smooth = self.yielding.feel(push, self.joints, self._reading.room, self.jacobian)
        self.human_input = replace(asked, nullspace_input=smooth)
        self._receive()
        if self.tracked_markers and self._ticks % self.config.detect_every == 0:
            self.detect(self.tracked_markers)
        every = self.config.keep_image_every
        if every and self._ticks % every == 0 and (image := self._markers.image()) is not None:
            self.images.append(KeptImage(time=self.time, image=image))
        self._wait_or_stop(asked)

    def _wait_or_stop(self, asked: HumanInput) -> None:
        """Do what a person asks of the task as a whole.

        Raises:
            StoppedByPersonError: They stop it; the arm is at rest by then.
        """
        if self._stopping:
            return
        if asked.stop:
            self._stopping, still = True, torch.zeros_like(self.joints)
            deadline = self.time + _COMES_TO_REST
            self.step(still)
            while self._guard.velocity.any() and self.time < deadline:
                self.step(still)
            self._stopping = False
            raise StoppedByPersonError(f"stopped: {asked.stop}")
        self.pace.lead(asked.pause, self.tell)

    def _nullspace_input(self, asked: HumanInput) -> Float[np.ndarray, " joints"]:
        """Of the person who pushes, and by which the arm makes way by itself [N m]."""
        way, distances = self.config.way_making, self.distances
        if way is None:
            return self._share * asked.nullspace_input
        push = asked.nullspace_input if way.expert else np.zeros_like(asked.nullspace_input)
        if way.automatic and distances is not None:
            push = push + self.config.damping * way_making_velocity(distances, way).numpy()
        return self._share * push

    def _watched_columns(self, velocity: Float[Tensor, " joints"]) -> dict[str, float]:
        """For the log: the sensed distance of people, and the protective one at this speed."""
        if self.watched is None:
            return {}
        near, separation = self.watched.distances, self.config.safety.separation
        needed = separation.protective_distance(
            -(near.gradient @ velocity), near.approach_speed
        )
        tightest = (near.distance - needed).argmin()
        return {
            "person_distance": self.watched.nearest,
            "person_age": self.watched.age,
            "protective_distance": float(needed[tightest]),
            "separation_margin": float((near.distance - needed)[tightest]),
            "pace": self.pace.beside_people,
        }

    def _receive(self) -> None:
        self.observation = self._markers.newest(self.time) or self.observation


def _hindered(told: Feedback) -> Bool[np.ndarray, " hindrances"]:
    """What keeps the arm from following the person, in the order of `HINDRANCE_COLUMNS`."""
    if not told.reasons:
        return _UNHINDERED
    reasons = {reason.hindrance for reason in told.reasons}
    return np.array([hindrance in reasons for hindrance in HINDRANCE_COLUMNS])
