"""Place an object on three shelves by a motion that was demonstrated for one of them.

In simulation, with the object held by friction: the demonstrated motion reproduced faster,
then the other shelves, in task space with the learned null-space posture and as the paper does
it (joint space, shifted goal); the demonstration with and without that posture; on request
from many random starts. Writes Rerun recordings, a report and the measured values. Exit status
1 if a target was missed.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from hrc_learn import cli
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.experiments.placing.experiment import ABLATION, PlacingExperiment, dataset_of


@dataclass(frozen=True, kw_only=True)
class Args(RunOptions):
    """What to run."""

    placing: Path
    """Folder of training/fit_dmp.py, from demonstrations of placing."""
    demonstrations: Path | None = None
    """Dataset the motion was learned from; the one named in that folder when None."""
    speed: float = 1.5
    """How many times faster than demonstrated."""
    noise: float = 0.1
    """Standard deviation of each joint at the random starts of --trials, about home [rad]."""
    ablation: int = 0
    """Further demonstrations with and without null-space posture."""
    pictures: bool = True
    """Whether to render pictures of the arm, where this machine can."""


def main(args: Args) -> int:
    dataset = args.demonstrations or dataset_of(args.placing)
    experiment = PlacingExperiment(
        placing=args.placing.resolve(),
        demonstrations=dataset.resolve(),
        speed=args.speed,
        noise=args.noise,
        snapshots=args.pictures,
    )
    counts = {ABLATION: args.ablation}
    return conduct(experiment, args, counts=counts, configuration=asdict(args))


if __name__ == "__main__":
    cli.run(main, Args)
