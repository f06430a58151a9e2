"""Three tasks of a newcomer, with the commands of the README alone.

An SO-101 dataset from `lerobot-record` is shown in 3D; a LeRobot policy that was trained on it
is smoothed; a primitive is fitted to it and played to a new goal. The newcomer already has
dataset and policy, so their creation is not counted. The table lists commands and time.

    python benchmarks/newcomer_tasks.py
"""

import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from bench_first_use import ROOT, commands_of, wait_for
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.cli._run import write_values

# The dataset is that of the tests of the SO-101 page.
sys.path.append(str(ROOT / "tests"))
from test_code_blocks import so101_dataset  # pyright: ignore[reportMissingImports]

TASKS = {
    "units told": ("hrc check --dataset PATH --units",),
    "dataset seen in 3D": ("hrc show",),
    "policy smoothed": ("hrc smooth",),
    "primitive steered": ("hrc fit", "hrc play"),
}
"""First words of the commands that each task needs."""
TRAIN = (
    "--policy.discover_packages_path=hrc_learn.lerobot --policy.type=motion_chunk "
    "--policy.device=cpu --policy.push_to_hub=false --wandb.enable=false "
    "--dataset.repo_id=own/own --dataset.root=own --dataset.video_backend=pyav --num_workers=0 "
    "--env_eval_freq=0 --batch_size=16 --steps=20 --save_freq=20 --output_dir=run"
)
POLICY = "run/checkpoints/last/pretrained_model"


@dataclass(frozen=True, kw_only=True)
class Args:
    json: Path | None = None
    """Receives commands and seconds of each task as one flat object."""


def main(args: Args) -> None:
    """Run the tasks, print a table and write the values; end at the first failing command."""
    named = commands_of((ROOT / "README.md").read_text("utf-8"))
    named = [line for line in named if "PATH" in line or "--model" in line]
    console, figures = Console(), {}
    table = Table("task", "commands", r"wall \[s]", r"CPU \[s]")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        so101_dataset(folder / "own")
        train = [str(Path(sys.executable).with_name("lerobot-train")), *shlex.split(TRAIN)]
        subprocess.run(train, cwd=folder, check=True)
        for task, beginnings in TASKS.items():
            lines = [line for line in named if line.startswith(beginnings)]
            waited = []
            for line in lines:
                command = line.replace("PATH", "own").replace("POLICY", POLICY)
                console.print(f"[dim]$ {command}")
                waited.append(wait_for(command, folder))
                if waited[-1].status:
                    console.print(waited[-1].output)
                    raise SystemExit(waited[-1].status)
            wall, cpu = (sum(getattr(one, key) for one in waited) for key in ("wall", "cpu"))
            table.add_row(task, str(len(lines)), f"{wall:.0f}", f"{cpu:.0f}")
            key = task.replace(" ", "_")
            figures |= {f"{key}_commands": len(lines), f"{key}_wall_s": wall}
    console.print(table)
    write_values(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
