"""Settings of the controller that stay the same through a task, and the paper's parameters.

The paper's are those of its grasping experiment (Table I), as printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.blending import BlendingConfig
from hrc_learn.controller.interface import Goals
from hrc_learn.controller.safety_filter import SafetyConfig
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import JointLimits
from hrc_learn.regions import JointRegion, OrientationRegion, PositionRegion, VisionRegion

GRIPPER_DOWN = (-0.28, 0.63, 0.66, 0.28)
"""p_g as printed; its norm is 0.995, and scalar first it points the gripper down."""

INITIAL_IMAGE_JACOBIAN = (
    (-1500.0, 0.0, 0.0, 0.0, -200.0, 60.0),
    (0.0, 2400.0, 170.0, -200.0, 0.0, 180.0),
)
"""J_s_hat at t = 0 [px/m, px/rad] (eq_js0): a camera above whose image right is -x."""


@dataclass(frozen=True, kw_only=True)
class ControllerConfig:
    """Settings of the law; the defaults are those that were measured to work best."""

    linear_speed: float = 0.25
    """Cap on the linear part of the twist [m/s]; the direction of the twist is kept."""
    angular_speed: float = 1.0
    """Cap on its angular part [rad/s]."""
    vision_rate: float = 4.0
    """Fastest decay of the pixel error that the estimate may ask for [1/s]. The gain of the
    law grows with the square of the Jacobian over that of the region: uncapped it can exceed
    what images at 15 to 30 Hz, late by a frame or more, allow."""
    approach_linear_speed: float = 0.5
    """Cap on the linear speed of the tool during a joint-space approach [m/s]."""
    approach_angular_speed: float = 2.0
    """Cap on its angular speed then [rad/s]."""
    jacobian: Literal["geometric", "analytic"] = "geometric"
    """By which gradients become motions of the tool: the analytic one counts rotation by the
    rotation vector, whose rates differ from angular velocity the more the tool is turned."""
    null_damping: float = 3.0
    """c_d: null-space input divided by it is velocity."""
    null_space_yields: bool = True
    """Scale null-space motion as a whole where a limit would cut single joints."""
    drift_compensation_rate: float = 2.0
    """Rate at which the tool returns to its place while a person acts [1/s]; 0: it does not."""
    blending: BlendingConfig = field(default_factory=BlendingConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self):
        for name in (
            "linear_speed",
            "angular_speed",
            "vision_rate",
            "approach_linear_speed",
            "approach_angular_speed",
            "null_damping",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if self.jacobian not in ("geometric", "analytic"):
            raise ValueError(
                f"jacobian must be 'geometric' or 'analytic', but is {self.jacobian!r}"
            )
        if self.drift_compensation_rate < 0:
            raise ValueError(
                "drift_compensation_rate must not be negative, but is "
                f"{self.drift_compensation_rate}"
            )

    @classmethod
    def paper(cls) -> ControllerConfig:
        """The law as printed: nothing between it and the safety filter."""
        return cls(
            linear_speed=math.inf,
            angular_speed=math.inf,
            vision_rate=math.inf,
            null_space_yields=False,
            drift_compensation_rate=0.0,
            blending=BlendingConfig(hysteresis=0.0, blend_time=0.0),
        )


def paper_joint_region(limits: JointLimits) -> JointRegion:
    """The paper's joint-space region in its printed, symmetric form; default gains."""
    return JointRegion.from_limits(limits.lower, limits.upper, formulation="paper")


def paper_goals(
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 2"],
) -> Goals:
    """The paper's regions with their printed gains and gradients.

    Args:
        centre: Of the box, which the paper leaves to the expert [m].
        half_size: Of the box, which the paper leaves to the expert [m].
        target: In the image [px].
    """
    goal = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    return Goals(
        position=PositionRegion(
            centre=centre, half_size=half_size, stiffness=(4e-4, 4e-4, 4e-5)
        ),
        orientation=OrientationRegion(goal=goal, stiffness=1.0, formulation="paper"),
        vision=VisionRegion(
            target=target,
            half_size=target.new_tensor((1440.0, 1080.0)),
            formulation="paper",
        ),
        vision_enabled=torch.tensor(True, device=centre.device),
    )
