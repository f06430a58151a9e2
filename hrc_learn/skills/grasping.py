"""Grasping an object with an uncalibrated camera, with recovery from failures.

    detect -> servo -> interact -> grasp -> lift
      ^         |                    |
      +---------+---- start over ----+

In "servo", the arm approaches in joint space and is then controlled by vision, as in the paper.
In "interact", servoing continues while a person pulls the elbow, for
`GraspJob.time_for_person`. Recoveries from failures are noted in the job:

- occluded marker of the end effector: the controller holds the end effector until the marker is
  detected again; after a timeout the arm goes home and starts over;
- undetected object: the arm waits, up to a timeout;
- missed grasp: the arm starts over from home.
"""

import copy
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.jacobian import CameraConfig, CameraEstimator
from hrc_learn.kinematics import GraspedBox, UnreachableError
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.marker_sensor import SeenFeature, longest_occlusion
from hrc_learn.skills.placing import GraspObject, Plan, Workplace
from hrc_learn.skills.visual_servoing import (
    ServoStep,
    ServoTarget,
    VisualServo,
    VisualServoConfig,
)
from hrc_learn.skills.visual_skill import OBJECT_FEATURE, VisualServoSkill
from hrc_learn.skills.work_cell import (
    BlockedPathError,
    Mishap,
    MissedGraspError,
    TaskFailedError,
    WorkCell,
)

OPEN, CLOSED = 0.08, 0.0
"""Commanded gripper widths [m]. `OPEN`: full stroke of the Franka hand; smaller hands open to
their own full stroke. `CLOSED`: zero, which squeezes an object between the fingers."""
JOINT_SPEED = 0.6
"""Largest joint speed between postures [rad/s]: about a quarter of the Panda's lowest limit."""
DESCENT_SPEED = 0.08
"""Mean speed of the last centimetres down to an object [m/s]."""
CLOSING_TIME = 0.7
"""Shortest time for the fingers to close and the grip to settle [s]."""
INTERACT = "interact"
"""Phase in which a person pulls the elbow aside."""

# Longest delay or occlusion that does not count as a recovery [s]: a few lost images.
_NEGLIGIBLE = 0.3

# Shortest time for the fingers to open before the arm leaves [s].
_OPENING_TIME = 0.3
# Timeout of a finger motion [s]: 3.2 s for the Franka Hand's full stroke at a quarter of its
# speed, half a second to start, and a margin.
_LONGEST_FINGER_MOTION = 4.0
# The fingers count as moved if their opening changed by more than `_FINGERS_MOVED` [m]. They
# count as at rest if the opening changes by less than a tenth of `_FINGERS_MOVED` within
# `_FINGERS_REST` [s]. Grippers report the opening at 50 Hz.
_FINGERS_MOVED, _FINGERS_REST = 0.002, 0.1
# Clearance to keep from objects [m]. It allows for the marker plate, which protrudes from the
# arm's capsules.
_PLATE_CLEARANCE = 0.06
# The clearance is checked at every fifth sample of a path: at `JOINT_SPEED`, the arm moves 3 cm
# between the checked samples.
_CHECK_EVERY = 5
# Number of joint-7 values tried for a pose requested by a person; a trial takes a millisecond.
_POSTURES = 9
# Largest distance of a joint from home that counts as at home [rad].
_AT_HOME = 0.05
UNMARKED = CameraConfig(pixel_noise=1.0, min_step=0.012, bump=6.0)
"""Settings for a tool without markers: its reference point is found within 1 px, and errors of
neighbouring images are alike. With a lower noise setting, the predicted error above the object
was three times the true error."""
# Settings of visual servoing for a tool without markers. Its reference point may be 0.4 m above
# the object, so the predicted error is larger than with a marker. Larger errors are allowed,
# since open fingers leave 15 mm on either side.
_UNMARKED_SERVO = {"tolerance": 3.0, "object_error": 0.004, "probe_aside": 120.0}
# `_PROBE_FRACTIONS`: fractions of the probe height (`VisualServoConfig.probe`) to try.
# `_PROBE_MARGIN`: required distance of the joints from their limits [rad], since the arm is
# slow close to a limit.
_PROBE_FRACTIONS, _PROBE_MARGIN = (1.0, 0.75, 0.5, 0.25), 0.1
# `_TABLE_RANGE`: uncertainty of the table height before the fingers touch the table [m].
# `_OBJECT_RANGE`: uncertainty after the touch [m].
_TABLE_RANGE, _OBJECT_RANGE = 0.05, 0.015


@dataclass(frozen=True, kw_only=True)
class GraspingConfig:
    """Settings of grasping."""

    servo: VisualServoConfig = field(default_factory=VisualServoConfig)
    """Settings of visual servoing."""
    controller: ControllerConfig = field(
        default_factory=lambda: ControllerConfig(
            drift_compensation_rate=10.0, command_delay=0.03
        )
    )
    """Settings of the adaptive controller; the high `drift_compensation_rate` compensates for
    the drift caused by 10 ms steps."""
    detection_timeout: float = 5.0
    """Give up after an object is undetected for this long [s]."""
    lift: float = 0.20
    """Height by which the Franka hand lifts an object [m]; it is scaled to other hands."""
    attempts: int = 3
    """Largest number of attempts, including attempts that fail before the fingers close."""

    unbounded = ("detection_timeout",)

    def __post_init__(self) -> None:
        check_settings(self, positive=("lift", "attempts"), not_negative=["detection_timeout"])


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """A failure from which the job recovered."""

    time: float
    """Time of the recovery [s]."""
    mishap: Mishap
    """Kind of failure."""
    what: str
    """Description of the failure and of the recovery."""


@dataclass(kw_only=True)
class GraspJob:
    """Grasp of one object, with its results."""

    item: GraspObject
    """Object to grasp."""
    time_for_person: float = 0.0
    """Time to keep servoing while a person pulls the elbow [s]."""
    servo_time: float = float("nan")
    """Duration of the last visual servoing [s]."""
    pixel_error: float = float("nan")
    """Distance of the end effector's marker from its target at the start of the descent
    [px]."""
    picked_up: Pose | None = None
    """Pose of the end effector at the grasp."""
    attempts: int = 1
    """Number of attempts so far."""
    recoveries: list[Recovery] = field(default_factory=list)
    """Recoveries from failures."""


class UndetectedObjectError(TaskFailedError):
    """The camera does not see the object."""


class Grasping:
    """Grasps objects: `grasp` runs the whole sequence, and the other methods are its steps.

    Attributes:
        servo: Visual servoing; its estimate of the image Jacobian persists between grasps.
    """

    def __init__(
        self,
        cell: WorkCell,
        workplace: Workplace,
        skill: VisualServoSkill,
        config: GraspingConfig | None = None,
        check: Callable[[Plan], None] = lambda plan: None,
    ):
        """Prepare grasping.

        Args:
            cell: Arm, gripper, camera and person.
            workplace: Hover pose above the table, region of the objects, and home. The hover
                pose sets the orientation of the end effector; in the simulator,
                `Workplace.approached` returns a workplace with the demonstrated orientation.
            skill: Learned image Jacobian and visual target.
            config: Settings of grasping.
            check: Function that raises if a plan must not be executed.

        Raises:
            ValueError: The skill has no visual target.
        """
        self._cell = cell
        self._workplace = workplace
        self._size = workplace.robot.hand_size
        if skill.target is None:
            raise ValueError(
                f"the skill has no visual target: its demonstrations lack {OBJECT_FEATURE}."
            )
        self._visual = skill.target
        config = config or GraspingConfig()
        servo = config.servo.scaled(self._size)
        servo = replace(servo, probe=_reachable_probe(workplace, servo.probe))
        servo = servo if skill.landmarks is None else replace(servo, **_UNMARKED_SERVO)
        self._config = config = replace(config, servo=servo)
        self._check = check
        # Estimated height of the table in the base frame, and its uncertainty [m].
        self._table = 0.0, self._size * _TABLE_RANGE
        controller = AdaptiveController(
            cell.chain,
            CameraEstimator(
                copy.deepcopy(skill.jacobian).double(),
                None if skill.landmarks is None else UNMARKED,
            ),
            Goals.at(workplace.hover().position, workplace.hover().orientation),
            config=replace(config.controller, safety=cell.watchful(cell.config.safety)),
        )
        law = ServoStep(
            controller, workplace.tool_marker, config.servo, skill.angle, self.refusal
        )
        self.servo = VisualServo(cell, law)

    def grasp(self, job: GraspJob) -> None:
        """Grasp an object and lift it, in at most `attempts` attempts.

        Args:
            job: Object, and record of the grasp.

        Raises:
            UndetectedObjectError: The object's marker stays undetected.
            MissedGraspError: All attempts failed.
        """
        self._cell.gripper.move(OPEN)
        while True:
            begun = self._cell.time
            target = self.locate(job.item)
            if (waited := self._cell.time - begun) > _NEGLIGIBLE:
                what = f"waited {waited:.1f} s for its marker"
                self.note(job, "object not detected", what)
            try:
                self._aim(job, target)
                self.close_on(job.item)
            except MissedGraspError as error:
                self.note(job, error.mishap, str(error))
                if job.attempts == self._config.attempts:
                    raise
                self.start_over()
                job.attempts += 1
            else:
                job.picked_up = self._cell.pose
                self.lift()
                return

    def note(self, job: GraspJob, mishap: Mishap, what: str) -> None:
        """Note a failure and the recovery from it."""
        job.recoveries.append(Recovery(time=self._cell.time, mishap=mishap, what=what))

    def _aim(self, job: GraspJob, target: ServoTarget) -> None:
        """Servo to the object, then keep servoing for `GraspJob.time_for_person`."""
        self._servo(job, target)
        if job.time_for_person > 0:
            self._cell.begin_phase(INTERACT)
            self.servo.hold(target, job.time_for_person)
            job.time_for_person = 0.0
            # After a push, an error of up to twice the tolerance is accepted. With a larger
            # error, servo again.
            on_target = self.servo.error(target) < 2 * self._config.servo.tolerance
            target = replace(target, posture=None)
            if not on_target:
                self._servo(job, target)
        job.pixel_error = self.servo.error(target)

    def _servo(self, job: GraspJob, target: ServoTarget) -> None:
        """Servo to a target, and note an occlusion of the marker as a recovery."""
        cell, start = self._cell, self._cell.time
        cell.begin_phase("servo")
        cell.tracked_markers = (self._workplace.tool_marker,)
        job.servo_time = self.servo.servo_to(target)
        occluded = longest_occlusion(cell.log, self._workplace.hover(), start, cell.chain)
        if occluded > _NEGLIGIBLE:
            what = f"held the end effector for {occluded:.1f} s"
            self.note(job, "marker occluded", what)

    def locate(self, item: GraspObject) -> ServoTarget:
        """Detect an object before the arm moves above the table, and return the servo target.

        An arm that is not at home may occlude the object. If the object is not detected, the
        arm therefore goes home and looks again.

        Raises:
            UndetectedObjectError: The object's marker stays undetected.
        """
        detected = self._detect(item)
        away = self._cell.joints - self._workplace.home_joints()
        if detected is None and float(away.abs().max()) >= _AT_HOME:
            self.go_home()
            detected = self._detect(item)
        if detected is None:
            raise UndetectedObjectError(
                f"detect: the camera does not see marker {item.marker.id} of {item.name!r}. "
                "Move the object into the camera's view, and the arm out of it."
            )
        posture = self._posture()
        return ServoTarget(
            config=self._config.servo,
            above=self._workplace.hover(),
            posture=posture,
            rest=posture if self._cell.config.after_push == "return" else None,
            visual=self._visual,
            item=detected.pixel,
            angle=detected.angle,
            turn_range=self._workplace.hover_turns,
        )

    def _detect(self, item: GraspObject) -> SeenFeature | None:
        """An object's marker in the image; None if it is not detected in time."""
        cell = self._cell
        cell.begin_phase("detect")
        deadline = cell.time + self._config.detection_timeout
        while item.marker.id not in (seen := cell.wait_for_detection().features):
            if cell.time >= deadline:
                return None
            cell.hold_pose(cell.config.detect_every * cell.config.dt)
        return seen[item.marker.id]

    def _posture(self) -> Float[Tensor, " joints"]:
        """Joint positions above the table; the paths to them, and from them to home, are free
        [rad].

        If there are no such positions, the arm goes home first. The positions of objects on the
        table are not known yet, so the path to the posture avoids the whole region of the
        objects.
        """
        posture = self._via(self._size * _PLATE_CLEARANCE)
        if posture is None:
            self.go_home()
            posture = self._workplace.hover_postures()[0]
        return posture

    def _via(self, clearance: float | None) -> Float[Tensor, " joints"] | None:
        """The first posture above the table for which the paths to it, and on to home, are free
        [rad].

        Args:
            clearance: Clearance from objects on the path to the posture [m]; None: not checked.

        Returns:
            The posture; None if there is no such posture.
        """
        here, home = self._cell.joints, self._workplace.home_joints()
        for posture in self._workplace.hover_postures():
            if self._free(here, posture, clearance) and self._free(posture, home):
                return posture
        return None

    def refusal(self, pose: Pose) -> str:
        """Reason why the end effector cannot go to a pose now; empty if it can.

        Args:
            pose: Pose requested by a person.
        """
        here = self._cell.joints
        try:
            posture = self._workplace.robot.inverse(pose, near=here, samples=_POSTURES)
        except UnreachableError:
            return "the arm does not reach there with this orientation"
        if float(self._to_objects(posture)) < self._size * _PLATE_CLEARANCE:
            return "too close to objects on the table"
        try:
            self._check(joint_plan(self._cell, here, posture))
        except BlockedPathError as error:
            return f"on the path there, {str(error).rstrip('.')}"
        return ""

    def close_on(self, item: GraspObject) -> None:
        """Descend and close the fingers.

        Raises:
            MissedGraspError: No object is between the fingers.
        """
        self._cell.begin_phase("grasp")
        self._cell.tracked_markers = ()
        self._touch_table(item)
        height = self._at_height(self._table[0] + item.half_size[2])
        self._cell.move_straight(height, speed=DESCENT_SPEED)
        move_fingers(self._cell, CLOSED, CLOSING_TIME)
        if not holds(self._cell, item):
            # The fingers may have touched an object instead of the table: forget its height.
            self._table = 0.0, self._size * _TABLE_RANGE
            raise MissedGraspError(
                f"grasp: the fingers closed on nothing. Check that {item.name!r} is under its "
                "marker."
            )
        self._cell.load = as_load(item)

    def _touch_table(self, item: GraspObject) -> None:
        """Touch the table with the fingers around an object, and update the table height.

        If the object is taller than expected, the palm touches the object, and the table seems
        higher than it is: the object is then grasped at about the right distance below its top.
        Without contact, the estimate does not change.
        """
        # Either the fingers meet the table first, or the palm meets the top of a tall object.
        reach = max(self._workplace.fingertip, 2 * item.half_size[2] - self._workplace.palm)
        height, margin = self._table
        expected = height + reach
        self._cell.move_straight(self._at_height(expected + margin), speed=DESCENT_SPEED)
        met = self._cell.move_until_contact(self._at_height(expected - margin))
        if met is not None:
            self._table = float(met.position[2]) - reach, self._size * _OBJECT_RANGE

    def _at_height(self, height: float) -> Pose:
        """Pose of the end effector after a motion along its z axis to a height [m]."""
        position = self._cell.pose.position
        orientation = self.servo.orientation(self._workplace.hover().orientation)
        direction = quaternion.to_matrix(orientation)[:, 2]
        distance = (height - position[2]) / direction[2]
        return Pose(position + distance * direction, orientation)

    def lift(self) -> None:
        """Lift the end effector straight up by the configured height."""
        self._cell.begin_phase("lift")
        self._cell.move_straight(raised(self._cell.pose, self._size * self._config.lift))

    def go_home(self) -> None:
        """Move the joints home, via another posture if the straight path is blocked.

        Raises:
            BlockedPathError: All paths are blocked.
        """
        self._cell.begin_phase("home")
        here, home = self._cell.joints, self._workplace.home_joints()
        # Paths with a clearance are tried first.
        for clearance in (self._size * _PLATE_CLEARANCE, None):
            if self._free(here, home, clearance):
                break
            if (via := self._via(clearance)) is not None:
                self._cell.follow_path(joint_plan(self._cell, here, via).path)
                break
        self.move_joints(home)

    def move_joints(self, goal: Float[Tensor, " joints"]) -> None:
        """Move the joints on a straight line in joint space to `goal` [rad].

        Raises:
            BlockedPathError: The path is blocked.
        """
        plan = joint_plan(self._cell, self._cell.joints, goal)
        self._check(plan)
        self._cell.follow_path(plan.path)

    def _free(
        self,
        start: Float[Tensor, " joints"],
        goal: Float[Tensor, " joints"],
        clearance: float | None = None,
    ) -> bool:
        """True if a straight line in joint space is free.

        Args:
            start: First joint positions [rad].
            goal: Last joint positions [rad].
            clearance: Required distance from the region of the objects [m]; None: not checked.
        """
        plan = joint_plan(self._cell, start, goal)
        try:
            self._check(plan)
        except BlockedPathError:
            return False
        if clearance is None:
            return True
        path = torch.from_numpy(plan.path[::_CHECK_EVERY])
        return bool((self._to_objects(path) > clearance).all())

    def _to_objects(self, q: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance of the arm from the region of the objects on the table [m]."""
        return self._workplace.robot.whole.box_distance(q, *self._workplace.object_region())

    def start_over(self) -> None:
        """Open the fingers and go home, where the arm does not hide the table."""
        self._cell.tracked_markers = ()
        self._cell.load = None
        move_fingers(self._cell, OPEN, _OPENING_TIME)
        if self._cell.pose.position[2] < self._workplace.hover_height:
            self.lift()
        self.go_home()


def _reachable_probe(workplace: Workplace, probe: float) -> float:
    """Largest height of a probe (`VisualServoConfig`) at which the arm reaches the whole region
    of the objects [m].

    Fractions of the wanted height are tried. If the arm reaches the region at none of these
    heights, the smallest height is returned.

    Args:
        workplace: Workplace with the region of the objects.
        probe: Wanted height of the probe above the hover height [m].
    """
    robot, hover = workplace.robot, workplace.hover()
    _, half = workplace.object_region()
    signs = half.new_tensor([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    for fraction in _PROBE_FRACTIONS:
        corners = hover.position + signs * half + half.new_tensor([0, 0, fraction * probe])
        with suppress(UnreachableError):
            pose = Pose(corners, hover.orientation.expand(4, 4))
            q = robot.inverse(pose, near=workplace.hover_joints())
            within = [robot.limits.contain(q + side * _PROBE_MARGIN) for side in (-1, 1)]
            if bool((within[0] & within[1]).all()):
                return fraction * probe
    return _PROBE_FRACTIONS[-1] * probe


def joint_plan(
    cell: WorkCell, start: Float[Tensor, " joints"], goal: Float[Tensor, " joints"]
) -> Plan:
    """Plan of a straight line in joint space for a work cell."""
    dt = cell.config.dt
    path = joint_line(start, goal, speed=JOINT_SPEED, dt=dt)
    return Plan(goal=cell.chain.forward(goal), dt=dt, path=path.numpy(), chain=cell.chain)


def as_load(item: GraspObject) -> GraspedBox:
    """Load for a grasped object: the fingers grip its x faces; its top points to the palm."""
    x, y, z = item.half_size
    return GraspedBox(half_size=(y, x, z))


def move_fingers(cell: WorkCell, width: float, at_least: float) -> None:
    """Open or close the fingers, and hold the end effector still until they are at rest.

    Real grippers start late, and some report the opening only at the end of a motion, so an
    unchanged opening does not count as rest.

    Args:
        cell: Arm and gripper.
        width: Opening to reach, or to squeeze towards [m].
        at_least: Shortest time to hold still [s].
    """
    before, begun = cell.state.gripper_width, cell.time
    width = min(width, _stroke(cell))  # fingers that are already open cannot open further
    cell.gripper.move(width)
    cell.hold_pose(at_least - _FINGERS_REST)
    expected = abs(width - before) > _FINGERS_MOVED
    while True:
        last = cell.state.gripper_width
        cell.hold_pose(_FINGERS_REST)
        now = cell.state.gripper_width
        at_rest = abs(now - last) < _FINGERS_MOVED / 10
        moved = abs(now - before) > _FINGERS_MOVED
        if (at_rest and moved) or not expected or cell.time - begun > _LONGEST_FINGER_MOTION:
            return


def holds(cell: WorkCell, item: GraspObject) -> bool:
    """True if the opening of the fingers matches an object held between them.

    The thresholds lie midway between the object's width and the openings of closed and of open
    fingers.
    """
    half = item.half_size[0]
    return half < cell.state.gripper_width < half + _stroke(cell) / 2


def _stroke(cell: WorkCell) -> float:
    """Opening of the open fingers [m]."""
    return cell.chain.hand_size * OPEN


def raised(pose: Pose, height: float) -> Pose:
    """A pose moved up by a height [m], in the same orientation."""
    return Pose(pose.position + pose.position.new_tensor([0.0, 0.0, height]), pose.orientation)
