"""Control barrier for the speed of points of the arm: its tool, its elbow, its load."""

from __future__ import annotations

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.controller.limit_barrier import LimitBarrier

# Velocity that ramps of the acceleration may add while the arm eases off, as a fraction of the
# velocity limits at a cap of 1 m/s: it decides how gently the arm eases off. It falls with the
# square of the cap, as the turning of the links does that gentle braking has to allow for.
_RAMP = 0.005
# Jerk [rad/s^3] in place of an infinite one, of which differences would be NaN.
_NO_LIMIT = 1e9


@final
class SpeedBarrier(nn.Module):
    """The invariant set of joint states from which speeds of points stay below a cap.

    Let J be the linear Jacobian of a point, v and a the joint velocity and acceleration. The
    speed |J v| changes although v rests, because J turns with the joints. The set therefore
    bounds the speed on the whole way to rest along one braking motion, v(t) = y v, in which y
    falls from 1 to 0 with  dy/dt = -1/T,  T = max(kappa |v_i|/A_i) + tau  of the present v.

    *Turning.* For joints i, j of a chain, d^2 p/dq_i dq_j = z_min(i,j) x J_max(i,j), at most as
    long as the column J_max(i,j). Let R_i be the longest column from joint i on, and x = |v|.
    After the joints have moved by d,

        |J(q + d) v - J(q) v| <= sum_ij R_max(i,j) d_j x_i,

    and B = sum_ij R_max(i,j) x_i x_j bounds |dJ/dt v|. Until y the joints move by at most
    x_j (T (1 - y^2)/2 + dt), the second term for the step itself. So the speed is at most

        y (|J v| + dt B + Gamma (1 - y^2)),    Gamma = B (T + tau)/2.

    Its largest value over y is |J v| + dt B as long as that exceeds 2 Gamma: braking outruns
    the turning. It is a barrier, because each term of the bound uses up its part of the next:
    one step of braking, of any length, does not increase it. The columns grow as well, by
    at most exp(sum of all d).

    *Jerk.* While its acceleration ramps down, a joint is faster than y v by at most
    (a + b)^2/(2 j) with its braking b = |v|/T. kappa makes these ramps small.

    *Joint limits.* Near its position limits a joint follows its own barrier, whose velocity
    decays at most at the rate A/c. Braking faster than y v, it leaves y v by at most
    (1 - (1 + log rho)/rho) v with rho = T A/c > 1.
    """

    deceleration: Tensor
    """A/kappa [rad/s^2], at which joints ease off."""
    jerk: Tensor
    """j [rad/s^3]; huge without a jerk limit."""
    fade: Tensor
    """tau, time in which the braking fades out at its end [s]."""
    decay: Tensor
    """Largest A/c of the joints [1/s]."""
    distal: Tensor
    """1 at (i, j) for j not before i (n, n)."""

    def __init__(self, joints: LimitBarrier, cap: float):
        """Compute the constants of the barrier.

        Args:
            joints: Barrier of the joint limits.
            cap: The usual cap [m/s]; the barrier holds for any other as well.
        """
        super().__init__()
        A, j = joints.acceleration, joints.jerk
        if not joints.jerk_limited:
            j = torch.full_like(j, _NO_LIMIT)
        gentle = min(cap, 1.0) * (2 * _RAMP * j * joints.velocity).sqrt()
        # A joint that may not move has a velocity limit of zero.
        deceleration = torch.minimum(A, gentle).clamp(min=1e-3 * A)
        constants = {
            "deceleration": deceleration,
            "jerk": j.clone(),
            "fade": (deceleration / j).amax() / 2,
            "decay": (joints.twice_acceleration / (2 * joints.knee)).amax(),
            "distal": torch.ones(len(A), len(A)).triu().to(A),
        }
        for name, value in constants.items():
            self.register_buffer(name, value)

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
            points: Linear Jacobians of the points at the start of the step.
            velocity: Joint velocity of the step [rad/s].
            acceleration: Acceleration with which it was reached [rad/s^2].
            dt: The step [s].
        """
        T = self.braking_time(velocity)
        x, towards = velocity.abs(), torch.sign(velocity) * acceleration
        ramp = (towards + x / T).clamp(min=0) ** 2
        # Braking harder than the motion needs, it swings past zero.
        swing = towards.clamp(max=0) ** 2 - 2 * self.jerk * x
        excess = torch.maximum(ramp, swing) / (2 * self.jerk)
        rho = (self.decay * T).clamp(min=1)
        excess = excess + (1 - (1 + rho.log()) / rho) * x
        fastest = x + excess

        growth = (fastest * (T / 2 + dt)).sum(-1, keepdim=True).exp()
        columns = torch.linalg.vector_norm(points, dim=-2) * growth.unsqueeze(-1)
        R = (columns.unsqueeze(-2) * self.distal).amax(-1)
        # sum_ij R_max(i,j) x_i x_j, by sums of x up to each joint.
        sums = (fastest.unsqueeze(-2) * self.distal.mT).sum(-1)
        pairs = (fastest * (2 * sums - fastest)).unsqueeze(-2)
        B = torch.linalg.vecdot(R, pairs)
        moved = torch.linalg.vecdot(points, velocity.unsqueeze(-2).unsqueeze(-2))
        M = torch.linalg.vector_norm(moved, dim=-1) + dt * B
        aside = torch.linalg.vecdot(R, excess.unsqueeze(-2))
        return (_peak(M, B * (T + self.fade) / 2) + aside).amax(-1, keepdim=True)


def _peak(M: Tensor, gamma: Tensor) -> Tensor:
    """Largest value of  y (M + gamma (1 - y^2))  for y from 0 to 1."""
    total = M + gamma
    inside = 3 * gamma > total
    square = total / torch.where(inside, 3 * gamma, 1.0)
    # A root of zero has no derivative.
    y = torch.where(inside, square, 1.0).clamp(min=torch.finfo(M.dtype).tiny).sqrt()
    return torch.where(inside, (2 / 3) * total * y, M)
