"""What goes into a control step and what comes out of it: goals, observation, command.

All are pytrees of tensors, so a step compiles, exports and maps over batches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.controller.safety_filter import SafetyReport
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import JointLimits, TaskSpace
from hrc_learn.pytree import pytree
from hrc_learn.regions import (
    AxisRegion,
    JointRegion,
    OrientationRegion,
    PositionRegion,
    PostureRegion,
    VisionRegion,
)

type ToolRegion = OrientationRegion | AxisRegion | None
"""What is led of the tool's orientation: all, its z axis, or nothing."""

_OF_TASK: dict[TaskSpace, Callable[[Tensor], ToolRegion]] = {
    "pose": lambda goal: OrientationRegion(goal=goal),
    "position+axis": lambda goal: AxisRegion(goal=goal),
    "position": lambda goal: None,
}

HALF_SIZE = (0.12, 0.12, 0.08)
"""Half edges of the box that proved large enough to find the marker in view [m]."""
IMAGE_SIZE = (1440, 1080)
"""Width and height of the paper's camera [px]."""


@pytree
@dataclass(frozen=True, kw_only=True)
class Goals:
    """The attracting regions and whether the camera takes part.

    Tensors all through, so a task changes them between two steps without rebuilding or
    recompiling the controller.
    """

    position: PositionRegion
    orientation: ToolRegion
    """Of the tool; an `AxisRegion` leaves turns about its axis free, None all of them. An arm
    of fewer joints than a pose has dimensions is led by less than one."""
    vision: VisionRegion
    vision_enabled: Bool[Tensor, "*#batch"]
    """False: steer by the Cartesian regions alone, whatever the camera sees."""
    posture: PostureRegion | None = None
    """Where to go in joint space before task-space feedback takes over; None: it leads from
    the start."""
    rest: PostureRegion | None = None
    """Where the null space goes back to; None: it stays where task and people leave it."""

    @property
    def task(self) -> TaskSpace:
        """What of the tool's pose is led."""
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
        image_size: tuple[int, int] = IMAGE_SIZE,
        task: TaskSpace = "pose",
    ) -> Goals:
        """Goals with the recommended gains.

        Args:
            centre: Of the box for the tool centre point [m].
            orientation: Of the tool, a unit quaternion.
            target: Of the feature in the image [px], u and v of each of its points; None
                switches the camera off.
            half_size: Of the box [m].
            image_size: Width and height of the image [px].
            task: What of the tool's pose is led: all, its position and its z axis, or its
                position. What is not led is null space.

        Raises:
            ValueError: The target lies outside the image.
        """
        enabled = target is not None
        if target is None:
            target = centre.new_tensor(image_size) / 2
        return cls(
            position=PositionRegion(centre=centre, half_size=centre.new_tensor(half_size)),
            orientation=_OF_TASK[task](orientation),
            vision=VisionRegion.inside_image(target, image_size),
            vision_enabled=torch.tensor(enabled, device=centre.device),
        )

    def moved_to(
        self,
        centre: Float[Tensor, "*#batch 3"],
        half_size: Float[Tensor, "*#batch 3"] | None = None,
    ) -> Goals:
        """The same goals with the box elsewhere and, if told, of another size [m]."""
        if half_size is None:
            half_size = self.position.half_size
        return replace(
            self, position=replace(self.position, centre=centre, half_size=half_size)
        )

    def turned_to(self, orientation: Float[Tensor, "*#batch 4"]) -> Goals:
        """The same goals with another tool orientation, where one is led."""
        if self.orientation is None:
            return self
        return replace(self, orientation=replace(self.orientation, goal=orientation))

    def aimed_at(self, target: Float[Tensor, "*#batch rows"]) -> Goals:
        """The same goals with another target in the image [px]."""
        return replace(self, vision=replace(self.vision, target=target))

    def approached_by(self, posture: Float[Tensor, "*#batch n"] | None) -> Goals:
        """The same goals, first approached in joint space towards a posture [rad].

        Take an inverse-kinematics solution of the box centre that is near the arm.
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
        """The same goals, with a null space that goes back to a posture [rad].

        Least velocities for a task that goes to and fro add up to a motion of the null space,
        which in time takes joints to their limits, and the arm into singularities.

        Args:
            posture: One that suits the box; None: the null space stays where it is.
            rate: How fast it is near there [1/s].
            speed: Fastest way back, of all joints together [rad/s].

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
        """The same goals with the camera taking part or not."""
        return replace(self, vision_enabled=torch.full_like(self.vision_enabled, enabled))


@pytree
@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the controller is told at one step."""

    joint_position: Float[Tensor, "*batch n"]
    """Measured [rad]."""
    feature: Float[Tensor, "*batch rows"]
    """Measured feature (u, v) [px], or u and v of several points in turn, as the corners of a
    marker; anything, also NaN, where it is not visible."""
    feature_visible: Bool[Tensor, "*batch"]
    """Whether the feature was found in the image."""
    dt: float | Float[Tensor, ""]
    """Time until the next step [s]."""
    target: Float[Tensor, "*#batch rows"] | None = None
    """Target in the image [px]; None: that of the goals. NaN: not known, so the camera does
    not take part."""
    nullspace_input: Float[Tensor, "*batch n"] | None = None
    """The operator's input d: effort of a person on each joint, which moves the arm in its
    null space [N m]; None: nobody acts."""
    goals: Goals | None = None
    """Regions to go to; None: those the controller was built with."""
    feature_new: Bool[Tensor, "*batch"] | None = None
    """Whether `feature` stems from an image that no earlier step has used; None: it does."""
    feature_age: Float[Tensor, "*batch"] | None = None
    """Time since the image was taken [s]; None: none."""
    image_joint_position: Float[Tensor, "*batch n"] | None = None
    """Joint position when the image was taken [rad]; None: the present one. Pairing an image
    with a later pose teaches the estimator a wrong Jacobian."""
    joint_state_stale: Bool[Tensor, "*batch"] | None = None
    """Whether the joint position is too old to be used; None: it is not."""
    human_distance: Float[Tensor, "*batch"] | None = None
    """Distance of the nearest person from the arm [m], by which the tool slows down and stops;
    NaN: not known, stop. None: nobody is watched for."""
    distances: Distances | None = None
    """Of the arm from itself, the scene and a worker, which `SafetyConfig.constraints` keep;
    None: none is."""
    stop: Bool[Tensor, "*batch"] | None = None
    """Whether to brake to rest and stay there, as a watchdog or a person asks; None: no."""


@pytree
@dataclass(frozen=True, kw_only=True)
class Command:
    """The joint velocity to send, and how it came about."""

    joint_velocity: Float[Tensor, "*batch n"]
    """To send [rad/s]; it has passed the safety filter."""
    twist: Float[Tensor, "*batch 6"]
    """Wanted motion of the tool (linear [m/s], angular [rad/s])."""
    null_velocity: Float[Tensor, "*batch n"]
    """Joint velocity in the null space [rad/s]."""
    xi_x: Float[Tensor, "*batch rows"]
    """Vision feedback, faded by the blending."""
    xi_r: Float[Tensor, "*batch 6"]
    """Cartesian feedback, position then orientation."""
    xi_q: Float[Tensor, "*batch n"]
    """Joint-space feedback."""
    s: Float[Tensor, "*batch 6"]
    """J_s_hat^T xi_x + xi_r, which goes to zero where the law is stable."""
    image_jacobian: Float[Tensor, "*batch rows 6"]
    """Estimate J_s_hat [px/m, px/rad]."""
    weight_norm: Float[Tensor, "*batch"]
    """Frobenius norm of the estimator's weights."""
    vision_level: Float[Tensor, "*batch"]
    """Fraction of vision feedback, 0 to 1."""
    potential: Float[Tensor, "*batch"]
    """Sum of the task-space potentials P_v + P_t + P_o: the part of the Lyapunov function
    that needs no true weights."""
    potential_rate: Float[Tensor, "*batch"]
    """Its rate as the estimated image Jacobian has it [1/s]; not positive where the law acts
    alone (`hrc_learn.controller.monitors`)."""
    safety: SafetyReport
    """What the safety filter did."""


# Parameters of the paper's grasping experiment (Table I), as printed.

GRIPPER_DOWN = (-0.28, 0.63, 0.66, 0.28)
"""p_g as printed; its norm is 0.995, and scalar first it points the gripper down."""

INITIAL_IMAGE_JACOBIAN = (
    (-1500.0, 0.0, 0.0, 0.0, -200.0, 60.0),
    (0.0, 2400.0, 170.0, -200.0, 0.0, 180.0),
)
"""J_s_hat at t = 0 [px/m, px/rad] (eq_js0): a camera above whose image right is -x."""


def paper_joint_region(limits: JointLimits) -> JointRegion:
    """The paper's joint-space region in its printed, symmetric form; default gains."""
    return JointRegion.from_limits(limits.lower, limits.upper, formulation="paper")


def paper_goals(
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 2"],
    stiffness: tuple[float, float, float] = (4e-4, 4e-4, 4e-5),
) -> Goals:
    """The paper's regions with their printed gains and gradients.

    Args:
        centre: Of the box, which the paper leaves to the expert [m].
        half_size: Of the box, which the paper leaves to the expert [m].
        target: In the image [px].
        stiffness: k_c of the box; default: as printed.
    """
    goal = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    return Goals(
        position=PositionRegion(centre=centre, half_size=half_size, stiffness=stiffness),
        orientation=OrientationRegion(goal=goal, stiffness=1.0, formulation="paper"),
        vision=VisionRegion(
            target=target,
            half_size=target.new_tensor((1440.0, 1080.0)),
            formulation="paper",
        ),
        vision_enabled=torch.tensor(True, device=centre.device),
    )
