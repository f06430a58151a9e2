"""Distances of every part of an arm from the people near it, as seen by a tracker."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
# Time in which an arm comes to rest [s]: a joint of a Panda from 0.8 rad/s with 0.7 of its
# acceleration, as drivers plan. Without this rule up to 7 of 60 jobs near a worker came too
# close.
_COMING_TO_REST = 0.15

NEAR_PEOPLE = ConstraintConfig(distance_weight=0.1)
"""Constraint layer of an arm near people. An arm may always come to rest before them, so it
need not leave its path: the path comes before the distance, and the arm brakes on it within the
reaction time that the protective distance allows for. The end effector then leaves its path by
0.5 mm, and by 6 mm if the distance comes first. The solver may stop early, as steps are not
compiled."""


@dataclass(frozen=True, kw_only=True)
class PersonWatchConfig:
    """Assumptions about people between two observations."""

    acceleration: float = 5.0
    """Highest acceleration of a person between two observations [m/s^2]. People begin a step
    with 1 to 2 m/s^2; a hand that reaches for an object near the arm accelerates with up to
    9 m/s^2. With 3 m/s^2, 3 of 1000 jobs near such hands came too close."""
    pairs: int = 8
    """Number of pairs of a part of the arm and a part of a person that are kept apart: the most
    urgent ones."""
    contact: float = 0.03
    """Observed distance below which a person may touch the arm [m], three standard deviations
    of a tracker's noise. The arm stops, as the direction away from the person is not known;
    where contact is allowed it only stops to approach the person."""
    fastest: float = 0.5
    """Speed from which the arm is taken to need its full time to come to rest [m/s], for
    the speed cap."""

    def __post_init__(self) -> None:
        check_settings(self, positive=("pairs", "fastest"), not_negative=["acceleration"])


class PersonWatch:
    """Distances that a safety filter keeps, from the observations of a tracker."""

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
            separation: Protective distance, and the mode: with power and force limiting the
                contact speeds of all pairs are computed as well.
            config: Assumptions about people.
            furniture: Boxes against which the arm may clamp people, in the base frame.

        Raises:
            ValueError: The mode needs the masses of the arm, and it has none.
        """
        self._tracker, self._arm = tracker, arm
        self._separation = separation or SeparationConfig()
        self._config = config or PersonWatchConfig()
        self._limits = None
        if self._separation.mode != "ssm":
            self._limits = ContactLimits(arm, self._separation, furniture)

    def watchful(self, safety: SafetyConfig) -> SafetyConfig:
        """Settings of a safety filter that keeps these distances."""
        constraints = safety.constraints or NEAR_PEOPLE
        return replace(safety, constraints=constraints, separation=self._separation)

    def look(
        self, time: float, joints: Float[Tensor, " joints"], load: GraspedBox | None = None
    ) -> WatchedPeople:
        """People near the arm now.

        Args:
            time: Reading of the clock [s].
            joints: Joint positions [rad].
            load: Object in the gripper; None: none.
        """
        seen, number = self._tracker.read(), self._config.pairs
        if seen is None:
            unknown = joints.new_full((number,), _NAN)
            return WatchedPeople(
                distances=Distances(
                    distance=unknown,
                    gradient=unknown[:, None].expand(number, len(joints)),
                    approach_speed=unknown,
                    person=torch.ones_like(unknown, dtype=torch.bool),
                ),
                nearest=unknown[0],
                age=unknown[0],
                speed_scale=joints.new_tensor(1.0),
                speed_cap=joints.new_tensor(math.inf),
            )
        ends, radius, velocity = (
            torch.from_numpy(x).to(joints) for x in (seen.ends, seen.radius, seen.velocity)
        )
        found, age = separation(self._arm, joints, ends, radius, load), time - seen.time
        contact = None
        if self._limits is not None and seen.regions:
            regions = region_numbers(seen.regions)
            contact = self._limits.speeds(found, joints, regions, load is not None)
        age = joints.new_tensor(age)
        return watched_people(found, velocity, age, self._separation, self._config, contact)


def watched_people(
    found: Separation,
    velocity: Float[Tensor, "*batch H 2 3"],
    age: Float[Tensor, "*batch"],
    separation: SeparationConfig,
    config: PersonWatchConfig,
    contact: ContactSpeeds | None = None,
) -> WatchedPeople:
    """Distances to keep from people, and limits of the speed near them.

    The protective distance limits the speed towards people only. An arm that moves past
    them, or makes way, approaches them as soon as they have come near; so it comes to rest
    by the time at which they may touch any part of it, if they accelerate all the while.
    People who recede count as at rest: a hand turns round faster than a tracker, which
    averages over some images, can show.

    Where contact is allowed, the cap takes the place of the scale: by that time the arm is
    at rest, or no faster than a contact in any direction allows.

    Args:
        found: Distances of the arm as it is now from people as they were observed.
        velocity: Velocities of the ends of their capsules [m/s].
        age: Age of the observation [s].
        separation: Protective distance, by which the urgency of pairs is judged.
        config: Assumptions about people.
        contact: Highest relative speeds of contacts; None: no contact is allowed.
    """
    a, rate = config.acceleration, found.person_rate(velocity)
    late = (age + separation.reaction_time)[..., None, None]
    # Speed that people may have gained since, and gain until the arm reacts.
    towards = (a * late - rate).clamp(min=0).flatten(-2)
    distance = found.distance.flatten(-2) - age.unsqueeze(-1) * towards
    # A contact that has begun may last, so that quasi-static limits hold.
    near, speed = found.distance < config.contact, None
    if contact is not None:
        speed = torch.where(near, contact.lasting, contact.first).flatten(-2)
        near = near & (contact.first <= 0)
    allowed = separation.allowed_speed(distance, towards, speed)
    # Among pairs that allow no approach the nearest are the most urgent.
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
    # The root t of  coming t + a t^2/2 = distance.
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
