"""Values of a control step: goals, observation, command, and the state of the safety filter.

All are pytrees of tensors, so a step compiles, exports and maps over batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.constraint_layer import ConstraintConfig, ConstraintReport, Distances
from hrc_learn.controller.contact_limits import SeparationConfig
from hrc_learn.geometry.numerics import check_choice, check_settings
from hrc_learn.kinematics import TaskSpace
from hrc_learn.kinematics.inverse import TASK_ROWS
from hrc_learn.pytree import pytree
from hrc_learn.regions import (
    AxisRegion,
    OrientationRegion,
    PositionRegion,
    PostureRegion,
    VisionRegion,
)

_LIMITS = ("velocity", "position", "acceleration", "jerk", "tcp_speed", "separation")
INTERVENTIONS = (*_LIMITS, "invalid", "stopped", "start")
"""Kinds of interventions, in the order of the last axis of `SafetyReport.flags` and
`SafetyState.counts`."""


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and caps in addition to the joint limits."""

    margin: float = 0.02
    """Distance kept from every joint position limit [rad]."""
    velocity_margin: float = 0.02
    """Unused fraction of every joint velocity limit. In MuJoCo, the servos overshoot their
    command by up to 1.2 % of the limit."""
    rate: float = 5.0
    """Fastest decay of the remaining distance to a limit [1/s]; at most 1/dt."""
    braking: float = 1.0
    """Fraction of the acceleration and jerk limits that the arm's driver uses, in (0, 1].
    The driver franky plans motions with its `dynamics` factor, 0.3 by default in our
    adapter."""
    delay: float = 0.0
    """Longest time from a joint position reading to the motion that results from it [s]."""
    jitter: float = 0.0
    """Largest relative deviation of a step from its `dt`, in [0, 1). Zero where dt is the
    measured time since the last step: then all limits hold exactly."""
    tcp_speed: float = 1.0
    """Highest speed of the tool centre point, the elbow and the far end of a load [m/s]."""
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    """Protective distance from people. It lowers the cap on the tool's speed where
    `human_distance` is given, and limits the speed of all links where `distances` to a person
    are given."""
    constraints: ConstraintConfig | None = None
    """Settings of the quadratic program that keeps limits and distances; in this program, the
    null space yields to the task. None: each joint brakes by itself before its limits, and no
    distance is kept."""

    unbounded = ("tcp_speed",)

    def __post_init__(self):
        check_settings(
            self,
            positive=("rate", "tcp_speed"),
            not_negative=("margin", "delay"),
            below_one=("velocity_margin", "jitter"),
            fraction=["braking"],
        )

    @property
    def longest_step(self) -> float:
        """Longest step for which the limits are guaranteed [s]."""
        return 1 / (self.rate * (1 + self.jitter))


@pytree
class SafetyState:
    """State of the filter between two steps."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity of the last step [rad/s]."""
    acceleration: Float[Tensor, "*batch n"]
    """Acceleration of the last step [rad/s^2]."""
    position: Float[Tensor, "*batch n"]
    """Predicted joint positions [rad], used while the measurement is invalid."""
    dt: Float[Tensor, "*batch"]
    """Length of the last valid step [s], used while the given `dt` is invalid."""
    fresh: Bool[Tensor, "*batch"]
    """True before the first step after a start."""
    too_fast: Float[Tensor, "*batch"]
    """Time for which a point has been faster than its cap, without interruption [s]."""
    counts: Int[Tensor, "*batch kinds"]
    """Number of steps with each of `INTERVENTIONS`."""

    def count(self, kind: str) -> Int[Tensor, "*batch"]:
        """Number of steps with one kind of intervention."""
        return self.counts[..., _index(kind)]


@pytree
class SafetyReport:
    """Interventions of the filter in one step."""

    flags: Bool[Tensor, "*batch kinds"]
    """True for each of `INTERVENTIONS` that changed the command by more than rounding."""
    speed_excess: Float[Tensor, "*batch"]
    """Excess of the fastest point's speed over the cap [m/s]. It is positive where no
    admissible motion keeps the cap, because the cap fell faster than the arm can brake, or the
    arm was too fast at the start."""
    speed_excess_time: Float[Tensor, "*batch"]
    """Time for which the cap has been exceeded, up to the end of this step [s]."""
    constraints: ConstraintReport | None = None
    """Effect of the constraints, which is zero while the arm brakes to rest. None: the filter
    has no constraints."""

    def acted(self, kind: str) -> Bool[Tensor, "*batch"]:
        """True where one kind of intervention changed the command."""
        return self.flags[..., _index(kind)]


def _index(kind: str) -> int:
    if kind not in INTERVENTIONS:
        raise ValueError(f"no intervention {kind!r}; there are {', '.join(INTERVENTIONS)}")
    return INTERVENTIONS.index(kind)


_TOOL_REGIONS = {
    "pose": OrientationRegion,
    "nearest pose": OrientationRegion,
    "position+axis": AxisRegion,
}
HALF_SIZE = (0.12, 0.12, 0.08)
"""Half edges of a box that is large enough for the camera to find the marker [m]."""
# Width and height of the images of the paper's camera [px].
_PAPER_IMAGE = (1440, 1080)


@pytree
class Goals:
    """Regions that attract the tool, the image feature and the joints.

    All fields are tensors, so a task can change them between two steps without rebuilding or
    recompiling the controller.
    """

    position: PositionRegion
    """Box for the tool centre point."""
    orientation: OrientationRegion | AxisRegion | None
    """Cone for the tool orientation. An `AxisRegion` leaves rotation about its axis free and
    None leaves all rotation free, for tasks and arms with fewer than six degrees of freedom."""
    vision: VisionRegion
    """Region of the feature in the image."""
    vision_enabled: Bool[Tensor, "*#batch"]
    """False: use the Cartesian regions alone, whatever the camera sees."""
    posture: PostureRegion | None = None
    """Posture approached in joint space before task-space feedback takes over; None: task-space
    feedback acts from the start."""
    rest: PostureRegion | None = None
    """Posture to which the null space returns; None: the null space does not return."""

    @property
    def task(self) -> TaskSpace:
        """Controlled part of the tool pose."""
        if self.orientation is None:
            return "position"
        return "position+axis" if isinstance(self.orientation, AxisRegion) else "pose"

    @classmethod
    def at(
        cls,
        centre: Float[Tensor, "*#batch 3"],
        orientation: Float[Tensor, "*#batch 4"],
        target: Float[Tensor, "*#batch rows"] | None = None,
        *,
        half_size: Sequence[float] = HALF_SIZE,
        image_size: tuple[int, int] = _PAPER_IMAGE,
        task: TaskSpace = "pose",
    ) -> Goals:
        """Goals with the recommended gains.

        Args:
            centre: Centre of the box for the tool centre point [m].
            orientation: Orientation of the tool, a unit quaternion (w, x, y, z).
            target: Target of the feature in the image [px]: u and v of each point. None: a
                feature of one point, with vision feedback switched off. To switch vision
                feedback off for a feature of several points, pass a target and call
                `with_vision(False)`.
            half_size: Half edges of the box [m].
            image_size: Width and height of the image [px].
            task: Controlled part of the tool pose: all of it, position and z axis, or position.
                The rest becomes null space.

        Raises:
            ValueError: The target lies outside the image.
        """
        check_choice("task", task, TASK_ROWS)
        enabled = target is not None
        if target is None:
            target = centre.new_tensor(image_size) / 2
        return cls(
            position=PositionRegion(centre=centre, half_size=centre.new_tensor(half_size)),
            orientation=None if task == "position" else _TOOL_REGIONS[task](goal=orientation),
            vision=VisionRegion.inside_image(target, image_size),
            vision_enabled=torch.tensor(enabled, device=centre.device),
        )

    def moved_to(self, centre: Float[Tensor, "*#batch 3"]) -> Goals:
        """The goals with another centre of the box [m]."""
        return replace(self, position=replace(self.position, centre=centre))

    def approached_by(self, posture: Float[Tensor, "*#batch n"] | None) -> Goals:
        """The goals, preceded by an approach to a posture in joint space [rad].

        Use an inverse-kinematics solution for the box centre that is close to the present
        joints.
        """
        region = None if posture is None else PostureRegion(goal=posture)
        return replace(self, posture=region)

    def resting_at(
        self,
        posture: Float[Tensor, "*#batch n"] | None,
        *,
        rate: float = 1.0,
        speed: float = 0.4,
    ) -> Goals:
        """The goals, with a null space that returns to a posture [rad].

        Without a posture, the minimum-norm velocities of a repeated task add up to a drift of
        the null space. This drift eventually moves joints to their limits and the arm into
        singularities.

        Args:
            posture: Posture in which the tool is in the box; None: the null space does not
                return.
            rate: Convergence rate near the posture [1/s].
            speed: Highest speed, norm over all joints [rad/s].

        Raises:
            ValueError: Rate or speed is not positive.
        """
        if not (rate > 0 and speed > 0):
            raise ValueError(f"rate and speed must be positive, but are {rate} and {speed}.")
        region = None
        if posture is not None:
            region = PostureRegion(goal=posture, stiffness=rate, saturation=speed / rate)
        return replace(self, rest=region)

    def with_vision(self, enabled: bool) -> Goals:
        """The goals with vision feedback switched on or off."""
        return replace(self, vision_enabled=torch.full_like(self.vision_enabled, enabled))


@pytree
class Observation:
    """Measurements and requests of one control step."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured joint positions [rad]."""
    feature: Float[Tensor, "*batch rows"]
    """Measured feature [px]: u and v of one point, or of several points in turn, such as the
    corners of a marker. Where the feature is not visible, any value is allowed, even NaN."""
    feature_visible: Bool[Tensor, "*batch"]
    """True if the feature was found in the image."""
    dt: float | Float[Tensor, ""]
    """Time until the next step [s]."""
    joint_velocity: Float[Tensor, "*batch n"] | None = None
    """Measured joint velocities [rad/s]. In the first step after a start, they replace the
    velocities of the initial state if the two differ clearly. None: not measured."""
    nullspace_input: Float[Tensor, "*batch n"] | None = None
    """Null-space input d of the paper: joint torques exerted by a person [N m]; None: no
    input."""
    goals: Goals | None = None
    """Goals of this step; None: the goals of the controller."""
    feature_new: Bool[Tensor, "*batch"] | None = None
    """True if `feature` is from an image that no earlier step has used; None counts as True."""
    feature_age: Float[Tensor, "*batch"] | None = None
    """Time since the image was taken [s]; None: zero."""
    image_joint_position: Float[Tensor, "*batch n"] | None = None
    """Joint positions when the image was taken [rad]; None: the present positions. Pairing an
    image with a later pose teaches the estimator a wrong Jacobian."""
    joint_state_stale: Bool[Tensor, "*batch"] | None = None
    """True if the joint position is too old to be used; None counts as False."""
    human_distance: Float[Tensor, "*batch"] | None = None
    """Distance of the nearest person from the tool [m]; a short distance slows down or stops
    the arm. NaN (unknown): stop. None: no person is monitored."""
    load: Float[Tensor, "*batch 3"] | None = None
    """Far end of a load in the frame of the tool centre point [m]. The cap on the tool's speed
    also applies to this point. None: no load."""
    distances: Distances | None = None
    """Distances of the arm from itself, the scene and people, kept by
    `SafetyConfig.constraints`; None: no distances are kept."""
    stop: Bool[Tensor, "*batch"] | None = None
    """True: brake to rest and stay there, as requested by a watchdog or a person. None counts
    as False."""

    @classmethod
    def unseen(
        cls, joint_position: Float[Tensor, " n"], target: Float[Tensor, " rows"], dt: float
    ) -> Observation:
        """Observation of an arm at rest before the first image. It has values in all fields
        that a loop with an arm and a camera sets.

        Args:
            joint_position: Joint positions [rad].
            target: Image position that stands for the unseen feature [px].
            dt: Time until the next step [s]; the observation stores it as a tensor, so that one
                compiled step serves all rates.
        """
        return cls(
            joint_position=joint_position,
            feature=target,
            feature_visible=torch.tensor(False),
            feature_new=torch.tensor(False),
            image_joint_position=joint_position,
            nullspace_input=torch.zeros_like(joint_position),
            dt=joint_position.new_tensor(dt),
        )


@pytree
class Command:
    """The joint velocity to send, and the terms of the law that led to it."""

    joint_velocity: Float[Tensor, "*batch n"]
    """Joint velocity to send [rad/s], after the safety filter."""
    twist: Float[Tensor, "*batch 6"]
    """Wanted motion of the tool (linear [m/s], angular [rad/s])."""
    null_velocity: Float[Tensor, "*batch n"]
    """Joint velocity in the null space [rad/s]."""
    xi_x: Float[Tensor, "*batch rows"]
    """Vision feedback, scaled by the blending and limited by `vision_rate`."""
    xi_r: Float[Tensor, "*batch 6"]
    """Cartesian feedback, position then orientation."""
    xi_q: Float[Tensor, "*batch n"]
    """Joint-space feedback."""
    s: Float[Tensor, "*batch 6"]
    """Task-space feedback J_s_hat^T xi_x + xi_r, which converges to zero."""
    image_jacobian: Float[Tensor, "*batch rows 6"]
    """Estimated image Jacobian J_s_hat [px/m, px/rad]."""
    weight_norm: Float[Tensor, "*batch"]
    """Frobenius norm of the estimator's weights."""
    vision_level: Float[Tensor, "*batch"]
    """Fraction of vision feedback, 0 to 1."""
    potential: Float[Tensor, "*batch"]
    """Sum P_t + P_o + P_v of the potentials of position, orientation and vision, with P_v
    scaled by the blending. It is the part of the Lyapunov function that does not depend on the
    unknown true weights of the estimator."""
    potential_rate: Float[Tensor, "*batch"]
    """s^T J u: rate of the potential, predicted with the estimated image Jacobian [1/s]. It is
    at most zero, unless a limit or a person moves the tool away from its goals. If the measured
    potential falls more slowly than predicted, the image Jacobian has an error."""
    safety: SafetyReport
    """Interventions of the safety filter."""


# Parameters of the paper's grasping experiment (Table I), as printed.

GRIPPER_DOWN = (-0.28, 0.63, 0.66, 0.28)
"""Goal orientation p_g as printed (w, x, y, z), gripper down; its norm is 0.995."""

INITIAL_IMAGE_JACOBIAN = (
    (-1500.0, 0.0, 0.0, 0.0, -200.0, 60.0),
    (0.0, 2400.0, 170.0, -200.0, 0.0, 180.0),
)
"""J_s_hat at t = 0 (equation eq_js0) [px/m, px/rad]: the camera is above the table, and u
increases along -x."""
