"""A run as one Rerun recording: the robot in 3D, what its camera saw, and every curve."""

import os
from io import BytesIO

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, UInt8
from PIL import Image

from . import palette
from .panels import run_tabs
from .recording import CameraRecording, RunRecording
from .rerun_file import (
    boxes,
    look_at_all,
    rrd_file,
    samples,
    seconds,
    send_body,
    send_curves,
    tab_view,
    thin,
)

_POSE_RATE = 30.0  # robot poses sent a second
_PATH_RATE = 6.0  # times a second at which the growing path is sent anew
_CROSS = 60.0  # half the size of the mark of the target [px]


def record_run(
    path: str | os.PathLike[str], run: RunRecording, *, image_quality: int = 75
) -> None:
    """Write a run as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        run: What happened. Panels without data are left out.
        image_quality: Of the JPEG images, 1 to 95.
    """
    tabs = run_tabs(run)
    with rrd_file(path, run.title, _blueprint(run)) as stream:
        _send_scene(stream, run)
        _send_motion(stream, run)
        if run.camera is not None:
            _send_camera(stream, run.time, run.camera, image_quality)
        for tab in tabs:
            for plot in tab.plots:
                for curves in plot.curves:
                    send_curves(stream, run.time, curves)
        if run.phases:
            _send_phases(stream, run)


def _send_scene(stream: rr.RecordingStream, run: RunRecording) -> None:
    if run.boxes:
        stream.log("world/scene", boxes(run.boxes), static=True)
    if run.region is not None:
        region = rr.Boxes3D(
            centers=[run.region.centre],
            half_sizes=[run.region.half_size],
            colors=[palette.rgba(palette.TARGET)],
            radii=[0.002],
            labels=[run.region.name or "region"],
            show_labels=False,
        )
        stream.log("world/region", region, static=True)
    for name, line, colour, radius in (
        ("demonstration", run.demo_path, palette.DEMO, 0.006),
        ("plan", run.plan_path, palette.ORANGE, 0.005),
    ):
        if line is not None:
            strip = rr.LineStrips3D([thin(line)], radii=[radius], colors=[palette.rgba(colour)])
            stream.log(f"world/paths/{name}", strip, static=True)


def _send_motion(stream: rr.RecordingStream, run: RunRecording) -> None:
    at = samples(run.time, _POSE_RATE)
    for body in run.bodies:
        send_body(stream, run.time, body, at)
    style = rr.LineStrips3D.from_fields(
        radii=[0.003], colors=[palette.rgba(palette.RUN_ON_DARK)]
    )
    stream.log("world/paths/run", style, static=True)
    ends = samples(run.time, _PATH_RATE)
    strips = [thin(run.position[: end + 1]) for end in ends]
    stream.send_columns(
        "world/paths/run", seconds(run.time[ends]), rr.LineStrips3D.columns(strips=strips)
    )


def _send_camera(
    stream: rr.RecordingStream,
    time: Float[np.ndarray, " time"],
    camera: CameraRecording,
    quality: int,
) -> None:
    model = camera.model
    place = rr.Transform3D(translation=model.pose[:3, 3], mat3x3=model.pose[:3, :3])
    pinhole = rr.Pinhole(
        image_from_camera=model.matrix,
        resolution=[model.width, model.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.25,
        color=palette.rgba(palette.SKY),
    )
    stream.log("world/camera", place, pinhole, static=True)
    if camera.images:
        stream.send_columns(
            "world/camera/image",
            seconds(camera.image_time),
            rr.EncodedImage.columns(
                blob=[_jpeg(image, quality) for image in camera.images],
                media_type=["image/jpeg"] * len(camera.images),
            ),
        )
    _send_overlays(stream, time, camera)


def _send_overlays(
    stream: rr.RecordingStream, time: Float[np.ndarray, " time"], camera: CameraRecording
) -> None:
    root = "world/camera/image"
    at = samples(time, _POSE_RATE)
    crosses = [_cross(pixel) for pixel in camera.target[at]]
    _send_lines(stream, f"{root}/target", time[at], crosses, palette.TARGET)
    seen = np.asarray(np.isfinite(camera.feature).all(axis=-1))
    ends = samples(time, _PATH_RATE)
    trails = [[thin(camera.feature[: end + 1][seen[: end + 1]])] for end in ends]
    _send_lines(stream, f"{root}/path", time[ends], trails, palette.SKY)

    style = rr.Points2D.from_fields(
        radii=[-5.0],  # negative: in points of the screen, whatever the zoom
        colors=[palette.rgba(palette.ORANGE)],
        draw_order=30.0,
    )
    stream.log(f"{root}/feature", style, static=True)
    # A sample without points takes the mark away while the feature is not seen.
    columns = rr.Points2D.columns(positions=camera.feature[at][seen[at]])
    stream.send_columns(
        f"{root}/feature", seconds(time[at]), columns.partition(seen[at].astype(int))
    )


def _send_lines(
    stream: rr.RecordingStream,
    path: str,
    time: Float[np.ndarray, " samples"],
    strips: list[list[Float[np.ndarray, "_ 2"]]],
    colour: str,
) -> None:
    """Lines over the image, any number of them at each sample."""
    style = rr.LineStrips2D.from_fields(
        radii=[-2.0], colors=[palette.rgba(colour)], draw_order=20.0
    )
    stream.log(path, style, static=True)
    columns = rr.LineStrips2D.columns(strips=[strip for here in strips for strip in here])
    stream.send_columns(path, seconds(time), columns.partition([len(here) for here in strips]))


def _cross(pixel: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "2 2"]]:
    """Two strokes across a pixel; none where there is no target."""
    if not np.isfinite(pixel).all():
        return []
    return [
        pixel + _CROSS * np.array([[-1, 0], [1, 0]]),
        pixel + _CROSS * np.array([[0, -1], [0, 1]]),
    ]


def _send_phases(stream: rr.RecordingStream, run: RunRecording) -> None:
    when = seconds(np.array([phase.time for phase in run.phases], dtype=float))
    # The viewer's own column of times is too narrow for decimals.
    texts = [f"{phase.time:.1f} s: {phase.text}" for phase in run.phases]
    levels = ["INFO"] * len(texts)
    stream.send_columns("phases", when, rr.TextLog.columns(text=texts, level=levels))


def _blueprint(run: RunRecording) -> rrb.Blueprint:
    scene = rrb.Spatial3DView(
        origin="/world",
        contents=["+ /world/**", "- /world/camera/image/**"],
        name="Robot: path of the run (blue), demonstration (grey), plan (orange)",
        eye_controls=look_at_all(_sights(run)),
    )
    left: list[rrb.View] = [scene]
    if run.camera is not None:
        left.append(
            rrb.Spatial2DView(
                origin="/world/camera/image",
                name="Camera: feature (orange dot), target (green cross), path (blue) [px]",
                contents=["$origin/**"],
            )
        )
    tabs = [tab_view(tab) for tab in run_tabs(run)]
    right: list[rrb.Container | rrb.View] = [rrb.Tabs(contents=tabs, active_tab=0)]
    if run.phases:
        right.append(rrb.TextLogView(origin="/phases", name="Phases of the task"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(contents=left, row_shares=[3, 2][: len(left)]),
            rrb.Vertical(contents=right, row_shares=[5, 1][: len(right)]),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="time"),
        collapse_panels=True,
    )


def _sights(run: RunRecording) -> Float[np.ndarray, "n 3"]:
    """What the first look at the scene should not miss: the path and the camera."""
    eyes = [] if run.camera is None else [run.camera.model.pose[None, :3, 3]]
    return np.concatenate([run.position, *eyes])


def _jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
