"""`hrc run placing`: the paper's first experiment."""

from dataclasses import asdict, replace

from rich.console import Console

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import command_line, refuse_existing
from hrc_learn.cli.arguments.run import RunPlacing as Args
from hrc_learn.cli.commands._demo_models import model
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.experiments.placing.experiment import ABLATION, PlacingExperiment, dataset_of


def run(args: Args) -> int:
    refuse_existing(args.out, args.overwrite)
    placing = model(args.placing, "placing", Console())
    args = replace(resolved(args), placing=placing)
    dataset = args.demonstrations or dataset_of(placing)
    experiment = PlacingExperiment(
        placing=placing.resolve(),
        demonstrations=dataset.resolve(),
        speed=args.speed,
        noise=args.noise,
        snapshots=args.pictures,
    )
    return conduct(
        experiment,
        RunOptions.of(args),
        counts={ABLATION: args.ablation},
        configuration=asdict(args),
        command=command_line(),
    )
