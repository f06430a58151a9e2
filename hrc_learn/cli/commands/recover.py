"""`hrc recover`: what a process that was killed left behind."""

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Recover as Args
from hrc_learn.demos import load_demos, recover_dataset


def run(args: Args) -> None:
    # Datasets are what can be recovered so far; whatever else is written transactionally
    # belongs here too.
    root = recover_dataset(args.path)
    demos = load_demos(root)
    print(f"{root}: {len(demos)} demonstrations recovered")
    if args.json is not None:
        frames = sum(len(demo) for demo in demos)
        write_json(args.json, {"episodes": len(demos), "frames": frames})
