"""Record the scripted expert on LeRobot's simulated Panda, in simulated time.

Writes what lerobot-record would write with --robot.type=mujoco_panda and
--teleop.type=panda_expert, but waits for no clock: every episode is shown to its end, as fast
as the machine can. Demonstrations that fail are shown again.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.progress import Progress

from hrc_learn import cli


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to record."""

    out: Path
    """Folder of the new dataset; must not exist."""
    scenario: Literal["placing", "grasping"] = "placing"
    """What is shown."""
    shelf: Literal["lower", "middle", "upper"] = "middle"
    """Where to place."""
    episodes: int = 10
    """Demonstrations to write."""
    fps: int = 20
    """Frames a second."""
    action_space: Literal["joint", "ee"] = "joint"
    """What actions give: positions of the joints, or of the hand."""
    pixels: bool = True
    """Whether the pixel of the object to grasp is observed."""
    seed: int = 0
    """Of the first beginning; each one after has the next."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> int:
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
    print(f"{args.episodes} demonstrations in {args.out} ({failed} thrown away)")
    if args.json is not None:
        cli.write_json(args.json, {"episodes": args.episodes, "thrown_away": failed})
    return 0


if __name__ == "__main__":
    cli.run(main, Args)
