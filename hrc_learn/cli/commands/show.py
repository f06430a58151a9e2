"""`hrc show`, `hrc report`: demonstrations in Rerun, and runs on a page."""

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments.dataset import Show
from hrc_learn.cli.arguments.run import Report
from hrc_learn.store import write_text
from hrc_learn.viz.report import read_report, reports_page


def show(args: Show) -> None:
    """A recording of the demonstrations of a dataset."""
    # Rerun and PyTorch, which a report does without.
    from hrc_learn.demos import load_demos
    from hrc_learn.learning.channels import demonstrations_recording
    from hrc_learn.viz.learning_dashboards import record_demonstrations

    demos = load_demos(args.dataset, episodes=args.episodes or None, units=args.units or None)
    title = f"Demonstrations in {args.dataset.resolve().name}"
    shown = demonstrations_recording(demos, title)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    record_demonstrations(args.out, shown)
    print(f"{len(demos)} demonstrations: rerun {args.out}")
    seconds = sum(demo.duration for demo in demos)
    write_values(args.json, {"episodes": len(demos), "seconds": seconds})


def report(args: Report) -> None:
    """One page from the folders of several runs."""
    if not args.runs:
        raise ValueError("no run: name at least one folder with a report.json")
    reports = [read_report(run) for run in args.runs]
    title = reports[0].title if len(reports) == 1 else args.title
    write_text(args.out, reports_page(title, reports))
    print(f"{args.out}: {', '.join(report.title for report in reports)}")
    values = {
        f"{run.resolve().name}_{m.key}": m.value
        for run, report in zip(args.runs, reports, strict=True)
        for m in report.table
    }
    write_values(args.json, values)
