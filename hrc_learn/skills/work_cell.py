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
    ConstraintReport,
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
    joint_line,
    kept_clear,
    null_space_giving_way,
    null_space_slowdown,
    task_rate,
)
from hrc_learn.skills.marker_sensor import (
    DelayedChannel,
    LatencyConfig,
    MarkerObservation,
    MarkerSensor,
)
from hrc_learn.skills.null_space_yielding import (
    CHANGE_OF_RATE,
    FAR_ASIDE,
    LONGEST_RETURN,
    NARROW,
    NullSpaceYielding,
    YieldingConfig,
    changed_rate,
    share_of_motion,
    smallest_singular_value,
)
from hrc_learn.skills.person_feedback import (
    PersonFeedback,
    contact_force,
    filter_hindrance,
    share_kept,
)
from hrc_learn.skills.person_watch import BESIDE_PEOPLE, PersonWatch
from hrc_learn.vision import angle, centre
from hrc_learn.viz import Event, StepLog

# What skills ask of the place they work in, whether simulated or real.


class TaskFailedError(RuntimeError):
    """A task could not be carried out; the message says at which phase and why."""


class MissedGraspError(TaskFailedError):
    """A grasp failed; another attempt may succeed."""


class StoppedByPersonError(TaskFailedError):
    """The person beside the arm has stopped it, or something has met it; it is at rest."""


class BlockedPathError(TaskFailedError):
    """A planned motion would collide or leave the limits of the arm."""


HINDRANCE_COLUMNS = HINDRANCES
"""Names of the components of the log's column "hindered"."""

SAFETY_COLUMNS = INTERVENTIONS
"""Names of the components of the log's column "safety"."""

# At the end of a straight line, for the pose error to decay by pose_gain [s].
_SETTLING_TIME = 0.4
STUCK = 2.0
"""Time after which a path that waits for the joints is gone back [s]."""
# After which they go back straight [s]; and to how many samples of the path that is tried.
_LONGEST_WAIT, _OTHERS = 20.0, 20
# Distance of the end effector from its path for the path to wait, and time by which servos lag
# [m, s]: half the deviation that a push may cause, and twice the lag of an arm 20 ms late.
_ON_PATH, _SERVO_LAG = 0.001, 0.06
# Metres that a radian of the end effector counts for: a length of hand and object.
_METRES_PER_RADIAN = 0.1
# Postures on the straight way back to a path that are checked: 0.1 rad apart at most.
_CHECKED = 50
# Readings of the torque that are averaged, and steps in which an arm gets under way: friction
# keeps it back at first.
_FELT, _GETTING_UNDER_WAY = 5, 25
# Part of the task that constraints take beyond rounding.
_SLOWED = 1e-3
# For which what was felt may still be met: the fingers open, the hand leaves it. And in which
# an arm that is stopped comes to rest [s].
_LEAVING, _COMES_TO_REST = 1.0, 1.0
# Images taken less than this apart are one image, whose age was read from another clock; and
# for how long joint positions are remembered, longer than any camera's delay [s].
_SAME_IMAGE, _REMEMBERED = 1e-3, 1.0
# How much faster the arm might close in on people who do not hold it back [m/s]: what the
# program leaves unused is rounding. And pace below which it stands still.
_SPARE, _STANDS = 1e-3, 0.01

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
        observation: Newest detection of markers that has arrived.
        watched: Where people beside the arm may be; None: nobody watches for them.
        load: What the arm holds, which people must not be hit with either.
        task_time: The clock without what the task waited for people, or was paused by them [s].
        human_input: What the person asks for now.
        tracked_markers: Markers detected every `detect_every` steps; empty: no image is taken.
        log: Columns of every step so far, and the phases of the task.
        remarks: What was said to the person beside the arm, and when [s].
        region: To which the last command of a controller led the end effector; None: the last
            command was of no controller.
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
        # Of the path that the next step follows; of most steps none.
        self._path_joints = self._no_path = np.full(len(chain.joint_names), _NAN)
        self.images: list[KeptImage] = []
        self.remarks: list[Event] = []
        self.region: PositionRegion | None = None
        self._arm, self._sensor, self._human = arm, sensor, human
        self._advance, self._on_phase = advance, on_phase
        self._clearance = clearance
        safety = self.config.safety
        self._watch, self.load = watch, None
        self._safety = SafetyFilter(chain.limits, self.watchful(safety))
        self._room = SafetyFilter(
            chain.limits, replace(safety, margin=safety.margin + self.config.limit_room)
        )
        self._ticks = 0
        self._reading = _Reading(chain, self._room, arm.read())
        self._feedback, self._pushing = PersonFeedback(chain), False
        self._yielding = NullSpaceYielding(
            chain, self.config.dt, self.config, self._feedback.hindrances
        )
        asked = human.read(self.state)
        self.human_input = replace(asked, nullspace_input=self._yielding.nullspace_input)
        self.observation = MarkerObservation()
        self._channel = DelayedChannel(self.config.latency, rng or np.random.default_rng(0))
        # When the newest image was taken, and the joint positions of the time before now.
        self._taken = -math.inf
        remembered = round(_REMEMBERED / self.config.dt)
        self._passed: deque[tuple[float, np.ndarray]] = deque(maxlen=remembered)
        self._guard = self._safety.initial_state(self.joints)
        # Share of the wanted motion that people beside the arm leave, and the sum of it.
        self._pace, self.task_time = 1.0, self.time
        # For how long it has stood still before somebody [s].
        self._stood = 0.0
        # Share of the task's motion that a person who pauses it leaves, and whether the arm
        # comes to rest for good.
        self._going, self._stopping = self.config.speed, False
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
        found = {} if self._sensor is None else self._sensor.corners(ids)
        taken = self.time - (0.0 if self._sensor is None else self._sensor.age)
        # A camera that is slower than the detection gives the same image again: no new one.
        if abs(taken - self._taken) > _SAME_IMAGE:
            self._taken = taken
        self._channel.send(
            MarkerObservation(
                time=self._taken,
                joints=self._joints_at(self._taken),
                pixels={id: centre(corners) for id, corners in found.items()},
                angles={id: angle(corners) for id, corners in found.items()},
            )
        )
        self._receive()

    def _joints_at(self, time: float) -> Float[Tensor, " joints"]:
        """Where the joints were at a time [s], as far back as is remembered [rad]."""
        if time >= self.time or not self._passed:
            return self.joints
        times, joints = zip(*self._passed, (self.time, self.joints.numpy()), strict=True)
        columns = np.stack(joints, axis=-1)
        return torch.tensor([np.interp(time, times, column) for column in columns])

    def wait_for_detection(self) -> MarkerObservation:
        """Hold still until an image taken from now on has arrived; what was detected in it."""
        now = self.time
        self.detect()
        while self.observation.time < now:
            self.hold_pose(self.config.detect_every * self.config.dt)
            self.detect()
        return self.observation

    def step(self, joint_velocity: Float[Tensor, " joints"], goal: Pose | None = None) -> None:
        """Send a command through the safety filter, and let one step pass.

        Args:
            joint_velocity: The command [rad/s].
            goal: Where the end effector should be now, for the log.
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
        self._send(safe, safety=report.flags.numpy(), goal_position=position, **_NO_VISION)

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
        velocity = self._going * command.joint_velocity
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
            region=torch.cat([region.centre, region.half_size]).numpy(),
            drawn=drawn,
            turn=np.zeros(3) if turn is None else turn,
        )

    def track_pose(
        self,
        goal: Pose,
        twist: Float[Tensor, "6"],
        drift: Float[Tensor, " joints"] | None = None,
    ) -> bool:
        """One step of tracking a moving pose; the null space yields to the person.

        Args:
            goal: Where the end effector should be.
            twist: Its velocity (linear [m/s], angular [rad/s]).
            drift: Joint velocity whose null-space part is wanted besides [rad/s].

        Returns:
            Whether the arm, pushed aside, would meet something if the pose went on.
        """
        joints = self.joints
        # Where the arm will be when it follows: the null space is that of then.
        J = self.chain.jacobian(joints + self.config.command_delay * self._guard.velocity)
        correction = self.config.pose_gain * self.pose.twist_to(goal)
        null_velocity = self._yielding.null_velocity
        if drift is not None:
            null_velocity = null_velocity + drift
        task = task_rate(J, twist + correction)
        null = null_projection(J, null_velocity)
        if drift is not None:
            # A person may push the way that the path leads: both together bend the null space.
            slowdown = null_space_slowdown(self.chain, joints, null)
            self._feedback.hindrances.note("speed", float(slowdown))
            null = null * slowdown
        waits = False
        if self._clearance is not None and bool(null.any()):
            clear = kept_clear(joints, task, null, self._clearance, self.config.clearance)
            distance, kept = 100 * float(clear.distance), share_kept(null, clear.null)
            self._feedback.hindrances.note("obstacle", kept, distance=distance)
            null, waits = clear.null, bool(clear.waits)
        null = self._within_limits(J, task, null)
        self.step(task + null, goal)
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
            self._feedback.hindrances.note_limits(null, kept, task + null, room)
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
        line, begun = StraightLine(self.pose, goal, speed), self.task_time
        while (passed := self.task_time - begun) < line.duration:
            self._track_line(line, passed)
        self._settle(goal, _SETTLING_TIME)

    def _track_line(self, line: StraightLine, passed: float) -> None:
        """One step along a line of which so much time has passed [s]."""
        now = min(passed + self.config.dt, line.duration)
        pose, _ = line.at(now)
        _, twist = line.at(min(now + self.config.command_delay, line.duration))
        self.track_pose(pose, self._going * twist)

    def move_until_contact(
        self, goal: Pose, speed: float = 0.02, force: float = 12.0
    ) -> Pose | None:
        """Move on a straight line, and stop where something is met; where that was.

        Args:
            goal: Where to, if nothing is met.
            speed: Mean speed [m/s]: what is met gives way by as much as it takes to stop.
            force: Of the contact against the motion [N]. Friction and an unknown load are felt
                too, so what counts is the change since the motion began.

        Returns:
            Pose of the end effector when it met something; None if it met nothing, also for an
            arm that does not tell external torques.
        """
        along = goal.position - self.pose.position
        along = (along / along.norm().clamp(min=1e-9)).numpy()
        felt: deque[float] = deque(maxlen=_FELT)
        before: deque[Pose] = deque(maxlen=_FELT)
        free, moving = None, 0
        line, begun = StraightLine(self.pose, goal, speed), self.task_time
        while (passed := self.task_time - begun) < line.duration:
            self._contact_expected = self.time + _LEAVING
            self._track_line(line, passed)
            felt.append(-float(self._contact_force() @ along))
            before.append(self.pose)
            # An arm that waits for somebody gets under way anew.
            moving = moving + 1 if self._is_undisturbed() else 0
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

    def follow_path(
        self, path: Float[np.ndarray, "steps joints"], until: Callable[[], bool] = lambda: False
    ) -> int:
        """Move the joints along a path sampled at the control step, yielding to the person.

        While a person pushes, the end effector keeps to the poses of the path, and the null
        space yields. Where the arm, pushed aside, cannot follow, the path waits: where it would
        meet something, and before a singularity of the path, at which nobody can push the arm
        off it. When they let go the joints go back to the path, at the end of it too, or stay
        beside it (`WorkCellConfig.after_push`).

        Args:
            path: Joint positions [rad].
            until: Asked before each step whether to stop there.

        Returns:
            Number of samples that were tracked.

        Raises:
            BlockedPathError: If the arm, pushed aside, does not find back to a path that waits.
        """
        dt = self.config.dt
        velocity = np.gradient(path, dt, axis=0) if len(path) > 1 else np.zeros_like(path)
        narrow = smallest_singular_value(self.chain, torch.from_numpy(path.copy())) < NARROW
        progress, rate, waited = 0.0, 1.0, 0.0
        if len(path):
            self._yielding.begin(torch.from_numpy(path[0]) - self.joints)
        while progress <= len(path) - 1:
            if until():
                return int(progress)
            now = rate * self._going
            later = progress + now * self.config.command_delay / dt
            goal, wanted = _between(path, progress), now * _between(velocity, later)
            here, ahead = int(progress), int(progress + CHANGE_OF_RATE / dt)
            behind = self._track_joints(
                goal, wanted, yields=not bool(narrow[here]), returns=rate <= 0
            )
            if not self._yielding.aside:
                waited = 0.0
            # Who pushes again and again must not hold it up for good.
            elif not self._yielding.pushed and self._is_undisturbed():
                waited = max(waited + (1.0 - 2.0 * max(rate, 0.0)) * dt, 0.0)
            # The null space that led aside further back leads back there as well.
            backs = waited > STUCK and progress > 0
            if not backs and self._yielding.aside:
                stops = bool(narrow[here : ahead + 1].any()) or self._astray(goal)
                behind = math.inf if stops else behind
            rate = float(changed_rate(rate, 2.0 - behind, dt, -1 if backs else 1))
            if rate <= 0:
                self._feedback.hindrances.mention("task_waits")
            progress = max(progress + rate * self._pace * self._going, 0.0)
            if waited > _LONGEST_WAIT:
                progress = self._go_straight_back(path, progress)
                waited = 0.0
        if len(path) and self.config.after_push == "return":
            end = torch.from_numpy(path[-1])
            deadline = self.time + LONGEST_RETURN
            yielding = self._yielding
            while yielding.aside and not yielding.pushed and self.time < deadline:
                self._track_joints(end, torch.zeros_like(end))
        return len(path)

    def _astray(self, goal: Float[Tensor, " joints"]) -> bool:
        """Whether joints aside might not find back to a path that goes on.

        The null space leads to another posture for the same pose, if that is nearer by then,
        and no task is kept near a singularity that the path itself does not pass.
        """
        if (
            self.config.after_push == "return"
            and float((goal - self.joints).norm()) > FAR_ASIDE
        ):
            return True
        ahead = self.joints + CHANGE_OF_RATE * self._guard.velocity
        near = smallest_singular_value(self.chain, torch.stack([self.joints, ahead]))
        return bool((near < NARROW).any())

    def _go_straight_back(
        self, path: Float[np.ndarray, "steps joints"], progress: float
    ) -> float:
        """To a path that waits, where no motion of the null space leads.

        Another posture for the same pose may lie between. The end effector leaves its path.

        Args:
            path: Joint positions [rad].
            progress: Sample at which it waits.

        Returns:
            The sample at which the arm is then: that one if its way there is clear of what is
            around it, else the nearest to the arm of which it is.

        Raises:
            BlockedPathError: If the arm would meet something on the way to any sample.
        """
        others = range(0, len(path), max(1, len(path) // _OTHERS))
        far = {k: float(np.linalg.norm(path[k] - self.joints.numpy())) for k in others}
        for sample in (progress, *sorted(far, key=far.__getitem__)):
            goal = _between(path, sample)
            way = joint_line(self.joints, goal, self.config.return_speed, self.config.dt)
            if self._is_clear(way):
                break
        else:
            raise BlockedPathError(
                "path: the arm was pushed aside and finds no way back that is clear of what is "
                "around it."
            )
        self._yielding.aside, pose, passed = False, self.chain.forward(goal), 0.0
        while passed <= len(way) - 1:
            q = way[int(passed)]
            passed += self._going
            self._path_joints = q.numpy()
            self._feedback.hindrances.note("too_far", 0.0)
            self.step(self.config.pose_gain * (q - self.joints), pose)
        return float(sample)

    def _is_clear(self, way: Float[Tensor, "steps joints"]) -> bool:
        """Whether the arm comes no nearer to what is around it than at the ends of a way."""
        if self._clearance is None:
            return True
        distance = self._clearance(way[:: max(1, len(way) // _CHECKED)])
        ends = distance[[0, -1]].min()
        return not bool((distance < ends.clamp(max=self.config.clearance)).any())

    def _track_joints(
        self,
        goal: Float[Tensor, " joints"],
        velocity: Float[Tensor, " joints"],
        yields: bool = True,
        returns: bool = False,
    ) -> float:
        """One step along a path of the joints, or of the end effector while they are aside.

        Args:
            goal: Where on the path [rad].
            velocity: Along it [rad/s].
            yields: Whether the person can push the joints off it here.
            returns: Whether joints that were pushed off it go back in any case.

        Returns:
            How far the end effector then is from its goal, as a ratio to what is allowed;
            above 1 the path has to wait.
        """
        error = goal - self.joints
        self._path_joints = goal.numpy()
        back = self._yielding.way_back(
            self.joints, error, self.jacobian, yields=yields, returns=returns
        )
        pose = self.chain.forward(goal)
        if back is None:
            if not yields:
                self._feedback.hindrances.note("narrow_path", 0.0)
            self.step(velocity + self.config.pose_gain * error, pose)
            return 0.0
        twist = self.chain.jacobian(goal + self.config.command_delay * velocity) @ velocity
        if self.track_pose(pose, twist, velocity + back):
            return math.inf
        return float(behind_path(self.pose.twist_to(pose), twist))

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
        # It may drop at once; it rises as paths get under way.
        self._pace = min(pace, self._pace + self.config.dt / CHANGE_OF_RATE)
        self.task_time += self._pace * self._going * self.config.dt
        self._stood = self._stood + self.config.dt if self._pace < _STANDS else 0.0
        if self._stood > self.config.longest_wait:
            raise TaskFailedError(
                f"somebody has been in the way of the arm for {self._stood:.0f} s: free its "
                "way, or let it wait longer (longest_wait)."
            )

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
            self._feedback.hindrances.note(cause, kept)

    def _note_controller(self, command: Command, approach: float) -> None:
        """Note what the adaptive controller takes from a push, beside its own gradient."""
        if not self._pushing:
            return
        wanted = self._yielding.null_velocity - command.xi_q / self.config.damping
        wanted = null_projection(self.jacobian, wanted)
        bounds = self._safety.velocity_bounds(self.joints)
        self._feedback.hindrances.note_limits(wanted, command.null_velocity, wanted, bounds)
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
            pace=self._pace * self._going,
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
            path_joints=self._path_joints,
            gripper=self.state.gripper_width,
            followed=told.followed if told.pushed else _NAN,
            hindered=_hindered(told),
            **self._watched_columns(velocity),
            **columns,
        )
        self._path_joints = self._no_path
        self._arm.command(velocity.numpy())
        self._human.tell(told)
        self._advance(self.config.dt)
        self._ticks += 1
        self._passed.append((self.time, self.state.joint_position))
        self._reading = _Reading(self.chain, self._room, self._arm.read())
        self._look()
        asked = self._human.read(self.state)
        way = self.config.way_making
        self._pushing = bool(asked.nullspace_input.any()) and (way is None or way.expert)
        push = smooth = self._nullspace_input(asked)
        if push.any() or self._yielding.pushed:
            smooth = self._yielding.feel(push, self.joints, self._reading.room, self.jacobian)
        self.human_input = replace(asked, nullspace_input=smooth)
        self._receive()
        if self.tracked_markers and self._ticks % self.config.detect_every == 0:
            self.detect(self.tracked_markers)
        every = self.config.keep_image_every
        if self._sensor is not None and every and self._ticks % every == 0:
            self.images.append(KeptImage(time=self.time, image=self._sensor.read()))
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
        full = self.config.speed
        if asked.pause and self._going == full:
            self.tell("The task waits.")
        going = changed_rate(self._going, float(not asked.pause), self.config.dt)
        going = min(float(going), full)
        if going == full and self._going < full:
            self.tell("The task goes on.")
        self._going = going

    def _is_undisturbed(self) -> bool:
        """Whether nobody slows the task down or pauses it."""
        return self._pace == 1 and self._going == self.config.speed

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
            "pace": self._pace,
        }

    def _receive(self) -> None:
        self.observation = self._channel.newest(self.time) or self.observation


def _hindered(told: Feedback) -> Bool[np.ndarray, " hindrances"]:
    """What keeps the arm from following the person, in the order of `HINDRANCE_COLUMNS`."""
    if not told.reasons:
        return _UNHINDERED
    reasons = {reason.hindrance for reason in told.reasons}
    return np.array([hindrance in reasons for hindrance in HINDRANCE_COLUMNS])


def _between(samples: Float[np.ndarray, "steps joints"], at: float) -> Float[Tensor, " joints"]:
    """A path between two of its samples, or at its end."""
    k = min(int(at), len(samples) - 1)
    following = samples[min(k + 1, len(samples) - 1)]
    return torch.from_numpy(samples[k] + (at - k) * (following - samples[k]))


def people_bind(
    distances: Distances,
    sent: Float[Tensor, "*batch joints"],
    kept: ConstraintReport,
    safety: SafetyConfig,
) -> Bool[Tensor, "*batch"]:
    """Whether the arm was slowed down as it came as near to people as it may, or as it does not
    know where they are.

    Where only its own limits hold it back, a path must go on: it would wait for ever.

    Args:
        distances: From people.
        sent: To the arm [rad/s].
        kept: What keeping its limits took.
        safety: Of the filter, with constraints.
    """
    near = at_people(distances, sent, safety)
    return ~distances.known() | ~kept.solved | ((kept.slowed > _SLOWED) & near)


def at_people(
    distances: Distances, sent: Float[Tensor, "*batch joints"], safety: SafetyConfig
) -> Bool[Tensor, "*batch"]:
    """Whether a velocity takes the arm towards people as fast as it may.

    Args:
        distances: From people.
        sent: To the arm [rad/s].
        safety: Of the filter, with constraints.
    """
    assert safety.constraints is not None  # without them there are no limits to be met
    allowed = distances.closing_speed(safety.constraints, safety.separation)
    opening = torch.linalg.vecdot(distances.gradient, sent.unsqueeze(-2))
    return (allowed + opening <= _SPARE).any(-1)


def behind_path(
    off: Float[Tensor, "*batch 6"], twist: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch"]:
    """How far the end effector is from its path, as a ratio to what is allowed.

    Args:
        off: Motion to where it should be (linear [m], angular [rad]).
        twist: Of the path there (linear [m/s], angular [rad/s]).
    """
    return _size(off) / (_ON_PATH + _SERVO_LAG * _size(twist))


def _size(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Of a motion, its turn counted in metres [m]."""
    return twist[..., :3].norm(dim=-1) + _METRES_PER_RADIAN * twist[..., 3:].norm(dim=-1)
