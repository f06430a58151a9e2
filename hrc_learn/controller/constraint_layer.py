"""One layer for all that limits a motion: the joints, the tool, the distances around the arm.

The joint velocity nearest to a wanted one that keeps them, with the task first: a quadratic
program of one unknown more than the arm has joints, and one for conflicts (`small_qp`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.motion_barriers import SeparationConfig
from hrc_learn.controller.small_qp import least_change, none_binds
from hrc_learn.geometry.numerics import is_number, matmul, orthonormal_basis
from hrc_learn.pytree import pytree


@dataclass(frozen=True, kw_only=True)
class ConstraintConfig:
    """What is kept, and what yields to keep it."""

    clearance: float = 0.03
    """Distance that is kept from things [m]: three times the errors of base and table. Of
    people the protective distance is kept (`SeparationConfig`)."""
    rate: float = 5.0
    """Fastest decay of what a distance is above that [1/s], as of joints towards their limits;
    at most 1/dt."""
    task_weight: float = 100.0
    """Of slowing down the task by all of it, beside 1 rad/s of the null space: to keep a
    hundredth of its speed the null space changes by up to 1 rad/s, and not by more."""
    path_weight: float = 1e3
    """Of leaving the path of the task, beside slowing it down; per rad/s."""
    distance_weight: float = 1e2
    """Of approaching faster than allowed, beside leaving the path; per m/s. With 1e2, what is
    approached too fast where distances exclude each other is least to a part in 1e4."""
    steps: int = 16
    """Of the solver; where they are not enough the arm brakes. Arms that a person walked up to
    never needed more than 12; limits drawn at random take more than 16 in 4 % of the states,
    and more than 24 in 0.1 %. Each takes some 3 % of a compiled control step."""
    early_exit: bool = False
    """Whether the solver stops as soon as it is done: 3 times as fast where steps run one by
    one, not compiled. Such a step neither compiles nor maps over batches."""

    def __post_init__(self):
        if self.clearance < 0:
            raise ValueError(f"clearance must not be negative, but is {self.clearance}")
        for name in ("rate", "task_weight", "path_weight", "distance_weight"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, but is {self.steps}")


@pytree
@dataclass(frozen=True, kw_only=True)
class Distances:
    """Distances that must not become too small: of the arm from itself, the scene, a worker."""

    distance: Float[Tensor, "*batch pairs"]
    """[m]"""
    gradient: Float[Tensor, "*batch pairs n"]
    """By the joint positions [m/rad]; zero of a pair that the arm does not move."""
    approach_speed: Float[Tensor, "*batch pairs"]
    """At which the distance shrinks while the arm rests [m/s]: the speed of the other towards
    the arm, along the line between both."""
    person: Bool[Tensor, "*batch pairs"] | None = None
    """Of a person: the arm comes nearer as slowly as the protective distance asks, and rests
    before it; people who come nearer themselves need not be fled from. Else of a thing; None:
    all are."""

    def known(self) -> Bool[Tensor, "*batch"]:
        """Whether all are numbers."""
        known = is_number(self.distance) & is_number(self.approach_speed)
        return (known & is_number(self.gradient).all(-1)).all(-1)

    def double(self) -> Distances:
        """The same in float64."""
        return Distances(
            distance=self.distance.double(),
            gradient=self.gradient.double(),
            approach_speed=self.approach_speed.double(),
            person=self.person,
        )

    def where(self, known: Bool[Tensor, "*batch"]) -> Distances:
        """The same where known, elsewhere zeros."""
        unknown = ~known.unsqueeze(-1)
        return Distances(
            distance=self.distance.masked_fill(unknown, 0),
            gradient=self.gradient.masked_fill(unknown.unsqueeze(-1), 0),
            approach_speed=self.approach_speed.masked_fill(unknown, 0),
            person=self.person,
        )

    def closing_speed(
        self, config: ConstraintConfig, separation: SeparationConfig
    ) -> Float[Tensor, "*batch pairs"]:
        """At which the arm may shrink each distance [m/s]; negative: it has to increase it."""
        thing = config.rate * (self.distance - config.clearance) - self.approach_speed
        if self.person is None:
            return thing
        person = separation.highest_speed(self.distance, self.approach_speed)
        return torch.where(self.person, person, thing)


class ConstrainedVelocity(NamedTuple):
    """A joint velocity within all limits, and what it took."""

    joint_velocity: Float[Tensor, "*batch n"]
    """[rad/s]"""
    slowed: Float[Tensor, "*batch"]
    """Part of the task that was given up: 0 none, 1 all."""
    violation: Float[Tensor, "*batch"]
    """By how much distances shrink faster than they may [m/s]: above zero where the limits of
    the joints, or other distances, leave nothing better."""
    solved: Bool[Tensor, "*batch"]
    """False: the arm brakes, as an input was not a number or the solver's steps not enough."""


def constrained_velocity(
    wanted: Float[Tensor, "*batch n"],
    task: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch m n"],
    lower: Float[Tensor, "*batch n"],
    upper: Float[Tensor, "*batch n"],
    distances: Distances | None = None,
    config: ConstraintConfig | None = None,
    share: Float[Tensor, "*batch"] | None = None,
    separation: SeparationConfig | None = None,
) -> ConstrainedVelocity:
    """The velocity nearest to a wanted one that the limits allow, the task first.

    With the task's velocity t, an orthonormal basis N of the null space of J, and P of the
    range of J^T, every joint velocity is

        u = wanted + sigma t + N z + P e,

    and the one returned solves

        min  |z|^2 + W_t^2 sigma^2 + W_p^2 |e|^2 + W_d^2 delta^2
        s.t. lower <= u <= upper,   -share <= sigma <= 0,
             -dd/dq u <= c + delta,

    with c = rate (d - clearance) - approach_speed for things, and for people the speed that
    keeps the protective distance (`Distances.closing_speed`).

    The weights are far apart. So the limits of the joints hold exactly; distances hold, or
    shrink too fast by as little as the joints let them, `delta` alike for all pairs; the path
    of the task is kept while anything on it is allowed, J u being J wanted + sigma J t; of the
    task as much as possible remains; and the null space yields first. Where nothing binds it
    is the wanted velocity itself.

    On the path the tool moves by J u = J wanted + sigma J t, whatever the null space does, and
    never faster than wanted: a cap on its speed is one on the wanted velocity.

    Args:
        wanted: Joint velocity of task and null space together [rad/s].
        task: That of the task, along which it may slow down [rad/s]. What of it leaves the tool
            at rest counts as the null space's.
        jacobian: Of the tool, with at most as many rows as joints; singular ones too.
        lower: Lowest joint velocity allowed, now and with a view to position, acceleration and
            jerk [rad/s]. Not above `upper`.
        upper: Highest joint velocity allowed [rad/s].
        distances: To be kept; None: none.
        config: Default: the recommended settings.
        share: Of the task in the wanted velocity, 0 to 1, as while the arm gets under way;
            None: all of it.
        separation: Of the protective distance from people. Default: the recommended settings.
    """
    config = config or ConstraintConfig()
    dtype = wanted.dtype
    # Weights are 1e7 apart, and float32 has seven digits.
    wanted, task, jacobian, lower, upper = (
        x.double() for x in (wanted, task, jacobian, lower, upper)
    )
    if distances is not None:
        distances = distances.double()
    share = torch.ones_like(wanted[..., 0]) if share is None else share.double()
    numbers = (wanted, task, lower, upper, jacobian.flatten(-2), share.unsqueeze(-1))
    known = is_number(torch.cat(numbers, dim=-1)).all(-1)
    if distances is not None:
        known = known & distances.known()
        distances = distances.where(known)
    unknown = ~known.unsqueeze(-1)
    wanted, task = wanted.masked_fill(unknown, 0), task.masked_fill(unknown, 0)
    jacobian = jacobian.masked_fill(unknown.unsqueeze(-1), 0)
    share = share.masked_fill(~known, 0)
    bounded = is_number(torch.cat([lower, upper], dim=-1)).all(-1, keepdim=True)
    lower, upper = lower.masked_fill(~bounded, 0), upper.masked_fill(~bounded, 0)

    # What the limits leave, of joints, task and distances, counted from the wanted velocity.
    zero = torch.zeros_like(share)
    least = [lower - wanted, -share.unsqueeze(-1)]
    most = [upper - wanted, zero.unsqueeze(-1)]
    if distances is not None:
        allowed = distances.closing_speed(config, separation or SeparationConfig())
        least.append(torch.full_like(allowed, -torch.inf))
        most.append(allowed + torch.linalg.vecdot(distances.gradient, wanted.unsqueeze(-2)))
    least, most = torch.cat(least, dim=-1), torch.cat(most, dim=-1)
    if config.early_exit and bool(none_binds(least, most).all()):
        u = wanted.clamp(lower, upper).to(dtype)
        return ConstrainedVelocity(
            joint_velocity=u,
            slowed=torch.where(known, zero, share).to(dtype),
            violation=zero.to(dtype),
            solved=known,
        )

    m, along = jacobian.shape[-2], config.task_weight
    off_path = along * config.path_weight
    slack = off_path * config.distance_weight
    # Joint velocities of one unit of cost each: off the path, along it, in the null space.
    basis = orthonormal_basis(jacobian).mT
    null, path = basis[..., m:, :], task.unsqueeze(-2)
    path = path - matmul(matmul(path, null.mT), null)
    basis = torch.cat([basis[..., :m, :] / off_path, path / along, null], dim=-2)
    # Rows of the limits.
    joints = torch.cat([basis, torch.zeros_like(basis[..., :1, :])], dim=-2)
    slower = torch.zeros_like(joints[..., :1])
    slower[..., m, :] = 1 / along
    rows = [joints, slower]
    if distances is not None:
        each = torch.full_like(distances.distance, 1 / slack).unsqueeze(-2)
        rows.append(-torch.cat([matmul(basis, distances.gradient.mT), each], dim=-2))
    change = least_change(
        torch.cat(rows, dim=-1), least, most, config.steps, early_exit=config.early_exit
    )

    y, solved = change.point, known & change.solved
    u = wanted + matmul(y[..., None, :-1], basis).squeeze(-2)
    # An arm that brakes goes to zero; the limits cut what the solver leaves by rounding.
    u = torch.where(solved.unsqueeze(-1), u, 0.0).clamp(lower, upper)
    return ConstrainedVelocity(
        joint_velocity=u.to(dtype),
        slowed=torch.where(solved, -y[..., m] / along, share).to(dtype),
        violation=torch.where(solved, y[..., -1] / slack, 0.0).to(dtype),
        solved=solved,
    )
