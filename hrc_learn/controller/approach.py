"""A joint-space approach to a posture, and when task-space feedback takes over from it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.activation import fade
from hrc_learn.controller.resolution import excess_speed
from hrc_learn.regions import PostureRegion

# Region function of the posture beyond which an approach begins anew: at the default
# tolerance of 0.5 rad, a distance of 1.5 rad.
_FAR_AWAY = 2.0


def approach_velocity(
    posture: PostureRegion,
    joint_position: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    caps: Float[Tensor, "2"],
) -> Float[Tensor, "*batch n"]:
    """Joint velocity towards a posture, as slow as the caps of the tool ask [rad/s].

    Args:
        posture: Where to go.
        joint_position: Now [rad].
        jacobian: Geometric Jacobian of the tool.
        caps: Highest linear and angular speed of the tool [m/s, rad/s].
    """
    velocity = -posture.gradient(joint_position)
    twist = torch.linalg.vecdot(jacobian, velocity.unsqueeze(-2))
    return velocity / excess_speed(twist, caps)


def next_arrival(
    arrival: Float[Tensor, "*batch"],
    posture: PostureRegion | None,
    joint_position: Float[Tensor, "*batch n"],
    following: Bool[Tensor, "*batch"],
    dt: float | Float[Tensor, ""],
    blend_time: float,
) -> Float[Tensor, "*batch"]:
    """Share in which task-space feedback has taken over from the approach, 0 to 1.

    It does so inside the posture region: earlier it would lead an arm from whatever posture it
    is in, and many of those end at a joint limit. Once it has, it keeps the lead, also where a
    person or the task moves the joints out of the region, unless the posture lies far away, as
    when a new phase begins.

    Args:
        arrival: The share after the step before.
        posture: Of the approach; None: there is none.
        joint_position: Now [rad].
        following: Whether the camera leads the arm, which then is not called back.
        dt: Step [s].
        blend_time: Time in which to take over [s].
    """
    if posture is None:
        return torch.zeros_like(arrival)
    f = posture.value(joint_position)
    leads = (arrival > 0) & ((f <= _FAR_AWAY) | following)
    return fade(arrival, leads | (f <= 0), dt, blend_time)
