"""`hrc demo`: the whole main job, command after command in one process."""

import json
from dataclasses import asdict

from rich.console import Console

from hrc_learn.cli._values import write_text
from hrc_learn.cli.arguments.run import Demo as Args
from hrc_learn.cli.arguments.run import RunCollaboration
from hrc_learn.cli.commands._demo_models import announce, learn


def run(args: Args) -> int:
    from hrc_learn.cli.commands import run_collaboration

    console = Console()
    learn(args.out, console, steps=5)
    write_text(args.out / "configuration.json", json.dumps(asdict(args), indent=2, default=str))
    announce(console, 5, 5, "Grasping beside a person, carrying, placing")
    return run_collaboration.run(
        RunCollaboration(
            placing=args.out / "placing",
            aiming=args.out / "aiming",
            shelf=args.shelf,
            robot=args.robot,
            out=args.out / "run",
            seed=args.seed,
            overwrite=True,
            json=args.json,
        )
    )
