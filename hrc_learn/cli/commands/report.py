"""`hrc report`: one page from the folders of several runs."""

from hrc_learn.cli._values import write_json, write_text
from hrc_learn.cli.arguments.run import Report as Args
from hrc_learn.viz.report import read_report, reports_page


def run(args: Args) -> None:
    if not args.runs:
        raise ValueError("no run: name at least one folder with a report.json")
    reports = [read_report(run) for run in args.runs]
    title = reports[0].title if len(reports) == 1 else args.title
    write_text(args.out, reports_page(title, reports))
    print(f"{args.out}: {', '.join(report.title for report in reports)}")
    if args.json is not None:
        values = {
            f"{run.resolve().name}_{m.key}": m.value
            for run, report in zip(args.runs, reports, strict=True)
            for m in report.table
        }
        write_json(args.json, values)
