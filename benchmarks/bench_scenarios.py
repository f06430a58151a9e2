"""Tests and examples of other libraries, computed with these libraries and with ours.

Scenarios are those of the tests and examples of movement-primitives 0.9.1 and MP_PyTorch 0.1.4
(`SCENARIOS` names the files), set up anew. Both columns are the same measure on the same data.
The column of a library that is not installed is empty.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import importlib.util
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.dmp import (
    JointDMP,
    MotionHead,
    MovingGoalDMP,
    PoseDMP,
    ProbabilisticDMP,
)
from hrc_learn.dmp.coupling import steering, velocity_coupling
from hrc_learn.dmp.learned_motion import choose
from hrc_learn.geometry import quaternion

F64 = torch.float64


@dataclass(frozen=True, kw_only=True)
class Args:
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True)
class Scenario:
    """A scenario of another library, and its measure."""

    name: str
    figure: str
    library: str
    source: str
    theirs: Callable[[], float]
    ours: Callable[[], float]


def main(args: Args) -> None:
    """Run all, print a table, and write the measured values."""
    torch.set_num_threads(1)
    table = Table("scenario", "figure", "theirs", "ours", "from")
    figures: dict[str, float] = {}
    for scenario in SCENARIOS:
        found = importlib.util.find_spec(scenario.library) is not None
        theirs, ours = scenario.theirs() if found else np.nan, scenario.ours()
        key = scenario.name.replace(" ", "_").replace(",", "")
        figures |= {f"{key}_theirs": theirs, f"{key}_ours": ours}
        shown = "" if np.isnan(theirs) else f"{theirs:.2g}"
        table.add_row(scenario.name, scenario.figure, shown, f"{ours:.2g}", scenario.source)
    Console(width=max(Console().width, 140)).print(table)
    if args.json:
        cli.write_json(args.json, {k: x for k, x in figures.items() if not np.isnan(x)})


# Scenarios of movement-primitives.


def waves(end: float, n: int, fast: float = 2.5, slow: float = 1.5) -> tuple[Tensor, Tensor]:
    """Two cosines of different frequencies."""
    t = torch.linspace(0, end, n, dtype=F64)
    return t, torch.stack([(fast * torch.pi * t).cos(), 0.5 + (slow * torch.pi * t).cos()], -1)


def their_dmp(end: float, n: int, dt: float, n_weights: int = 100) -> Any:
    from movement_primitives.dmp import DMP  # pyright: ignore[reportMissingImports]

    t, y = (x.numpy() for x in waves(end, n))
    dmp = DMP(n_dims=2, execution_time=end, dt=dt, n_weights_per_dim=n_weights)
    dmp.imitate(t, y)
    dmp.configure(start_y=y[0], goal_y=y[-1])
    return dmp


def their_imitation() -> float:
    return np.abs(their_dmp(1.0, 1001, 1e-3).open_loop()[1] - waves(1.0, 1001)[1].numpy()).max()


def our_imitation() -> float:
    t, y = waves(1.0, 1001)
    return (JointDMP.fit(t, y, 100).rollout().position - y).abs().max().item()


def their_step_length() -> float:
    fine, coarse = (their_dmp(1.0, 1001, dt).open_loop()[1] for dt in (1e-3, 1e-2))
    return np.abs(fine[::10] - coarse).max()


def our_step_length() -> float:
    dmp = JointDMP.fit(*waves(1.0, 1001), 100)
    state, worst = dmp.initial_state(), 0.0
    path = dmp.rollout(dt=0.01).position
    for wanted in path[1:]:
        state = dmp.step(state, 0.01)
        worst = max(worst, (state.position - wanted).abs().max().item())
    return worst


def their_new_ends() -> float:
    dmp = their_dmp(1.0, 1001, 1e-3)
    dmp.configure(start_y=np.array([1.0, 1.5]), goal_y=np.array([0.2, 0.3]))
    return np.abs(dmp.open_loop(run_t=1.0)[1][-1] - [0.2, 0.3]).max()


def our_new_ends() -> float:
    dmp = JointDMP.fit(*waves(1.0, 1001), 100)
    goal = torch.tensor([0.2, 0.3], dtype=F64)
    end = dmp.rollout([0.0, 1.0], start=[1.0, 1.5], goal=goal).position[-1]
    return (end - goal).abs().max().item()


def their_half_duration() -> float:
    dmp = their_dmp(2.0, 2001, 1e-2)
    slow = dmp.open_loop()[1]
    dmp.execution_time_ = 1.0
    return np.abs(dmp.open_loop()[1] - slow[::2]).max()


def our_half_duration() -> float:
    dmp = JointDMP.fit(*waves(2.0, 2001), 100)
    return (
        (dmp.rollout(dt=0.01, speed=2.0).position - dmp.rollout(dt=0.02).position)
        .abs()
        .max()
        .item()
    )


def their_final_velocity() -> float:
    from movement_primitives.dmp import (  # pyright: ignore[reportMissingImports]
        DMPWithFinalVelocity,
    )

    t = np.linspace(0, 1, 101)
    dmp, worst = DMPWithFinalVelocity(n_dims=2, execution_time=1.0), 0.0
    dmp.imitate(t, np.stack([np.cos(np.pi * t), -np.cos(np.pi * t)], -1))
    for wanted in (0.0, 1.0, 2.0):
        dmp.configure(goal_yd=np.full(2, wanted))
        y = dmp.open_loop(run_t=1.0)[1]
        worst = max(worst, np.abs((y[-1] - y[-2]) / 0.01 - wanted).max())
    return worst


def our_final_velocity() -> float:
    t = torch.linspace(0, 1, 101, dtype=F64)
    y = torch.stack([(torch.pi * t).cos(), -(torch.pi * t).cos()], -1)
    dmp, worst = MovingGoalDMP(JointDMP.fit(t, y, 10)), 0.0
    for wanted in (0.0, 1.0, 2.0):
        end = dmp.rollout([1.0], end_velocity=torch.full((2,), wanted, dtype=F64)).velocity
        worst = max(worst, (end - wanted).abs().max().item())
    return worst


def their_coupling() -> float:
    from movement_primitives.dmp import (  # pyright: ignore[reportMissingImports]
        CouplingTermPos1DToPos1D,
    )

    dmp = their_dmp(2.0, 101, 0.01, 200)
    term = CouplingTermPos1DToPos1D(desired_distance=0.5, lf=(1.0, 0.0), k=1.0)
    y = dmp.open_loop(coupling_term=term)[1]
    return abs(np.mean(y[:, 1] - y[:, 0]) - 0.5)


def our_coupling() -> float:
    """The first coordinate is followed by the second at the distance."""
    dmp, gain = JointDMP.fit(*waves(2.0, 101), 50), 20.0
    state, apart = dmp.initial_state(), []
    wanted = torch.tensor([0.5], dtype=F64)
    for _ in range(2000):
        (lead, follow), (v, w) = state.position[:, None], state.velocity[:, None]
        error, rate = wanted - (follow - lead), v - w
        push = velocity_coupling(
            gain * error, gain * rate, spring=dmp.spring, duration=state.duration
        )
        state = dmp.step(state, 1e-3, coupling=torch.cat([0 * push, push]))
        apart.append((state.position[1] - state.position[0]).item())
    return abs(float(np.mean(apart)) - 0.5)


OBSTACLE = np.full(3, 0.5)


def obstacle_starts() -> np.ndarray:
    return 0.2 + 0.2 * np.random.RandomState(42).randn(20, 3)


def their_obstacle() -> float:
    from movement_primitives.dmp import (  # pyright: ignore[reportMissingImports]
        DMP,
        CouplingTermObstacleAvoidance3D,
    )

    nearest = []
    for start in obstacle_starts():
        dmp = DMP(n_dims=3, execution_time=1.0, n_weights_per_dim=10, dt=0.01)
        dmp.configure(start_y=start, goal_y=np.ones(3))
        y = dmp.open_loop(coupling_term=CouplingTermObstacleAvoidance3D(OBSTACLE))[1]
        nearest.append(np.linalg.norm(y - OBSTACLE, axis=1).min())
    return float(np.median(nearest))


def our_obstacle() -> float:
    """All starts in one batch, with a spherical obstacle as in the other library."""
    starts = torch.from_numpy(obstacle_starts())
    t = torch.linspace(0, 1, 101, dtype=F64)
    still = JointDMP.fit(t, torch.zeros(101, 3, dtype=F64), 10)
    state = still.initial_state(start=starts, goal=torch.ones(3, dtype=F64))
    obstacle = torch.from_numpy(OBSTACLE).expand(20, 1, 3)
    nearest = torch.full((20,), torch.inf, dtype=F64)
    for _ in range(1000):
        push = steering(state.position, state.velocity, obstacle)
        state = still.step(state, 1e-3, coupling=push)
        away = (state.position - obstacle[:, 0]).norm(dim=-1)
        nearest = torch.minimum(nearest, away)
    return nearest.quantile(0.5).item()


def line(n: int) -> np.ndarray:
    return np.stack([np.linspace(0, 1, n), np.linspace(1, 2, n)], -1)


def their_via_points() -> float:
    from movement_primitives.dmp import (  # pyright: ignore[reportMissingImports]
        StateFollowingDMP,
    )

    dmp = StateFollowingDMP(n_dims=2, execution_time=3.0, dt=0.001, n_viapoints=8)
    dmp.forcing_term.viapoints[:] = line(8)
    dmp.configure(start_y=line(8)[0])
    y = dmp.open_loop(run_t=3.0)[1]
    return max(np.linalg.norm(y - via, axis=1).min() for via in line(8))


def our_via_points() -> float:
    """Via points at given times, which the other library does not guarantee."""
    t = torch.linspace(0, 3, 301, dtype=F64)
    ends = torch.from_numpy(line(2))
    s = (t / 3)[:, None]
    way = ends[0] + (ends[1] - ends[0]) * s**3 * (10 - 15 * s + 6 * s**2)
    moments, via = torch.linspace(0, 3, 8, dtype=F64)[1:-1], torch.from_numpy(line(8)[1:-1])
    path = JointDMP.fit(t, way, 50).condition(moments, via).rollout(moments).position
    return (path - via).norm(dim=-1).max().item()


def distribution() -> tuple[Tensor, Tensor]:
    """Twenty waves whose phase varies."""
    rng, t = np.random.RandomState(10), np.linspace(0, 1, 101)
    shift = rng.randn(20, 2) * [0.3, 0.5]
    angle = 2 * np.pi * t[:, None] + shift[:, None]
    y = np.stack([np.sin(angle[..., 0]), 0.5 + np.cos(angle[..., 1])], -1)
    return torch.from_numpy(t), torch.from_numpy(y)


def their_promp() -> Any:
    from movement_primitives.promp import ProMP  # pyright: ignore[reportMissingImports]

    t, y = (x.numpy() for x in distribution())
    promp = ProMP(n_dims=2, n_weights_per_dim=15)
    promp.imitate(np.tile(t, (len(y), 1)), y)
    return promp


def our_promp() -> ProbabilisticDMP[JointDMP]:
    return ProbabilisticDMP.fit(JointDMP.fit(*distribution(), 15))


def spread_error(mean: Any, deviation: Any) -> float:
    y = distribution()[1].numpy()
    off = np.abs(np.asarray(mean) - y.mean(0)).max()
    return max(off, np.abs(np.asarray(deviation) - y.std(0, ddof=1)).max())


def their_spread() -> float:
    promp, t = their_promp(), distribution()[0].numpy()
    return spread_error(promp.mean_trajectory(t), np.sqrt(promp.var_trajectory(t)))


def our_spread() -> float:
    return spread_error(*our_promp().position(distribution()[0]))


CONDITION = np.array([0.8, 1.2])


def their_condition() -> float:
    given = their_promp().condition_position(CONDITION, y_cov=np.zeros(2), t=0.2)
    return np.abs(given.mean_trajectory(np.array([0.0, 0.2, 1.0]))[1] - CONDITION).max()


def our_condition() -> float:
    given = our_promp().condition([0.2], CONDITION[None])
    return np.abs(given.position([0.2])[0][0].numpy() - CONDITION).max()


def contexts() -> tuple[Tensor, Tensor, Tensor]:
    """Waves that a context shifts and widens, and their contexts."""
    t, c = torch.linspace(0, 1, 101, dtype=F64), torch.linspace(0, 1, 12, dtype=F64)
    y = c[:, None] * (torch.pi * t).sin() ** 2 + (1 + c[:, None]) * t
    return t, y[..., None], c[:, None]


def their_context() -> float:
    from gmr import GMM  # pyright: ignore[reportMissingImports]
    from movement_primitives.promp import ProMP  # pyright: ignore[reportMissingImports]

    t, y, c = (x.numpy() for x in contexts())
    promp = ProMP(n_dims=1, n_weights_per_dim=10)
    weights = np.stack([promp.weights(t, one) for one in y])
    gmm = GMM(n_components=1, random_state=0)
    gmm.from_samples(np.hstack([c, weights]))
    given = gmm.condition([0], np.array([0.35])).to_mvn()
    promp.from_weight_distribution(given.mean, given.covariance)
    return np.abs(promp.mean_trajectory(t)[:, 0] - wanted_at(t, 0.35)).max()


def our_context() -> float:
    t, y, c = contexts()
    model = choose([JointDMP.fit(t, y, 10)], c, regression_only=True)
    path = model.at(context=[0.35]).rollout(t).position[:, 0]
    return np.abs(path.detach().numpy() - wanted_at(t.numpy(), 0.35)).max()


def wanted_at(t: np.ndarray, c: float) -> np.ndarray:
    return c * np.sin(np.pi * t) ** 2 + (1 + c) * t


def pose_demonstration() -> tuple[Tensor, Tensor, Tensor]:
    """A reach along y that rotates from one axis to another."""
    t = torch.linspace(0, 1, 1001, dtype=F64)
    s = 0.5 * ((1.5 * torch.pi * (t - 0.5)).tanh() + 1)
    position = torch.stack([0 * t + 0.6, -0.2 + 0.4 * s, 0 * t + 0.45], -1)
    axis = torch.stack([0 * s, 1 - s, s], -1)
    turn = torch.pi / 4 * axis / axis.norm(dim=-1, keepdim=True)
    return t, position, quaternion.exp(turn)


def their_pose() -> float:
    from movement_primitives.dmp import CartesianDMP  # pyright: ignore[reportMissingImports]

    t, *columns = pose_demonstration()
    y = torch.cat(columns, -1).numpy()
    dmp = CartesianDMP(execution_time=1.0, dt=1e-3, n_weights_per_dim=10, int_dt=1e-4)
    dmp.imitate(t.numpy(), y, allow_final_velocity=True)
    dmp.configure(start_y=y[0], goal_y=y[-1])
    shown = torch.from_numpy(dmp.open_loop()[1][:, 3:])
    return torch.rad2deg(quaternion.angle(shown, columns[1])).max().item()


def our_pose() -> float:
    t, position, orientation = pose_demonstration()
    shown = PoseDMP.fit(t, position, orientation, 10).rollout().orientation
    return torch.rad2deg(quaternion.angle(shown, orientation)).max().item()


def their_saved() -> float:
    from movement_primitives.dmp import DMP  # pyright: ignore[reportMissingImports]
    from movement_primitives.io import (  # pyright: ignore[reportMissingImports]
        read_json,
        write_json,
    )

    dmp = their_dmp(1.0, 101, 0.01, 20)
    with tempfile.TemporaryDirectory() as folder:
        write_json(f"{folder}/dmp.json", dmp)
        again: DMP = read_json(f"{folder}/dmp.json")
    return np.abs(again.open_loop()[1] - dmp.open_loop()[1]).max()


def our_saved() -> float:
    dmp = JointDMP.fit(*waves(1.0, 101), 20)
    with tempfile.TemporaryDirectory() as folder:
        dmp.save(folder)
        again = JointDMP.load(folder)
    return (again.rollout().position - dmp.rollout().position).abs().max().item()


# Scenarios of MP_PyTorch.


def their_prodmp(learn_tau: bool = False, dtype: torch.dtype = torch.float32) -> Any:
    from mp_pytorch.mp import MPFactory  # pyright: ignore[reportMissingImports]

    arguments = {
        "num_basis": 10,
        "basis_bandwidth_factor": 2,
        "num_basis_outside": 0,
        "alpha": 25,
        "alpha_phase": 2,
        "dt": 0.01,
    }
    return MPFactory.init_mp(
        mp_type="prodmp", num_dof=2, tau=3, learn_tau=learn_tau, mp_args=arguments, dtype=dtype
    )


def sines() -> tuple[Tensor, Tensor]:
    t = torch.linspace(0, 3, 601)
    return t, torch.stack([torch.sin(2 * t + i) + 5 for i in range(2)], -1)


def their_weights() -> float:
    t, y = sines()
    mp = their_prodmp()
    found = mp.learn_mp_params_from_trajs(t[None], y[None])
    return (mp.get_traj_pos(t[None], **found)[0] - y).square().mean().sqrt().item()


def our_weights() -> float:
    t, y = sines()
    return (JointDMP.fit(t, y, 10).rollout().position - y).square().mean().sqrt().item()


TAU = 3.17
"""Duration [s]; with 3.2, times would fall on knots of the other library's table, where it has
no derivative."""


def their_duration_gradient() -> float:
    t = torch.linspace(0, 3, 61, dtype=F64)[None]
    weights = torch.randn(1, 22, generator=torch.Generator().manual_seed(0)).double()
    still = torch.zeros(1, 2, dtype=F64)

    def path(tau: Tensor) -> Tensor:
        mp = their_prodmp(True, F64)  # an instance that has been used keeps its duration
        mp.update_inputs(t, torch.cat([tau, weights], -1), None, t[:, 0], still, still)
        return mp.get_traj_pos()

    return gradient_error(path, torch.tensor([[TAU]], dtype=F64), 1e-5)


def our_duration_gradient() -> float:
    (t, y), times = sines(), torch.linspace(0, 3, 61)
    dmp = JointDMP.fit(t.double(), y.double(), 10)
    return gradient_error(
        lambda tau: dmp.rollout(times, duration=tau).position,
        torch.tensor(TAU, dtype=F64),
        1e-5,
    )


def gradient_error(path: Callable[[Tensor], Tensor], tau: Tensor, h: float) -> float:
    """Relative error of the gradient of the sum of squares, against central differences."""
    tau = tau.requires_grad_()
    exact = torch.autograd.grad(path(tau).square().sum(), tau)[0].sum()
    with torch.no_grad():
        ahead, behind = (path(tau + step).square().sum() for step in (h, -h))
    central = (ahead - behind) / (2 * h)
    return abs(exact / central - 1).item()


NOW, RATE = torch.tensor([[4.0, 5.5]]), torch.tensor([[-1.0, 2.0]])


def state_error(position: Tensor, velocity: Tensor) -> float:
    """Error of the initial state of a motion that should start at `NOW` and `RATE`."""
    return max((position - NOW).abs().max(), (velocity - RATE).abs().max()).item()


def their_replan() -> float:
    mp, t = their_prodmp(), torch.linspace(0, 3, 301)[None]
    z = 100 * torch.randn(1, 22, generator=torch.Generator().manual_seed(0))
    mp.update_inputs(t, z, None, t[:, 0], NOW, RATE)
    return state_error(mp.get_traj_pos()[:, 0], mp.get_traj_vel()[:, 0])


def our_replan() -> float:
    head = MotionHead(2, 10, duration=3.0, amplitude=1.0)
    z = torch.randn(1, head.n_parameters, generator=torch.Generator().manual_seed(0))
    motion = head(z, torch.linspace(0, 3, 301), NOW, RATE)
    return state_error(motion.position[:, 0], motion.velocity[:, 0])


def sampled_error(samples: Tensor, deviation: Tensor) -> float:
    """Largest error of a deviation against that of samples, relative to the largest one."""
    return ((samples.std(0) - deviation).abs().max() / deviation.max()).item()


def their_deviation() -> float:
    mp, t = their_prodmp(), torch.linspace(0, 3, 61)[None]
    rng = torch.Generator().manual_seed(0)
    factor = torch.randn(1, 22, 22, generator=rng).tril() / 5
    factor.diagonal(dim1=-2, dim2=-1).abs_()
    y = torch.zeros(1, 2)
    torch.manual_seed(0)
    mp.update_inputs(t, torch.zeros(1, 22), factor, t[:, 0], y, y)
    samples = mp.sample_trajectories(num_smp=4000)[0]
    return sampled_error(samples[0], mp.get_traj_pos_std()[0])


def our_deviation() -> float:
    head, t = MotionHead(2, 10, duration=3.0, amplitude=1.0), torch.linspace(0, 3, 61)
    rng = torch.Generator().manual_seed(0)
    n = head.n_parameters
    factor = torch.randn(n, n, generator=rng).tril() / 5
    factor.diagonal().abs_()
    plans = head.distribution(torch.zeros(n), factor, torch.zeros(2))
    torch.manual_seed(0)
    z = plans.rsample((4000,))
    samples = head(z, t, torch.zeros(4000, 2)).position
    return sampled_error(samples, plans.position(t)[1])


MP, ALR = "movement_primitives", "mp_pytorch"
SCENARIOS = (
    Scenario(
        "imitate two waves", "largest error", MP, "test_dmp", their_imitation, our_imitation
    ),
    Scenario(
        "ten times the step",
        "largest change",
        MP,
        "test_dmp",
        their_step_length,
        our_step_length,
    ),
    Scenario(
        "new start and goal", "error at the end", MP, "test_dmp", their_new_ends, our_new_ends
    ),
    Scenario(
        "half the duration",
        "change of the path",
        MP,
        "test_dual_cartesian_dmp",
        their_half_duration,
        our_half_duration,
    ),
    Scenario(
        "end at 0, 1, 2 per s",
        "velocity error",
        MP,
        "test_dmp_with_final_velocity",
        their_final_velocity,
        our_final_velocity,
    ),
    Scenario(
        "keep 0.5 apart", "error of the mean", MP, "test_coupling", their_coupling, our_coupling
    ),
    Scenario(
        "pass an obstacle, 20 starts",
        "median distance, more is better",
        MP,
        "test_obstacle_avoidance",
        their_obstacle,
        our_obstacle,
    ),
    Scenario(
        "eight via points",
        "largest miss",
        MP,
        "test_state_following_dmp",
        their_via_points,
        our_via_points,
    ),
    Scenario("spread of 20 waves", "largest error", MP, "test_promp", their_spread, our_spread),
    Scenario(
        "condition on a point",
        "miss",
        MP,
        "test_conditional_promps",
        their_condition,
        our_condition,
    ),
    Scenario(
        "a context not shown",
        "largest error",
        MP,
        "test_contextual_promps",
        their_context,
        our_context,
    ),
    Scenario(
        "imitate a pose, 10 functions",
        "degrees",
        MP,
        "test_cartesian_dmp",
        their_pose,
        our_pose,
    ),
    Scenario("save and load", "largest change", MP, "test_io", their_saved, our_saved),
    Scenario("learn weights", "RMSE", ALR, "demo_prodmp", their_weights, our_weights),
    Scenario(
        "gradient by the duration",
        "relative error",
        ALR,
        "learnable_tau",
        their_duration_gradient,
        our_duration_gradient,
    ),
    Scenario(
        "go on from any state",
        "error of state",
        ALR,
        "demo_prodmp",
        their_replan,
        our_replan,
    ),
    Scenario(
        "deviation of plans",
        "against samples, relative",
        ALR,
        "demo_prodmp",
        their_deviation,
        our_deviation,
    ),
)


if __name__ == "__main__":
    cli.run(main, Args)
