"""How fast one control step is, alone and in batches, against its floor and against mink.

One thread, float64, eager. A step reads joints and image feature, adapts the image Jacobian
and passes the safety filter. Its floor is what any resolved-rate step needs: forward
kinematics, Jacobian, and one 6 x 6 solve. Each figure is the median CPU time of calls made in
turn; mink's `solve_ik` with a frame and a posture task is measured along where it is installed.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from timing import Timing, time_calls
from torch import Tensor

from hrc_learn import cli
from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
    SafetyFilter,
)
from hrc_learn.controller.resolution import resolve
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics import panda

BATCHES = (64, 1024)


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 500
    """Repeats of each call."""
    json: Path | None = None
    """Receives the figures as one flat object."""


def main(args: Args) -> None:
    """Measure, print a table, write the figures."""
    torch.set_num_threads(1)
    with torch.inference_mode():
        timings = time_calls(_single_calls(), args.repeats)
        batched = time_calls(_batched_calls(), max(10, args.repeats // 50))
    figures = _figures(timings, batched)
    table = Table("figure", "value", title="Control step, eager, float64, one thread")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _figures(timings: dict[str, Timing], batched: dict[str, Timing]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, timing in timings.items():
        figures[f"{name}_us"] = 1e6 * timing.median
        figures[f"{name}_p99_us"] = 1e6 * timing.p99
    figures["step_over_floor"] = timings["step"].median / timings["floor"].median
    if "mink" in timings:
        figures["step_over_mink"] = timings["step"].median / timings["mink"].median
    for name, timing in batched.items():
        figures[f"{name}_per_s"] = int(name.rsplit("_", 1)[1]) / timing.median
    return figures


def _single_calls() -> dict[str, Callable[[], object]]:
    q = panda.ready
    twist = torch.full((6,), 0.1, dtype=torch.float64)
    effort = torch.full((7,), 0.1, dtype=torch.float64)

    def floor() -> object:
        _, J = panda.forward_and_jacobian(q)
        return resolve(J, twist, effort)

    safety = SafetyFilter(panda.limits)
    safe = safety.initial_state(q)
    calls: dict[str, Callable[[], object]] = {
        "floor": floor,
        "filter": lambda: safety.step(safe, q, effort, 0.001),
        "step": _step(FixedEstimator, q),
        "step_with_person": _step(FixedEstimator, q, human_effort=effort),
        "step_composite": _step(CompositeEstimator, q),
        "step_kalman": _step(KalmanEstimator, q),
    }
    if importlib.util.find_spec("mink") is not None:
        calls["mink"] = _mink_call()
    return calls


def _batched_calls() -> dict[str, Callable[[], object]]:
    return {
        f"steps_{kind.__name__.removesuffix('Estimator').lower()}_{batch}": _step(
            kind, panda.ready.expand(batch, 7).clone()
        )
        for kind in (FixedEstimator, CompositeEstimator)
        for batch in BATCHES
    }


def _step(
    kind: type[ImageJacobianEstimator], q: Tensor, human_effort: Tensor | None = None
) -> Callable[[], object]:
    """A step of the controller while it servoes on a visible target."""
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    estimator = kind(RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1))  # pyright: ignore[reportCallIssue]
    centre = q.new_tensor((0.4, 0.1, 0.4))
    down = quaternion.normalize(q.new_tensor(GRIPPER_DOWN))
    goals = Goals.at(centre, down, q.new_tensor((700.0, 500.0)))
    controller = AdaptiveController(panda, estimator, goals)
    observation = Observation(
        joint_position=q,
        feature=torch.full((*q.shape[:-1], 2), 600.0, dtype=q.dtype),
        feature_visible=torch.ones(q.shape[:-1], dtype=torch.bool),
        dt=0.001,
        human_effort=human_effort,
    )
    state = controller.initial_state(q)
    for _ in range(400):  # until vision feedback has faded in
        _, state = controller.step(state, observation)
    return lambda: controller.step(state, observation)


def _mink_call() -> Callable[[], object]:
    """One step of mink on the same arm: frame and posture task, position and speed limits."""
    import mink  # pyright: ignore[reportMissingImports]
    import mujoco

    from hrc_learn.sim.panda_model import PandaModelConfig, add_panda

    spec = mujoco.MjSpec()  # pyright: ignore[reportAttributeAccessIssue]
    spec.compiler.degree = False
    add_panda(spec, PandaModelConfig())
    model = spec.compile()
    configuration = mink.Configuration(model)
    q = configuration.q.copy()
    q[:7] = panda.ready.numpy()
    configuration.update(q)
    frame = mink.FrameTask("tcp", "site", position_cost=1.0, orientation_cost=1.0)
    frame.set_target_from_configuration(configuration)
    posture = mink.PostureTask(model, cost=1e-2)
    posture.set_target_from_configuration(configuration)
    speeds = dict(zip(panda.joint_names, panda.limits.velocity.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    q[:7] += 0.01

    def step() -> object:
        configuration.update(q)
        return mink.solve_ik(configuration, [frame, posture], 0.001, "daqp", limits=limits)

    return step


if __name__ == "__main__":
    cli.run(main, Args)
