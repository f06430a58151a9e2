"""Columns of a work cell's log."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import Command, SeparationConfig
from hrc_learn.controller.arm_loop_state import ArmReport
from hrc_learn.protocols import HINDRANCES, ArmState, Feedback
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.person_watch import WatchedPeople

NO_VISION: dict[str, Any] = {
    "feature": np.full(2, math.nan),
    "target": np.full(2, math.nan),
    "image_jacobian": np.full((2, 6), math.nan),
    "weight_norm": math.nan,
    "potential": math.nan,
    "potential_rate": math.nan,
    "vision_activation": math.nan,
    "approach": math.nan,
    "region": np.full(6, math.nan),
    "drawn": False,
    "turn": np.full(3, math.nan),
}
"""Columns of a step without a camera in the loop."""


def motion_columns(
    state: ArmState, velocity: Float[Tensor, " joints"], effort: Float[np.ndarray, " joints"]
) -> dict[str, Any]:
    """Columns of the arm.

    Args:
        state: Reading of the arm.
        velocity: Joint velocity sent to it [rad/s].
        effort: Null-space input [N m].
    """
    return {
        "time": state.time,
        "joint_position": state.joint_position,
        "joint_velocity": state.joint_velocity,
        "command_velocity": velocity.numpy(),
        "nullspace_input": effort,
        "gripper": state.gripper_width,
    }


def report_columns(report: ArmReport, feedback: Feedback, joints: int) -> dict[str, Any]:
    """Columns of the loop, and of the feedback to the person.

    The components of "hindered" are `HINDRANCES`, those of "safety" `INTERVENTIONS`.

    Args:
        report: Report of the loop.
        feedback: Feedback to the person.
        joints: Number of joints.
    """
    goal, path = report.goal, report.path_joints
    reasons = {reason.hindrance for reason in feedback.reasons}
    return {
        "followed": feedback.followed if feedback.pushed else math.nan,
        "hindered": np.array([hindrance in reasons for hindrance in HINDRANCES]),
        "safety": report.safety.flags.numpy(),
        "goal_position": np.full(3, math.nan) if goal is None else goal.position.numpy(),
        "path_joints": np.full(joints, math.nan) if path is None else path.numpy(),
    }


def servo_columns(
    command: Command,
    target: Float[np.ndarray, "2"],
    feature: np.ndarray,
    approach: float,
    *,
    region: PositionRegion,
    drawn: bool,
    turn: Float[np.ndarray, "3"] | None,
) -> dict[str, Any]:
    """Columns of the adaptive controller; arguments are those of `WorkCell.execute`."""
    return {
        "feature": feature,
        "target": target,
        "image_jacobian": command.image_jacobian.numpy(),
        "weight_norm": float(command.weight_norm),
        "potential": float(command.potential),
        "potential_rate": float(command.potential_rate),
        "vision_activation": float(command.vision_level),
        "approach": approach,
        "region": torch.cat([region.centre, region.half_size]).numpy(),
        "drawn": drawn,
        "turn": np.zeros(3) if turn is None else turn,
    }


def separation_columns(
    watched: WatchedPeople,
    separation: SeparationConfig,
    velocity: Float[Tensor, " joints"],
    people_scale: float,
) -> dict[str, float]:
    """Columns of the distance from people, and of the protective one at this speed.

    Args:
        watched: People near the arm.
        separation: Protective distance.
        velocity: Joint velocity sent to the arm [rad/s].
        people_scale: Speed scale imposed by people, 0 to 1.
    """
    near = watched.distances
    needed = separation.protective_distance(-(near.gradient @ velocity), near.approach_speed)
    tightest = (near.distance - needed).argmin()
    return {
        "person_distance": watched.nearest,
        "person_age": watched.age,
        "protective_distance": float(needed[tightest]),
        "separation_margin": float((near.distance - needed)[tightest]),
        "pace": people_scale,
    }
