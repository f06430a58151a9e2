"""`hrc show`, `hrc report`: dashboards in Rerun, and runs on a page."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments.dataset import Show
from hrc_learn.cli.arguments.run import Report
from hrc_learn.store import write_text
from hrc_learn.viz.report import read_report, reports_page


def show(args: Show) -> int:
    """Open recordings, or make one of the demonstrations of a dataset."""
    if not args.path.exists():
        raise FileNotFoundError(f"{args.path} is not there.")
    if recordings := recordings_in(args.path):
        if args.out is not None:
            raise ValueError(
                f"--out is for a dataset, but {args.path} is recorded already: "
                f"{', '.join(map(str, recordings))}."
            )
        return _open(recordings, args.web)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        _record_demonstrations(args, args.out)
        print(args.out)
        return 0
    with tempfile.TemporaryDirectory(prefix="hrc_show_") as folder:
        recording = Path(folder) / "demonstrations.rrd"
        _record_demonstrations(args, recording)
        return _open([recording], args.web)


def recordings_in(path: Path) -> list[Path]:
    """The recording that a path is, or those in a folder; that of the run itself first."""
    if path.is_file():
        return [path]
    return sorted(path.glob("*.rrd"), key=lambda file: (file.stem != "run", file.name))


def viewer_command(recordings: Sequence[Path], web: bool) -> list[str]:
    """The command line of the viewer, by the Python that this is: no path has to hold it.

    Args:
        recordings: To open.
        web: In the browser.
    """
    # On this machine alone: the viewer would listen to all networks by default.
    serving = ["--serve-web", "--bind", "127.0.0.1"] if web else []
    return [sys.executable, "-m", "rerun", *serving, *map(str, recordings)]


def _open(recordings: Sequence[Path], web: bool) -> int:
    screen = not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    if not screen and not web:
        print("no screen here: the dashboard is served to the browser (Ctrl-C ends it)")
    try:
        return subprocess.run(
            viewer_command(recordings, web or not screen), check=False
        ).returncode
    except KeyboardInterrupt:
        return 0


_SHOWN, _SHOWN_FRAMES = 200, 1_000_000
"""Demonstrations shown of a dataset, unless they are named, and their frames: more are neither
told apart by eye nor held by a viewer."""


_ALONE = 8
"""Demonstrations with a tab of their own, and with images in it."""


def _record_demonstrations(args: Show, out: Path) -> None:
    # Rerun and PyTorch, which a report does without.
    from hrc_learn.demos import open_demos, thumbnails
    from hrc_learn.learning.channels import demonstrations_recording
    from hrc_learn.viz.learning_dashboards import record_demonstrations

    source = open_demos(args.path, episodes=args.episodes or None, units=args.units or None)
    shown = source
    if not args.episodes:
        usual = sorted(source.lengths)[len(source) // 2]
        shown = source.spread(min(_SHOWN, max(1, _SHOWN_FRAMES // usual)))
    demos = shown.load()
    title = f"Demonstrations in {args.path.resolve().name}"
    images, missing = thumbnails(args.path, demos[:_ALONE])
    record_demonstrations(out, demonstrations_recording(demos, title, images), most=_ALONE)
    for said in missing:
        print(f"left out: {said}")
    if len(demos) < len(source):
        print(f"of {len(source)}, spread over them (--episodes names others): ", end="")
    print(f"{len(demos)} demonstrations")
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
