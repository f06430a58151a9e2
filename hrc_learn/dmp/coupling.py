"""What a robot and its surroundings add to a motion while it is stepped.

Functions of positions and velocities in one frame; `step` takes their results as `slowdown`
or as `coupling`. Obstacles are points on their surfaces, the nearest of each, so that the
terms know no shapes: see `nearest_on_sphere` and `nearest_on_box`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

TOUCH = 1e-3
"""Nearer than this [m], repulsion grows no further: it has no bound at contact."""


def phase_stopping(
    planned: Float[Tensor, "*#batch D"], measured: Float[Tensor, "*#batch D"], gain: float
) -> Float[Tensor, "*batch"]:
    """Slow-down that waits for a robot that is held back: gain |planned - measured|^2.

    (Ijspeert et al. 2013, "Dynamical movement primitives", section 2.5; here it slows the
    whole system, not the phase alone, so that the motion waits on its path.)

    Args:
        planned: Position of the primitive.
        measured: Position of the robot.
        gain: 1 / [rad^2] or 1 / [m^2]; the clock runs at half speed at 1 / sqrt(gain).
    """
    return gain * (planned - measured).square().sum(-1)


def steering(
    position: Float[Tensor, "*#batch 3"],
    velocity: Float[Tensor, "*#batch 3"],
    obstacles: Float[Tensor, "*#batch n 3"],
    *,
    gain: float = 1000.0,
    sharpness: float = 20.0 / torch.pi,
    reach: float | None = None,
) -> Float[Tensor, "*batch 3"]:
    """Acceleration that turns the velocity away from obstacles ahead [m/s^2].

    gamma R v phi exp(-beta phi), phi the angle between velocity and obstacle, R a quarter
    turn away from it (Hoffmann et al. 2009, "Biologically-inspired dynamical systems for
    movement generation", eq. 9). It bends the path and neither drives nor brakes. An obstacle
    straight ahead has no side to pass on, and turns nothing.

    Args:
        position: [m].
        velocity: [m/s].
        obstacles: Points to avoid [m].
        gain: gamma [1/s].
        sharpness: beta [1/rad]; the larger, the narrower the cone ahead that matters.
        reach: Distance [m] over which the effect fades to 1 / e; None, as published: never.
    """
    towards = obstacles - position[..., None, :]
    v = velocity[..., None, :].expand(towards.shape)
    normal = torch.linalg.cross(towards, v)
    sine, cosine = normal.norm(dim=-1, keepdim=True), (towards * v).sum(-1, keepdim=True)
    axis = normal / sine.clamp_min(torch.finfo(sine.dtype).tiny)
    angle = torch.atan2(sine, cosine)
    term = gain * torch.linalg.cross(axis, v) * angle * torch.exp(-sharpness * angle)
    if reach is not None:
        term = term * torch.exp(-towards.norm(dim=-1, keepdim=True) / reach)
    return term.sum(-2)


def repulsion(
    position: Float[Tensor, "*#batch 3"],
    obstacles: Float[Tensor, "*#batch n 3"],
    *,
    reach: float,
    gain: float = 1e-3,
) -> Float[Tensor, "*batch 3"]:
    """Acceleration away from obstacles nearer than `reach` [m/s^2].

    Minus the gradient of U = gain / 2 (1 / d - 1 / reach)^2, d the distance (Khatib 1986,
    "Real-time obstacle avoidance for manipulators and mobile robots").

    Args:
        position: [m].
        obstacles: Nearest points of them [m].
        reach: [m].
        gain: [m^4/s^2].
    """
    away = position[..., None, :] - obstacles
    distance = away.norm(dim=-1, keepdim=True)
    d = distance.clamp_min(TOUCH)
    strength = gain * (1 / d - 1 / reach).clamp_min(0) / d**2
    return (strength * away / d).sum(-2)


def nearest_on_sphere(
    position: Float[Tensor, "*#batch 3"],
    centre: Float[Tensor, "*#batch 3"],
    radius: Float[Tensor, "*#batch"] | float,
) -> Float[Tensor, "*batch 3"]:
    """Point of a solid sphere nearest to `position` [m]; `position` itself inside."""
    offset = position - centre
    distance = offset.norm(dim=-1, keepdim=True)
    limit = radius[..., None] if isinstance(radius, Tensor) else radius
    inwards = (limit / distance.clamp_min(torch.finfo(distance.dtype).tiny)).clamp_max(1)
    return centre + offset * inwards


def nearest_on_box(
    position: Float[Tensor, "*#batch 3"],
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Point of a solid box along the axes nearest to `position` [m]; itself inside."""
    return torch.minimum(torch.maximum(position, centre - half_size), centre + half_size)
