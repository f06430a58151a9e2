"""Time of a control step: exported, eager and in batches, compared with targets and mink.

One thread; float64, batches float32. The measured step has all features: Kalman estimate of the
image Jacobian, a person, late images, safety filter. The floor is the time that any
resolved-rate step needs: forward kinematics, Jacobian, and one 6 x 6 solve. Calls are made in
turn, with cold caches; `exported_alone` is called repeatedly. Reported are median, 99th
percentile and minimum of the CPU time. If mink is installed (`tools/make_environments.sh
peers`), its `solve_ik` with a frame and a posture task is measured in turn with the rest.
`call` is the floor of a compiled step: the call of a compiled function without instructions.
Exported steps are built once, each in seconds, and kept.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from timing import Timing, time_calls
from torch import Tensor
from torch.utils import _pytree

from hrc_learn import cli
from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
    SafetyFilter,
)
from hrc_learn.controller.resolved_rate import resolved_rate
from hrc_learn.deploy import EagerRunner, StepRunner, open_step
from hrc_learn.deploy.native_code import NativeCode, NativeStep, assemble
from hrc_learn.deploy.package import StepLayouts
from hrc_learn.deploy.scalar_program import ScalarProgram
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
    grid,
)
from hrc_learn.kinematics import panda

BATCHES = (1024, 8192)
NEURONS = (25, 64)
TARGETS = {
    "exported_alone_us": 10.0,
    "exported_alone_p99_us": 60.0,
    "exported_over_eager": 0.1,
    "exported_over_mink": 0.25,
    "eager_us": 300.0,
    "kinematics_us": 40.0,
}
"""Upper bounds of the measured values."""
LEAST = {
    "kinematics_compiled_1024_per_s": 1e7,
    "kinematics_compiled_8192_per_s": 1e7,
    "steps_exported_25_neurons_1024_per_s": 1.5e6,
    "steps_exported_64_neurons_1024_per_s": 0.7e6,
}
"""Lower bounds of the measured values."""


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 500
    """Number of calls of each kind."""
    compile: bool = True
    """Measure compiled code as well."""
    packages: Path | None = None
    """Folder in which compiled steps are kept; default: the user's cache."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table, and write the measured values."""
    torch.set_num_threads(1)
    console = Console()
    with torch.inference_mode():
        calls = _single_calls(args, console)
        timings = time_calls(calls, args.repeats)
        if "exported" in calls:
            alone = {"exported_alone": calls["exported"]}
            timings |= time_calls(alone, 20 * args.repeats)
        batched = time_calls(_batched_calls(args), max(10, args.repeats // 50))
    figures = _figures(timings, batched)
    table = Table("figure", "value", "target", title="Control step, one thread")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}", _target(name))
    console.print(table)
    if args.json is not None:
        cli.write_json(args.json, figures)


def _target(name: str) -> str:
    if name in TARGETS:
        return f"<= {TARGETS[name]:g}"
    return f">= {LEAST[name]:g}" if name in LEAST else ""


def _figures(timings: dict[str, Timing], batched: dict[str, Timing]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, timing in timings.items():
        figures[f"{name}_us"] = 1e6 * timing.median
        figures[f"{name}_p99_us"] = 1e6 * timing.p99
        figures[f"{name}_least_us"] = 1e6 * timing.least
    pairs = [("exported", "eager"), ("exported", "call"), ("exported", "mink")]
    for name, other in (*pairs, ("eager", "floor"), ("eager", "mink")):
        if {name, other} <= timings.keys():
            figures[f"{name}_over_{other}"] = timings[name].median / timings[other].median
    for name, timing in batched.items():
        figures[f"{name}_per_s"] = int(name.rsplit("_", 1)[1]) / timing.median
    return figures


def _single_calls(args: Args, console: Console) -> dict[str, Callable[[], object]]:
    q = panda.ready
    twist = torch.full((6,), 0.1, dtype=torch.float64)
    effort = torch.full((7,), 0.1, dtype=torch.float64)

    def floor() -> object:
        _, J = panda.forward_and_jacobian(q)
        return resolved_rate(J, twist, effort)

    safety = SafetyFilter(panda.limits)
    safe = safety.initial_state(q)
    controller, observation = usual_step(q)
    calls: dict[str, Callable[[], object]] = {
        "kinematics": lambda: panda.transform_and_jacobian(q),
        "floor": floor,
        "filter": lambda: safety.step(safe, q, effort, 0.001),
        "eager": settled(EagerRunner(controller, observation)),
        "eager_fixed": settled(EagerRunner(*_servoing(FixedEstimator, 9, q))),
        "eager_composite": settled(EagerRunner(*_servoing(CompositeEstimator, 9, q))),
    }
    if args.compile:
        with warnings.catch_warnings(record=True) as caught:
            runner = open_step(controller, observation, args.packages)
        for warning in caught:
            console.print(str(warning.message), style="yellow")
        if not isinstance(runner, EagerRunner):
            calls["exported"] = settled(runner)
            calls["call"] = _empty_call()
    if importlib.util.find_spec("mink") is not None:
        calls["mink"] = _mink_call()
    else:
        text = "no mink to compare with: run tools/make_environments.sh peers, use its Python"
        console.print(text, style="yellow")
    return calls


def usual_step(q: Tensor) -> tuple[AdaptiveController, Observation]:
    """The recommended step with all features, for one arm or many."""
    controller, observation = _servoing(KalmanEstimator, 9, q)
    return controller, replace(
        observation,
        feature_new=torch.ones(q.shape[:-1], dtype=torch.bool),
        image_joint_position=q.clone(),
        nullspace_input=torch.full_like(q, 0.1),
    )


def settled(runner: StepRunner) -> Callable[[], object]:
    """A step of a controller whose vision feedback has faded in."""
    for _ in range(400):
        runner.step()
    return runner.step


def _batched_calls(args: Args) -> dict[str, Callable[[], object]]:
    calls: dict[str, Callable[[], object]] = {}
    for batch in BATCHES:
        q = panda.ready.expand(batch, 7).float().contiguous()
        calls[f"kinematics_{batch}"] = lambda q=q: panda.transform_and_jacobian(q)
        for neurons in NEURONS:
            controller, observation = _servoing_batch(neurons, q)
            state = controller.initial_state(q)
            calls[f"steps_{neurons}_neurons_{batch}"] = partial(
                controller.step, state, observation
            )
            if args.compile and batch == BATCHES[0]:
                runner = open_step(controller, observation, args.packages)
                if not isinstance(runner, EagerRunner):
                    calls[f"steps_exported_{neurons}_neurons_{batch}"] = runner.step
        if args.compile:
            # One row per joint: the batch is last in memory.
            rows = q.mT.contiguous().mT
            compiled = torch.compile(panda.transform_and_jacobian, dynamic=False)
            calls[f"kinematics_compiled_{batch}"] = lambda q=rows, f=compiled: f(q)
    return calls


def _servoing_batch(neurons: int, q: Tensor) -> tuple[AdaptiveController, Observation]:
    """Controller and observation of many arms, each with its own adapting weights, in the dtype
    of q.
    """
    controller, observation = _servoing(CompositeEstimator, neurons, q.double())
    controller = controller.to(q.dtype)
    observation = _pytree.tree_map(
        lambda x: x.to(q) if isinstance(x, Tensor) and x.is_floating_point() else x, observation
    )
    return controller, observation


def _servoing(
    kind: type[ImageJacobianEstimator], neurons: int, q: Tensor
) -> tuple[AdaptiveController, Observation]:
    """A controller, and its observation while it servoes to a visible target."""
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    side = round(neurons**0.5)
    neurons_at = grid((0.05, 0.35, side), (0.35, 0.65, side))
    estimator = kind(RBFImageJacobian.from_jacobian(J, neurons_at, 0.1))  # pyright: ignore[reportCallIssue]
    down = quaternion.normalize(q.new_tensor(GRIPPER_DOWN))
    goals = Goals.at(q.new_tensor((0.4, 0.1, 0.4)), down, q.new_tensor((700.0, 500.0)))
    observation = Observation(
        joint_position=q,
        feature=torch.full((*q.shape[:-1], 2), 600.0, dtype=q.dtype),
        feature_visible=torch.ones(q.shape[:-1], dtype=torch.bool),
        dt=0.001,
    )
    return AdaptiveController(panda, estimator, goals), observation


def _empty_call() -> Callable[[], object]:
    """Call of a compiled step without instructions."""
    code = NativeCode(ScalarProgram(torch.float64), StepLayouts._fields, 1)
    run = NativeStep(assemble(code.text), 1, code.workspace)
    vectors = [torch.zeros(1, dtype=torch.float64) for _ in StepLayouts._fields]
    return partial(run, vectors)


def _mink_call() -> Callable[[], object]:
    """One step of mink with the same arm: frame and posture task, position and speed limits."""
    import mink  # pyright: ignore[reportMissingImports]
    import mujoco

    from hrc_learn.sim import ArmModelConfig
    from hrc_learn.sim.arm_model import add_arm

    spec = mujoco.MjSpec()  # pyright: ignore[reportAttributeAccessIssue]
    spec.compiler.degree = False
    add_arm(spec, ArmModelConfig(robot=panda))
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
