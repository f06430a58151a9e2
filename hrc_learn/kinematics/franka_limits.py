"""Limits of the joints of Franka's arms, as published; the strictest where sources differ."""

from __future__ import annotations

import torch

from hrc_learn.kinematics.limits import JointLimits


def _limits(vintage: str, **rows: tuple[float, ...]) -> JointLimits:
    table = {name: torch.tensor(row, dtype=torch.float64) for name, row in rows.items()}
    return JointLimits(vintage=vintage, **table)


PANDA_LIMITS = _limits(
    "Franka Emika Panda (FER), FCI documentation up to libfranka 0.9",
    lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity=(2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100),
    acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    torque=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
)
"""Franka's "Robot and interface specifications", control-parameters-joint-fer.csv."""

# What all sources for the Research 3 agree on.
_FR3 = {
    "velocity": (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    "acceleration": (10.0,) * 7,
    "jerk": (5000.0,) * 7,
    "torque": (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
    "deceleration": (6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0),
}
# The range of the mechanical stops, in the newer sources.
_STOPS = {
    "lower": (-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508),
    "upper": (2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508),
}
FR3_VINTAGES = {
    "libfranka": _limits(
        "Franka Research 3, compute{Upper,Lower}LimitsJointVelocity in rate_limiting.h of "
        "libfranka 0.10 to 0.21, and the robot's URDF in franka-sim 1.1.7",
        lower=(-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196),
        upper=(2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196),
        velocity_offset=(0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35),
        **_FR3,
    ),
    "description": _limits(
        "Franka Research 3, URDF with position-based velocity limits, as in franky-sim 1.0.4",
        velocity_offset=(0.652, 0.25, 0.2005, 0.3542, 0.5738, 0.4885, 0.4592),
        **_STOPS,
        **_FR3,
    ),
    "documentation": _limits(
        "Franka Research 3, control-parameters-joint-fr3.csv of Franka's documentation, as "
        "revised in a76efff, read in May 2026",
        velocity_offset=(0.6599, 0.2517, 0.2000, 0.3533, 0.5757, 0.4878, 0.4628),
        **_STOPS,
        **_FR3,
    ),
}
"""Limits by source. They differ in the position limits and in the offsets of the position-based
velocity limits. A robot uses those of the URDF that it sends to its driver, hence of its system
image.
"""


def strictest(*vintages: JointLimits) -> JointLimits:
    """Limits that keep all of the given ones, at every position.

    The innermost limits of position, and of velocity the smallest offset whose curve stays
    below all. With the distance w from the innermost limit to that of one vintage, d alike, its
    curve and ours are nearest where its velocity limit is reached, so there they meet at

        o = sqrt((velocity + o_k)^2 - 2 d w) - velocity.

    Args:
        vintages: With the same limits of velocity and deceleration.

    Raises:
        ValueError: Those differ.
    """
    first = vintages[0]
    v, d = first.velocity, first.deceleration
    if d is None or not all(
        k.deceleration is not None
        and torch.equal(k.deceleration, d)
        and torch.equal(k.velocity, v)
        for k in vintages
    ):
        raise ValueError(
            "only vintages with the same limits of velocity and deceleration can be combined"
        )
    lower = torch.stack([k.lower for k in vintages]).amax(0)
    upper = torch.stack([k.upper for k in vintages]).amin(0)
    offsets = []
    for k in vintages:
        assert k.velocity_offset is not None
        # The nearer of both sides, which asks for more.
        w = torch.minimum(k.upper - upper, lower - k.lower)
        offsets.append(((v + k.velocity_offset) ** 2 - 2 * d * w).sqrt() - v)
    return JointLimits(
        lower=lower,
        upper=upper,
        velocity=v,
        acceleration=torch.stack([k.acceleration for k in vintages]).amin(0),
        jerk=torch.stack([k.jerk for k in vintages]).amin(0),
        torque=torch.stack([k.torque for k in vintages]).amin(0),
        velocity_offset=torch.stack(offsets).amax(0),
        deceleration=d,
        vintage="the strictest of: " + "; ".join(k.vintage for k in vintages),
    )


FR3_LIMITS = strictest(*FR3_VINTAGES.values())
"""Kept by every Research 3, whichever of these tables it has."""
