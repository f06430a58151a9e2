"""How far every part of an arm is from the people beside it, as far as a tracker tells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import ConstraintConfig, Distances, SeparationConfig
from hrc_learn.kinematics import CapsuleArm, GraspedBox, Separation, separation
from hrc_learn.protocols import PersonTracker

_NAN = math.nan
# In which an arm comes to rest [s]: a joint of a Panda from 0.8 rad/s with 0.7 of its
# acceleration, as drivers plan. Without this rule up to 7 of 60 jobs beside a worker came too
# near.
_COMING_TO_REST = 0.15

BESIDE_PEOPLE = ConstraintConfig(early_exit=True, distance_weight=0.1)
"""Of the constraint layer of an arm that watches people. Before them an arm may always rest, so
it never has to leave its path: that comes before the distance, and the arm brakes on it within
the reaction time that the protective distance allows for. Off it, an elbow that a person had to
stop for took the end effector along by 6 mm, on it by 0.5 mm. Steps run one by one."""


@dataclass(frozen=True, kw_only=True)
class PersonWatchConfig:
    """What is assumed of people between two observations, and how much is told of them."""

    acceleration: float = 5.0
    """At which a person may get faster than they were seen to be [m/s^2]. People begin a step
    with 1 to 2 m/s^2, but a hand that sets off at what lies beside the arm does so with up to
    9 m/s^2: taken for 3 m/s^2, 3 of 1000 jobs beside such hands came too near."""
    pairs: int = 8
    """Of parts of the arm and of a person, the most urgent ones, that are kept apart: others
    are told of once they are among them."""

    contact: float = 0.03
    """Distance seen below which people may touch the arm [m], three deviations of a tracker's
    noise: it stops, as which way leads away from them is not known."""

    def __post_init__(self) -> None:
        if self.acceleration < 0:
            raise ValueError(f"acceleration must not be negative, but is {self.acceleration}.")
        if self.pairs < 1:
            raise ValueError(f"pairs must be at least 1, but is {self.pairs}.")


@dataclass(frozen=True, kw_only=True)
class WatchedPeople:
    """Where people may be by now, seen from the arm."""

    distances: Distances
    """Of the most urgent pairs, smaller than seen by as much as people may have come nearer
    since. NaN, for which the arm brakes, as long as nothing is known, and where people may
    touch it."""
    nearest: float = _NAN
    """Smallest distance when they were seen, from the arm as it is now [m]."""
    age: float = _NAN
    """Of the observation [s]."""
    share: float = 1.0
    """Of its speed that is left to the arm, whichever way it moves: see `share_of_speed`."""


class PersonWatch:
    """Turns what a tracker sees into distances that a safety filter keeps."""

    def __init__(
        self,
        tracker: PersonTracker,
        arm: CapsuleArm,
        separation: SeparationConfig | None = None,
        config: PersonWatchConfig | None = None,
    ):
        """Begin to watch.

        Args:
            tracker: Sees the people.
            arm: Capsules of arm and tool.
            separation: Of the protective distance: by it pairs are the more or less urgent.
            config: What is assumed of people.
        """
        self._tracker, self._arm = tracker, arm
        self._separation = separation or SeparationConfig()
        self._config = config or PersonWatchConfig()

    def look(
        self, time: float, joints: Float[Tensor, " joints"], load: GraspedBox | None = None
    ) -> WatchedPeople:
        """Where they may be now.

        Args:
            time: Now [s].
            joints: Joint positions now [rad].
            load: What the arm holds; None: nothing.
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
                )
            )
        ends, radius, velocity = (
            torch.from_numpy(x).to(joints) for x in (seen.ends, seen.radius, seen.velocity)
        )
        found, age = separation(self._arm, joints, ends, radius, load), time - seen.time
        what_is_seen = found, velocity, joints.new_tensor(age), self._separation, self._config
        return WatchedPeople(
            distances=urgent_distances(*what_is_seen),
            nearest=float(found.distance.min()),
            age=age,
            share=float(share_of_speed(*what_is_seen)),
        )


def urgent_distances(
    found: Separation,
    velocity: Float[Tensor, "*batch H 2 3"],
    age: Float[Tensor, "*batch"],
    separation: SeparationConfig,
    config: PersonWatchConfig,
) -> Distances:
    """The most urgent distances from people who were seen some time ago.

    Args:
        found: Distances of the arm as it is now from people as they were seen.
        velocity: Of the ends of their capsules, as seen [m/s].
        age: Of the observation [s].
        separation: Of the protective distance: by it pairs are the more or less urgent.
        config: What is assumed of people.

    Returns:
        The distances, smaller than seen by as much as people may have come nearer since. NaN
        where they may touch the arm.
    """
    # What they may have gained since, and gain until the arm reacts.
    gain = (config.acceleration * (age + separation.reaction_time))[..., None, None]
    towards = (gain - found.person_rate(velocity)).clamp(min=0).flatten(-2)
    distance = found.distance.flatten(-2) - age.unsqueeze(-1) * towards
    allowed = separation.highest_speed(distance, towards)
    # Of pairs that allow nothing the nearest ones: they may open again.
    number = min(config.pairs, distance.shape[-1])
    _, urgent = (allowed + 1e-3 * distance).topk(number, dim=-1, largest=False)
    touching = found.distance.flatten(-2).amin(-1, keepdim=True) < config.contact
    return Distances(
        distance=distance.gather(-1, urgent).masked_fill(touching, _NAN),
        gradient=found.gradient_of(urgent),
        approach_speed=towards.gather(-1, urgent),
        person=torch.ones_like(urgent, dtype=torch.bool),
    )


def share_of_speed(
    found: Separation,
    velocity: Float[Tensor, "*batch H 2 3"],
    age: Float[Tensor, "*batch"],
    separation: SeparationConfig,
    config: PersonWatchConfig,
) -> Float[Tensor, "*batch"]:
    """Share of its speed that people who come towards an arm leave it, 0 to 1.

    Distances limit how fast the arm comes nearer. One that moves past people, or makes way,
    closes in on them as soon as they are beside it; so it rests by the time that they may touch
    any part of it, getting faster all the while. Who goes away counts as at rest: a hand turns
    round faster than a tracker, which averages over some images, tells.

    Args:
        found: Distances of the arm as it is now from people as they were seen.
        velocity: Of the ends of their capsules, as seen [m/s].
        age: Of the observation [s].
        separation: Of the protective distance, for the time until the arm reacts.
        config: What is assumed of people.
    """
    coming = (-found.person_rate(velocity)).clamp(min=0)
    # The root t of  coming t + a t^2/2 = distance.
    a, distance = config.acceleration, (found.distance - config.contact).clamp(min=0)
    arrival = 2 * distance / (coming + (coming**2 + 2 * a * distance).sqrt()).clamp(min=1e-9)
    left = arrival.amin((-2, -1)) - age - separation.reaction_time
    return (left / _COMING_TO_REST).clamp(0, 1)
