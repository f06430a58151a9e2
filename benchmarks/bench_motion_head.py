"""Compare `MotionHead` with ProDMP of MP_PyTorch as the last layer of a policy.

Episodic reinforcement learning in MuJoCo: a planar arm with five joints passes two points at
given times and ends at a third. Once per episode, a network maps the three points to the mean
of a Gaussian over the parameters of a motion. A clipped policy gradient (PPO, for black-box
optimisation as in Otto et al. 2022) improves the network. Both heads have the same network,
optimiser, contexts, number of parameters and root mean square deviation of the first samples;
all other settings are the defaults of each head. The learning rate falls to zero during a run.
In addition, CMA-ES searches both parameter spaces, for one context at a time and without a
network. Reported are returns over environment steps.

Needs mp_pytorch and cma: pip install mp_pytorch cma
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from mujoco import MjData, MjModel, mj_stateSize, mjtState, rollout
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from hrc_learn import cli
from hrc_learn.dmp import MotionHead
from hrc_learn.viz import palette
from hrc_learn.viz.figures import STYLE, WIDTH

# pyright: reportAttributeAccessIssue=false
# MuJoCo's classes are compiled, and its stubs omit most of them.

JOINTS, LINK = 5, 0.2
"""Number of joints of the arm, and length of each link [m]."""
STEP, DURATION = 0.01, 2.0
"""Time step of the simulation, and duration of an episode [s]."""
STEPS = round(DURATION / STEP)
PASSED = (0.35, 0.7, 1.0)
"""Times at which the tip should be at the three points, as fractions of the episode."""
EFFORT = 1e-4
"""Cost of a mean squared joint acceleration of 1 rad^2/s^4, as a distance [m]."""
QUANTILE = 2.776
"""Quantile of Student's distribution with four degrees of freedom, for 95 % intervals of five
seeds."""


@dataclass(frozen=True, kw_only=True)
class Args:
    seeds: int = 5
    """Number of runs of each head, with different contexts, networks and samples."""
    iterations: int = 400
    """Number of updates of a policy."""
    episodes: int = 128
    """Number of episodes between two updates."""
    search_episodes: int = 3000
    """Number of episodes of CMA-ES for one context."""
    search_contexts: int = 8
    """Number of contexts of CMA-ES in each run, one after another; their mean is reported."""
    n_basis: int = 5
    """Number of basis functions of each joint; with the goal, a joint has one parameter more.
    """
    deviation: float = 0.3
    """Initial standard deviation of whitened parameters."""
    rate: float = 1e-3
    """Initial learning rate of Adam; it falls linearly to zero."""
    first_seed: int = 0
    """First seed. Use seeds other than the reported ones to choose `deviation` and `rate`."""
    picture: Path | None = None
    """File for a picture of the learning curves."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


type Motions = Callable[[Float[Tensor, "B P"]], Float[Tensor, "B T D"]]
"""Map from parameters to joint positions at every step."""


def main(args: Args) -> None:
    """Train both heads with all seeds; print, draw and write the results."""
    missing = [name for name in ("mp_pytorch", "cma") if find_spec(name) is None]
    if missing:
        raise ValueError(f"not installed: pip install {' '.join(missing)}")
    if args.seeds != 5:
        warnings.warn("intervals are those of five seeds", stacklevel=1)
    torch.set_num_threads(1)
    heads = {"MotionHead": our_motions(args.n_basis), "ProDMP": prodmp_motions(args.n_basis)}
    curves: dict[str, Float[np.ndarray, "seeds points"]] = {}
    for name, motions in heads.items():
        seeds = range(args.first_seed, args.first_seed + args.seeds)
        curves[f"policy, {name}"] = np.stack([learn(motions, args, seed) for seed in seeds])
        curves[f"CMA-ES, {name}"] = np.stack([search(motions, args, seed) for seed in seeds])
    figures = summarise(curves, args)
    show(figures)
    if args.picture:
        draw(curves, args, args.picture)
    if args.json:
        cli.write_json(args.json, figures)


def our_motions(n_basis: int) -> Motions:
    """Motions of a head without timing parameters."""
    head = MotionHead(JOINTS, n_basis, duration=DURATION)
    time = STEP * torch.arange(1, STEPS + 1)
    return lambda z: head(z, time, torch.zeros(JOINTS)).position


def prodmp_motions(n_basis: int) -> Motions:
    """Motions of ProDMP, with each basis function scaled to one as its authors advise.

    A common scale makes unit normal parameters deviate as much as in our head.
    """
    from mp_pytorch.mp import MPFactory  # pyright: ignore[reportMissingImports]

    mp = MPFactory.init_mp(
        mp_type="prodmp",
        num_dof=JOINTS,
        tau=DURATION,
        mp_args={
            "num_basis": n_basis,
            "num_basis_outside": 0,
            "basis_bandwidth_factor": 3,
            "alpha_phase": 3,
            "alpha": 25,
            "dt": STEP,
            "auto_scale_basis": True,
            "relative_goal": True,
        },
    )
    time = STEP * torch.arange(1, STEPS + 1)

    def motions(z: Float[Tensor, "B P"]) -> Float[Tensor, "B T D"]:
        still = torch.zeros(len(z), JOINTS)
        times = time.expand(len(z), -1)
        return mp.get_traj_pos(times, z, torch.zeros(len(z)), still, still)

    z = torch.randn(2000, JOINTS * (n_basis + 1), generator=torch.Generator().manual_seed(0))
    gain = our_motions(n_basis)(z).square().mean().sqrt() / motions(z).square().mean().sqrt()
    return lambda z: motions(gain * z)


class Reacher:
    """Episodes of the arm, whose joints follow motions by springs and dampers."""

    def __init__(self):
        body = end = ""
        for i in range(JOINTS):
            body += (
                f'<body pos="{LINK * (i > 0)} 0 0"><joint name="j{i}" axis="0 0 1" '
                f'damping="0.05" armature="0.01"/><geom type="capsule" size="0.02" '
                f'fromto="0 0 0 {LINK} 0 0" mass="0.3"/>'
            )
            end += "</body>"
        motors = "".join(
            f'<position joint="j{i}" kp="60" kv="4" forcerange="-20 20"/>'
            for i in range(JOINTS)
        )
        self._model = MjModel.from_xml_string(
            f'<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="implicitfast">'
            f'<flag contact="disable"/></option><worldbody>{body}<site name="tip" '
            f'pos="{LINK} 0 0"/>{end}</worldbody><actuator>{motors}</actuator>'
            '<sensor><framepos objtype="site" objname="tip"/></sensor></mujoco>'
        )
        self._data = MjData(self._model)
        size = mj_stateSize(self._model, mjtState.mjSTATE_FULLPHYSICS)
        self._start = np.zeros((1, size))

    def returns(
        self, path: Float[Tensor, "B T D"], context: Float[Tensor, "B 6"]
    ) -> Float[Tensor, "B"]:
        """Returns: minus the distances from the points [m], minus the effort."""
        control = path.double().numpy()
        initial = self._start.repeat(len(control), 0)
        state, tip = (
            np.asarray(x) for x in rollout.rollout(self._model, self._data, initial, control)
        )
        times = [round(share * STEPS) - 1 for share in PASSED]
        points = context.double().numpy().reshape(-1, 3, 2)
        distance = np.linalg.norm(tip[:, times, :2] - points, axis=-1).sum(-1)
        speed = state[..., 1 + JOINTS : 1 + 2 * JOINTS]
        effort = np.square(np.diff(speed, axis=1) / STEP).mean((1, 2))
        return torch.from_numpy(-distance - EFFORT * effort).float()


def contexts(n: int, rng: torch.Generator) -> Float[Tensor, "n 6"]:
    """Random contexts: three points in reach, the second near the line between the others."""
    first, last = 0.7 * torch.randn(2, n, JOINTS, generator=rng)
    middle = (first + last) / 2 + 0.4 * torch.randn(n, JOINTS, generator=rng)
    angle = torch.stack([first, middle, last], 1).cumsum(-1)
    return LINK * torch.stack([angle.cos().sum(-1), angle.sin().sum(-1)], -1).flatten(1)


def network(outputs: int) -> nn.Sequential:
    """Network with two hidden layers and an initial output of zero."""
    last = nn.Linear(64, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(6, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)


def learn(motions: Motions, args: Args, seed: int) -> Float[np.ndarray, "points"]:
    """Returns of the mean policy on held-out contexts, at each tenth update and at the end."""
    torch.manual_seed(seed)
    rng = torch.Generator().manual_seed(seed)
    reacher, held_out = Reacher(), contexts(64, torch.Generator().manual_seed(10_000))
    P = JOINTS * (args.n_basis + 1)
    mean, value = network(P), network(1)
    log_deviation = nn.Parameter(torch.full((P,), math.log(args.deviation)))
    optimiser = torch.optim.Adam(
        [*mean.parameters(), *value.parameters(), log_deviation], args.rate
    )
    curve = []
    for iteration in range(args.iterations + 1):
        if iteration % 10 == 0:
            with torch.no_grad():
                z = mean(held_out)
            curve.append(reacher.returns(motions(z), held_out).mean().item())
        if iteration == args.iterations:
            break
        for group in optimiser.param_groups:
            group["lr"] = args.rate * (1 - iteration / args.iterations)
        x = contexts(args.episodes, rng)
        with torch.no_grad():
            policy = torch.distributions.Normal(mean(x), log_deviation.exp())
            z = policy.sample()
            before = policy.log_prob(z).sum(-1)
            gained = reacher.returns(motions(z), x)
            advantage = gained - value(x)[:, 0]
            advantage = (advantage - advantage.mean()) / advantage.std()
        for _ in range(10):
            for part in torch.randperm(len(x), generator=rng).split(32):
                policy = torch.distributions.Normal(mean(x[part]), log_deviation.exp())
                ratio = (policy.log_prob(z[part]).sum(-1) - before[part]).exp()
                surrogate = torch.minimum(
                    ratio * advantage[part], ratio.clamp(0.8, 1.2) * advantage[part]
                )
                miss = (value(x[part])[:, 0] - gained[part]).square().mean()
                optimiser.zero_grad()
                (miss - surrogate.mean()).backward()
                optimiser.step()
    return np.array(curve)


def search(motions: Motions, args: Args, seed: int) -> Float[np.ndarray, "points"]:
    """Best return found by CMA-ES by generation; mean over contexts."""
    rng = torch.Generator().manual_seed(20_000 + seed)
    runs = [
        search_one(motions, args, context[None], args.search_contexts * seed + k + 1)
        for k, context in enumerate(contexts(args.search_contexts, rng))
    ]
    return np.mean(runs, axis=0)


def search_one(
    motions: Motions, args: Args, context: Float[Tensor, "1 6"], seed: int
) -> Float[np.ndarray, "points"]:
    """The same for one context; `seed` is positive."""
    import cma  # pyright: ignore[reportMissingImports]

    reacher, P = Reacher(), JOINTS * (args.n_basis + 1)
    options = {"seed": seed, "verbose": -9, "maxfevals": args.search_episodes}
    strategy = cma.CMAEvolutionStrategy(P * [0.0], args.deviation, options)
    curve, best = [], -math.inf
    for _ in range(args.search_episodes // strategy.popsize):
        asked = strategy.ask()
        z = torch.tensor(np.array(asked), dtype=torch.float32)
        gained = reacher.returns(motions(z), context.expand(len(z), -1))
        strategy.tell(asked, (-gained).tolist())
        best = max(best, gained.max().item())
        curve.append(best)
    return np.array(curve)


def summarise(
    curves: dict[str, Float[np.ndarray, "seeds points"]], args: Args
) -> dict[str, float]:
    """Means and half-widths of 95 % intervals, for both heads and their difference with equal
    seeds.
    """
    figures: dict[str, float] = {}
    for kind in ("policy", "CMA-ES"):
        ours, theirs = (curves[f"{kind}, {name}"] for name in ("MotionHead", "ProDMP"))
        for share, when in ((0.25, "quarter"), (0.5, "half"), (1.0, "end")):
            k = round(share * (ours.shape[1] - 1))
            for name, runs in (
                ("motion_head", ours), ("prodmp", theirs), ("difference", ours - theirs)
            ):  # fmt: skip
                key = f"{kind.lower().replace('-', '_')}_{name}_{when}"
                figures[key] = float(runs[:, k].mean())
                figures[f"{key}_interval"] = half_width(runs[:, k])
        target = theirs.mean(0)[-1]
        reached = np.flatnonzero(ours.mean(0) >= target)
        share = reached[0] / (ours.shape[1] - 1) if len(reached) else math.nan
        figures[f"{kind.lower().replace('-', '_')}_steps_to_their_last_return"] = float(share)
    figures["environment_steps_of_a_policy"] = args.iterations * args.episodes * STEPS
    figures["environment_steps_of_cma_es"] = args.search_episodes * STEPS
    return figures


def half_width(values: Float[np.ndarray, "seeds"]) -> float:
    """Half-width of the 95 % interval of a mean."""
    return QUANTILE * float(values.std(ddof=1)) / math.sqrt(len(values))


def show(figures: dict[str, float]) -> None:
    """Print all measured values."""
    table = Table("figure", "value", title="A reacher through points, return [m]")
    for name, value in figures.items():
        table.add_row(name, f"{value:,.4g}")
    Console().print(table)


def draw(
    curves: dict[str, Float[np.ndarray, "seeds points"]], args: Args, picture: Path
) -> None:
    """Learning curves with intervals of the mean."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.8))
        _draw_curves(figure, curves, args)
        figure.savefig(picture, dpi=120)


def _draw_curves(
    figure: Figure, curves: dict[str, Float[np.ndarray, "seeds points"]], args: Args
) -> None:
    axes = figure.subplots(1, 2)
    for axis, kind, total in (
        (axes[0], "policy", args.iterations * args.episodes * STEPS),
        (axes[1], "CMA-ES", args.search_episodes * STEPS),
    ):
        for name, color in (("MotionHead", palette.BLUE), ("ProDMP", palette.ORANGE)):
            runs = curves[f"{kind}, {name}"]
            steps = np.linspace(0, total / 1e6, runs.shape[1])
            middle = runs.mean(0)
            width = np.array([half_width(column) for column in runs.T])
            axis.plot(steps, middle, color=color, label=name)
            axis.fill_between(steps, middle - width, middle + width, color=color, alpha=0.2)
        axis.set_xlabel("environment steps [million]")
        axis.set_ylabel("return [m]")
    axes[0].set_title("Policy, held-out contexts")
    axes[1].set_title("CMA-ES, one context, best so far")
    low = min(runs.mean(0)[len(runs.T) // 20] for key, runs in curves.items() if "CMA" in key)
    axes[1].set_ylim(1.1 * low, 0)
    axes[0].legend(loc="lower right")


if __name__ == "__main__":
    cli.run(main, Args)
