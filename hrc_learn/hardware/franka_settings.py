"""Settings of a Franka arm's control box, common to both drivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Load:
    """A load on the flange, in addition to the end effector that the arm is configured for."""

    mass: float = 0.0
    """[kg]"""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass, in the flange's frame [m]."""
    inertia: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3
    """About that centre, along the flange's axes [kg m^2]."""

    def __post_init__(self) -> None:
        if not 0 <= self.mass < float("inf"):
            raise ValueError(f"mass of a load must not be negative, but is {self.mass} kg.")
        if not np.isfinite(self.centre).all():
            raise ValueError(f"centre of a load must be finite, but is {self.centre} m.")
        tensor = np.array(self.inertia)
        if tensor.shape != (3, 3) or not np.allclose(tensor, tensor.T, rtol=1e-9, atol=0):
            raise ValueError(
                f"inertia of a load must be a symmetric matrix, 3 by 3, but is {self.inertia}."
            )
        if np.linalg.eigvalsh(tensor).min() < 0:
            raise ValueError(
                f"inertia of a load must not be negative about any axis, but is {self.inertia}."
            )


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """Estimated external load from which on the arm stops by a reflex.

    By default that of the maker's own example of joint velocities (libfranka,
    examples/generate_joint_velocity_motion.cpp), for contacts and collisions alike.
    """

    torque: tuple[float, ...] = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    """On each joint [N m]."""
    force: tuple[float, ...] = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
    """Threshold at the end effector: forces along x, y, z [N], torques about them [N m]."""

    def __post_init__(self) -> None:
        for name, number in (("torque", 7), ("force", 6)):
            values = getattr(self, name)
            if len(values) != number or not all(0 < v < float("inf") for v in values):
                raise ValueError(
                    f"{name} of a collision must be {number} positive numbers, but is {values}."
                )
