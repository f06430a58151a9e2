"""Times and errors of other libraries on the same demonstration, if they are installed."""

import importlib.util
from collections.abc import Callable

import torch
from timing import time_calls
from torch import Tensor

type Demonstration = tuple[Tensor, Tensor]
"""Stamps (T,) [s] and positions (T, D)."""


def measure_peers(demonstration: Demonstration, n_basis: int) -> dict[str, float]:
    """Measured values of all installed libraries; prints the missing ones."""
    figures = {}
    for package, measure in PEERS.items():
        if importlib.util.find_spec(package) is None:
            print(f"{package} is not installed: pip install {INSTALL[package]}")
        else:
            figures |= measure(demonstration, n_basis)
    return figures


def measure_movement_primitives(demonstration: Demonstration, n_basis: int) -> dict[str, float]:
    """Values of movement_primitives with its default, a fourth-order method in Cython."""
    from movement_primitives.dmp import DMP  # pyright: ignore[reportMissingImports]

    time, position = (column.double().numpy() for column in demonstration)
    dt = time[-1] / (len(time) - 1)
    dmp = DMP(position.shape[1], time[-1], dt, n_weights_per_dim=n_basis)
    dmp.imitate(time, position)
    y, rate = position[0], 0.0 * position[0]
    calls: dict[str, Callable[[], object]] = {
        "fit": lambda: dmp.imitate(time, position),
        "rollout": lambda: dmp.open_loop(),
    }
    t = time_calls(calls, 5)
    dmp.reset()
    step = time_calls({"step": lambda: dmp.step(y, rate)}, 500)["step"]
    return {
        "movement_primitives_fit_1_ms": 1e3 * t["fit"].median,
        "movement_primitives_rollout_per_s": 1 / t["rollout"].median,
        "movement_primitives_step_us": 1e6 * step.median,
    }


def measure_mp_pytorch(demonstration: Demonstration, n_basis: int) -> dict[str, float]:
    """Values of ProDMP in MP_PyTorch, which maps weights to a trajectory by a table, as this
    package.
    """
    from mp_pytorch.mp import MPFactory  # pyright: ignore[reportMissingImports]

    time, position = (column.float() for column in demonstration)
    mp = MPFactory.init_mp(
        mp_type="prodmp",
        num_dof=position.shape[1],
        tau=time[-1].item(),
        mp_args={
            "num_basis": n_basis,
            "num_basis_outside": 0,
            "basis_bandwidth_factor": 2,
            "alpha_phase": 3,
            "alpha": 25,
            "dt": time[-1].item() / (len(time) - 1),
        },
        learn_tau=False,
        learn_delay=False,
    )
    time, position = time[None], position[None]
    weights = mp.learn_mp_params_from_trajs(time, position)["params"]
    first, still = position[:, 0], torch.zeros_like(position[:, 0])

    def rollout(batch: int) -> Callable[[], Tensor]:
        arguments = [
            x.expand(batch, *x.shape[1:]).contiguous() for x in (time, weights, first, still)
        ]
        times, params, start, velocity = arguments

        def call() -> Tensor:
            return mp.get_traj_pos(times, params, times[:, 0], start, velocity)

        return call

    t = time_calls({"1": rollout(1), "256": rollout(256)}, 5)
    return {
        "mp_pytorch_rollout_1_per_s": 1 / t["1"].median,
        "mp_pytorch_rollout_256_per_s": 256 / t["256"].median,
    }


PEERS: dict[str, Callable[[Demonstration, int], dict[str, float]]] = {
    "movement_primitives": measure_movement_primitives,
    "mp_pytorch": measure_mp_pytorch,
}
INSTALL = {
    "movement_primitives": "movement-primitives pytransform3d",
    "mp_pytorch": "mp_pytorch",
}
