"""Models of other libraries and papers that predict a motion from its start and goal.

Each peer is fitted with several settings at once, so that common computations are done once.
All demonstrations last one second, and are centred and scaled (`bench_peers.py`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import torch
from task_mixtures import KernelPrimitive, TaskMixture

from hrc_learn.dmp import JointDMP, mean_primitive
from hrc_learn.dmp.learned_motion import learn

type Array = np.ndarray
type Predictor = Callable[[Array, Array], Array]
"""Start (D,) and goal (D,) to a motion (T, D)."""
type Setting = dict[str, Any]

THINNED = 4
"""Mixtures are fitted to every n-th sample."""
FINE = 5
"""Integration steps per sample of movement_primitives, whose method is of first order."""
REFERENCE = 40
"""Reference points of kernelized primitives."""
VIA_VARIANCE = 1e-6
"""Variance of start and goal in kernelized primitives, as in the authors' code."""


@dataclass(frozen=True)
class Peer:
    """A model and the settings among which cross-validation chooses."""

    fit: Callable[[Array, Sequence[Setting]], list[Predictor]]
    """Demonstrations (n, T, D) and settings to predictors."""
    settings: Sequence[Setting] = ({},)


def grid(**choices: Sequence[Any]) -> list[Setting]:
    """All combinations of the choices."""
    return [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]


def nearest(shown: Array, start: Array, goal: Array) -> int:
    """Index of the demonstration with the smallest sum of distances of start and goal."""
    away = np.linalg.norm(shown[:, 0] - start, axis=1)
    return int((away + np.linalg.norm(shown[:, -1] - goal, axis=1)).argmin())


def times(shown: Array) -> Array:
    """Times of the samples [s]."""
    return np.linspace(0, 1, shown.shape[1])


@torch.no_grad()
def our_learn(shown: Array, _: Sequence[Setting]) -> list[Predictor]:
    """`hrc_learn.learn` with its defaults, which include its own choice of the model."""
    t = times(shown)
    learned = learn([(t, one) for one in shown])

    @torch.no_grad()
    def predict(start: Array, goal: Array) -> Array:
        return learned.rollout(t, start, goal, 1.0).position.numpy()

    return [predict]


@torch.no_grad()
def our_primitive(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """Mean or nearest of our primitives, adapted to start and goal with `approach=1`."""
    t = torch.from_numpy(times(shown))
    each = JointDMP.fit(t, torch.from_numpy(shown), 40, approach=1.0)

    def predictor(of: str) -> Predictor:
        @torch.no_grad()
        def predict(start: Array, goal: Array) -> Array:
            chosen = each[nearest(shown, start, goal)] if of == "nearest" else mean
            ends = torch.from_numpy(start), torch.from_numpy(goal)
            return chosen.with_boundary(*ends).rollout(t).position.numpy()

        mean = mean_primitive(each)
        return predict

    return [predictor(**setting) for setting in settings]


def their_dmp(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """DMP of movement_primitives, with the mean weights or the weights of the nearest."""
    from movement_primitives.dmp import DMP  # pyright: ignore[reportMissingImports]

    t = times(shown)

    def predictor(count: int, smooth: bool, of: str) -> Predictor:
        dmp = DMP(
            shown.shape[2],
            execution_time=1.0,
            dt=1 / (FINE * (len(t) - 1)),
            n_weights_per_dim=count,
            smooth_scaling=smooth,
        )
        weights = []
        for one in shown:
            dmp.imitate(t, one)
            weights.append(dmp.get_weights())

        def predict(start: Array, goal: Array) -> Array:
            only = weights[nearest(shown, start, goal)]
            dmp.set_weights(only if of == "nearest" else np.mean(weights, axis=0))
            dmp.configure(start_y=start, goal_y=goal)
            fine, path = dmp.open_loop(run_t=1.0)
            return np.stack([np.interp(t, fine, column) for column in path.T], axis=1)

        return predict

    return [predictor(**setting) for setting in settings]


def their_promp(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """ProMP of movement_primitives, conditioned on the positions at start and end."""
    from movement_primitives.promp import ProMP  # pyright: ignore[reportMissingImports]

    t = times(shown)

    @cache
    def fitted(count: int) -> Any:
        promp = ProMP(shown.shape[2], count)
        promp.imitate([t.copy() for _ in shown], list(shown))
        return promp

    def predictor(count: int, variance: float) -> Predictor:
        promp, noise = fitted(count), variance * np.eye(shown.shape[2])

        def predict(start: Array, goal: Array) -> Array:
            given = promp.condition_position(start, noise, t=0.0)
            return given.condition_position(goal, noise, t=1.0).mean_trajectory(t.copy())

        return predict

    return [predictor(**setting) for setting in settings]


@cache
def prodmp(columns: int, samples: int, count: int) -> Any:
    """ProDMP of MP_PyTorch; building its tables takes longer than a fit."""
    from mp_pytorch.mp import MPFactory  # pyright: ignore[reportMissingImports]

    return MPFactory.init_mp(
        mp_type="prodmp",
        num_dof=columns,
        tau=1.0,
        mp_args={
            "num_basis": count,
            "num_basis_outside": 0,
            "basis_bandwidth_factor": 2,
            "alpha_phase": 3,
            "alpha": 25,
            "dt": 1 / (samples - 1),
            "auto_scale_basis": True,
        },
        dtype=torch.float64,
    )


@torch.no_grad()
def their_prodmp(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """ProDMP of MP_PyTorch, with the mean weights or the weights of the nearest.

    The goal parameter is shifted by the error of the final position, and the initial velocity
    is that of the demonstrations, because the library has no conditioning.
    """
    n, T, D = shown.shape
    t, given = torch.from_numpy(times(shown)), torch.from_numpy(shown)

    @cache
    def parameters(count: int, ridge: float) -> dict[str, torch.Tensor]:
        mp = prodmp(D, T, count)
        return mp.learn_mp_params_from_trajs(t.expand(n, T), given, reg=ridge)

    def predictor(count: int, ridge: float, of: str) -> Predictor:
        mp, found = prodmp(D, T, count), parameters(count, ridge)

        @torch.no_grad()
        def predict(start: Array, goal: Array) -> Array:
            only = [nearest(shown, start, goal)] if of == "nearest" else list(range(n))
            params, velocity = (found[name][only].mean(0) for name in ("params", "init_vel"))
            first = t[:1], torch.from_numpy(start)[None], velocity[None]
            made = mp.get_traj_pos(t[None], params[None], *first)[0]
            params = params.reshape(D, -1).clone()
            params[:, -1] += (torch.from_numpy(goal) - made[-1]) / mp.weights_goal_scale[-1]
            return mp.get_traj_pos(t[None], params.reshape(1, -1), *first)[0].numpy()

        return predict

    return [predictor(**setting) for setting in settings]


def mixture_samples(shown: Array, origins: Array) -> Array:
    """Time and position in frames with these origins (n, P, D), (n T, P, 1 + D)."""
    local = shown[:, ::THINNED, None] - origins[:, None]
    t = np.broadcast_to(times(shown)[::THINNED, None, None], (*local.shape[:3], 1))
    joined = np.concatenate([t, local], axis=-1)
    return joined.reshape(-1, *joined.shape[2:])


def task_mixture(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """Task-parameterized mixture with frames at start and goal."""
    samples = mixture_samples(shown, shown[:, [0, -1]])

    def predictor(count: int, ridge: float) -> Predictor:
        mixture = TaskMixture.fit(samples, count, ridge)
        t = times(shown)
        return lambda start, goal: mixture.at(np.stack([start, goal])).regress(t)[0]

    return [predictor(**setting) for setting in settings]


def kernel_primitive(shown: Array, settings: Sequence[Setting]) -> list[Predictor]:
    """Kernelized primitive through start and goal, about the regression of a mixture.

    The mixture has one frame, the world, or frames at start and goal: the authors' method for
    places far from the demonstrations.
    """
    t, ends, at = times(shown), np.array([0.0, 1.0]), np.linspace(0, 1, REFERENCE)

    @cache
    def mixture(count: int, local: bool) -> TaskMixture:
        origins = shown[:, [0, -1]] if local else np.zeros_like(shown[:, :1])
        return TaskMixture.fit(mixture_samples(shown, origins), count, 1e-4)

    def predictor(count: int, local: bool, width: float, penalty: float) -> Predictor:
        def predict(start: Array, goal: Array) -> Array:
            given = np.stack([start, goal])
            origins = given if local else np.zeros_like(given[:1])
            reference = mixture(count, local).at(origins).regress(at)
            learned = KernelPrimitive(at, *reference, width, penalty)
            return learned.through(ends, given, VIA_VARIANCE).position(t)

        mixture(count, local)
        return predict

    return [predictor(**setting) for setting in settings]


WIDTHS = (0.1, 0.2, 0.4, 0.8)
"""Widths of kernels, relative to the duration."""
MEAN_OR_NEAREST = ("mean", "nearest")
PEERS = {
    "learn": Peer(our_learn),
    "mean": Peer(our_primitive, grid(of=["mean"])),
    "nearest": Peer(our_primitive, grid(of=["nearest"])),
    "movement_primitives DMP": Peer(
        their_dmp, grid(count=(10, 30), smooth=(False, True), of=MEAN_OR_NEAREST)
    ),
    "movement_primitives ProMP": Peer(
        their_promp, grid(count=(5, 10, 20), variance=(0.0, 1e-4, 1e-3, 1e-2))
    ),
    "MP_PyTorch ProDMP": Peer(
        their_prodmp, grid(count=(5, 10, 20), ridge=(1e-9, 1e-5), of=MEAN_OR_NEAREST)
    ),
    "TP-GMM": Peer(task_mixture, grid(count=(5, 10, 20), ridge=(1e-5, 1e-3, 1e-2))),
    "KMP": Peer(
        kernel_primitive,
        grid(count=(8, 16), local=(False, True), width=WIDTHS, penalty=(0.1, 1.0, 10.0, 100.0)),
    ),
}
"""Ours and those of others, by the name in the table."""
