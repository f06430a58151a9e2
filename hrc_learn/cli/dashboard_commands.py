"""`hrc show` and `hrc report`: Rerun dashboards, and one page that reports several runs."""

import contextlib
import subprocess
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from hrc_learn.cli._run import has_screen, write_values
from hrc_learn.cli.arguments import Report, Show, refuse_given
from hrc_learn.store import write_text
from hrc_learn.viz.evidence import evidence_page
from hrc_learn.viz.report import read_report, reports_page

if TYPE_CHECKING:
    from hrc_learn.learning.demonstration_dashboard import ShownDataset


def show(args: Show) -> int:
    """Open the recordings of a folder, or show the demonstrations of a dataset."""
    if not args.dataset.exists():
        raise FileNotFoundError(f"there is nothing at {args.dataset}")
    if recordings := recordings_in(args.dataset):
        listed = ", ".join(map(str, recordings))
        text = f"is for datasets, but {args.dataset} holds recordings: {listed}."
        refuse_given(args, ["out", "episodes", "robot"], text)
        return _open(recordings, args.web)
    if args.out is not None:
        return _record(args, args.out)
    if args.web or not has_screen():
        return _stream(args)
    with tempfile.TemporaryDirectory(prefix="hrc_show_") as folder:
        recording = Path(folder) / "demonstrations.rrd"
        return _record(args, recording) or _open([recording], args.web)


def recordings_in(path: Path) -> list[Path]:
    """Recordings at a path: the file itself, or those in a folder, `run.rrd` first."""
    if path.is_file():
        return [path]
    return sorted(path.glob("*.rrd"), key=lambda file: (file.stem != "run", file.name))


def _open(recordings: Sequence[Path], web: bool) -> int:
    """Open recordings in Rerun's viewer, or serve them to the browser until Ctrl-C."""
    with contextlib.suppress(KeyboardInterrupt):
        if has_screen() and not web:
            # Started by this interpreter, so that the viewer need not be on PATH.
            command = [sys.executable, "-m", "rerun", *map(str, recordings)]
            return subprocess.run(command, check=False).returncode
        # Imported here: the desktop viewer does not need the web server.
        from hrc_learn.teleoperation.dashboard_page import serve_recordings

        if not web:
            print("no screen: the dashboard is served to the browser (Ctrl-C ends it)")
        with serve_recordings(recordings) as url:
            print(f"Dashboard at {url} (Ctrl-C ends it)", flush=True)
            if has_screen():
                webbrowser.open(url)
            threading.Event().wait()
    return 0


_SHOWN, _SHOWN_FRAMES = 200, 1_000_000
"""Largest number of demonstrations and frames shown by default, limited by the viewer."""
_VIDEO_BYTES = 300_000_000
"""Total size of the images shown, above which the images of further episodes are left out."""


def _record(args: Show, out: Path) -> int:
    """Write the recording of a dataset."""
    # Imported here: `report` needs neither Rerun nor PyTorch.
    from hrc_learn.learning.demonstration_dashboard import record_demonstrations

    out.parent.mkdir(parents=True, exist_ok=True)
    with Console().status(f"Reading {args.dataset}"):
        shown = _shown(args)
        seconds = record_demonstrations(out, shown)
    print(out)
    write_values(args.json, {"episodes": len(shown.demos), "seconds": seconds})
    return 0


def _stream(args: Show) -> int:
    """Serve a dataset to the browser, from its first episode on, until Ctrl-C."""
    from hrc_learn.learning.demonstration_dashboard import (
        demonstration_layout,
        send_demonstrations,
    )
    from hrc_learn.teleoperation.dashboard_page import serve_stream

    shown = _shown(args)
    with contextlib.suppress(KeyboardInterrupt), serve_stream(None) as (stream, url):
        stream.send_blueprint(demonstration_layout(shown))
        print(f"Dashboard at {url} (Ctrl-C ends it)", flush=True)
        if has_screen():
            webbrowser.open(url)
        seconds = sum(demo.duration for demo in send_demonstrations(stream, shown))
        write_values(args.json, {"episodes": len(shown.demos), "seconds": seconds})
        threading.Event().wait()
    return 0


def _shown(args: Show) -> "ShownDataset":
    """Demonstrations of a dataset, prepared for display."""
    from hrc_learn.demos import DatasetError, Demonstration, open_demos
    from hrc_learn.demos.dataset_views import arm_of_dataset
    from hrc_learn.demos.images import ImageReader, camera_images
    from hrc_learn.demos.videos import CameraImages
    from hrc_learn.learning.demonstration_dashboard import ShownDataset

    source = open_demos(args.dataset, episodes=args.episodes or None)
    demos = source
    if not args.episodes:
        usual = sorted(source.lengths)[len(source) // 2]
        demos = source.spread(min(_SHOWN, max(1, _SHOWN_FRAMES // usual)))
    try:
        arm = arm_of_dataset(source, args.robot)
    except DatasetError as error:
        if args.robot:
            raise
        arm = None
        print(f"no arm is drawn: {error}")
    reader = ImageReader(source.folder)
    left = _VIDEO_BYTES

    def images(demo: Demonstration) -> dict[str, CameraImages]:
        nonlocal left
        found: dict[str, CameraImages] = {}
        for name, camera in camera_images(reader, demo) if left > 0 else ():
            if isinstance(camera, DatasetError):
                print(f"left out: {camera}")
            else:
                found[name] = camera
                left -= sum(map(len, camera.samples))
        if left <= 0 and found:
            print(
                f"left out: images after episode {demo.episode}, which would need more than "
                f"{_VIDEO_BYTES // 1_000_000} MB (--episodes selects others)"
            )
        return found

    chosen = f"{len(demos)} of {len(source)}" if len(demos) < len(source) else len(source)
    print(
        f"{chosen} demonstrations" + " (--episodes selects others)" * (len(demos) < len(source))
    )
    return ShownDataset(
        title=f"Demonstrations in {args.dataset.resolve().name}",
        demos=demos,
        arm=arm,
        units=source.units,
        images=images,
        cameras=[key.removeprefix("observation.images.") for key in reader.cameras],
        notes=source.notes,
    )


def report(args: Report) -> None:
    """Write the reports of several runs to one page."""
    reports = [read_report(run) for run in args.runs]
    title = reports[0].title if len(reports) == 1 else "Runs"
    page = evidence_page(reports) if args.evidence else reports_page(title, reports)
    write_text(args.out, page)
    print(f"{args.out}: {', '.join(report.title for report in reports)}")
    names = [run.resolve().name for run in args.runs]
    values = {}
    for number, (name, report) in enumerate(zip(names, reports, strict=True), start=1):
        # Numbers on the page distinguish runs in folders of the same name.
        own = name if names.count(name) == 1 else f"{name}_{number}"
        values |= {f"{own}_{m.key}": m.value for m in report.table}
    write_values(args.json, values)
