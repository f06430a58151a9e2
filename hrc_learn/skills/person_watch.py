"""Distances of every part of an arm from the people near it, as seen by a tracker."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import ConstraintConfig, Distances, SafetyConfig, SeparationConfig
from hrc_learn.controller.arm_loop_state import WatchedPeople
from hrc_learn.controller.contact_limits import ContactLimits, ContactSpeeds, region_numbers
from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import CapsuleArm, GraspedBox, Separation, separation
from hrc_learn.protocols import PersonTracker

_NAN = math.nan
# Distance that is reported while no person is seen: no protective distance is that large [m].
_NO_PERSON = 100.0
# Largest time by which the tracker's clock may be ahead of the arm's [s]. An observation whose
# time stamp is further ahead has an unknown age.
_CLOCK_ERROR = 0.05
# Time in which an arm comes to rest [s]. The arm's drivers brake with 0.7 of the highest joint
# acceleration; a joint of a Panda then stops from 0.8 rad/s in this time. This time determines
# the speed scale near people. Without the speed scale, the arm came too close to a worker in up
# to 7 of 60 jobs.
_COMING_TO_REST = 0.15

NEAR_PEOPLE = ConstraintConfig(distance_weight=0.02)
"""Constraint layer of an arm near people. The path has priority over the distance: the arm need
not leave its path, since it can brake on the path within the reaction time that the protective
distance includes. The end effector then deviates from its path by 0.5 mm; with priority for the
distance, it would deviate by 6 mm. Near a worker, higher weights take time and lower ones
let the end effector deviate more (`benchmarks/complementarity_map.py`)."""


@dataclass(frozen=True, kw_only=True)
class PersonWatchConfig:
    """Assumptions about people between two observations."""

    acceleration: float = 5.0
    """Highest acceleration of a person between two observations [m/s^2]. People begin a step
    with 1 to 2 m/s^2; a hand that reaches for an object near the arm accelerates with up to
    9 m/s^2. With 3 m/s^2, the arm came too close to such a hand in 3 of 1000 jobs."""
    pairs: int = 8
    """Number of pairs (a part of the arm, a part of a person) that are kept apart. The most
    urgent pairs are chosen."""
    contact: float = 0.03
    """Observed distance below which a person may already touch the arm [m]: three standard
    deviations of a tracker's noise. The arm then stops, because the direction away from the
    person is unknown. Where contact is allowed, the arm does not stop, but the limits of
    lasting contacts apply."""
    fastest: float = 0.5
    """Speed from which the arm is assumed to come to rest within 0.15 s [m/s]. The speed cap
    follows from this assumption."""

    def __post_init__(self) -> None:
        if math.isnan(self.contact):
            raise ValueError("contact is NaN: give a distance [m]; a negative one turns it off")
        check_settings(self, positive=("pairs", "fastest"), not_negative=["acceleration"])


class PersonWatch:
    """Turns the observations of a tracker into distances that a safety filter keeps."""

    def __init__(
        self,
        tracker: PersonTracker,
        arm: CapsuleArm,
        separation: SeparationConfig | None = None,
        config: PersonWatchConfig | None = None,
        furniture: Sequence[Box] = (),
    ):
        """Begin without an observation.

        Args:
            tracker: Tracker of the people.
            arm: Capsules of arm and tool.
            separation: Protective distance and mode. With power and force limiting, the
                highest contact speeds of all pairs are computed, too.
            config: Assumptions about people.
            furniture: Boxes against which the arm may clamp people, in the base frame.

        Raises:
            ValueError: The mode needs the masses of the arm, but the arm has none.
        """
        self._tracker, self._arm = tracker, arm
        self._separation = separation or SeparationConfig()
        self._config = config or PersonWatchConfig()
        self._limits = None
        if self._separation.mode != "ssm":
            self._limits = ContactLimits(arm, self._separation, furniture)

    def watchful(self, safety: SafetyConfig) -> SafetyConfig:
        """Settings of a safety filter, changed so that it keeps the distances from people."""
        constraints = safety.constraints or NEAR_PEOPLE
        return replace(safety, constraints=constraints, separation=self._separation)

    def look(
        self, time: float, joints: Float[Tensor, " joints"], load: GraspedBox | None = None
    ) -> WatchedPeople:
        """People near the arm now. If the observation or the joint positions are not valid, the
        distances are NaN, and the arm brakes.

        Args:
            time: Reading of the clock [s].
            joints: Joint positions [rad].
            load: Object in the gripper; None: no object.
        """
        seen, number = self._tracker.read(), self._config.pairs
        age, usable = _NAN, False
        if seen is not None:
            age, numbers = time - seen.time, (seen.ends, seen.velocity, seen.radius)
            usable = age >= -_CLOCK_ERROR and all(np.isfinite(x).all() for x in numbers)
            usable = usable and (seen.radius >= 0).all() and bool(joints.isfinite().all())
        if seen is None or not usable or not len(seen.ends):
            distance = joints.new_full((number,), _NO_PERSON if usable else _NAN)
            return WatchedPeople(
                distances=Distances(
                    distance=distance,
                    gradient=joints.new_zeros(number, len(joints)),
                    approach_speed=torch.zeros_like(distance),
                    person=torch.ones_like(distance, dtype=torch.bool),
                ),
                nearest=distance[0],
                age=joints.new_tensor(age),
                speed_scale=joints.new_tensor(1.0),
                speed_cap=joints.new_tensor(math.inf),
            )
        ends, radius, velocity = (
            torch.from_numpy(x).to(joints) for x in (seen.ends, seen.radius, seen.velocity)
        )
        found = separation(self._arm, joints, ends, radius, load)
        contact = None
        if self._limits is not None and seen.regions:
            regions = region_numbers(seen.regions)
            contact = self._limits.speeds(found, joints, regions, load is not None)
        late = joints.new_tensor(max(age, 0.0))
        return watched_people(found, velocity, late, self._separation, self._config, contact)


def watched_people(
    found: Separation,
    velocity: Float[Tensor, "*batch H 2 3"],
    age: Float[Tensor, "*batch"],
    separation: SeparationConfig,
    config: PersonWatchConfig,
    contact: ContactSpeeds | None = None,
) -> WatchedPeople:
    """Distances to keep from people, and limits of the speed near them.

    The protective distance limits only the speed towards people. An arm that moves past people
    or makes way for them could still move when they reach it. Therefore a speed scale brings
    the arm to rest before people can touch any part of it, even if they accelerate. People
    moving away count as at rest: a tracker averages over several images, and a hand can reverse
    its motion faster than the tracker shows.

    Where contact is allowed, a speed cap replaces the speed scale: before people can touch the
    arm, it is at rest or slow enough for a contact in any direction.

    Args:
        found: Distances between the arm as it is now and people as they were observed.
        velocity: Velocities of the ends of the people's capsules [m/s].
        age: Age of the observation [s].
        separation: Settings of the protective distance, which decides how urgent a pair is.
        config: Assumptions about people.
        contact: Highest relative speeds of contacts; None: no contact is allowed.
    """
    a, rate = config.acceleration, found.person_rate(velocity)
    late = (age + separation.reaction_time)[..., None, None]
    # Speed of people towards the arm, plus the speed that they may gain between the observation
    # and the reaction of the arm.
    towards = (a * late - rate).clamp(min=0).flatten(-2)
    distance = found.distance.flatten(-2) - age.unsqueeze(-1) * towards
    # A contact that has begun may last, so the quasi-static limits apply to it.
    near, speed = found.distance < config.contact, None
    if contact is not None:
        speed = torch.where(near, contact.lasting, contact.first).flatten(-2)
        near = near & (contact.first <= 0)
    allowed = separation.allowed_speed(distance, towards, speed)
    # Among pairs that allow no approach, the nearest pairs are the most urgent.
    number = min(config.pairs, distance.shape[-1])
    _, urgent = (allowed + 1e-3 * distance).topk(number, dim=-1, largest=False)
    touching = near.flatten(-2).any(-1, keepdim=True)
    distances = Distances(
        distance=distance.gather(-1, urgent).masked_fill(touching, _NAN),
        gradient=found.gradient_of(urgent),
        approach_speed=towards.gather(-1, urgent),
        person=torch.ones_like(urgent, dtype=torch.bool),
        contact_speed=None if speed is None else speed.gather(-1, urgent),
    )

    coming = (-rate).clamp(min=0)
    # The arrival time t solves  coming t + a t^2/2 = gap.
    gap = (found.distance - config.contact).clamp(min=0)
    arrival = 2 * gap / (coming + (coming**2 + 2 * a * gap).sqrt()).clamp(min=1e-9)
    scale = ((arrival - late) / _COMING_TO_REST).clamp(0, 1)
    cap = torch.full_like(scale, math.inf)
    if contact is not None:
        slowest = torch.maximum(contact.first - coming - a * late, config.fastest * scale)
        touchable = contact.first > 0
        cap = torch.where(touchable & (scale < 1), slowest, math.inf)
        scale = scale.masked_fill(touchable, 1.0)
    return WatchedPeople(
        distances=distances,
        nearest=found.distance.amin((-2, -1)),
        age=age,
        speed_scale=scale.amin((-2, -1)),
        speed_cap=cap.amin((-2, -1)),
    )
