"""How the null space yields to a person who pushes the joints off their path, and how they go
back when the person lets go.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller import scale_null_space
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SerialChain
from hrc_learn.skills.arm_motion import null_space_slowdown, singularity_fade
from hrc_learn.skills.person_feedback import Hindrances

LEAST_INPUT = 0.05
"""Null-space input below which one that has ended is over [N m]."""
# Fractions of the joints' acceleration that a push and its end may use: the rest is for the
# task, which is slowed down as well where both together need more than the arm has.
_PUSHED_EFFORT, _STOPPING_EFFORT = 0.3, 0.6
# At which an arm at rest looks ahead [rad/s].
_SLOW = 0.2
# How far the null space is from a planned path for the arm to have been pushed aside, and to be
# back [rad]: servos lag by 0.03 rad at the speed of transfers.
_ASIDE, _BACK = 0.1, 0.03
# Time to go back at the end of a path, or while it waits [s].
LONGEST_RETURN = 5.0
# Smallest singular value of the Jacobian of a path below which the arm cannot follow beside it,
# as damping begins at 0.05.
NARROW = 0.07
# How far the joints may be from a path that goes on [rad]: with 1.4 rad, an elbow aside by some
# 0.2 m, all found back, with 2 rad not all. A path that waited for them goes on with 1.4 rad.
FAR_ASIDE = 1.8
_NEAR_AGAIN = 1.4
# Cosine between the null space and the way back in joint space below which the one may lead
# elsewhere than the other: an elbow that has gone a quarter of its circle has 0.7, one that has
# gone half of it none. From the second on paths that waited go on, and a push counts in full.
LEADS_BACK = 0.65
_LEADS_WELL_BACK = 0.8
# Distances from the path [rad]: below the first joints find back whatever the cosine, which
# counts in full from the second on.
_NEARBY = 0.3, 0.5
# Motion of the end effector, metres and radians as they are, below which nothing waits [1/s].
_AT_REST = 1e-3
# In which a path stops, and goes on [s].
CHANGE_OF_RATE = 0.2
STUCK = 2.0
"""Time after which a path that waits for joints which come no nearer is gone back [s]."""
# By how much they have to come nearer not to be stuck [rad]: 1 s of the slowest ways back.
_NEARER = 0.05


@dataclass(frozen=True, kw_only=True)
class YieldingConfig:
    """How the null space yields, and how the joints go back."""

    damping: float = 3.0
    """c_d: null-space input per unit of joint velocity (paper, Table I) [N m s/rad]."""
    nullspace_rise: float = 0.15
    """Time constant with which the null-space input is smoothed [s]."""
    pose_gain: float = 4.0
    """Decay rate of the pose error on given motions [1/s]."""
    after_push: Literal["return", "stay"] = "return"
    """Whether the joints go back to a planned path, or on beside it, when a person who pushed
    them aside lets go; and whether a servoed arm goes back to its posture."""
    return_speed: float = 0.4
    """Fastest way back, of all joints together [rad/s]."""
    clearance: float = 0.03
    """Distance from what is around that nobody can push the arm below [m]: three times the
    errors of base and table."""


class NullSpaceYielding:
    """Whether a person has pushed the joints off their path, and the way back to it.

    Attributes:
        nullspace_input: What the person asks for, without jumps [N m].
        aside: Whether the joints are off their path.
        lost: Whether the null space might lead them elsewhere than back: the path waits.
        push_share: What is left of a push that leads them farther aside, 0 to 1.
        hindrances: What keeps the arm from following; whoever tells the person empties it.
    """

    def __init__(
        self,
        chain: SerialChain,
        dt: float,
        config: YieldingConfig,
        hindrances: Hindrances | None = None,
    ):
        """Begin on the path, with nobody pushing.

        Args:
            chain: Kinematics of the arm.
            dt: Control step [s].
            config: How it yields.
            hindrances: Take what limits a push; None: nobody is told.
        """
        self._chain, self._dt, self._config = chain, dt, config
        self.hindrances = hindrances or Hindrances()
        self._back = torch.zeros(len(chain.joint_names), dtype=torch.float64)
        self.nullspace_input, self.aside = self._back.numpy(), False
        self.lost, self.push_share = False, 1.0

    @property
    def pushed(self) -> bool:
        """Whether a person pushes at the null space now."""
        return bool(self.nullspace_input.any())

    @property
    def null_velocity(self) -> Float[Tensor, " joints"]:
        """Joint velocity whose null-space part the person asks for [rad/s]."""
        return torch.from_numpy(self.nullspace_input) / self._config.damping

    def feel(
        self,
        asked: Float[np.ndarray, " joints"],
        joints: Float[Tensor, " joints"] | None = None,
        bounds: tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]] | None = None,
        jacobian: Float[Tensor, "6 joints"] | None = None,
    ) -> Float[np.ndarray, " joints"]:
        """Take in what a person asks for now; the null-space input without jumps [N m].

        An arm follows late and with limited acceleration. A jump of its null-space motion, or
        one that is too fast, would therefore move the end effector.

        Args:
            asked: Null-space input [N m].
            joints: Where they are [rad]; with them what is left is as much as the arm can
                follow, in its null space. None: whoever follows limits it.
            bounds: Lowest and highest velocities that leave the task its room [rad/s].
            jacobian: Of the end effector there, where it is known.
        """
        if joints is None or bounds is None:
            share = min(self._dt / self._config.nullspace_rise, 1.0)
            smooth = self.nullspace_input + share * (asked - self.nullspace_input)
        elif not (self.pushed or asked.any()):
            smooth = asked
        else:
            J = self._chain.jacobian(joints) if jacobian is None else jacobian
            damping = self._config.damping
            push = torch.from_numpy(asked) / damping
            eased = eased_null_velocity(
                self._chain, joints, J, self.null_velocity, push, bounds, self._dt, self._config
            )
            self.hindrances.note_across(push, eased.felt)
            self.hindrances.note("speed", float(eased.slowdown))
            self.hindrances.note("singularity", float(eased.fade))
            self.hindrances.note_limits(eased.wanted, eased.within, eased.wanted, bounds)
            velocity = eased.velocity
            smooth = (damping * velocity).numpy()
        if not asked.any() and np.abs(smooth).max() < LEAST_INPUT:
            smooth = asked
        self.nullspace_input = smooth
        return smooth

    def way_back(
        self,
        joints: Float[Tensor, " joints"],
        error: Float[Tensor, " joints"],
        jacobian: Float[Tensor, "6 joints"] | None = None,
        *,
        yields: bool = True,
        returns: bool = False,
    ) -> Float[Tensor, " joints"] | None:
        """Velocity of the joints back to their path, without jumps.

        Args:
            joints: Where they are [rad].
            error: From there to the path [rad].
            jacobian: Of the end effector there, where it is known.
            yields: Whether the person can push the joints off it here.
            returns: Whether joints that were pushed off it go back in any case.

        Returns:
            The velocity, in the null space [rad/s]; None of joints on their path.
        """
        away = self._away(joints, error, jacobian) if yields or self.aside else None
        self.push_share = 1.0
        if away is None:
            self._back, self.lost = torch.zeros_like(error), False
            return None
        if self._config.after_push == "return":
            straight = straightness(away, error)
            waited = self.lost and not self.pushed
            self.lost = bool(may_not_find_back(error, straight, waited))
            self.push_share = float(share_of_push(self.null_velocity, away, straight))
        # Not against the person while they push.
        goes = returns or (self._config.after_push == "return" and not self.pushed)
        away = away if goes else torch.zeros_like(away)
        self._back = eased_way_back(self._back, away, self._dt, self._config)
        return self._back

    def begin(self, error: Float[Tensor, " joints"]) -> None:
        """Begin a path; joints that are far from its start [rad] were pushed aside before."""
        self.aside = float(error.norm()) > _ASIDE

    def _away(
        self,
        joints: Float[Tensor, " joints"],
        error: Float[Tensor, " joints"],
        jacobian: Float[Tensor, "6 joints"] | None,
    ) -> Float[Tensor, " joints"] | None:
        """Null-space part of the way back to a path [rad]; None if nobody pushed it off."""
        pushed, aside = torch.tensor(self.pushed), torch.tensor(self.aside)
        self.aside = bool(stays_aside(pushed, aside, error))
        if not self.aside:
            return None
        J = self._chain.jacobian(joints) if jacobian is None else jacobian
        return null_projection(J, error)


def stays_aside(
    pushed: Bool[Tensor, "*batch"],
    aside: Bool[Tensor, "*batch"],
    error: Float[Tensor, "*batch joints"],
) -> Bool[Tensor, "*batch"]:
    """Whether joints are off their path because somebody pushes them, or did.

    Those that nobody pushed and that are behind meet something: they go on.

    Args:
        pushed: Whether a person pushes at the null space now.
        aside: Whether the joints were off their path a step before.
        error: From the joints to the path [rad].
    """
    return pushed | (aside & (error.norm(dim=-1) > _BACK))


class EasedVelocity(NamedTuple):
    """What the null space takes of what a person wants, and why not all of it."""

    velocity: Float[Tensor, "*batch joints"]
    """[rad/s]"""
    felt: Float[Tensor, "*batch joints"]
    """The null-space part of what is wanted [rad/s]."""
    slowdown: Float[Tensor, "*batch"]
    """Share of it at which the end effector can be kept in place."""
    fade: Float[Tensor, "*batch"]
    """Share of that which does not lead into a singularity."""
    wanted: Float[Tensor, "*batch joints"]
    """What is left [rad/s]."""
    within: Float[Tensor, "*batch joints"]
    """The same within the bounds [rad/s]."""


def eased_null_velocity(
    chain: SerialChain,
    joints: Float[Tensor, "*batch joints"],
    jacobian: Float[Tensor, "*batch 6 joints"],
    before: Float[Tensor, "*batch joints"],
    wanted: Float[Tensor, "*batch joints"],
    bounds: tuple[Float[Tensor, "*batch joints"], Float[Tensor, "*batch joints"]],
    dt: float,
    config: YieldingConfig,
) -> EasedVelocity:
    """The null-space velocity of a step in which a person wants another one.

    As much of it as the arm can follow without moving its end effector, and without jumps.

    Args:
        chain: Kinematics of the arm.
        joints: Where they are [rad].
        jacobian: Of the end effector there.
        before: Null-space velocity of the step before [rad/s].
        wanted: Joint velocity whose null-space part is wanted [rad/s].
        bounds: Lowest and highest velocities that leave the task its room [rad/s].
        dt: Control step [s].
        config: How it yields.
    """
    before, felt = null_projection(jacobian, before), null_projection(jacobian, wanted)
    slowdown = null_space_slowdown(chain, joints, felt)
    wanted = felt * slowdown.unsqueeze(-1)
    # As far ahead as the arm gets while it slows down.
    last, size = before.norm(dim=-1, keepdim=True), wanted.norm(dim=-1, keepdim=True)
    speed = last.clamp(min=_SLOW) / size.clamp(min=1e-9)
    fade = singularity_fade(chain, joints, speed * wanted)
    wanted = wanted * fade.unsqueeze(-1)
    within = scale_null_space(torch.zeros_like(wanted), wanted, *bounds)
    slows = within.norm(dim=-1, keepdim=True) < last
    change = torch.where(slows, 1.0, min(dt / config.nullspace_rise, 1.0)) * (within - before)
    effort = torch.where(slows, _STOPPING_EFFORT, _PUSHED_EFFORT)
    reach = effort * dt * chain.limits.acceleration
    velocity = before + change / (change.abs() / reach).amax(-1, keepdim=True).clamp(min=1.0)
    return EasedVelocity(velocity, felt, slowdown, fade, wanted, within)


def eased_way_back(
    before: Float[Tensor, "*batch joints"],
    away: Float[Tensor, "*batch joints"],
    dt: float,
    config: YieldingConfig,
) -> Float[Tensor, "*batch joints"]:
    """Null-space velocity back to a path, without jumps that would move the end effector.

    Args:
        before: That of the step before [rad/s].
        away: Null-space part of the way back [rad]; zero of who is not to go back.
        dt: Control step [s].
        config: How fast.
    """
    fastest = config.return_speed / away.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    back = fastest.clamp(max=config.pose_gain) * away
    return before + min(dt / config.nullspace_rise, 1.0) * (back - before)


def smallest_singular_value(
    chain: SerialChain, joint_position: Float[Tensor, "*batch joints"]
) -> Float[Tensor, "*batch"]:
    """Of the Jacobian of the end effector, metres and radians as they are: see `NARROW`.

    Args:
        chain: Kinematics of the arm.
        joint_position: [rad]
    """
    return torch.linalg.svdvals(chain.jacobian(joint_position))[..., -1]


def straightness(
    away: Float[Tensor, "*batch joints"], error: Float[Tensor, "*batch joints"]
) -> Float[Tensor, "*batch"]:
    """How much of a way back the null space leads: the cosine of the two, 1 of a short way.

    Args:
        away: The part of the way in the null space [rad].
        error: All of it, from the joints to their path [rad].
    """
    size, (near, far) = error.norm(dim=-1), _NEARBY
    cosine = away.norm(dim=-1) / size.clamp(min=near)
    return torch.lerp(torch.ones_like(size), cosine, ((size - near) / (far - near)).clamp(0, 1))


def may_not_find_back(
    error: Float[Tensor, "*batch joints"],
    straight: Float[Tensor, "*batch"],
    waited: Bool[Tensor, "*batch"] | bool = False,
) -> Bool[Tensor, "*batch"]:
    """Whether the null space might lead joints elsewhere than back to a path that goes on.

    It leads to another posture for the same pose, if that is nearer by then.

    Args:
        error: From the joints to their path [rad].
        straight: `straightness` of their way back.
        waited: Whether the path has waited for them, and nobody pushes them any more: it goes
            on once they are well on their way, as it would lead them astray again.
    """
    waited = torch.as_tensor(waited)
    farthest = torch.where(waited, _NEAR_AGAIN, FAR_ASIDE)
    least = torch.where(waited, _LEADS_WELL_BACK, LEADS_BACK)
    return (error.norm(dim=-1) > farthest) | (straight < least)


def share_of_push(
    push: Float[Tensor, "*batch joints"],
    away: Float[Tensor, "*batch joints"],
    straight: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """What is left of a push, 0 to 1: nobody leads joints to where they would not find back.

    Args:
        push: Velocity that is asked for [rad/s]. All is left of one that leads back.
        away: Null-space part of the way back [rad].
        straight: Its `straightness`.
    """
    share = ((straight - LEADS_BACK) / (_LEADS_WELL_BACK - LEADS_BACK)).clamp(0.0, 1.0)
    return torch.where(torch.linalg.vecdot(push, away) > 0, 1.0, share)


def waited_for(
    waited: Float[Tensor, "*batch"],
    nearest: Float[Tensor, "*batch"],
    off: Float[Tensor, "*batch"],
    rate: Float[Tensor, "*batch"],
    counts: Bool[Tensor, "*batch"],
    dt: float,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """For how long a path has waited for joints that come no nearer, a step later.

    Time in which the path goes on is taken off again: one that stops and starts before somebody
    who pushes again and again is stuck only if it rests for more than half of the time.

    Args:
        waited: A step before [s].
        nearest: How far the joints were from the path when they last had come nearer [rad].
        off: How far they are now [rad].
        rate: Of the path, -1 to 1.
        counts: Whether the step does: nobody pushes, or slows the path down.
        dt: Control step [s].

    Returns:
        The first two, a step later.
    """
    nearer = counts & (off < nearest - _NEARER) & (waited <= STUCK)
    longer = (waited + (1.0 - 2.0 * rate.clamp(min=0)) * dt).clamp(min=0)
    waited = torch.where(nearer, 0.0, torch.where(counts, longer, waited))
    return waited, torch.where(nearer | ~counts, off, nearest)


def nears_singularity(
    chain: SerialChain,
    joints: Float[Tensor, "*batch joints"],
    velocity: Float[Tensor, "*batch joints"],
) -> Bool[Tensor, "*batch"]:
    """Whether an arm beside its path is near a singularity, or will be by the time that the
    path has stopped: there it could not keep the end effector on it.

    Args:
        chain: Kinematics of the arm.
        joints: Where they are [rad].
        velocity: Their own [rad/s].
    """
    ahead = joints + CHANGE_OF_RATE * velocity
    return (smallest_singular_value(chain, torch.stack([joints, ahead])) < NARROW).any(0)


def share_of_motion(
    asked: Float[Tensor, "*batch 6"], done: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch"]:
    """How much of the motion that was asked for is done, 0 to 1; 1 where it is at rest.

    Args:
        asked: Twist of the end effector (linear [m/s], angular [rad/s]).
        done: What the arm was left of it.
    """
    square, along = (asked * asked).sum(-1), (asked * done).sum(-1)
    moves = square > _AT_REST**2
    return torch.where(moves, along / torch.where(moves, square, 1.0), 1.0).clamp(0, 1)


def changed_rate(
    rate: float | Float[np.ndarray, " paths"],
    wanted: float | Float[np.ndarray, " paths"],
    dt: float,
    direction: int | Int[np.ndarray, " paths"] = 1,
) -> float | Float[np.ndarray, " paths"]:
    """The rate of a path a step later: without jumps, as every change of speed is one of the
    end effector's.

    Args:
        rate: Share of the path's own speed, -1 to 1; of one path or several.
        wanted: Its size that it should have, cut to between 0 and 1.
        dt: Control step [s].
        direction: 1 for on, -1 for back.
    """
    change, goal = dt / CHANGE_OF_RATE, direction * np.clip(wanted, 0.0, 1.0)
    return rate + np.clip(goal - rate, -change, change)
