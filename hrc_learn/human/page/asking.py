"""What all who hold the arm ask of it together."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ...geometry import Pose
from ...kinematics import SerialChain
from ..coarse_orientation import coarse_orientation
from ..drag import DragConfig, bounded, drag_effort, hand_twist
from .grips import Grip


@dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """Effort and motion, and the arrows that show where they come from."""

    effort: Float[np.ndarray, " joints"]
    """Null-space effort d [N m]."""
    twist: Float[np.ndarray, "6"]
    """Of the hand, linear [m/s] and angular [rad/s]."""
    arrows: Float[np.ndarray, "grips 2 3"]
    """From the point held to the handle, in the base frame [m]."""


def ask(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    grips: Collection[Grip],
    config: DragConfig,
    *,
    coarse: bool = True,
) -> Asked:
    """What comes of several grips: their efforts add up, and are bounded as one is.

    Args:
        chain: The arm.
        joint_position: Where it is [rad].
        grips: Who holds it where.
        config: How strongly handles act.
        coarse: Whether a hand that is led turns by the coarse orientation rule; otherwise it
            turns as its handle is turned, if it is.
    """
    links = chain.link_poses(torch.as_tensor(joint_position, dtype=torch.float64))
    hand = links[-1]
    effort, velocity = np.zeros(len(chain.joint_names)), np.zeros(3)
    orientation, led = None, False
    arrows = np.empty((len(grips), 2, 3))
    for k, grip in enumerate(grips):
        point = _point_held(links, grip)
        displacement = grip.pointer - point
        arrows[k] = point, grip.pointer
        if grip.joint is not None:
            effort += drag_effort(
                chain, joint_position, grip.joint, point, displacement, config
            )
            continue
        led = True
        velocity += config.rate * displacement
        if grip.orientation is not None:
            orientation = torch.as_tensor(grip.orientation, dtype=torch.float64)
    if coarse:
        orientation = coarse_orientation(hand.position)
    return Asked(
        effort=bounded(effort, config.largest_effort),
        twist=hand_twist(hand, velocity, orientation, config) if led else np.zeros(6),
        arrows=arrows,
    )


def _point_held(links: Pose, grip: Grip) -> Float[np.ndarray, "3"]:
    """Where the point held is now, in the base frame [m]."""
    if grip.joint is None:
        return links[-1].position.numpy() + grip.held_at
    return links[grip.joint - 1].apply(torch.as_tensor(grip.held_at)).numpy()
