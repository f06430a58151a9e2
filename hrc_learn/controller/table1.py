"""Table I of the paper: the settings of its grasping experiment, as printed."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.config import ControllerConfig
from hrc_learn.controller.goals import Goals
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


def table1_config() -> ControllerConfig:
    """The law as printed; only the safety filter stands between it and the arm."""
    return ControllerConfig.paper()


def table1_joint_region(limits: JointLimits) -> JointRegion:
    """Joint-space region with its printed, symmetric form; the gains are the default."""
    return JointRegion.from_limits(limits.lower, limits.upper, formulation="paper")


def table1_goals(
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 2"],
) -> Goals:
    """Regions with their printed gains and gradients.

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
