"""Speed limits of an arm near a person, from the protective distance and from allowed contacts.

Speed and separation monitoring keeps a distance (`SeparationConfig`). For power and force
limiting, arm and body region are modelled as two masses with the spring of the region between
them (ISO 10218-2:2025, Annex M; formerly ISO/TS 15066:2016, A.3.4). A contact at the relative
speed v has the peak force v sqrt(mu k), with the stiffness k of the spring and

    1/mu = 1/m_H + 1/m_R,    1/m_R = n^T J M^-1 J^T n.

Here m_H is the effective mass of the body region, m_R the effective mass of the arm at its
posture, n the direction of approach, J the Jacobian of the contact point, and M the mass
matrix. A part of the body between the arm and furniture cannot yield: in this case we also
assume that the arm keeps pushing until it has stopped.

The values are those of ISO/TS 15066:2016, tables A.2 and A.3, as commonly quoted. Secondary
sources confirm the spring constants and masses, and state that the edition of 2025 kept the
tables. Compare the forces and pressures with the standard before you rely on them. None of this
is a certified safety function.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import Constant, check_settings
from hrc_learn.kinematics import Arm, CapsuleArm, Separation
from hrc_learn.kinematics.inertia import MassMatrix

PersonMode = Literal["ssm", "pfl", "ssm+pfl"]
"""Reaction to people: speed and separation monitoring, power and force limiting wherever
contact is allowed, or whichever of the two allows the higher speed."""


class BodyRegion(NamedTuple):
    """Limits and mechanics of a region of the body."""

    force: float
    """Limit of the quasi-static force [N], the lowest within the region; 0: no contact is
    allowed."""
    pressure: float
    """Limit of the quasi-static pressure [N/cm^2], the lowest within the region."""
    stiffness: float
    """Effective spring constant [N/mm]."""
    mass: float
    """Effective mass [kg]."""
    gap: float
    """Smallest gap that does not crush the region [m]: ISO 13854:2017, table 1."""


_REGIONS = tomllib.loads(Path(__file__).with_name("body_regions.toml").read_text("utf-8"))
BODY_REGIONS = {name: BodyRegion(**row) for name, row in _REGIONS.items()}
"""Regions by name: ISO/TS 15066:2016, tables A.2 and A.3."""
_TABLE = Constant(torch.tensor(list(BODY_REGIONS.values()), dtype=torch.float64))
# Transient limits are this many times the quasi-static limits (table A.2).
_TRANSIENT = 2.0
# Cosine of 60 degrees: furniture clamps a person if, seen from the arm, the directions of
# furniture and person differ by at most this angle.
_FACING = 0.5
# Distance of the arm from furniture below which the direction to the furniture is undefined
# [m].
_TOUCHING = 1e-6
# Excess speed that counts as rounding of the constraint solver [m/s].
_TOLERANCE = 1e-10


@dataclass(frozen=True, kw_only=True)
class ContactConfig:
    """Surface and inertia of the arm, and the fraction of the contact limits that is used."""

    area: float = 1.0
    """Smallest contact area [cm^2], as in the examples of ISO/TS 15066, table A.4."""
    padding: float = math.inf
    """Stiffness of a padding [N/mm]; infinite: no padding."""
    used: float = 0.9
    """Fraction of the limits that is used; the rest allows for errors in the masses of arm and
    load."""
    rotor_inertia: float = 0.1
    """Inertia of motor and gear at each joint [kg m^2]: the value of MuJoCo's Panda."""
    load: float = 0.5
    """Mass of an object in the gripper, at the tool centre point [kg]."""

    unbounded = ("padding",)

    def __post_init__(self) -> None:
        surface, masses = ("area", "padding"), ("rotor_inertia", "load")
        check_settings(self, positive=surface, not_negative=masses, fraction=["used"])


@dataclass(frozen=True, kw_only=True)
class SeparationConfig:
    """Settings of speed and separation monitoring and of power and force limiting.

    The first four fields are terms of the protective separation distance (ISO 10218-2:2025,
    Annex L; formerly ISO/TS 15066:2016, 5.5.4.2.3).
    """

    human_speed: float = 1.6
    """v_h, speed of the person towards the arm where it is not measured [m/s]: walking speed
    of ISO 13855."""
    reaction_time: float = 0.1
    """T_r, time from the person's motion to the arm's response [s]: sensing, transport, and
    about 20 ms for a control step and the ramp of the acceleration."""
    deceleration: float = 2.0
    """Deceleration a of the tool while the arm stops [m/s^2]: it gives the stopping time v/a
    and the stopping distance v^2/(2 a)."""
    clearance: float = 0.2
    """C + Z_d + Z_r, intrusion distance and position uncertainties of person and arm [m]: the
    distance that is left when the arm has stopped."""
    mode: PersonMode = "ssm"
    """Speed and separation monitoring ("ssm"), power and force limiting wherever contact is
    allowed ("pfl"), or whichever of the two allows the higher speed ("ssm+pfl"). Body regions
    that must not be touched are kept at the protective distance in all modes."""
    contact: ContactConfig = field(default_factory=ContactConfig)
    """Surface and inertia of the arm, for power and force limiting."""

    def __post_init__(self):
        terms = "human_speed", "reaction_time", "clearance"
        check_settings(self, positive=["deceleration"], not_negative=terms)

    def protective_distance(
        self, speed: Float[Tensor, "*batch"], human_speed: Float[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch"]:
        """S_p = v_h (T_r + v/a) + v T_r + v^2/(2 a) + C + Z_d + Z_r [m].

        Args:
            speed: v, closing speed of the arm [m/s]; negative counts as zero.
            human_speed: v_h, as in `highest_speed` [m/s].
        """
        v = speed.clamp(min=0)
        v_h = self.human_speed if human_speed is None else human_speed.clamp(min=0)
        stopping = v / self.deceleration
        arm = v * (self.reaction_time + stopping / 2)
        return v_h * (self.reaction_time + stopping) + arm + self.clearance

    def highest_speed(
        self,
        distance: Float[Tensor, "*batch"],
        human_speed: Float[Tensor, "*batch"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Speed towards a person that keeps the protective separation distance [m/s].

        The speed v solves d = S_p(v), see `protective_distance`; it is zero where the person is
        too close for any motion. An unknown distance (NaN) counts as zero.

        Args:
            distance: Distance between person and arm [m]; infinite: no person is near.
            human_speed: v_h, measured speed of the person towards the arm, plus the speed that
                the person may gain until the arm reacts [m/s]; negative counts as zero. None:
                the configured one.
        """
        a = self.deceleration
        v_h = self.human_speed if human_speed is None else human_speed.clamp(min=0)
        spare = distance - v_h * self.reaction_time - self.clearance
        spare = torch.where(spare > 0, spare, 0.0)  # NaN compares false: too close
        delay = self.reaction_time + v_h / a
        return a * (torch.sqrt(delay**2 + (2 / a) * spare) - delay)

    def allowed_speed(
        self,
        distance: Float[Tensor, "*batch"],
        human_speed: Float[Tensor, "*batch"],
        contact_speed: Float[Tensor, "*batch"] | None,
    ) -> Float[Tensor, "*batch"]:
        """Speed of the arm towards a person that `mode` allows [m/s].

        Args:
            distance: Distance between person and arm [m].
            human_speed: v_h, as in `highest_speed` [m/s].
            contact_speed: Highest relative speed of an allowed contact (`contact_limits`), zero
                where no contact is allowed [m/s]; None: no contact is allowed at all.
        """
        kept = self.highest_speed(distance, human_speed)
        if contact_speed is None or self.mode == "ssm":
            return kept
        touching = (contact_speed - human_speed.clamp(min=0)).clamp(min=0)
        if self.mode == "pfl":
            return torch.where(contact_speed > 0, touching, kept)
        return torch.maximum(kept, touching)

    def touches_gently(
        self,
        speed: Float[Tensor, "*batch"],
        human_speed: Float[Tensor, "*batch"],
        contact_speed: Float[Tensor, "*batch"] | None,
    ) -> Bool[Tensor, "*batch"]:
        """True where a contact at these speeds is allowed, so that no distance has to be kept.

        Args:
            speed: Closing speed of the arm [m/s].
            human_speed: v_h, as in `highest_speed` [m/s].
            contact_speed: As in `allowed_speed` [m/s].
        """
        if contact_speed is None or self.mode == "ssm":
            return torch.zeros_like(speed, dtype=torch.bool)
        gentle = speed + human_speed <= contact_speed + _TOLERANCE
        return gentle & (contact_speed > 0)


def region_numbers(names: Sequence[str]) -> Int[Tensor, " parts"]:
    """Indices of body regions, for `contact_speed`.

    Raises:
        ValueError: A name is not in `BODY_REGIONS`.
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
    separation: SeparationConfig,
) -> Float[Tensor, "*batch"]:
    """Highest relative speed of a contact within the limits of force and pressure [m/s].

    A free contact is transient. In a clamped contact the body cannot yield, and the
    quasi-static limits apply to two extreme models of the arm: a free mass, and a stiff drive
    that moves on for the reaction time and then brakes.

    Args:
        inverse_mass: 1/m_R of the arm in the direction of the contact [1/kg].
        region: Index of the body region.
        clamped: True where the body is between the arm and furniture.
        separation: Surface, reaction time and deceleration of the arm.
    """
    config, T, a = separation.contact, separation.reaction_time, separation.deceleration
    force, pressure, stiffness, mass, _ = _TABLE.like(inverse_mass)[region].unbind(-1)
    k = 1e3 / (1 / stiffness + 1 / config.padding)
    F = config.used * torch.minimum(force, pressure * config.area)
    free = _TRANSIENT * F * ((1 / mass + inverse_mass) / k).sqrt()
    driven = a * ((T**2 + 2 * F / (k * a)).sqrt() - T)
    held = torch.minimum(F * (inverse_mass / k).sqrt(), driven)
    return torch.where(clamped, torch.minimum(held, free), free)


class ContactSpeeds(NamedTuple):
    """Highest relative speeds of contacts [m/s]; zero where no contact is allowed."""

    first: Float[Tensor, "*batch C H"]
    """Speeds allowed at the first contact."""
    lasting: Float[Tensor, "*batch C H"]
    """Speeds that keep quasi-static limits, for contacts that last."""


class ContactLimits:
    """Contact speeds of an arm near furniture, for power and force limiting."""

    def __init__(self, arm: CapsuleArm, separation: SeparationConfig, furniture: Sequence[Box]):
        """Prepare the mass matrix of the arm.

        Args:
            arm: Capsules of arm and tool.
            separation: Reaction time, deceleration, surface and inertia of the arm.
            furniture: Boxes against which the arm may clamp people, in the base frame.

        Raises:
            ValueError: `arm.chain` is not an `Arm`, so the masses of its links are unknown.
        """
        if not isinstance(arm.chain, Arm):
            raise ValueError(
                f"power and force limiting (mode={separation.mode!r}) needs the masses of the "
                "arm: use one of `hrc_learn.kinematics.arm`, or mode='ssm'."
            )
        self._separation, self._furniture = separation, furniture
        self._mass = MassMatrix(arm.chain, separation.contact.rotor_inertia)

    def speeds(
        self,
        found: Separation,
        joints: Float[Tensor, "*batch joints"],
        regions: Int[Tensor, "*#batch H"],
        holds: bool,
    ) -> ContactSpeeds:
        """`contact_speed` for each pair of a part of the arm and a part of a person.

        Args:
            found: Distances between arm and person.
            joints: Joint positions [rad].
            regions: Body region of each part of the person (`region_numbers`).
            holds: True if the gripper holds an object.
        """
        mass = self._mass(joints, self._separation.contact.load if holds else 0.0)
        rows, factor = found.gradient.flatten(-3, -2), torch.linalg.cholesky(mass)
        whitened = torch.linalg.solve_triangular(factor, rows.mT, upper=False)
        inverse_mass = (whitened * whitened).sum(-2).unflatten(-1, found.distance.shape[-2:])
        regions = regions.unsqueeze(-2)
        held = clamped(found, self._furniture, _TABLE.like(mass)[regions][..., -1])
        first, lasting = (
            contact_speed(inverse_mass, regions, held, self._separation)
            for held in (held, torch.ones_like(held))
        )
        return ContactSpeeds(first, lasting)


def clamped(
    found: Separation, furniture: Sequence[Box], gap: Float[Tensor, "*#batch 1 H"]
) -> Bool[Tensor, "*batch C H"]:
    """True where the space between the arm and furniture behind the person is below `gap`.

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
