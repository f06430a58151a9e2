"""`hrc show`: demonstrations in Rerun."""

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Show as Args
from hrc_learn.demos import load_demos
from hrc_learn.learning.channels import demonstrations_recording
from hrc_learn.viz.learning_dashboards import record_demonstrations


def run(args: Args) -> None:
    demos = load_demos(args.dataset, episodes=args.episodes or None, units=args.units or None)
    title = f"Demonstrations in {args.dataset.resolve().name}"
    shown = demonstrations_recording(demos, title)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    record_demonstrations(args.out, shown)
    print(f"{len(demos)} demonstrations: rerun {args.out}")
    if args.json is not None:
        seconds = sum(demo.duration for demo in demos)
        write_json(args.json, {"episodes": len(demos), "seconds": seconds})
