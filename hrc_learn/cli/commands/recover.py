"""`hrc recover`: what a process that was killed left behind."""

from collections.abc import Iterator
from pathlib import Path

from hrc_learn import store
from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Recover as Args
from hrc_learn.demos import DatasetError, load_demos, recover_dataset
from hrc_learn.demos.write.staging import staging_folder


def run(args: Args) -> None:
    done = store.recover(args.path)
    episodes = frames = 0
    for root in _interrupted_recordings(args.path):
        try:
            demos = load_demos(recover_dataset(root))
        except DatasetError as error:
            done.append(str(error))
            continue
        done.append(f"{root}: {len(demos)} demonstrations recovered")
        episodes += len(demos)
        frames += sum(len(demo) for demo in demos)
    if not done and not args.path.exists():
        raise FileNotFoundError(f"{args.path}: neither this nor an interrupted writer of it")
    print("\n".join(done) or f"{args.path}: nothing was left unfinished")
    if args.json is not None:
        values = {"recovered": len(done), "episodes": episodes, "frames": frames}
        write_json(args.json, values)


def _interrupted_recordings(path: Path) -> Iterator[Path]:
    """Datasets that were being recorded: the path itself, and all below it."""
    suffix = staging_folder(path).name.removeprefix(path.resolve().name)
    if staging_folder(path).is_dir():
        yield path
    for staging in sorted(path.rglob(f"*{suffix}")):
        if staging.is_dir():
            yield staging.with_name(staging.name.removesuffix(suffix))
