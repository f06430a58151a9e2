"""`hrc tune`: gains, searched over simulated closed loops."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import write_values
from hrc_learn.cli._tables import named
from hrc_learn.cli.arguments.learn import Tune
from hrc_learn.controller import ControllerConfig
from hrc_learn.experiments.controller.initialization_study import (
    ClosedLoops,
    StartsConfig,
    summary,
)
from hrc_learn.jacobian import KalmanEstimator
from hrc_learn.kinematics import ArmChoice
from hrc_learn.learning.tuning import TUNED, TuningState
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.visual_skill import guessed_network
from hrc_learn.store import new_folder, write_json, write_text
from hrc_learn.viz.figures import learning_figure
from hrc_learn.viz.report import show_measurements


def tune(args: Tune) -> None:
    args = resolved(args)
    if args.generations < 1 or args.population < 3:
        raise ValueError("a search needs --generations of 1 and --population of 3, or more")
    torch.set_num_threads(1)
    console, default = Console(), ControllerConfig()
    place = args.out.with_name(f"{args.out.name}.search.json")
    search, history = _begin(args, place, default)
    with new_folder(args.out, asdict(args), args.overwrite) as folder:
        cost = _cost(_loops(args, args.starts), default)
        with Progress(console=console) as progress:
            task = progress.add_task("Searching", total=args.generations)
            progress.advance(task, search.generation)
            while search.generation < args.generations:
                tried = search.ask(args.population)
                search = search.tell(tried, [cost(gains) for gains in tried])
                history.append(search.best_cost)
                state = {"search": search.to_json(), "costs": history}
                write_text(place, json.dumps(state))
                best = f"Searching, mean time {search.best_cost:.3f} s"
                progress.update(task, advance=1, description=best)
        gains = dict(zip(search.names, search.best, strict=True))
        figures = _figures(args, default, gains)
        write_json(folder / "gains.json", gains)
        write_json(folder / "metrics.json", figures)
        learning_figure(history, len(history) - 1, "s").savefig(folder / "search.png", dpi=120)
    place.unlink(missing_ok=True)
    rows = [named(name, value) for name, value in figures.items()]
    title = "Gains, on closed loops not searched"
    show_measurements(rows, title=title, elsewhere="metrics.json")
    console.print(f"Gains in {args.out / 'gains.json'}")
    write_values(args.json, figures)


def _begin(
    args: Tune, place: Path, default: ControllerConfig
) -> tuple[TuningState, list[float]]:
    """A new search, or the one that was interrupted.

    Raises:
        FileNotFoundError: None was interrupted.
        ValueError: Its file holds something else, or searches other gains.
    """
    if args.resume:
        text = place.read_text(encoding="utf-8")
        try:
            state = json.loads(text)
            search = TuningState.from_json(state["search"])
            history = [float(cost) for cost in state["costs"]]
            widths = {len(search.names), len(search.middle), len(search.spread)}
            if len(widths) > 1 or len(search.best) not in (0, *widths):
                raise ValueError("its lists differ in length")
            # Asking and telling looks at all that a search holds.
            search.tell(tried := search.ask(2), [0.0] * len(tried))
        except Exception as error:
            raise ValueError(
                f"{place} holds no search to go on with ({type(error).__name__}: {error}): "
                f"delete it and start without --resume"
            ) from None
        if search.names != TUNED:
            raise ValueError(
                f"{place} searches {', '.join(search.names)}, not {', '.join(TUNED)}: delete "
                f"it and start without --resume"
            )
        return search, history
    start = {name: getattr(default, name) for name in TUNED}
    return TuningState.around(start, seed=args.starts.seed), []


def _loops(args: Tune, config: StartsConfig) -> ClosedLoops:
    """Above the table of the arm's workplace."""
    workplace = Workplace.of(ArmChoice(args.robot, args.base, args.tip).work_arm())
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    middle = workplace.hover().position
    reach = torch.tensor([0.09, 0.07, 0.03], dtype=torch.float64)
    return ClosedLoops.draw(
        workplace.scene.camera,
        world.hand_marker_offset(),
        torch.stack([middle - reach, middle + reach]),
        workplace.hover_joints(),
        config,
        workplace.robot,
    )


def _cost(loops: ClosedLoops, default: ControllerConfig) -> Callable[[dict[str, float]], float]:
    """Mean time [s]; a start that does not get there counts twice the time it was given."""
    estimator, never = KalmanEstimator(guessed_network()), 2 * loops.config.duration

    def cost(gains: dict[str, float]) -> float:
        times = loops.times(estimator, replace(default, **gains))
        return float(times.nan_to_num(posinf=never).mean())

    return cost


def _figures(
    args: Tune, default: ControllerConfig, gains: dict[str, float]
) -> dict[str, float]:
    """The gains, and times with and without them on closed loops that were not searched."""
    loops = _loops(args, replace(args.starts, seed=args.held_out_seed))
    estimator = KalmanEstimator(guessed_network())
    figures = dict(gains)
    for name, config in (("default", default), ("tuned", replace(default, **gains))):
        times = loops.times(estimator, config)
        figures |= {f"{name}_{key}": value for key, value in summary(times).items()}
        reached = times[times.isfinite()]
        figures[f"{name}_mean"] = float(reached.mean()) if len(reached) else math.inf
    return figures
