"""Velocities from recorded positions."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from ...geometry import quaternion
from ..demonstration import Demonstration
from .local_polynomial import local_polynomial


def estimate_joint_velocity(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Demonstration:
    """The demonstration with `joint_velocity` estimated from its joint positions.

    Differences of jittered stamps multiply the noise; a polynomial fitted around each frame
    (`local_polynomial`) does not, and uses the stamps as they are.

    Args:
        demo: Its joint positions recorded.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: No joint positions are recorded, or too few frames.
    """
    if demo.joint_position is None:
        raise ValueError(
            "a joint velocity is estimated from joint positions; none are recorded"
        )
    _, velocity = local_polynomial(demo.time, demo.joint_position, window=window, degree=degree)
    return replace(demo, joint_velocity=velocity)


def estimate_twist(
    demo: Demonstration, window: float | int = 0.1, degree: int = 3
) -> Float64[np.ndarray, "_frames 6"]:
    """Linear [m/s] and angular [rad/s] velocity of the end effector, in the base frame.

    The angular velocity is 2 q' q* of the polynomials fitted to the quaternion's components;
    it does not depend on the choice of the base frame.

    Args:
        demo: Its position and orientation recorded.
        window: Width of the neighbourhood [s].
        degree: Degree of the polynomials.

    Raises:
        ValueError: The pose is not recorded, or too few frames.
    """
    if demo.position is None or demo.orientation is None:
        raise ValueError("a twist needs position and orientation; one is not recorded")
    _, linear = local_polynomial(demo.time, demo.position, window=window, degree=degree)
    q, q_dot = (
        torch.from_numpy(array)
        for array in local_polynomial(demo.time, demo.orientation, window=window, degree=degree)
    )
    # A fitted quaternion is not quite of unit length; its own growth drops out of this part.
    product = quaternion.multiply(q_dot, quaternion.conjugate(q))
    angular = 2 * product[:, 1:] / q.square().sum(1, keepdim=True)
    return np.hstack([linear, angular.numpy()])
