"""Control barriers for the limits of the joints, and for the speed of points of the arm."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.kinematics import MotionLimits

# Rounding error of a velocity, in units of the dtype's resolution times v_max: one unit for the
# sum v + a dt, and one in reserve for the operations before this sum.
_ROUNDING = 2.0
# Margin [rad/s] that libfranka 0.21 also subtracts from position-dependent velocity limits to
# absorb rounding errors (kJointVelocityLimitsTolerance).
_TOLERANCE = 1e-3


@final
class LimitBarrier(nn.Module):
    """The invariant set of joint states from which all limits can be kept, and its bounds.

    Let delta be the distance to a limit, less the margin, v the speed towards the limit, A and
    j the limits of acceleration and jerk, and v_hat = v + (a + A)^2/(2 j). The set is

        v_hat <= min(h(delta), v_max + A^2/(2 j)),   h(delta) = sqrt(c^2 + 2 A delta) - c,
        c = A / rate     <=>     Q(v_hat) = v_hat^2/(2 A) + v_hat/rate <= delta

    To brake, a joint ramps its acceleration a down to -A. Braking with A *without a ramp*, but
    from v_hat instead of v, takes a distance that is longer than with the ramp, by
    (a + A)^3/(6 j^2). So one curve h is safe for every a.

    The set is invariant in discrete time. Assume that step k starts with v_hat_k inside the
    set, that the joint moves by v_k dt, and that the next acceleration is max(a_k - j dt, -A).
    Then v_hat_{k+1} <= v_hat_k - A dt, and for every dt <= 1/rate

        Q(v_hat - A dt) = Q(v_hat) - v_hat dt - A dt (1/rate - dt/2) <= delta - v_k dt.

    If v_hat < A dt, the joint moves by at most v_hat dt <= rate dt delta <= delta. So a step
    that keeps all limits always exists. dt is the time between two steps, at most 1/rate; if it
    is measured, the steps may differ in length. The proof assumes that joints move by v dt and
    start inside the set. At rest v_hat = A^2/(2 j), so the start must satisfy

        delta >= A^3/(8 j^2) + A^2/(2 j rate),

    which is 3 mrad for a Panda with rate = 5 1/s, less than the margin. The first term is the
    distance that the joint travels while the acceleration ramps down. This term matters for
    axes with a long ramp time A/j.

    *Starts outside.* A joint may start at rest with a smaller delta, or beyond the limit. Such
    a joint never moves outwards, and may stay at rest; the set is then
    v_hat <= max(h(delta), A^2/(2 j)). A joint that comes to rest within its margin then stops
    at most A^2/(2 j) (A/j + dt) past the wall delta = 0, which is 0.2 mrad for a Panda at
    125 Hz. This set is also invariant, because braking lowers v_hat.

    *Delay and jitter.* If joints follow a command after a delay T, their speed while braking is
    at most v + A T. To compensate, the barrier moves the wall inwards by T v_hat. Each braking
    step reduces this shift by T A dt. The condition becomes Q(v_hat) + T v_hat <= delta, so
    1/rate + T replaces 1/rate. If a step lasts (1 + jitter) dt, the deceleration is
    A/(1 + jitter), which replaces A in Q.

    *Position-dependent velocity limits.* With o and d from `MotionLimits.velocity_bounds` and
    the margin m, these limits have a lower bound of the same form as h:

        sqrt(2 d (delta + m)) - o >= sqrt(o^2 + 2 d delta) - o   if m >= o^2/(2 d).

    The right-hand side decreases with o, and for A = d and o = c it equals h. h increases
    with A. So the limits hold at every position, and joints brake in time, on two conditions:
    in Q, min(A, d) replaces A and max(1/rate, o/d) replaces 1/rate; and m satisfies the
    inequality above. Here o includes the margin that libfranka subtracts. In the inequality for
    m, A^2/(2 j) is added to o, because a joint may come to rest within the margin. All of these
    values are constants, so they do not add computation to a step.
    """

    def __init__(
        self,
        limits: MotionLimits,
        *,
        margin: float,
        rate: float,
        delay: float = 0.0,
        jitter: float = 0.0,
    ):
        """Compute the constants of the barrier.

        Args:
            limits: Limits of the joints.
            margin: Distance kept from every position limit [rad]; wider where
                position-dependent velocity limits require it.
            rate: Fastest decay of the remaining distance [1/s].
            delay: Time until the joints follow a command [s].
            jitter: Largest relative excess of a step over its dt.
        """
        super().__init__()
        A, j = limits.acceleration, limits.jerk
        reserve = A**2 / (2 * j)
        slowest, decay_time = A / (1 + jitter), torch.full_like(A, 1 / rate)
        margins = torch.full_like(A, margin)
        if limits.velocity_offset is not None and limits.deceleration is not None:
            o, d = limits.velocity_offset + _TOLERANCE, limits.deceleration
            slowest, decay_time = slowest.minimum(d), decay_time.maximum(o / d)
            margins = margins.maximum((o + reserve) ** 2 / (2 * d))
        self.velocity = nn.Buffer(limits.velocity.clone())
        """v_max [rad/s]."""
        self.acceleration = nn.Buffer(A.clone())
        """A [rad/s^2]."""
        self.jerk = nn.Buffer(j.clone())
        """j [rad/s^3]."""
        self.walls = nn.Buffer(torch.stack([-limits.lower - margins, limits.upper - margins]))
        """Lower and upper limits less the margin, times the signs of `sides` (2, n) [rad]."""
        self.sides = nn.Buffer(torch.tensor([[1.0], [-1.0]]).to(self.walls))
        """Signs of the lower and the upper limit, (2, 1)."""
        self.knee = nn.Buffer(slowest * (decay_time + delay))
        """c [rad/s]."""
        self.knee_square = nn.Buffer(self.knee**2)
        """c^2."""
        self.twice_acceleration = nn.Buffer(2 * slowest)
        """2 A in Q [rad/s^2]."""
        self.reserve = nn.Buffer(reserve)
        """v_hat - v at a = 0, which is A^2/(2 j) [rad/s]."""

    def usable(
        self, dt: float | Float[Tensor, "*#batch 1"]
    ) -> tuple[Float[Tensor, "*#batch n"], Float[Tensor, "*#batch n"]]:
        """Limits of acceleration and jerk, less the effect of rounding the sent velocities.

        A velocity is rounded by at most r = 2 eps v_max, which changes the acceleration by
        2 r/dt and the jerk by 4 r/dt^2. In float32 at 1 kHz that is 1e-4 of a Panda's limits.

        Args:
            dt: Step [s], one for all arms or one for each.
        """
        eps = torch.finfo(self.velocity.dtype).eps
        rounding = self.velocity * (_ROUNDING * eps / dt)
        acceleration = torch.sub((1 - 4 * eps) * self.acceleration, rounding, alpha=2)
        jerk = torch.sub((1 - 4 * eps) * self.jerk, rounding / dt, alpha=4)
        return acceleration.clamp(min=0), jerk.clamp(min=0)

    def velocity_bounds(
        self, joint_position: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity [rad/s] of a steady motion (a = 0) inside the set."""
        delta = torch.addcmul(self.walls, self.sides, joint_position.unsqueeze(-2))
        # v_hat = v + A^2/(2 j) at a = 0. A joint past its wall may rest, like a joint at its
        # wall.
        square = torch.addcmul(self.knee_square, self.twice_acceleration, delta.clamp(min=0))
        speed = (square.sqrt() - self.knee - self.reserve).clamp(min=0)
        most = (1 - 2 * _ROUNDING * torch.finfo(self.velocity.dtype).eps) * self.velocity
        lower, upper = (torch.minimum(speed, most) * -self.sides).unbind(-2)
        return lower, upper

    def acceleration_bounds(
        self,
        velocity: Float[Tensor, "*batch n"],
        bounds: tuple[Tensor, Tensor],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest acceleration [rad/s^2] that stay inside the set.

        The bounds are the roots a of v + a dt + (a + A)^2/(2 j) = bound + A^2/(2 j).

        Args:
            velocity: Velocity of the last step [rad/s].
            bounds: `velocity_bounds` now.
            dt: Step [s], one for all arms or one for each.
        """
        lower, upper = bounds
        slack = torch.stack([velocity - lower, upper - velocity], dim=-2)
        offset = (self.acceleration + self.jerk * dt).unsqueeze(-2)
        # Far outside the set no acceleration suffices, and the square is negative. Clamping it
        # to zero brakes hard.
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
        usable: tuple[Tensor, Tensor] | None = None,
    ) -> Float[Tensor, "*batch n"]:
        """The acceleration that is nearest to `wanted` and keeps the limits now and later
        [rad/s^2].

        Args:
            wanted: Acceleration wanted [rad/s^2].
            last: Acceleration of the last step [rad/s^2].
            velocity: Velocity of the last step [rad/s].
            bounds: `velocity_bounds` now.
            dt: Step [s], one for all arms or one for each.
            usable: The result of `usable(dt)`; None: it is computed here.
        """
        A, jerk = self.usable(dt) if usable is None else usable
        inside = wanted.clamp(*self.acceleration_bounds(velocity, bounds, dt))
        return _reachable(inside, last, A, jerk * dt)

    def reachable_velocity(
        self,
        velocity: Float[Tensor, "*batch n"],
        acceleration: Float[Tensor, "*batch n"],
        bounds: tuple[Tensor, Tensor],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
        """Lowest and highest velocity of the next step that keep all limits [rad/s].

        If the acceleration and jerk limits do not permit the velocity that the position and
        velocity limits require, both bounds are the nearest permitted velocity.

        Args:
            velocity: Velocity of the last step [rad/s].
            acceleration: Acceleration of the last step [rad/s^2].
            bounds: `velocity_bounds` now.
            dt: Step [s], one for all arms or one for each.
        """
        A, jerk = self.usable(dt)
        allowed, reach = self.acceleration_bounds(velocity, bounds, dt), jerk * dt
        ends = (-A).clamp(*allowed), A.clamp(*allowed)
        lowest, highest = (_reachable(a, acceleration, A, reach) for a in ends)
        return velocity + dt * lowest, velocity + dt * highest


def _reachable(wanted: Tensor, last: Tensor, limit: Tensor, reach: Tensor) -> Tensor:
    """Acceleration nearest to `wanted`, within its limit and within `reach` of the last one
    [rad/s^2].

    The clamp to the reach, which the jerk limit sets, comes last for two reasons. Outside the
    set, the barrier may require an acceleration beyond the reach. At the start, the
    acceleration may be so far outside its limit that one step cannot bring it back.
    """
    return wanted.clamp(-limit, limit).clamp(last - reach, last + reach)


# During gentle braking, ramps of the acceleration may add this fraction of the velocity limits
# to the velocity, for a cap of 1 m/s. With a smaller fraction, the arm brakes more gently. The
# added velocity falls with the square of the cap, as does the effect of the turning links.
_RAMP = 0.005


@final
class SpeedBarrier(nn.Module):
    """The invariant set of joint states from which speeds of points can be kept below a cap.

    Let J be the linear Jacobian of a point, v and a the joint velocity and acceleration. The
    speed |J v| changes even at constant v, because J turns with the joints. The set therefore
    bounds the speed throughout one braking motion to rest, v(t) = y v, in which y falls from 1
    to 0 with dy/dt = -1/T. For the present v, T = max(kappa |v_i|/A_i) + tau, with the limits
    A_i of the acceleration, a factor kappa >= 1, and a time tau in which the braking fades out.

    *Turning.* For joints i, j of a chain, d^2 p/dq_i dq_j = z_min(i,j) x J_max(i,j), which is
    at most as long as the column J_max(i,j). Let R_i be the longest column from joint i on, and
    x = |v|. After the joints have moved by d,

        |J(q + d) v - J(q) v| <= sum_ij R_max(i,j) d_j x_i,

    and B = sum_ij R_max(i,j) x_i x_j bounds |dJ/dt v|. While y falls from 1 to a value y, joint
    j moves by at most x_j (T (1 - y^2)/2 + dt); the term dt is the step before the braking. So
    the speed is at most

        y (|J v| + dt B + Gamma (1 - y^2)),    Gamma = B (T + tau)/2.

    The largest value over y is |J v| + dt B if this sum exceeds 2 Gamma: braking then lowers
    the speed faster than turning raises it. The bound is a barrier, because one step of
    braking, of any length, does not increase it. The columns R_i also grow, by a factor of at
    most exp(sum of all d).

    *Jerk.* While its acceleration a ramps down, a joint is faster than y v by at most
    (a + b)^2/(2 j), where b = |v|/T is its deceleration. A large kappa keeps these ramps small.

    *Joint limits.* Near its position limits, a joint follows its own barrier, where the
    velocity decays at most at the rate A/c. A joint that brakes faster than y v deviates from
    y v by at most (1 - (1 + log rho)/rho) v with rho = T A/c > 1.

    *Delay and jitter.* If positions are read a time D before the motion, the joints have since
    moved by at most D (x + A D), which turns the links further; from one reading to the next
    they move by at most dt (x + A D). A step lasts up to (1 + jitter) dt.
    """

    def __init__(
        self, joints: LimitBarrier, cap: float, *, delay: float = 0.0, jitter: float = 0.0
    ):
        """Compute the constants of the barrier.

        Args:
            joints: Barrier of the joint limits.
            cap: The usual cap [m/s]; the barrier also holds for other caps.
            delay: D, time from a reading to the motion that results from it [s].
            jitter: Largest relative excess of a step over its dt.
        """
        super().__init__()
        self.delay, self.stretch = delay, 1 + jitter
        A, j = joints.acceleration, joints.jerk
        gentle = min(cap, 1.0) * (2 * _RAMP * j * joints.velocity).sqrt()
        # A joint that may not move has a velocity limit of zero.
        deceleration = torch.minimum(A, gentle).clamp(min=1e-3 * A)
        self.deceleration = nn.Buffer(deceleration)
        """A/kappa, deceleration of gentle braking [rad/s^2]."""
        self.jerk = nn.Buffer(j.clone())
        """j [rad/s^3]."""
        self.fade = nn.Buffer((deceleration / j).amax() / 2)
        """tau, time in which the braking fades out at its end [s]."""
        self.decay = nn.Buffer((joints.twice_acceleration / (2 * joints.knee)).amax())
        """Largest A/c of the joints [1/s]."""
        self.distal = nn.Buffer(torch.ones(len(A), len(A)).triu().to(A))
        """1 at (i, j) for j >= i, otherwise 0 (n, n)."""
        self.slowing = nn.Buffer(A * delay)
        """A D: a joint may have been faster by this much when its position was read [rad/s]."""

    def braking_time(self, velocity: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch 1"]:
        """T, the time constant of the braking motion at a velocity [s]."""
        return (velocity.abs() / self.deceleration).amax(-1, keepdim=True) + self.fade

    def highest_speed(
        self,
        points: Float[Tensor, "*batch points 3 n"],
        velocity: Float[Tensor, "*batch n"],
        acceleration: Float[Tensor, "*batch n"],
        dt: float | Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch 1"]:
        """Bound on the speed of all points during a step and the braking after it [m/s].

        Args:
            points: Linear Jacobians of the points at the joint positions read last.
            velocity: Joint velocity of the step [rad/s].
            acceleration: Acceleration with which this velocity is reached [rad/s^2].
            dt: The step [s].
        """
        T = self.braking_time(velocity)
        x, towards = velocity.abs(), torch.sign(velocity) * acceleration
        braking, twice_jerk = x / T, 2 * self.jerk
        # Deviation from y v: a joint is faster while its acceleration ramps down, and slower if
        # it brakes harder. A joint that cannot end the braking before zero velocity reverses.
        # Then |a| > |v|/T, as T > max(A_i/j_i)/(2 kappa).
        hard = towards.clamp(max=0) ** 2
        ramp = torch.where(hard > twice_jerk * x, hard, (towards + braking) ** 2)
        excess = ramp / twice_jerk
        rho = (self.decay * T).clamp(min=1)
        excess = excess + (1 - (1 + rho.log()) / rho) * x
        fastest = x + excess

        late, before = self.stretch * dt + self.delay, fastest + self.slowing
        growth = (fastest * T / 2 + before * late).sum(-1, keepdim=True).exp()
        columns = torch.linalg.vector_norm(points, dim=-2) * growth.unsqueeze(-1)
        R = (columns.unsqueeze(-2) * self.distal).amax(-1)
        B = turned = self._turning(R, fastest, fastest)
        if self.delay > 0:
            turned = self._turning(R, fastest, before)
        moved = torch.linalg.vecdot(points, velocity.unsqueeze(-2).unsqueeze(-2))
        M = torch.linalg.vector_norm(moved, dim=-1) + late * turned
        aside = torch.linalg.vecdot(R, excess.unsqueeze(-2))
        return (_peak(M, B * (T + self.fade) / 2) + aside).amax(-1, keepdim=True)

    def _turning(self, R: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Sum over i, j of R_max(i,j) x_i y_j, computed from partial sums up to each joint."""
        up_to_x, up_to_y = x.cumsum(-1), y.cumsum(-1)
        return torch.linalg.vecdot(R, (x * up_to_y + y * (up_to_x - x)).unsqueeze(-2))


def _peak(M: Tensor, gamma: Tensor) -> Tensor:
    """Largest value of  y (M + gamma (1 - y^2))  for y from 0 to 1."""
    total = M + gamma
    inside = 3 * gamma > total
    square = total / torch.where(inside, 3 * gamma, 1.0)
    # A root of zero has no derivative.
    y = torch.where(inside, square, 1.0).clamp(min=torch.finfo(M.dtype).tiny).sqrt()
    return torch.where(inside, (2 / 3) * total * y, M)
