"""Coupling to forces and to a second arm, at the level of velocities.

Gams et al. 2014, "Coupling movement primitives: interaction with the environment and
bimanual tasks". Where a push on the acceleration has the spring against it, a term C added
to the velocity moves the primitive as a whole:

    tau z_dot = alpha (beta (g - y) - z) + f + lead tau C_dot,   tau y_dot = z + C

C = tau gain error, the error one of force or of distance. A goal that disagrees with what is
wanted still pulls: at rest, feedback alone leaves 1 / (1 + K gain) of the error, K = k tau /
beta on a contact of stiffness k, 2 tau / beta between two arms. `learn` takes the rest away
over repetitions. Held over each step as all coupling is: first order in its length.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.spring import SpringDamper


def velocity_coupling(
    velocity: Float[Tensor, "*#batch D"],
    acceleration: Float[Tensor, "*#batch D"],
    *,
    spring: SpringDamper,
    duration: Float[Tensor, "*#batch"],
    lead: float = 0.0,
) -> Float[Tensor, "*batch D"]:
    """The `coupling` for `step` that acts as C added to the velocity.

    Eliminating z leaves alpha / tau V + (1 + lead) V_dot, V = C / tau: from an error, a
    proportional and a derivative term.

    Args:
        velocity: V, such as gain * (wanted - measured force) [m/s].
        acceleration: V_dot, such as -gain * (rate of the measured force) [m/s^2].
        spring: Of the primitive.
        duration: tau of the motion [s], `state.duration`.
        lead: Weight of C_dot on the acceleration as well, c_2 / tau there: more damping.
    """
    return spring.alpha / duration[..., None] * velocity + (1 + lead) * acceleration


def offset_error(
    position: Float[Tensor, "*#batch D"],
    velocity: Float[Tensor, "*#batch D"],
    other: Float[Tensor, "*#batch D"],
    other_velocity: Float[Tensor, "*#batch D"],
    wanted: Float[Tensor, "*#batch D"],
) -> tuple[Float[Tensor, "*batch D"], Float[Tensor, "*batch D"]]:
    """Wanted minus actual offset other - position, and its rate.

    Two arms keep their offset as one is coupled to gain * error and the other to minus
    that; an arm that follows takes all of it and the leader nothing.

    Args:
        position: Of the one arm [m].
        velocity: Its rate [m/s].
        other: Of the other arm, which is moved by plus the error.
        other_velocity: Its rate.
        wanted: Offset to keep.
    """
    return wanted - (other - position), velocity - other_velocity


def distance_error(
    position: Float[Tensor, "*#batch D"],
    velocity: Float[Tensor, "*#batch D"],
    other: Float[Tensor, "*#batch D"],
    other_velocity: Float[Tensor, "*#batch D"],
    wanted: Float[Tensor, "*#batch"] | float,
) -> tuple[Float[Tensor, "*batch D"], Float[Tensor, "*batch D"]]:
    """As `offset_error` for the distance alone, along the line from one arm to the other.

    The pair may turn. Where both are at one point there is no line: the error is zero.

    Args:
        position: Of the one arm [m].
        velocity: Its rate [m/s].
        other: Of the other arm, which is moved by plus the error.
        other_velocity: Its rate.
        wanted: Distance to keep [m].
    """
    offset, rate = other - position, other_velocity - velocity
    distance = offset.norm(dim=-1, keepdim=True)
    limit = wanted[..., None] if isinstance(wanted, Tensor) else wanted
    stretch = limit / distance.clamp_min(torch.finfo(distance.dtype).tiny) - 1
    stretch = torch.where(distance > 0, stretch, 0.0)
    # error = (wanted / d - 1) offset; d' = offset . rate / d
    along = (offset * rate).sum(-1, keepdim=True)
    bend = torch.where(distance > 0, (stretch + 1) * along, 0.0)
    square = torch.where(distance > 0, distance.square(), 1.0)
    return stretch * offset, stretch * rate - bend / square * offset


def learn(
    learned: Float[Tensor, "*batch T D"],
    error: Float[Tensor, "*batch T D"],
    *,
    gain: float,
    rate: float = 1.0,
    retention: float = 0.99,
) -> Float[Tensor, "*batch T D"]:
    """Feed-forward velocity for the next repetition, from the error of this one.

    V_i = learned_i + gain e_i,   learned_(i+1) = Q (learned_i + L gain e_i)

    (iterative learning control with the current iteration in the loop). With L = Q = 1
    what was fed back is fed forward, and at rest each repetition shrinks the error by the
    factor by which feedback alone does.

    Args:
        learned: Of this repetition, at its T steps; zeros at first [m/s].
        error: Met at these steps.
        gain: Of the feedback; [m/s] per unit of the error.
        rate: L.
        retention: Q, up to 1; the smaller, the more robust, and the more error stays.
    """
    return retention * (learned + rate * gain * error)
