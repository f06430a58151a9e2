"""`hrc show` and `hrc report`: Rerun dashboards, and one page that reports several runs."""

import subprocess
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from hrc_learn.cli._run import has_screen, write_values
from hrc_learn.cli.arguments import Report, Show
from hrc_learn.store import write_text
from hrc_learn.viz.report import read_report, reports_page


def show(args: Show) -> int:
    """Open the recordings of a folder, or record the demonstrations of a dataset."""
    if not args.dataset.exists():
        raise FileNotFoundError(f"there is nothing at {args.dataset}")
    if recordings := recordings_in(args.dataset):
        if args.out is not None:
            raise ValueError(
                f"--out records a dataset, but {args.dataset} holds recordings: "
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
    """Recordings at a path: the file itself, or those in a folder, `run.rrd` first."""
    if path.is_file():
        return [path]
    return sorted(path.glob("*.rrd"), key=lambda file: (file.stem != "run", file.name))


def _open(recordings: Sequence[Path], web: bool) -> int:
    """Open recordings in Rerun's viewer, or serve them to the browser until Ctrl-C."""
    screen = has_screen()
    if not screen and not web:
        print("no screen: the dashboard is served to the browser (Ctrl-C ends it)")
    try:
        if web or not screen:
            return _serve(recordings)
        # Started by this interpreter, so that the viewer need not be on PATH.
        command = [sys.executable, "-m", "rerun", *map(str, recordings)]
        return subprocess.run(command, check=False).returncode
    except KeyboardInterrupt:
        return 0


def _serve(recordings: Sequence[Path]) -> int:
    # Imported here: the desktop viewer does not need the web server.
    from hrc_learn.teleoperation.dashboard_page import serve_recordings

    with serve_recordings(recordings) as url:
        print(f"Dashboard at {url} (Ctrl-C ends it)", flush=True)
        if has_screen():
            webbrowser.open(url)
        threading.Event().wait()
    return 0


_SHOWN, _SHOWN_FRAMES = 200, 1_000_000
"""Largest number of demonstrations and frames shown by default, limited by the viewer."""
_WITH_TAB = 8
"""Largest number of demonstrations that get their own tab and images."""


def _record_demonstrations(args: Show, out: Path) -> None:
    # Imported here: `report` needs neither Rerun nor PyTorch.
    from hrc_learn.demos import open_demos, thumbnails
    from hrc_learn.learning.demonstration_dashboard import record_demonstrations

    source = open_demos(args.dataset, episodes=args.episodes or None)
    shown = source
    if not args.episodes:
        usual = sorted(source.lengths)[len(source) // 2]
        shown = source.spread(min(_SHOWN, max(1, _SHOWN_FRAMES // usual)))
    demos = shown.load()
    title = f"Demonstrations in {args.dataset.resolve().name}"
    images, missing = thumbnails(source.folder, demos[:_WITH_TAB])
    record_demonstrations(out, demos, title, images, most=_WITH_TAB)
    for image in missing:
        print(f"left out: {image}")
    if len(demos) < len(source):
        print(f"{len(demos)} of {len(source)} demonstrations (--episodes selects others)")
    else:
        print(f"{len(demos)} demonstrations")
    seconds = sum(demo.duration for demo in demos)
    write_values(args.json, {"episodes": len(demos), "seconds": seconds})


def report(args: Report) -> None:
    """Write the reports of several runs to one page."""
    if not args.runs:
        raise ValueError("name at least one folder with a report.json")
    reports = [read_report(run) for run in args.runs]
    title = reports[0].title if len(reports) == 1 else "Runs"
    write_text(args.out, reports_page(title, reports))
    print(f"{args.out}: {', '.join(report.title for report in reports)}")
    values = {
        f"{run.resolve().name}_{m.key}": m.value
        for run, report in zip(args.runs, reports, strict=True)
        for m in report.table
    }
    write_values(args.json, values)
