"""Rerun recording of a run: the robot in 3D, its camera images, and all curves.

The same dashboard shows a finished run from a file, and a running one in a browser.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Bool, Float, Int, Shaped
from rerun.blueprint.datatypes import TimelineColumn

from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.viz import palette
from hrc_learn.viz.panels import Plot, run_tabs, several
from hrc_learn.viz.rerun_stream import (
    POSE_RATE,
    TIMELINE,
    CameraStream,
    StaticShapes,
    begin,
    boxes,
    dashboard,
    frame_view,
    plot_view,
    rrd_file,
    samples,
    seconds,
    send_poses,
    send_rows,
    send_shapes,
    style,
    tab_view,
    thin,
)


def run_layout(run: RunRecording, finished: bool = True) -> rrb.Blueprint:
    """Layout with the robot and its camera on the left and tabs of curves on the right.

    Args:
        run: The run.
        finished: Plots show all data of their tab, not only the newest data.
    """
    left: list[rrb.View] = [
        rrb.Spatial3DView(
            origin="/world",
            contents=["+ /world/**", "- /world/camera/image/**"],
            name="Robot: path of the run (blue), demonstration (grey), plan (orange), "
            "region, gap to the worker (red)",
            # Show only the path: if a distant camera were in view, the robot would be small.
            eye_controls=frame_view(run.position),
        )
    ]
    if run.camera is not None:
        left.append(
            rrb.Spatial2DView(
                origin="/world/camera/image",
                name="Camera: feature (orange dot), target (green cross), path (blue) [px]",
                contents=["$origin/**"],
            )
        )
    views = [tab_view(tab, run.time if finished else None) for tab in run_tabs(run, finished)]
    right: list[rrb.Container | rrb.View] = [rrb.Tabs(contents=views, active_tab=0)]
    if run.phases:
        # The text contains the time: a column of times would only make the text narrower.
        hidden = TimelineColumn(TIMELINE, visible=False)
        text = rrb.TextLogColumns(timeline_columns=hidden, text_log_columns=["Body"])
        right.append(rrb.TextLogView(origin="/phases", name="Phases of the task", columns=text))
    tabs_and_text = rrb.Vertical(contents=right, row_shares=[5, 1][: len(right)])
    return dashboard(left, [tabs_and_text], row_shares=(3, 2))


_PATH_RATE = 6.0  # rate at which the growing path is sent again [1/s]


class RunStream:
    """Sends new data of a run, and its layout.

    One call sends a finished run; repeated calls with longer recordings send a run in progress.
    The result is the same.
    """

    def __init__(self, stream: rr.RecordingStream, finished: bool = False):
        """Send to a recording stream.

        Args:
            stream: Recording stream into a file or to a viewer.
            finished: The run is over, so that plots show all of it.
        """
        self._stream, self._still, self._finished = stream, StaticShapes(stream), finished
        self._camera = CameraStream(stream, self._still)
        self._rows = self._phases = self._remarks = 0
        self._outline: tuple | None = None
        self._drawn: set[str] = set()

    def send(self, run: RunRecording) -> None:
        """Send the data of a run that were not sent before.

        Args:
            run: The same run as before, as long or longer.
        """
        plots = [(tab.title, [plot.title for plot in tab.plots]) for tab in run_tabs(run)]
        outline = (plots, run.camera is not None, bool(run.phases))
        if self._outline is None:
            begin(self._stream, run.title)
        if outline != self._outline:
            self._stream.send_blueprint(run_layout(run, self._finished))
            self._outline = outline
        self._send_scene(run)
        if len(run.time) > self._rows:
            self._send_rows(run, self._rows)
            self._rows = len(run.time)
        if run.camera is not None:
            self._camera.send_images(run.camera)
        self._send_phases(run)

    def _send_scene(self, run: RunRecording) -> None:
        if run.boxes:
            self._still.send("world/scene", boxes(run.boxes), key=run.boxes)
        if run.region is not None:
            region = rr.Boxes3D(
                centers=[run.region.centre],
                half_sizes=[run.region.half_size],
                colors=[palette.rgba(palette.TARGET)],
                radii=[0.002],
                labels=[run.region.name or "region"],
                show_labels=False,
            )
            self._still.send("world/region", region, key=run.region)
        for name, line, colour, radius in (
            ("demonstration", run.demo_path, palette.DEMO, 0.006),
            ("plan", run.plan_path, palette.ORANGE, 0.005),
        ):
            if line is not None:
                colours = [palette.rgba(colour)]
                strip = rr.LineStrips3D([thin(line)], radii=[radius], colors=colours)
                self._still.send(f"world/paths/{name}", strip, key=line.tobytes())
        for body in run.bodies:
            if body.name not in self._drawn:
                self._drawn.add(body.name)
                send_shapes(self._stream, body)

    def _send_rows(self, run: RunRecording, first: int) -> None:
        time = run.time
        at = first + samples(time[first:], POSE_RATE)
        ends = first + samples(time[first:], _PATH_RATE)
        for body in run.bodies:
            send_poses(self._stream, time, body, at)
        self._send_path(run, ends)
        for name, pairs, colour, radius in (
            ("worker_distance", run.worker_nearest, palette.LIMIT, 0.004),
            ("push", run.push, palette.PERSON, 0.012),
        ):
            if pairs is not None:
                look = rr.Arrows3D.from_fields(radii=[radius], colors=[palette.rgba(colour)])
                self._still.send(f"world/{name}", look)
                self._send_arrows(f"world/{name}", time[at], pairs[at])
        if run.active_region is not None:
            drawn = np.zeros(len(time), bool) if run.drawn is None else run.drawn
            self._send_region(time[at], run.active_region[at], drawn[at])
        if run.camera is not None:
            self._camera.send_overlays(time, run.camera, at, ends)
        # The overview shows curves of other tabs: each curve is sent once.
        plots = [plot for tab in run_tabs(run, self._finished) for plot in tab.plots]
        for curves in {c.path: c for plot in plots for c in plot.curves}.values():
            self._still.send(curves.path, style(curves), key=curves.names)
            new = replace(curves, values=curves.values[first:])
            send_rows(self._stream, seconds(time[first:]), new)

    def _send_path(self, run: RunRecording, ends: Int[np.ndarray, " ends"]) -> None:
        path, colours = "world/paths/run", [palette.rgba(palette.RUN_ON_DARK)]
        self._still.send(path, rr.LineStrips3D.from_fields(radii=[0.003], colors=colours))
        strips = [thin(run.position[: end + 1]) for end in ends]
        columns = rr.LineStrips3D.columns(strips=strips)
        self._stream.send_columns(path, seconds(run.time[ends]), columns)

    def _send_region(
        self,
        time: Float[np.ndarray, " samples"],
        region: Float[np.ndarray, "samples 6"],
        drawn: Bool[np.ndarray, " samples"],
    ) -> None:
        """Send the controller's region, with another colour if a person has drawn it."""
        path, known = "world/active_region", np.isfinite(region).all(axis=1)
        self._still.send(path, rr.Boxes3D.from_fields(radii=[0.002]))
        colours = [palette.rgba(palette.PERSON if d else palette.TARGET) for d in drawn[known]]
        columns = rr.Boxes3D.columns(
            centers=region[known, :3], half_sizes=region[known, 3:], colors=colours
        )
        # A step without a region removes the box.
        counts = known.astype(int)
        self._stream.send_columns(path, seconds(time), columns.partition(counts))

    def _send_arrows(
        self,
        path: str,
        time: Float[np.ndarray, " samples"],
        pairs: Float[np.ndarray, "samples 2 3"],
    ) -> None:
        """Send arrows between pairs of points, where these are known."""
        known = np.isfinite(pairs).all(axis=(1, 2))
        start, end = pairs[known].swapaxes(0, 1)
        columns = rr.Arrows3D.columns(origins=start, vectors=end - start)
        self._stream.send_columns(path, seconds(time), columns.partition(known.astype(int)))

    def _send_phases(self, run: RunRecording) -> None:
        new = (*run.phases[self._phases :], *run.remarks[self._remarks :])
        self._phases, self._remarks = len(run.phases), len(run.remarks)
        if new:
            when = seconds(np.array([phase.time for phase in new], dtype=float))
            # The viewer's own column of times is too narrow for decimals.
            texts = [f"{phase.time:.1f} s: {phase.text}" for phase in new]
            columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
            self._stream.send_columns("phases", when, columns)


def record_run(path: str | os.PathLike[str], run: RunRecording) -> None:
    """Write a run as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        run: The run. Panels without data are left out.
    """
    with rrd_file(path, run.title) as stream:
        RunStream(stream, finished=True).send(run)


class LogStream:
    """Sends the chosen columns of a log, and a grid of plots that shows them.

    `stream` is any recording stream: `stream.serve_grpc()`, `stream.spawn()` or
    `stream.connect_grpc()` show it in a viewer; `stream.save()` writes it to a file.
    """

    def __init__(self, log: LoggedSteps, stream: rr.RecordingStream, columns: Sequence[str]):
        """Send the layout.

        Args:
            log: Log of a running loop; its column "time" holds the time [s].
            stream: Recording stream.
            columns: Columns of the log to send.
        """
        self._log, self._stream, self._still = log, stream, StaticShapes(stream)
        self._columns, self._rows = tuple(columns), 0
        views = [plot_view(_plot(name, np.empty((0, 1)))) for name in self._columns]
        stream.send_blueprint(rrb.Blueprint(rrb.Grid(contents=views), collapse_panels=True))

    def send(self) -> None:
        """Send the new rows."""
        for rows in self._log.blocks(self._rows):
            if len(rows):
                for name in self._columns:
                    values = rows[name].reshape(len(rows), -1)
                    for curves in _plot(name, values).curves:
                        self._still.send(curves.path, style(curves))
                        send_rows(self._stream, seconds(rows["time"]), curves)
                self._rows += len(rows)


def _plot(name: str, values: Shaped[np.ndarray, "rows curves"]) -> Plot:
    count = values.shape[1]
    names = [name] if count == 1 else [f"{name} {i + 1}" for i in range(count)]
    curves = several(f"live/{name}", names, values.astype(float))
    return Plot(title=name, curves=(curves,), legend=True)


_DUTY_CYCLE = 0.2  # largest fraction of the thread's time spent on sending


@contextmanager
def live_sender(send: Callable[[], object], *, period: float = 0.25) -> Iterator[None]:
    """Call a function a few times a second in a thread, and once more at the end.

    An error of the function ends the thread and is raised at the end of the `with` block.

        log = StepLog()
        with live_sender(LogStream(log, stream, ["joint_position", "feature"]).send):
            ...  # the loop, which appends to `log`

    Args:
        send: Sends the new data.
        period: Time between two calls [s]; longer if sending would take more than a fifth of
            the time.
    """
    closing, errors = threading.Event(), []

    def run() -> None:
        pause = period
        try:
            while not closing.wait(pause):
                began = time.monotonic()
                send()
                pause = max(period, (time.monotonic() - began) * (1 / _DUTY_CYCLE - 1))
            send()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=run, name="live_sender", daemon=True)
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join()
    if errors:
        raise errors[0]


@contextmanager
def live_dashboard(
    stream: rr.RecordingStream,
    snapshot: Callable[[], RunRecording | None],
    *,
    period: float = 0.25,
) -> Iterator[None]:
    """Show a run in progress, in the layout of `record_run`.

    Args:
        stream: Recording stream; `teleoperation.dashboard_page.serve_stream` makes one for a
            browser.
        snapshot: Returns the run so far, or None before its start; called by another thread.
        period: Time between two updates [s].
    """
    sender = RunStream(stream)

    def send() -> None:
        if (run := snapshot()) is not None:
            sender.send(run)

    with live_sender(send, period=period):
        yield
    stream.flush()
