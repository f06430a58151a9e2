"""Cartesian and joint motions: resolved rates, straight lines, inverse kinematics of a goal."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import UnreachableError, panda, pseudo_inverse, singularity_damping


def resolved_rate(
    jacobian: Float[Tensor, "*batch 6 joints"],
    twist: Float[Tensor, "*batch 6"],
    null_velocity: Float[Tensor, "*batch joints"],
) -> Float[Tensor, "*batch joints"]:
    """Joint velocities for a given twist, as close as possible to given joint velocities.

    u = J^+ twist + N null_velocity, with N = I - J^+ J.

    Args:
        jacobian: Geometric Jacobian of the end effector.
        twist: Linear [m/s] and angular [rad/s] velocity of the end effector.
        null_velocity: Desired joint velocities; only their null-space part acts [rad/s].
    """
    J_pinv = pseudo_inverse(jacobian, singularity_damping(jacobian))
    remaining = twist - (jacobian @ null_velocity.unsqueeze(-1)).squeeze(-1)
    return null_velocity + (J_pinv @ remaining.unsqueeze(-1)).squeeze(-1)


def straight_line(
    start: Pose, goal: Pose, speed: float, dt: float, angular_speed: float = 0.6
) -> Iterator[tuple[Pose, Float[Tensor, "6"]]]:
    """Poses and twists along a straight line, from rest to rest.

    Args:
        start: First pose.
        goal: Last pose.
        speed: Mean speed of the end effector [m/s].
        dt: Time between samples [s].
        angular_speed: Mean turning speed [rad/s]; the slower of both sets the duration.

    Yields:
        Pose and twist (linear [m/s], angular [rad/s]) at each sample, the last at rest.
    """
    twist = start.twist_to(goal)
    distance, turn = float(twist[:3].norm()), float(twist[3:].norm())
    # Not below 0.3 s: a short motion would need accelerations beyond the safety filter's.
    duration = max(distance / speed, turn / angular_speed, 0.3)
    for k in range(1, math.ceil(duration / dt) + 1):
        s, slope = minimum_jerk(k * dt / duration)
        turned = quaternion.multiply(quaternion.exp(s * twist[3:]), start.orientation)
        yield Pose(start.position + s * twist[:3], turned), twist * (slope / duration)


def joint_line(
    start: Float[Tensor, " joints"], goal: Float[Tensor, " joints"], speed: float, dt: float
) -> Float[Tensor, "steps joints"]:
    """Joint positions on a straight line in joint space, from rest to rest.

    Args:
        start: First [rad].
        goal: Last [rad].
        speed: Largest speed of any joint [rad/s].
        dt: Time between samples [s].
    """
    # A minimum jerk motion peaks at 1.875 times its mean speed.
    duration = max(1.875 * float((goal - start).abs().max()) / speed, dt)
    steps = round(duration / dt) + 1
    progress = torch.tensor(
        [minimum_jerk(k * dt / duration)[0] for k in range(steps + 1)], dtype=start.dtype
    )
    return torch.lerp(start, goal, progress[:, None])


def path_velocity(
    path: Float[np.ndarray, "steps joints"], k: int, dt: float
) -> Float[np.ndarray, " joints"]:
    """Velocity of a sampled path at sample k, by central differences inside [rad/s]."""
    low, high = max(k - 1, 0), min(k + 1, len(path) - 1)
    return (
        (path[high] - path[low]) / ((high - low) * dt) if high > low else np.zeros_like(path[k])
    )


def nearest_configuration(
    goal: Pose, near: Float[Tensor, "7"], samples: int = 57
) -> Float[Tensor, "7"]:
    """Joint positions that reach a pose, as near as can be to given ones.

    Scans joint 7, the redundant one, and keeps the best of the analytic solutions.

    Args:
        goal: Pose of the tool centre point.
        near: Joint positions [rad].
        samples: Values of joint 7 tried between its limits.

    Raises:
        UnreachableError: If no value of joint 7 reaches the pose within the limits.
    """
    lower, upper = float(panda.limits.lower[6]), float(panda.limits.upper[6])
    # A little inside the limits, where the arm can still be corrected.
    candidates = torch.linspace(lower + 0.02, upper - 0.02, samples, dtype=torch.float64)
    candidates = torch.cat([near[6:7], candidates])
    best, distance = None, math.inf
    for q7 in candidates:
        try:
            q = panda.inverse(goal, q7, near=near)
        except UnreachableError:
            continue
        if (d := float((q - near).norm())) < distance:
            best, distance = q, d
    if best is None:
        x, y, z = goal.position.tolist()
        w = [round(v, 3) for v in quaternion.normalize(goal.orientation).tolist()]
        raise UnreachableError(
            f"no joint positions within the limits reach position ({x:.3f}, {y:.3f}, {z:.3f}) "
            f"m with orientation {w} (wxyz): move the goal towards the robot or turn it."
        )
    return best
