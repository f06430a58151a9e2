"""`hrc record expert`: the scripted expert on LeRobot's simulated Panda."""

import sys

from rich.progress import Progress

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.record import RecordExpert as Args


def run(args: Args) -> int:
    from hrc_learn.lerobot.expert_recording import record_expert
    from hrc_learn.lerobot.robots import MujocoPandaConfig

    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    if args.out.exists():
        raise FileExistsError(f"there is something at {args.out}: give another folder.")
    config = MujocoPandaConfig(
        scenario=args.scenario,
        shelf=args.shelf,
        fps=float(args.fps),
        action_space=args.action_space,
        pixels=args.pixels and args.scenario == "grasping",
        seed=args.seed,
    )
    failed = 0
    try:
        with Progress(transient=True) as progress:
            shown = progress.add_task(f"Demonstrations of {args.scenario}", total=args.episodes)
            for written, succeeded in record_expert(args.out, config, args.episodes):
                failed += not succeeded
                progress.update(shown, completed=written)
    except RuntimeError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    print(f"{args.episodes} demonstrations in {args.out} ({failed} discarded)")
    if args.json is not None:
        write_json(args.json, {"episodes": args.episodes, "thrown_away": failed})
    return 0
