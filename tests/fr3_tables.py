"""Published tables of the Franka Research 3, which differ in positions and velocity offsets."""

from dataclasses import replace

import torch

from hrc_learn.kinematics import JointLimits, fr3


def _table(source: str, **rows: tuple[float, ...]) -> JointLimits:
    values = {name: torch.tensor(row, dtype=torch.float64) for name, row in rows.items()}
    return replace(fr3.limits, vintage=source, **values)


# The range of the mechanical stops, in the newer sources.
_STOPS = {
    "lower": (-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508),
    "upper": (2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508),
}
FR3_TABLES = {
    "libfranka": _table(
        "compute{Upper,Lower}LimitsJointVelocity in rate_limiting.h of libfranka 0.10 to 0.21, "
        "and the robot's URDF in franka-sim 1.1.7",
        lower=(-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196),
        upper=(2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196),
        velocity_offset=(0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35),
    ),
    "description": _table(
        "URDF with position-based velocity limits, as in franky-sim 1.0.4",
        velocity_offset=(0.652, 0.25, 0.2005, 0.3542, 0.5738, 0.4885, 0.4592),
        **_STOPS,
    ),
    "documentation": _table(
        "control-parameters-joint-fr3.csv of Franka's documentation, as revised in a76efff, "
        "read in May 2026",
        velocity_offset=(0.6599, 0.2517, 0.2000, 0.3533, 0.5757, 0.4878, 0.4628),
        **_STOPS,
    ),
}
"""Limits by source."""
