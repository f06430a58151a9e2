"""Coupling terms: effects of the robot, its surroundings and a second arm on a motion.

Terms are passed to `step` of a primitive as `phase_stopping` or as `coupling`. An obstacle is
described by the nearest point on its surface, so the terms need no shapes.

Errors of a force, or of the distance to a second arm, act on the velocity (Gams et al. 2014,
"Coupling movement primitives: interaction with the environment and bimanual tasks"). The spring
would oppose a term in the acceleration, whereas a term C in the velocity moves the whole
primitive:

    tau z_dot = alpha (beta (g - y) - z) + f + lead tau C_dot,   tau y_dot = z + C

Here f is the forcing term, z the scaled velocity, and C = tau gain error; `lead` adds damping
(see `velocity_coupling`). If the wanted force requires another position than the goal g, the
spring opposes it. At rest, feedback alone then leaves the fraction 1 / (1 + K gain) of the
error. K is k tau / beta in contact with a surface of stiffness k, and 2 tau / beta between two
arms. If the next repetition of the motion applies this feedback as feed-forward, the error
decreases by the same factor again. A coupling is constant over each step, which causes an error
of first order in the length of the step.

To keep two arms at the positions `position` and `other` a wanted offset apart, the error is
wanted - (other - position). The first arm receives minus the error, and the second arm plus the
error. If one arm follows the other, only the follower receives the error.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.dynamics import SpringDamper

TOUCH = 1e-3
"""Distance [m] below which repulsion stops growing, so that it stays finite at contact."""


def phase_stopping(
    planned: Float[Tensor, "*#batch D"], measured: Float[Tensor, "*#batch D"], gain: float
) -> Float[Tensor, "*batch"]:
    """Slow-down p for a robot that is held back: gain |planned - measured|^2.

    The clock of the primitive runs slower by the factor 1 + p (Ijspeert et al. 2013, "Dynamical
    movement primitives", section 2.5). There, p slows the phase alone. Here it slows the whole
    system, so that the motion waits on its path.

    Args:
        planned: Position of the primitive [rad] or [m].
        measured: Position of the robot, in the same units.
        gain: Gain [1/rad^2] or [1/m^2]; at a distance of 1 / sqrt(gain) the clock runs at
            half speed.
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

    The term is gamma R v phi exp(-beta phi). phi is the angle between the velocity v and the
    direction of the obstacle; R rotates v by 90 degrees away from the obstacle (Hoffmann et al.
    2009, "Biologically-inspired dynamical systems for movement generation", eq. 9). The term
    bends the path and keeps the speed. An obstacle straight ahead has no effect, because
    neither side is nearer.

    Args:
        position: Position of the motion [m].
        velocity: Velocity v [m/s].
        obstacles: Points to avoid [m].
        gain: Gain gamma [1/s].
        sharpness: Decay beta over the angle [1/rad]; larger values narrow the cone ahead in
            which obstacles act.
        reach: Distance [m] over which the effect fades to 1 / e; None: no fading, as published.
    """
    towards = obstacles - position[..., None, :]
    v = velocity[..., None, :].expand(towards.shape)
    normal = torch.linalg.cross(towards, v)
    sine, cosine = normal.norm(dim=-1, keepdim=True), (towards * v).sum(-1, keepdim=True)
    # Straight ahead and behind there is no axis: the term is zero.
    axis = normal / torch.where(sine > 0, sine, 1.0)
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
    """Acceleration away from obstacles closer than `reach` [m/s^2].

    It is minus the gradient of the potential U = gain / 2 (1 / d - 1 / reach)^2 at the distance
    d (Khatib 1986, "Real-time obstacle avoidance for manipulators and mobile robots").

    Args:
        position: Position of the motion [m].
        obstacles: Nearest point of each obstacle [m].
        reach: Distance below which obstacles act [m].
        gain: Factor on the potential U [m^4/s^2].
    """
    away = position[..., None, :] - obstacles
    distance = away.norm(dim=-1, keepdim=True)
    d = distance.clamp_min(TOUCH)
    # Obstacles farther than `reach` have no effect.
    strength = gain * (1 / d - 1 / reach).clamp_min(0) / d**2
    # At distance zero, the direction away from the obstacle is undefined: the term is zero.
    return (strength * away / torch.where(distance > 0, distance, 1.0)).sum(-2)


def velocity_coupling(
    velocity: Float[Tensor, "*#batch D"],
    acceleration: Float[Tensor, "*#batch D"],
    *,
    spring: SpringDamper,
    duration: Float[Tensor, "*#batch"],
    lead: float = 0.0,
) -> Float[Tensor, "*batch D"]:
    """Coupling for `step` that acts as a term C added to the velocity.

    The result is alpha / tau V + (1 + lead) V_dot with V = C / tau, a proportional and a
    derivative term of the error. It follows from the equations at the top of this module by
    elimination of z.

    Args:
        velocity: Velocity V, for example gain * (wanted - measured force) [m/s].
        acceleration: Its derivative V_dot, for example -gain * (rate of the measured force)
            [m/s^2].
        spring: Gains of the primitive.
        duration: Duration tau of the motion [s], `state.duration`.
        lead: Additional weight of C_dot on the acceleration (c_2 / tau in the source), for more
            damping.
    """
    return spring.alpha / duration[..., None] * velocity + (1 + lead) * acceleration
