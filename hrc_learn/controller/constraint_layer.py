"""Joint velocities that keep joint limits and distances at once, from a quadratic program.

The program finds the joint velocity nearest to a wanted one, with priority for the task. It has
two unknowns more than the arm has joints: the speed of the task, and the amount by which
closing speeds exceed their limits where distances conflict. The arm keeps distances from
itself, from objects and from people (`SeparationConfig`).

The solver is the dual active-set method of Goldfarb and Idnani (1983), batched, with a fixed
limit on the number of steps. It starts at the optimum without limits and adds one limit at a
time to the active set, so a program with few active limits is solved exactly in few steps. Each
step adds or drops one limit, separately for each element of a batch: the operations do not
depend on the data, so they compile and export.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.contact_limits import SeparationConfig
from hrc_learn.geometry.numerics import (
    check_settings,
    is_number,
    matmul,
    may_branch,
    orthonormal_basis,
    safe_norm,
)
from hrc_learn.pytree import pytree, zero_where

# Violations of a limit up to this size count as rounding.
_TOLERANCE = 1e-10
# The row of a limit counts as linearly dependent on the active rows if its projection onto
# their null space is shorter than this fraction of the row. Rounding leaves 1e-16; with weights
# of 1e7, a fraction of 1e-7 of a row is significant.
_DEPENDENT = 1e-12


class LeastChange(NamedTuple):
    """The point nearest to the origin within some limits."""

    point: Float[Tensor, "*batch p"]
    multipliers: Float[Tensor, "*batch rows"]
    """Lagrange multipliers: positive at active upper limits, negative at active lower ones."""
    solved: Bool[Tensor, "*batch"]
    """True where the solution was found within the allowed steps."""


@dataclass(frozen=True, kw_only=True)
class _Step:
    """State of the method after a step: nearest point within the active limits.

    Shapes are given in parentheses.
    """

    y: Tensor
    """The point (p)."""
    dual: Tensor
    """Multipliers, not negative (rows)."""
    side: Tensor
    """1 for an active upper limit, -1 for an active lower one, 0 otherwise (rows)."""
    operators: Tensor
    """Projector onto the null space of the active rows (p, p) and, to its right, the
    pseudo-inverse of these rows (p, rows). The columns of the pseudo-inverse are multiplied by
    `side`, so the columns of inactive limits are zero."""
    pending: Tensor
    """True while a limit is only partly added, because another limit had to be dropped first
    (1)."""
    index: Tensor
    """Index of the partly added limit (1)."""
    multiplier: Tensor
    """Multiplier of the partly added limit so far (1)."""


def least_change(
    rows: Float[Tensor, "*batch p rows"],
    lower: Float[Tensor, "*batch rows"],
    upper: Float[Tensor, "*batch rows"],
    steps: int,
) -> LeastChange:
    """Solve  min |y|^2 / 2  subject to  lower <= C y <= upper.

    Any strictly convex program takes this form: with the Hessian L L^T and the optimum x_0
    without limits, its unknown is y = L^T (x - x_0).

    Args:
        rows: C^T, with a column for each limit. In this layout sums run over the first axis,
            and compiled code works on vectors of limits.
        lower: Lower limits, not above `upper`; minus infinity: no limit.
        upper: Upper limits; infinity: no limit.
        steps: Number of steps. Each active limit takes one step, and each limit that is added
            and dropped again takes two.
    """
    *batch, p, _ = rows.shape
    nothing = torch.zeros_like(lower)
    eye = torch.eye(p, dtype=rows.dtype, device=rows.device).expand(*batch, p, p)
    now = _Step(
        y=rows.new_zeros(rows.shape[:-1]),
        dual=nothing,
        side=nothing,
        operators=torch.cat([eye, torch.zeros_like(rows)], dim=-1),
        pending=torch.zeros_like(lower[..., :1], dtype=torch.bool),
        index=torch.zeros_like(lower[..., :1], dtype=torch.int64),
        multiplier=nothing[..., :1],
    )
    for _ in range(steps):
        if may_branch(rows) and bool(_solved(now, rows, lower, upper).all()):
            break
        now = _next(now, rows, lower, upper)
    return LeastChange(now.y, now.side * now.dual, _solved(now, rows, lower, upper))


def _solved(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> Bool[Tensor, "*batch"]:
    below, above = _violations(now, rows, lower, upper)
    # A pending limit is not active yet, so it counts as violated.
    violation = torch.where(now.side == 0, torch.maximum(below, above), 0.0).amax(-1)
    return violation <= _TOLERANCE


def _violations(
    now: _Step, rows: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Violations of the lower and the upper limits, positive where violated."""
    value = _combine(now.y, rows)
    return lower - value, value - upper


def _next(now: _Step, rows: Tensor, lower: Tensor, upper: Tensor) -> _Step:
    """One step: add the most violated limit, or drop an active limit that prevents this."""
    below, above = _violations(now, rows, lower, upper)
    violation = torch.where(now.side == 0, torch.maximum(below, above), -1.0)
    index = torch.where(now.pending, now.index, violation.argmax(-1, keepdim=True))
    a, b = above.gather(-1, index), below.gather(-1, index)
    side = torch.where(a > b, 1.0, -1.0).to(a.dtype)
    excess = torch.maximum(a, b)
    wanted = now.pending | (excess > _TOLERANCE)

    # `z`: direction towards the limit along which the active limits remain satisfied. `lost`:
    # rates at which their multipliers decrease along this direction.
    p = rows.shape[-2]
    c = side * _column(rows, index)
    passed = _combine(c, now.operators)
    # Projected twice: one projection leaves too few correct digits of a short vector.
    z, lost = _combine(passed[..., :p], now.operators[..., :p]), passed[..., p:]
    zz = (z * z).sum(-1, keepdim=True)
    independent = zz > _DEPENDENT**2 * (c * c).sum(-1, keepdim=True)
    full = torch.where(independent, excess / torch.where(independent, zz, 1.0), math.inf)
    losing = (now.side != 0) & (lost > 0)
    ratio = torch.where(losing, now.dual / torch.where(losing, lost, 1.0), math.inf)
    leaving = ratio.argmin(-1, keepdim=True)
    partial = ratio.gather(-1, leaving)
    length = torch.minimum(full, partial)
    acts = wanted & (length < math.inf)
    length = torch.where(acts, length, 0.0)
    adds, drops = acts & (full <= partial), acts & (full > partial)

    number = torch.arange(rows.shape[-1], device=rows.device)
    enters, leaves = (number == index) & adds, (number == leaving) & drops
    v = _column(now.operators, leaving + p)
    direction = torch.where(adds, z, v)
    square = torch.where(adds, zz, (v * v).sum(-1, keepdim=True))
    scale = torch.where(acts, 1 / torch.where(acts, square, 1.0), 0.0)
    # A rank-one update: the projector loses the direction of an added limit, or gains the
    # direction of a dropped limit. In both cases, the pseudo-inverse becomes orthogonal to it.
    entering = torch.cat([z, lost - enters.to(c.dtype)], dim=-1)
    exiting = torch.cat([-v, _combine(v, now.operators[..., p:])], dim=-1)
    turn = scale * torch.where(adds, entering, exiting)
    multiplier = now.multiplier + length
    return _Step(
        y=now.y - torch.where(independent, length, 0.0) * z,
        dual=torch.where(
            enters,
            multiplier,
            torch.where(leaves, 0.0, (now.dual - length * lost).clamp(min=0)),
        ),
        side=torch.where(enters, side, torch.where(leaves, 0.0, now.side)),
        operators=now.operators - direction.unsqueeze(-1) * turn.unsqueeze(-2),
        pending=drops,
        index=index,
        multiplier=torch.where(drops, multiplier, 0.0),
    )


def _combine(weights: Tensor, rows: Tensor) -> Tensor:
    """Weighted sum of the rows of a matrix."""
    return (weights.unsqueeze(-1) * rows).sum(-2)


def _column(matrix: Tensor, index: Tensor) -> Tensor:
    """Column of a matrix at an index (1), for each element of a batch."""
    shape = (*matrix.shape[:-1], 1)
    return matrix.gather(-1, index.unsqueeze(-2).expand(shape)).squeeze(-1)


@dataclass(frozen=True, kw_only=True)
class ConstraintConfig:
    """Distances to keep, and the costs that decide which motion yields first."""

    clearance: float = 0.03
    """Distance kept from objects and from the arm itself [m]: three times the calibration error
    of base and table. People are kept at the protective distance (`SeparationConfig`)."""
    rate: float = 5.0
    """Fastest decay of a distance towards the clearance [1/s], as for joints towards their
    limits; at most 1/dt."""
    task_weight: float = 100.0
    """Cost of slowing the task down, relative to the same change of the null-space velocity:
    with 100, a change by 1 rad/s costs as much as 0.01 rad/s of the task."""
    path_weight: float = 1e3
    """Cost of leaving the path of the task, relative to slowing it down by the same joint
    velocity."""
    distance_weight: float = 1e2
    """Cost of approaching 1 m/s faster than allowed, relative to leaving the path. With 1e2,
    the violation of conflicting distances exceeds the least possible violation by 1 part in
    1e4."""
    steps: int = 16
    """Steps of the solver; the arm brakes where they are not enough. An arm that a person
    approached never needed more than 12; random limits need more than 16 in 4 % of the states,
    and more than 24 in 0.1 %. Each step of the solver takes about 3 % of the time of a compiled
    control step."""

    def __post_init__(self):
        positive = "rate", "task_weight", "path_weight", "distance_weight", "steps"
        check_settings(self, positive=positive, not_negative=["clearance"])

    @property
    def path_cost(self) -> float:
        """Cost of leaving the path by 1 rad/s, relative to 1 rad/s of the null space."""
        return self.task_weight * self.path_weight

    @property
    def slack_cost(self) -> float:
        """Cost of approaching 1 m/s too fast, relative to 1 rad/s of the null space."""
        return self.path_cost * self.distance_weight


@pytree
class Distances:
    """Distances to keep: between the arm and itself, the scene, or a person."""

    distance: Float[Tensor, "*batch pairs"]
    """Distance of each pair [m]."""
    gradient: Float[Tensor, "*batch pairs n"]
    """Gradient with respect to the joint positions [m/rad]; zero for a pair that the arm does
    not move."""
    approach_speed: Float[Tensor, "*batch pairs"]
    """Rate at which the distance shrinks while the arm rests [m/s]: the speed of the other body
    towards the arm, along the line between both."""
    person: Bool[Tensor, "*batch pairs"] | None = None
    """True for pairs with a person: the arm approaches only as fast as the protective distance
    allows, and does not retreat from an approaching person. False for objects; None: all pairs
    are objects."""
    contact_speed: Float[Tensor, "*batch pairs"] | None = None
    """Highest relative speed of an allowed contact with the person [m/s]; zero where no contact
    is allowed. None: no contact is allowed at all."""

    def known(self) -> Bool[Tensor, "*batch"]:
        """True where all values are finite."""
        known = is_number(self.distance) & is_number(self.approach_speed)
        if self.contact_speed is not None:
            known = known & is_number(self.contact_speed)
        return (known & is_number(self.gradient).all(-1)).all(-1)

    def where(self, known: Bool[Tensor, "*batch"]) -> Distances:
        """The distances where `known`, zeros elsewhere."""
        return replace(zero_where(~known, self), person=self.person)

    def closing_speed(
        self, config: ConstraintConfig, separation: SeparationConfig
    ) -> Float[Tensor, "*batch pairs"]:
        """Highest speed of the arm towards the other body of each pair [m/s]; negative: the arm
        has to retreat.
        """
        towards_object = config.rate * (self.distance - config.clearance) - self.approach_speed
        if self.person is None:
            return towards_object
        towards_person = separation.allowed_speed(
            self.distance, self.approach_speed, self.contact_speed
        )
        return torch.where(self.person, towards_person, towards_object)


@pytree
class ConstraintReport:
    """Effect of the limits on a joint velocity."""

    slowed: Float[Tensor, "*batch"]
    """Fraction of the tool's velocity given up, 0 to 1."""
    violation: Float[Tensor, "*batch"]
    """Largest excess of a closing speed over the allowed speed [m/s]; above zero where joint
    limits or other distances permit no better solution."""
    solved: Bool[Tensor, "*batch"]
    """False where the arm brakes because the solver needed more steps than allowed."""


def constrained_velocity(
    wanted: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch m n"],
    lower: Float[Tensor, "*batch n"],
    upper: Float[Tensor, "*batch n"],
    distances: Distances | None = None,
    config: ConstraintConfig | None = None,
    separation: SeparationConfig | None = None,
) -> tuple[Float[Tensor, "*batch n"], ConstraintReport]:
    """Joint velocity that keeps all limits and is nearest to a wanted one, with priority for
    the task.

    With orthonormal bases N of the null space of J and P of the range of J^T, the task is the
    part t = P P^T wanted, which moves the tool. Every joint velocity is

        u = wanted + sigma t + N z + P e,

    and the returned velocity solves

        min  |z|^2 + W_t^2 |sigma t|^2 + W_p^2 |e|^2 + W_d^2 delta^2
        s.t. lower <= u <= upper,   -1 <= sigma <= 0,
             -dd/dq u <= c + delta,

    with c = rate (d - clearance) - approach_speed for objects, and for people the speed that
    keeps the protective distance (`Distances.closing_speed`).

    The weights are far apart (W_t `task_weight`, W_p `path_cost`, W_d `slack_cost` of
    `ConstraintConfig`), which makes them priorities. Joint limits hold exactly. Distances
    hold, or are violated by the least possible excess `delta`, equal for all pairs. The tool
    stays on the path of the task, J u = (1 + sigma) J wanted, if the limits allow any motion on
    it. The null space yields first, then the task loses speed: a slow task stops before the
    null space becomes fast. Where no limit binds, the result is the wanted velocity.

    On the path, the tool never moves faster than wanted, whatever the null space does. To cap
    the speed of the tool, cap the wanted velocity.

    Args:
        wanted: Joint velocity of task and null space together [rad/s].
        jacobian: Jacobian of the tool; may be singular. If it has more rows than the arm has
            joints, the arm has no null space: all motion belongs to the task.
        lower: Lowest joint velocity allowed by the limits of position, velocity, acceleration
            and jerk [rad/s]. Not above `upper`.
        upper: Highest joint velocity allowed [rad/s].
        distances: Distances to keep; None: no distances.
        config: Weights and clearance; default: the recommended settings.
        separation: Protective distance from people; default: the recommended settings.

    Returns:
        Joint velocities [rad/s], and the effect of the limits.
    """
    config = config or ConstraintConfig()
    dtype, m = wanted.dtype, min(jacobian.shape[-2:])
    # Weights are 1e7 apart, and float32 has seven digits.
    wanted, J, lower, upper = (x.double() for x in (wanted, jacobian, lower, upper))
    # Limits of joints and distances, relative to the wanted velocity.
    gradient, least, most = None, lower - wanted, upper - wanted
    if distances is not None:
        gradient = distances.gradient.double()
        allowed = distances.closing_speed(config, separation or SeparationConfig())
        allowed = allowed + torch.linalg.vecdot(gradient, wanted.unsqueeze(-2))
        least = torch.cat([least, torch.full_like(allowed, -torch.inf)], dim=-1)
        most = torch.cat([most, allowed], dim=-1)
    zero = torch.zeros_like(wanted[..., 0])
    if may_branch(wanted) and bool((torch.maximum(least, -most) <= _TOLERANCE).all()):
        solved = torch.ones_like(zero, dtype=torch.bool)
        within, zero = wanted.clamp(lower, upper).to(dtype), zero.to(dtype)
        return within, ConstraintReport(slowed=zero, violation=zero, solved=solved)

    basis, speed = _unit_cost_directions(J, wanted, config)
    # Limits of the task: it slows down to rest at most.
    least = torch.cat([least, -speed.unsqueeze(-1)], dim=-1)
    most = torch.cat([most, zero.unsqueeze(-1)], dim=-1)
    change = least_change(_limit_rows(basis, gradient, m, config), least, most, config.steps)
    y, solved = change.point, change.solved
    u = wanted + matmul(y[..., None, :-1], basis).squeeze(-2)
    # Without a solution the arm brakes towards zero; the clamp also removes rounding of the
    # solver.
    u = torch.where(solved.unsqueeze(-1), u, 0.0).clamp(lower, upper)
    lost = -y[..., m] / config.task_weight / torch.where(speed > 0, speed, 1.0)
    slowed = torch.where(solved, lost, 1.0)
    violation = torch.where(solved, y[..., -1] / config.slack_cost, 0.0)
    report = ConstraintReport(
        slowed=slowed.to(dtype), violation=violation.to(dtype), solved=solved
    )
    return u.to(dtype), report


def _unit_cost_directions(
    jacobian: Tensor, wanted: Tensor, config: ConstraintConfig
) -> tuple[Tensor, Tensor]:
    """Joint velocities that cost one unit each (directions, n): m directions that leave the
    path, one along the path, and the directions of the null space. Second, the speed of the
    task [rad/s].
    """
    m = min(jacobian.shape[-2:])
    basis = orthonormal_basis(jacobian).mT
    leaving, null = basis[..., :m, :], basis[..., m:, :]
    task = matmul(matmul(wanted.unsqueeze(-2), leaving.mT), leaving)
    speed = safe_norm(task.squeeze(-2))
    along = task / torch.where(speed > 0, config.task_weight * speed, 1.0)[..., None, None]
    return torch.cat([leaving / config.path_cost, along, null], dim=-2), speed


def _limit_rows(
    basis: Tensor, gradient: Tensor | None, m: int, config: ConstraintConfig
) -> Tensor:
    """Argument `rows` of `least_change` (unknowns, limits). The columns are the limits of the
    joints, of the distances and of the task. The last unknown is the common excess of the
    distances.
    """
    joints = torch.cat([basis, torch.zeros_like(basis[..., :1, :])], dim=-2)
    slower = torch.zeros_like(joints[..., :1])
    slower[..., m, :] = 1 / config.task_weight
    rows = [joints]
    if gradient is not None:
        excess = torch.full_like(gradient[..., 0], 1 / config.slack_cost).unsqueeze(-2)
        rows.append(-torch.cat([matmul(basis, gradient.mT), excess], dim=-2))
    return torch.cat([*rows, slower], dim=-1)
