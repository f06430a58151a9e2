"""Sending a run to Rerun, all at once or as it grows."""

from dataclasses import replace

import numpy as np
import rerun as rr
from jaxtyping import Int

from . import palette
from .camera_stream import CameraStream
from .panels import run_tabs
from .recording import RunRecording
from .rerun_file import (
    StillThings,
    boxes,
    samples,
    seconds,
    send_poses,
    send_shapes,
    send_values,
    style,
    thin,
)
from .run_layout import run_layout, run_outline

_POSE_RATE = 30.0  # robot poses sent a second
_PATH_RATE = 6.0  # times a second at which the growing path is sent anew


class RunStream:
    """Sends what is new in a run, and the layout that shows it.

    One call sends a finished run; one call every now and then, with ever longer recordings of
    it, sends one that still goes on. What arrives is the same.
    """

    def __init__(self, stream: rr.RecordingStream, *, image_quality: int = 75):
        """Send to a recording stream.

        Args:
            stream: Into a file or to a viewer.
            image_quality: Of the JPEG images, 1 to 95.
        """
        self._stream, self._still = stream, StillThings(stream)
        self._camera = CameraStream(stream, self._still, image_quality)
        self._rows = self._phases = 0
        self._outline: tuple | None = None

    def send(self, run: RunRecording) -> None:
        """Send all of a run that was not sent before.

        Args:
            run: The same run as before, as long or longer.
        """
        outline = run_outline(run)
        if outline != self._outline:
            self._stream.send_blueprint(run_layout(run))
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
            self._still.send("world/scene", run.boxes, lambda: boxes(run.boxes))
        if run.region is not None:
            region = rr.Boxes3D(
                centers=[run.region.centre],
                half_sizes=[run.region.half_size],
                colors=[palette.rgba(palette.TARGET)],
                radii=[0.002],
                labels=[run.region.name or "region"],
                show_labels=False,
            )
            self._still.send("world/region", run.region, lambda: region)
        for name, line, colour, radius in (
            ("demonstration", run.demo_path, palette.DEMO, 0.006),
            ("plan", run.plan_path, palette.ORANGE, 0.005),
        ):
            if line is not None:
                strip = rr.LineStrips3D(
                    [thin(line)], radii=[radius], colors=[palette.rgba(colour)]
                )
                self._still.send(f"world/paths/{name}", line.tobytes(), lambda s=strip: s)
        for body in run.bodies:
            send_shapes(self._still, body)

    def _send_rows(self, run: RunRecording, first: int) -> None:
        time = run.time
        at = first + samples(time[first:], _POSE_RATE)
        ends = first + samples(time[first:], _PATH_RATE)
        for body in run.bodies:
            send_poses(self._stream, time, body, at)
        self._send_path(run, ends)
        if run.camera is not None:
            self._camera.send_overlays(time, run.camera, at, ends)
        for tab in run_tabs(run):
            for plot in tab.plots:
                for curves in plot.curves:
                    self._still.send(curves.path, curves.names, lambda c=curves: style(c))
                    new = replace(curves, values=curves.values[first:])
                    send_values(self._stream, time[first:], new)

    def _send_path(self, run: RunRecording, ends: Int[np.ndarray, " ends"]) -> None:
        path, colours = "world/paths/run", [palette.rgba(palette.RUN_ON_DARK)]
        self._still.send(
            path, None, lambda: rr.LineStrips3D.from_fields(radii=[0.003], colors=colours)
        )
        strips = [thin(run.position[: end + 1]) for end in ends]
        columns = rr.LineStrips3D.columns(strips=strips)
        self._stream.send_columns(path, seconds(run.time[ends]), columns)

    def _send_phases(self, run: RunRecording) -> None:
        new = run.phases[self._phases :]
        self._phases += len(new)
        if new:
            when = seconds(np.array([phase.time for phase in new], dtype=float))
            # The viewer's own column of times is too narrow for decimals.
            texts = [f"{phase.time:.1f} s: {phase.text}" for phase in new]
            levels = ["INFO"] * len(texts)
            self._stream.send_columns(
                "phases", when, rr.TextLog.columns(text=texts, level=levels)
            )
