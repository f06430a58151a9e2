"""Random states of an arm amid limits and distances, and an oracle for what it should do."""

from dataclasses import dataclass, field, replace

import numpy as np
import sampling
import torch
from scipy.optimize import linprog, nnls
from torch import Tensor

from hrc_learn.controller import ConstraintConfig, Distances, SafetyFilter, SeparationConfig
from hrc_learn.geometry.numerics import null_projection, orthonormal_basis
from hrc_learn.kinematics import panda

DOUBLE = torch.float64


@dataclass(frozen=True, kw_only=True)
class State:
    """Arguments of `constrained_velocity`; elements in the first axis."""

    task: Tensor
    null: Tensor
    jacobian: Tensor
    lower: Tensor
    upper: Tensor
    distances: Distances
    separation: SeparationConfig = field(default_factory=SeparationConfig)

    @property
    def arguments(self) -> tuple:
        wanted = self.task + self.null
        return (wanted, self.jacobian, self.lower, self.upper, self.distances)


def of_panda(count: int, seed: int = 0, pairs: int = 8) -> State:
    """A Panda anywhere within its limits: at rest, on its path, beside it, or moving anyhow."""
    rng = sampling.generator(seed)
    limits = panda.limits
    q = sampling.within(limits.lower, limits.upper, count, rng=rng)
    state = _of(panda.jacobian(q), pairs, rng)
    task, null = state.task, state.null
    share, other = torch.rand(2, count, 1, generator=rng, dtype=DOUBLE)
    noise = torch.randn(count, 7, generator=rng, dtype=DOUBLE)
    path = share * task + other * null
    moving = torch.stack([0 * task, path, path + 0.02 * noise, 0.5 * noise])
    kind = torch.randint(4, (count,), generator=rng)
    last = moving[kind, torch.arange(count)].clamp(-limits.velocity, limits.velocity)
    # What acceleration allows in steps of 10 ms, or of ten times that to leave more choice.
    dt = torch.where(torch.rand(count, 1, generator=rng) < 0.5, 0.01, 0.1).to(DOUBLE)
    safety = SafetyFilter(limits).barrier
    reach = dt * limits.acceleration
    bounds = safety.velocity_bounds(q)
    lower, upper = (b.clamp(last - reach, last + reach) for b in bounds)
    return replace(state, lower=lower, upper=upper)


def of_any_arm(count: int, joints: int, rows: int, seed: int = 0, pairs: int = 4) -> State:
    """Random Jacobians, every fourth of them singular."""
    rng = sampling.generator(seed)
    J = torch.randn(count, rows, joints, generator=rng, dtype=DOUBLE)
    J[::4, -1] = J[::4, 0]
    return _of(J, pairs, rng)


def _of(J: Tensor, pairs: int, rng: torch.Generator) -> State:
    count, rows, joints = J.shape

    def noise(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=rng, dtype=DOUBLE)

    twist = 0.3 * noise(rows)
    gram = J @ J.mT + 0.05**2 * torch.eye(rows, dtype=DOUBLE)  # some damping for all
    task = (J.mT @ torch.linalg.solve(gram, twist.unsqueeze(-1))).squeeze(-1)
    comes = torch.rand(count, pairs, generator=rng) < 0.3
    return State(
        task=task,
        null=null_projection(J, noise(joints)),
        jacobian=J,
        lower=-0.2 - noise(joints).abs(),
        upper=0.2 + noise(joints).abs(),
        distances=Distances(
            distance=0.3 * torch.rand(count, pairs, generator=rng, dtype=DOUBLE),
            gradient=0.3 * noise(pairs, joints),
            approach_speed=torch.where(comes, 0.5 * noise(pairs).abs(), 0.0),
            person=torch.rand(count, pairs, generator=rng) < 0.3,
            # Half of the parts of a person must not be touched.
            contact_speed=(torch.rand(count, pairs, generator=rng, dtype=DOUBLE) - 0.5).clamp(
                min=0
            ),
        ),
    )


def allowed(state: State, config: ConstraintConfig) -> Tensor:
    """How fast each distance may shrink by the arm's own motion [m/s]."""
    d, s = state.distances, state.separation
    thing = config.rate * (d.distance - config.clearance) - d.approach_speed
    # Of a person v with  v^2/(2 a) + v (T_r + v_h/a) = d - v_h T_r - C, as a root of NumPy's.
    person = [
        max(np.roots([0.5 / s.deceleration, s.reaction_time + v_h / s.deceleration, -spare]))
        if spare > 0
        else 0.0
        for v_h, spare in zip(
            d.approach_speed.flatten().tolist(),
            (d.distance - d.approach_speed * s.reaction_time - s.clearance).flatten().tolist(),
            strict=True,
        )
    ]
    assert d.person is not None
    assert d.contact_speed is not None
    apart = torch.tensor(person, dtype=DOUBLE).view_as(thing)
    touching = (d.contact_speed - d.approach_speed).clamp(min=0)
    if s.mode == "ssm+pfl":
        apart = torch.maximum(apart, touching)
    elif s.mode == "pfl":
        apart = torch.where(d.contact_speed > 0, touching, apart)
    return torch.where(d.person, apart, thing)


@dataclass(frozen=True, kw_only=True)
class Program:
    """One element in NumPy: u = wanted + D x, the program in x = (e, sigma, z, delta)."""

    directions: np.ndarray
    weights: np.ndarray
    matrix: np.ndarray
    """Limits on x: matrix x <= bound."""
    bound: np.ndarray
    wanted: np.ndarray
    paths: int
    """Number of directions off the path, the first ones."""


def program(state: State, k: int, config: ConstraintConfig) -> Program:
    """Written down anew, with the singular value decomposition of the Jacobian."""
    J = state.jacobian[k].numpy()
    m, n = min(J.shape), J.shape[1]
    Q = np.linalg.svd(J)[2].T
    if np.linalg.matrix_rank(J) < m:
        # Which m directions count as those of the path is a matter of rounding then.
        Q = orthonormal_basis(state.jacobian[k]).numpy()
    g, wanted = state.distances.gradient[k].numpy(), (state.task + state.null)[k].numpy()
    task = Q[:, :m] @ (Q[:, :m].T @ wanted)
    directions = np.column_stack([Q[:, :m], task, Q[:, m:], np.zeros(n)])
    path = config.task_weight * config.path_weight
    slowing = config.task_weight * float(np.linalg.norm(task))
    weights = np.array(
        [path] * m + [slowing] + [1.0] * (n - m) + [path * config.distance_weight]
    )
    nearing = -g @ directions
    nearing[:, -1] = -1.0
    share = np.zeros((1, n + 2))
    share[0, m] = 1.0
    lower, upper = state.lower[k].numpy(), state.upper[k].numpy()
    matrix = np.vstack([directions, -directions, share, -share, nearing])
    slack = allowed(state, config)[k].numpy() + g @ wanted
    bound = np.concatenate([upper - wanted, wanted - lower, [0.0, 1.0], slack])
    return Program(
        directions=directions,
        weights=weights,
        matrix=matrix,
        bound=bound,
        wanted=wanted,
        paths=m,
    )


def optimum(p: Program, size: float) -> np.ndarray:
    """Joint velocity by non-negative least squares (Lawson and Hanson 1974, chapter 23).

    Args:
        p: The program.
        size: About the norm of the weighted solution, by which it is scaled: the method divides
            by what is small otherwise.
    """
    rows = p.matrix / p.weights
    E = np.vstack([-rows.T, -p.bound / size])
    multipliers, _ = nnls(E, np.append(np.zeros(len(p.weights)), 1.0), maxiter=10_000)
    # Its normal equations square the weights: which limits bind is right, the rest follows.
    binds = multipliers > 0
    y = np.linalg.lstsq(rows[binds], p.bound[binds], rcond=1e-14)[0]
    return p.wanted + p.directions @ (y / p.weights)


def least_slowing(p: Program, off_path: float = 0.0) -> float | None:
    """Part of the task that has to be given up on its path, by linear programming; None where
    no velocity on the path is allowed.

    Args:
        p: The program.
        off_path: How far off the path each direction may lead [rad/s].
    """
    m, columns = p.paths, len(p.weights)
    cost = np.zeros(columns)
    cost[m] = -1.0
    fixed = [(-off_path, off_path)] * m + [(None, None)] * (columns - m - 1) + [(0.0, 0.0)]
    found = linprog(cost, A_ub=p.matrix, b_ub=p.bound, bounds=fixed, method="highs")
    return None if found.status != 0 else float(found.fun)
