"""Bounds on motion from control barriers.

`LimitBarrier`: how fast a joint may move, and how hard accelerate, so that its limits can still
be kept. `SeparationConfig`: how fast the tool may move when a person is near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.kinematics import MotionLimits

# Fraction of v_max left unused: sums of rounded numbers must not exceed it in the last digit.
_ROUNDING = 1e-12
# What libfranka takes off velocity limits that depend on the position, for the same reason
# (kJointVelocityLimitsTolerance, 0.21) [rad/s].
_TOLERANCE = 1e-3


@final
class LimitBarrier(nn.Module):
    """The set of joint states from which the limits can be kept, and the bounds it implies.

    With delta the distance to a limit less its margin, v the speed towards it, A and j the
    limits of acceleration and jerk, and v_hat = v + (a + A)^2/(2 j):

        v_hat <= min(h(delta), v_max + A^2/(2 j)),   h(delta) = sqrt(c^2 + 2 A delta) - c,
        c = A / rate     <=>     Q(v_hat) = v_hat^2/(2 A) + v_hat/rate <= delta

    v_hat is the speed from which braking with A *at once* would end where ramping the
    acceleration down to -A ends, so one curve h serves. Without a jerk limit v_hat = v.

    The set is invariant in discrete time. Let v_hat_k hold at step k, the joint move by
    v_k dt, and the next acceleration be max(a_k - j dt, -A). Then v_hat_{k+1} <= v_hat_k -
    A dt, and for every dt <= 1/rate

        Q(v_hat - A dt) = Q(v_hat) - v_hat dt - A dt (1/rate - dt/2) <= delta - v_k dt,

    while below A dt the joint gets no further than v_hat dt <= rate dt delta <= delta. So a
    step that keeps all limits always exists. dt is the time between both steps, so steps of
    any length keep the limits where it is the time that has passed since the last. It takes
    joints that move by v dt, and a start inside the set. At rest v_hat = A^2/(2 j), so that is

        delta >= A^3/(8 j^2) + A^2/(2 j rate),

    3 mrad for a Panda at 5 1/s, which the margin covers; the first term, the way on which
    the acceleration ramps down, counts where A/j is long, as for slow axes.

    From rest nearer to a limit, or past it, a joint moves inwards only. `rests_outside` says
    whether it must (False), or does so when asked to and else may rest (True): then the set is
    v_hat <= max(h(delta), A^2/(2 j)), and a joint that comes to rest within its margin does so
    at most A^2/(2 j) (A/j + dt) past the wall, 0.2 mrad for a Panda at 125 Hz. That set is
    invariant as well: braking lowers v_hat.

    Joints that do what they are told T late go on with the speed of then, v + A T at most,
    while they brake. A wall that recedes by T v_hat, which braking lowers by T A dt in a step,
    makes up for it: Q(v_hat) + T v_hat <= delta, which is 1/rate + T in place of 1/rate. In
    steps that take (1 + jitter) of the dt that is told, A dt brakes with A/(1 + jitter): so
    much for A in Q.

    Velocity limits that tighten towards those of position are, with o and d of
    `MotionLimits.velocity_bounds` and the margin m, a curve of the same kind:

        sqrt(2 d (delta + m)) - o >= sqrt(o^2 + 2 d delta) - o   if m >= o^2/(2 d).

    The right-hand side falls as o grows, to h with the knee c >= o, and h grows with A. So the
    limits hold at every position, and joints brake in time, if Q has min(A, d) in place of A
    and at least o/d in place of 1/rate, and the margin is wide enough. What libfranka takes off
    its limits is added to the offset o and, where the margin is asked for, the A^2/(2 j) with
    which joints may come to rest in it. All of that are constants: a step does nothing more.
    """

    velocity: Tensor
    """v_max [rad/s]."""
    acceleration: Tensor
    """A [rad/s^2]."""
    jerk: Tensor
    """j [rad/s^3]."""
    walls: Tensor
    """Lower and upper limits, less the margin, with the signs of `sides` [rad]."""
    sides: Tensor
    knee: Tensor
    """c [rad/s]."""
    knee_square: Tensor
    twice_acceleration: Tensor
    reserve: Tensor
    """A^2/(2 j), what it takes to start braking [rad/s]; zero without a jerk limit."""

    def __init__(
        self,
        limits: MotionLimits,
        *,
        margin: float,
        rate: float,
        jerk_limited: bool,
        rests_outside: bool = False,
        delay: float = 0.0,
        jitter: float = 0.0,
    ):
        """Prepare the constants.

        Args:
            limits: Of the joints.
            margin: Distance kept from every position limit [rad], more where the limits of
                velocity ask for it.
            rate: Fastest decay of the remaining distance [1/s].
            jerk_limited: Whether the acceleration changes by at most j dt in a step.
            rests_outside: Whether a joint outside its limits may rest there.
            delay: Until the joints do what they are told [s].
            jitter: Fraction by which a step may be longer than it says.
        """
        super().__init__()
        self.rests_outside = rests_outside
        self.jerk_limited = jerk_limited
        A, j = limits.acceleration, limits.jerk
        reserve = A**2 / (2 * j) if jerk_limited else torch.zeros_like(A)
        slowest, decay_time = A / (1 + jitter), torch.full_like(A, 1 / rate)
        margins = torch.full_like(A, margin)
        if limits.velocity_offset is not None and limits.deceleration is not None:
            o, d = limits.velocity_offset + _TOLERANCE, limits.deceleration
            slowest, decay_time = slowest.minimum(d), decay_time.maximum(o / d)
            margins = margins.maximum((o + reserve) ** 2 / (2 * d))
        knee = slowest * (decay_time + delay)
        walls = torch.stack([-limits.lower - margins, limits.upper - margins])
        constants = {
            "velocity": limits.velocity * (1 - _ROUNDING),
            "acceleration": A.clone(),
            "jerk": j.clone(),
            "walls": walls,
            "sides": torch.tensor([[1.0], [-1.0]]).to(walls),
            "knee": knee,
            "knee_square": knee**2,
            "twice_acceleration": 2 * slowest,
            "reserve": reserve,
        }
        for name, value in constants.items():
            self.register_buffer(name, value)

    def velocity_bounds(
        self, joint_position: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity [rad/s] of a steady motion (a = 0) inside the set."""
        room = torch.addcmul(self.walls, self.sides, joint_position.unsqueeze(-2))
        # h(|delta|) with the sign of delta: past a limit less its margin the joint is driven
        # back as fast as from the same distance inside it, and the root stays real.
        square = torch.addcmul(self.knee_square, self.twice_acceleration, room.abs())
        speed = torch.copysign(square.sqrt() - self.knee, room)
        if self.jerk_limited:
            speed = speed - self.reserve  # v_hat = v + A^2/(2 j) at a = 0
        if self.rests_outside:
            speed = speed.clamp(min=0)
        bounds = speed.clamp(-self.velocity, self.velocity) * -self.sides
        lower, upper = bounds.unbind(-2)
        return lower, upper

    def acceleration_bounds(
        self,
        velocity: Float[Tensor, "*batch n"],
        bounds: tuple[Tensor, Tensor],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest acceleration [rad/s^2] that stay inside the set.

        The roots a of v + a dt + (a + A)^2/(2 j) = bound + A^2/(2 j), for both limits.

        Args:
            velocity: Of the last step [rad/s].
            bounds: `velocity_bounds` now.
            dt: Step [s], which may differ between arms.
        """
        lower, upper = bounds
        slack = torch.stack([velocity - lower, upper - velocity], dim=-2)
        offset = self.acceleration + self.jerk * dt
        # Negative far outside the set, where no acceleration is enough: the clamp brakes hard.
        offset = offset.unsqueeze(-2)  # for both limits; dt may differ between arms
        square = torch.addcmul(offset * offset, self.jerk, slack, value=2)
        down, up = (square.clamp(min=0).sqrt() - offset).unbind(-2)
        return -down, up

    def nearest_acceleration(
        self,
        wanted: Float[Tensor, "*batch n"],
        last: Float[Tensor, "*batch n"],
        velocity: Float[Tensor, "*batch n"],
        bounds: tuple[Tensor, Tensor],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch n"]:
        """The nearest acceleration with which the limits are kept, now and later [rad/s^2].

        Args:
            wanted: Acceleration wanted [rad/s^2].
            last: Acceleration of the last step [rad/s^2].
            velocity: Of the last step [rad/s].
            bounds: `velocity_bounds` now.
            dt: Step [s], which may differ between arms.
        """
        # Last what the arm cannot exceed: outside its set the barrier may ask for more.
        inside = wanted.clamp(*self.acceleration_bounds(velocity, bounds, dt))
        return inside.clamp(*self._reachable_acceleration(last, dt))

    def _reachable_acceleration(
        self, last: Tensor, dt: float | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Lowest and highest acceleration of the next step that the jerk leaves [rad/s^2]."""
        reach = self.jerk * dt
        return (
            torch.maximum(last - reach, -self.acceleration),
            torch.minimum(last + reach, self.acceleration),
        )

    def reachable_velocity(
        self,
        velocity: Float[Tensor, "*batch n"],
        acceleration: Float[Tensor, "*batch n"],
        bounds: tuple[Tensor, Tensor],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity of the next step with which all limits are kept [rad/s].

        Where those of position and velocity ask for more than the others allow, the nearest
        that is allowed.

        Args:
            velocity: Of the last step [rad/s].
            acceleration: Of the last step [rad/s^2].
            bounds: `velocity_bounds` now.
            dt: Step [s], which may differ between arms.
        """
        A = self.acceleration
        if self.jerk_limited:
            allowed = self.acceleration_bounds(velocity, bounds, dt)
            reachable = self._reachable_acceleration(acceleration, dt)
            lowest, highest = (a.clamp(*allowed).clamp(*reachable) for a in (-A, A))
            return velocity + dt * lowest, velocity + dt * highest
        lower, upper = velocity - A * dt, velocity + A * dt
        return bounds[0].clamp(lower, upper), bounds[1].clamp(lower, upper)


@dataclass(frozen=True, kw_only=True)
class SeparationConfig:
    """Speed and separation monitoring: how fast the tool may move when a person is near.

    The terms of the protective separation distance (ISO/TS 15066:2016, 5.5.4.2.3).
    """

    human_speed: float = 1.6
    """v_h, at which the person may come closer [m/s]; 1.6 where it is not measured."""
    reaction_time: float = 0.1
    """T_r, from the person's motion to the arm's response [s]: sensing, transport, and some
    20 ms for a control step and the ramp of the acceleration."""
    deceleration: float = 2.0
    """Of the tool while the arm stops [m/s^2]: T_s = v/a and S_s = v^2/(2 a)."""
    clearance: float = 0.2
    """C + Z_d + Z_r, intrusion and the uncertainty of both positions [m]: the distance that is
    left when everything has come to rest."""

    def __post_init__(self):
        for name in ("human_speed", "reaction_time", "clearance"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, but is {getattr(self, name)}")
        if not self.deceleration > 0:
            raise ValueError(f"deceleration must be positive, but is {self.deceleration}")

    def protective_distance(
        self,
        speed: Float[Tensor, "*batch"],
        human_speed: Float[Tensor, "*batch"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """S_p = v_h (T_r + v/a) + v T_r + v^2/(2 a) + C + Z_d + Z_r [m].

        Args:
            speed: v, at which the arm closes in [m/s]; one that moves away counts as at rest.
            human_speed: v_h, as for `highest_speed`.
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

        The root v of  d = S_p(v),  see `protective_distance`; zero where the person is too
        close for any motion. A distance of NaN is not known and counts as zero.

        Args:
            distance: Between the person and the arm [m]; infinite: nobody is there.
            human_speed: v_h of this person towards the arm, where it is measured, with what
                they may gain meanwhile [m/s]. Who goes away counts as at rest.
        """
        a = self.deceleration
        v_h = self.human_speed if human_speed is None else human_speed.clamp(min=0)
        spare = distance - v_h * self.reaction_time - self.clearance
        spare = torch.where(spare > 0, spare, 0.0)  # NaN compares false: too close
        delay = self.reaction_time + v_h / a
        return a * (torch.sqrt(delay**2 + (2 / a) * spare) - delay)
