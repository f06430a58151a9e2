"""`hrc recover`: what a process that was killed left behind."""

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Recover as Args
from hrc_learn.demos import recover_all


def run(args: Args) -> None:
    done = recover_all(args.path)
    if not done and not args.path.exists():
        raise FileNotFoundError(f"there is nothing at {args.path}, nor was it being written")
    for mended in done:
        print(mended)
    if not done:
        print(f"{args.path}: nothing to recover")
    if args.json is not None:
        write_json(args.json, {"mended": len(done)})
