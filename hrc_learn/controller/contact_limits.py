"""Power and force limiting: the speed at which an arm may touch each region of a person's body.

Arm and body region are two masses with the spring of the region between them (ISO 10218-2:2025,
Annex M; before it ISO/TS 15066:2016, A.3.4). A contact at the relative speed v has the peak
force v sqrt(mu k), with 1/mu = 1/m_H + 1/m_R and the effective mass of the arm at its posture

    1/m_R = n^T J M^-1 J^T n

along the direction n of approach. A part of the body between the arm and furniture cannot
yield: there the arm is also taken to push on until it has stopped.

The values are those of ISO/TS 15066:2016, tables A.2 and A.3, as commonly quoted; secondary
sources confirm the spring constants and masses, and that the edition of 2025 kept the tables.
Compare forces and pressures with the standard before you rely on them. None of this is a
certified safety function.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.setting_checks import check_settings
from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import Constant
from hrc_learn.kinematics import Separation

PersonMode = Literal["ssm", "pfl", "ssm+pfl"]
"""Reaction to people: speed and separation monitoring, power and force limiting wherever
contact is allowed, or the one of the two that allows the higher speed."""


class BodyRegion(NamedTuple):
    """Limits and mechanics of a region of the body."""

    force: float
    """Largest quasi-static force [N], the smallest of the region; 0: no contact is allowed."""
    pressure: float
    """Largest quasi-static pressure [N/cm^2], the smallest of the region."""
    stiffness: float
    """Effective spring constant [N/mm]."""
    mass: float
    """Effective mass [kg]."""
    gap: float
    """Smallest gap that does not crush the region [m]: ISO 13854:2017, table 1."""


BODY_REGIONS: dict[str, BodyRegion] = {
    # Transient limits do not exist for skull and face; a tracker does not tell the larynx,
    # for which there are none either, from the rest of the neck.
    "head": BodyRegion(0.0, 0.0, 75.0, 4.4, 0.3),
    "neck": BodyRegion(0.0, 0.0, 50.0, 1.2, 0.3),
    "back and shoulders": BodyRegion(210.0, 160.0, 35.0, 40.0, 0.5),
    "chest": BodyRegion(140.0, 120.0, 25.0, 40.0, 0.5),
    "abdomen": BodyRegion(110.0, 140.0, 10.0, 40.0, 0.5),
    "pelvis": BodyRegion(180.0, 210.0, 25.0, 40.0, 0.5),
    "upper arm": BodyRegion(150.0, 190.0, 30.0, 3.0, 0.12),
    "lower arm": BodyRegion(160.0, 180.0, 40.0, 2.0, 0.12),
    "hand": BodyRegion(140.0, 190.0, 75.0, 0.6, 0.1),
    "thigh": BodyRegion(220.0, 220.0, 50.0, 75.0, 0.18),
    "lower leg": BodyRegion(130.0, 210.0, 60.0, 75.0, 0.18),
}
"""Regions by name: ISO/TS 15066:2016, tables A.2 and A.3."""
_TABLE = Constant(torch.tensor(list(BODY_REGIONS.values()), dtype=torch.float64))
# Transient limits are this many times the quasi-static ones (table A.2).
_TRANSIENT = 2.0
# Furniture clamps a part of the body that the arm pushes towards it, within 60 degrees.
_FACING = 0.5
# Smallest distance that has a direction [m].
_TOUCHING = 1e-6


@dataclass(frozen=True, kw_only=True)
class ContactConfig:
    """Surface of the arm, and the part of the limits that is used."""

    area: float = 1.0
    """Smallest contact area [cm^2]: that of the examples of ISO/TS 15066, table A.4."""
    padding: float = math.inf
    """Stiffness of a padding [N/mm]; infinite: none."""
    used: float = 0.9
    """Fraction of the limits that is used, for errors of the masses of arm and load."""
    rotor_inertia: float = 0.1
    """Inertia of motor and gear at each joint [kg m^2]: that of MuJoCo's Panda."""
    load: float = 0.5
    """Mass of an object in the gripper, at the tool centre point [kg]."""

    def __post_init__(self) -> None:
        masses = "rotor_inertia", "load"
        check_settings(self, positive=("area", "padding", "used"), not_negative=masses)
        if self.used > 1:
            raise ValueError(f"used must be at most 1, but is {self.used}")


def region_numbers(names: Sequence[str]) -> Int[Tensor, " parts"]:
    """Numbers of body regions, for `contact_speed`.

    Raises:
        ValueError: There is no such region.
    """
    known = list(BODY_REGIONS)
    for name in names:
        if name not in known:
            raise ValueError(f"no body region {name!r}; there are {', '.join(known)}")
    return torch.tensor([known.index(name) for name in names], dtype=torch.int64)


def contact_speed(
    inverse_mass: Float[Tensor, "*batch"],
    region: Int[Tensor, "*#batch"],
    clamped: Bool[Tensor, "*#batch"],
    config: ContactConfig,
    reaction_time: float,
    deceleration: float,
) -> Float[Tensor, "*batch"]:
    """Highest relative speed of a contact that keeps force and pressure [m/s].

    A free contact is transient. In a clamped one the body does not yield, and quasi-static
    limits hold for both extremes of the arm: a mass without drive, and a stiff drive that goes
    on for the reaction time and then brakes.

    Args:
        inverse_mass: 1/m_R of the arm in the direction of the contact [1/kg].
        region: Number of the body region.
        clamped: True where the body is between the arm and furniture.
        config: Surface of the arm.
        reaction_time: Time from the contact to the begin of braking [s].
        deceleration: Deceleration of the arm [m/s^2].
    """
    table = _TABLE.like(inverse_mass)[region]
    force, pressure, stiffness, mass, _ = table.unbind(-1)
    k = 1e3 / (1 / stiffness + 1 / config.padding)
    F = config.used * torch.minimum(force, pressure * config.area)
    free = _TRANSIENT * F * ((1 / mass + inverse_mass) / k).sqrt()
    T, a = reaction_time, deceleration
    driven = a * ((T**2 + 2 * F / (k * a)).sqrt() - T)
    held = torch.minimum(F * (inverse_mass / k).sqrt(), driven)
    return torch.where(clamped, torch.minimum(held, free), free)


class ContactSpeeds(NamedTuple):
    """Highest relative speeds of contacts [m/s]; zero where none is allowed."""

    first: Float[Tensor, "*batch C H"]
    """Speeds at which arm and person may meet."""
    lasting: Float[Tensor, "*batch C H"]
    """Speeds that keep quasi-static limits, for contacts that last."""


def contact_speeds(
    found: Separation,
    mass: Float[Tensor, "*#batch joints joints"],
    region: Int[Tensor, "*#batch H"],
    furniture: Sequence[Box],
    config: ContactConfig,
    reaction_time: float,
    deceleration: float,
) -> ContactSpeeds:
    """`contact_speed` of all parts of an arm with all parts of a person [m/s].

    Args:
        found: Distances between arm and person.
        mass: Mass matrix of the arm with its load.
        region: Body region of each part of the person.
        furniture: Boxes against which a person may be clamped, in the base frame.
        config: Surface of the arm.
        reaction_time: Time from the contact to the begin of braking [s].
        deceleration: Deceleration of the arm [m/s^2].
    """
    rows, factor = found.gradient.flatten(-3, -2), torch.linalg.cholesky(mass)
    whitened = torch.linalg.solve_triangular(factor, rows.mT, upper=False)
    inverse_mass = (whitened * whitened).sum(-2).unflatten(-1, found.distance.shape[-2:])
    region = region.unsqueeze(-2)
    held = clamped(found, furniture, _TABLE.like(mass)[region][..., -1])

    def speeds(held: Tensor) -> Tensor:
        return contact_speed(inverse_mass, region, held, config, reaction_time, deceleration)

    return ContactSpeeds(speeds(held), speeds(torch.ones_like(held)))


def clamped(
    found: Separation, furniture: Sequence[Box], gap: Float[Tensor, "*#batch 1 H"]
) -> Bool[Tensor, "*batch C H"]:
    """True where less than a gap is left between the arm and furniture behind the person.

    Args:
        found: Distances between arm and person.
        furniture: Boxes in the base frame.
        gap: Smallest gap that does not crush each part of the person [m].
    """
    held = torch.zeros_like(found.distance, dtype=torch.bool)
    for box in furniture:
        point = found.on_arm
        centre, half = point.new_tensor(box.centre), point.new_tensor(box.half_size)
        way = centre + (point - centre).clamp(-half, half) - point
        far = way.norm(dim=-1)
        facing = (way * found.direction).sum(-1) >= _FACING * far
        held = held | ((far < gap) & (facing | (far < _TOUCHING)))
    return held
