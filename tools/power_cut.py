"""Kill writing programs at random moments, and check that nothing is lost or left behind.

Writers of this package are killed while they write one result after another and acknowledge
each. The leftovers are repaired in turns by `recover_all` and by the next start. With
--commands, commands of `hrc` are watched while they write, see `power_cut_commands.py`:

    tools/power_cut.py --commands all --inputs outputs/power_cut --json outputs/power_cut.json

Exit status 1 if an acknowledged result is lost, a result is incomplete, or files are left over.
"""

import itertools
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from power_cut_commands import CASES, Count, make_inputs, watch_command
from rich.console import Console
from rich.table import Table

from hrc_learn import cli

# Longest time of a writer after its first result [s]: many times that of one result, so that a
# kill comes at any of its steps.
WINDOW = 0.5


@dataclass(frozen=True, kw_only=True)
class Args:
    kills: int = 50
    """Kills of each writer."""
    writers: tuple[str, ...] = ()
    """Writers to kill: file, model, results, recording, append, trials; all when none."""
    commands: tuple[str, ...] = ()
    """Commands to watch instead, such as "record placing"; "all" for every one."""
    inputs: Path | None = None
    """Folder of inputs, made if missing, which takes minutes."""
    seed: int = 0
    """Seed of the random moments."""
    json: Path | None = None
    """File for the counts."""
    write: str = ""
    """Run as this writer (used for the processes that are killed)."""
    out: Path | None = None
    """Output of the writer."""


def main(args: Args) -> int:
    if args.write:
        assert args.out is not None
        WRITERS[args.write].write(args.out)
        return 0
    commands = tuple(CASES) if args.commands == ("all",) else args.commands
    if {*args.writers} - {*WRITERS} or {*commands} - {*CASES} or args.kills < 1:
        raise ValueError(
            f"there are --writers {', '.join(WRITERS)}, --commands {', '.join(CASES)}, and "
            f"--kills of 1 or more"
        )
    rng = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as folder:
        if commands:
            inputs = args.inputs or Path(folder) / "inputs"
            make_inputs(inputs)
            counts = {
                name: watch_command(name, inputs, Path(folder) / name, rng) for name in commands
            }
        else:
            counts = {
                name: kill_writer(name, args.kills, Path(folder) / name, rng)
                for name in args.writers or WRITERS
            }
    show(counts)
    if args.json is not None:
        figures = {
            f"{n}_{k}": v for n, count in counts.items() for k, v in asdict(count).items()
        }
        cli.write_json(args.json, figures)
    return int(any(count.failures for count in counts.values()))


def kill_writer(name: str, kills: int, folder: Path, rng: random.Random) -> Count:
    """Kill one writer of this package again and again."""
    count, writer, out = Count(), WRITERS[name], folder / "out"
    folder.mkdir()
    for number in range(kills):
        if not writer.goes_on:
            shutil.rmtree(folder)
            folder.mkdir()
        process = subprocess.Popen(
            [sys.executable, __file__, "--write", name, "--out", str(out)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        time.sleep(rng.uniform(0, WINDOW))
        process.kill()
        lines += process.stdout.readlines()
        process.wait()
        count.kills += 1
        count.interrupted += [path.name for path in folder.iterdir()] != ["out"]
        if not lines[0]:
            count.stuck += 1
            continue
        if number % 2 and writer.goes_on:
            continue  # the next start mends it
        recover(folder)
        try:
            found = writer.read(out)
        except Exception as error:  # of whatever kind
            print(f"{name}: {error}", file=sys.stderr)
            count.broken += 1
            continue
        acknowledged = int([line for line in lines if line.endswith("\n")][-1])
        count.lost += found < acknowledged
        # One more may have been written and not yet said.
        count.broken += found > acknowledged + 1
        count.orphans += [path.name for path in folder.iterdir()] != ["out"]
    return count


def recover(folder: Path) -> None:
    from hrc_learn.demos import recover_all

    recover_all(folder)


class Writer(NamedTuple):
    """Writes one thing after another, and says the number of each when it is safe."""

    write: Callable[[Path], None]
    read: Callable[[Path], int]
    """Number of the last result written."""
    goes_on: bool = True
    """True if its next start continues with the existing results."""


def write_files(out: Path) -> None:
    from hrc_learn.store import new_file

    for number in numbers(out, read_file):
        with new_file(out) as part:
            part.write_text(f"{number}\n", encoding="utf-8")


def read_file(out: Path) -> int:
    return int(out.read_text(encoding="utf-8"))


def write_models(out: Path) -> None:
    import torch

    from hrc_learn.model_files import write_model

    for number in numbers(out, read_model):
        write_model(out, "Number", {"number": number}, {"number": torch.tensor([number])})


def read_model(out: Path) -> int:
    from hrc_learn.model_files import SavedModel

    model = SavedModel(out, "Number")
    number = model.get("number", int)
    if int(model.tensor("number")) != number:
        raise ValueError(f"{out} is half of one model and half of another")
    return number


def write_results(out: Path) -> None:
    from hrc_learn.store import new_folder

    for number in numbers(out, read_results):
        with new_folder(out, {"number": number}, overwrite=True) as folder:
            (folder / "figures").mkdir()
            for name in range(5):
                text = str(number)
                (folder / "figures" / str(name)).write_text(text, encoding="utf-8")


def read_results(out: Path) -> int:
    from hrc_learn.store import read_made_by

    number = read_made_by(out)["number"]
    found = [read_file(out / "figures" / str(name)) for name in range(5)]
    if found != [number] * 5:
        raise ValueError(f"{out} is of {number} and {found}")
    return number


def write_recording(out: Path) -> None:
    from hrc_learn.demos import DatasetWriter

    with DatasetWriter(out, 50, "any", ["a", "b"]) as writer:
        for number in itertools.count(1):
            record(writer)
            print(number, flush=True)


def write_longer_datasets(out: Path) -> None:
    from hrc_learn.demos import DatasetWriter

    recover(out.parent)  # else the episodes of the recording would stand in the way
    for _ in numbers(out, read_dataset):
        with DatasetWriter(out, 50, "any", ["a", "b"], append=out.exists()) as writer:
            record(writer)


def record(writer) -> None:
    writer.start_episode("reach")
    for k in range(5):
        writer.add_frame(joint_position=[writer.episodes, k])
    writer.save_episode()


def read_dataset(out: Path) -> int:
    from hrc_learn.demos import check_dataset, load_demos

    report = check_dataset(out)
    if not report.ok:
        raise ValueError(str(report))
    return len(load_demos(out))


def write_trials(out: Path) -> None:
    from hrc_learn.experiments.trials import Trial, TrialFile

    with TrialFile(out, {"tried": "nothing"}) as file:
        for number in itertools.count(len(file.trials) + 1):
            file.append(Trial(seed=number, values={}))
            print(number, flush=True)


def read_trials(out: Path) -> int:
    from hrc_learn.experiments.trials import TrialFile

    with TrialFile(out, {"tried": "nothing"}) as file:
        return len(file.trials)


def numbers(out: Path, read: Callable[[Path], int]):
    """Numbers from the one after the last written; each is said when the next is asked for."""
    from hrc_learn.store import settle

    settle(out)
    for number in itertools.count(read(out) + 1 if out.exists() else 1):
        yield number
        print(number, flush=True)


WRITERS = {
    "file": Writer(write_files, read_file),
    "model": Writer(write_models, read_model),
    "results": Writer(write_results, read_results),
    "recording": Writer(write_recording, read_dataset, goes_on=False),
    "append": Writer(write_longer_datasets, read_dataset),
    "trials": Writer(write_trials, read_trials),
}


def show(counts: dict[str, Count]) -> None:
    # Of writers that are killed nothing is watched.
    shown = [k for k in Count.__annotations__ if any(asdict(c)[k] for c in counts.values())]
    table = Table("", *shown, title="Power cuts")
    for name, count in counts.items():
        table.add_row(name, *(str(asdict(count)[key]) for key in shown))
    Console().print(table)


if __name__ == "__main__":
    cli.run(main, Args)
