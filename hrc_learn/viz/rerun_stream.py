"""Send data to Rerun: complete .rrd files, columns instead of single values, and layouts."""

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, Int, UInt8
from PIL import Image

from hrc_learn.geometry import Body, Box, Capsule, MeshFile, MeshPart, read_mesh
from hrc_learn.log import CameraRecording
from hrc_learn.store import new_file
from hrc_learn.viz import palette
from hrc_learn.viz.panels import Curves, Plot, Tab, slug

TIMELINE = "time"
"""Timeline of all data [s]: the viewer shows only one timeline at a time."""

POSE_RATE = 30.0
"""Poses and dots sent per second: more would not be visible."""
_PATH_POINTS = 400


@contextmanager
def rrd_file(
    path: str | os.PathLike[str], title: str, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """A recording stream into a file that appears only when it is complete.

    Args:
        path: The file.
        title: Title of the recording.
        blueprint: Layout; None: a `RunStream` sends layout and title.
    """
    with new_file(Path(path)) as part:
        stream = rr.RecordingStream("hrc_learn")
        # Not `stream.save`: on a full disk it loses data, and its `flush` never returns.
        content = stream.binary_stream()
        try:
            if blueprint is not None:
                # The layout must be active: the viewer in the browser ignores a default layout.
                stream.send_blueprint(blueprint)
                begin(stream, title)
            yield stream
            part.write_bytes(content.read() or b"")
        finally:
            content.read()  # Rerun warns of data that are not read
            stream.disconnect()


def begin(stream: rr.RecordingStream, title: str) -> None:
    """Send the name of a recording and its upward direction."""
    stream.send_recording_name(title)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)


class StaticShapes:
    """Sends static data once, and again only if they changed."""

    def __init__(self, stream: rr.RecordingStream):
        self._stream = stream
        self._sent: dict[str, object] = {}

    def send(self, path: str, *shapes: rr.AsComponents, key: object = None) -> None:
        """Send data to an entity if their key is new or has changed."""
        if path not in self._sent or self._sent[path] != key:
            self._sent[path] = key
            self._stream.log(path, *shapes, static=True)


def seconds(
    time: Float[np.ndarray, " time"], timelines: Sequence[str] = (TIMELINE,)
) -> list[rr.TimeColumn]:
    """Time index for columns that are sampled at these times, on one timeline or several."""
    durations = np.rint(1e9 * time).astype("timedelta64[ns]")
    return [rr.TimeColumn(timeline, duration=durations) for timeline in timelines]


def send_tab(stream: rr.RecordingStream, time: Float[np.ndarray, " time"], tab: Tab) -> None:
    """Send all curves of a tab, which have the same times [s]."""
    for plot in tab.plots:
        for curves in plot.curves:
            send_curves(stream, time, curves)


def send_curves(
    stream: rr.RecordingStream,
    time: Float[np.ndarray, " time"],
    curves: Curves,
    timelines: Sequence[str] = (TIMELINE,),
) -> None:
    """Send curves with their names and colours; NaN interrupts them."""
    stream.log(curves.path, style(curves), static=True)
    send_rows(stream, seconds(time, timelines), curves)


def style(curves: Curves) -> rr.SeriesLines | rr.SeriesPoints:
    """Names, colours and widths of curves."""
    names, colours, sizes = curves.names, curves.colours, [curves.width] * len(curves.names)
    if curves.marks:
        return rr.SeriesPoints(names=names, colors=colours, marker_sizes=sizes)
    return rr.SeriesLines(names=names, colors=colours, widths=sizes)


def send_rows(stream: rr.RecordingStream, index: list[rr.TimeColumn], curves: Curves) -> None:
    """Send the samples of curves on a timeline of any kind."""
    values = np.asarray(curves.values, dtype=np.float64)
    columns = rr.Scalars.columns(scalars=values.ravel())
    stream.send_columns(curves.path, index, columns.partition([values.shape[1]] * len(values)))


def body_path(body: Body) -> str:
    """Entity of a body."""
    return f"world/bodies/{slug(body.name)}"


def send_shapes(stream: rr.RecordingStream, body: Body) -> None:
    """Send the shapes of a body: meshes and named boxes, or else capsules and all boxes."""
    path, plain = body_path(body), body.boxes
    for k, mesh in enumerate(body.meshes):
        for j, part in enumerate(read_mesh(mesh.path)):
            stream.log(f"{path}/mesh{k}_{j}", _drawn(mesh, part), static=True)
    if body.meshes:
        plain = tuple(box for box in body.boxes if box.name)
    elif body.capsules:
        stream.log(f"{path}/capsules", capsules(body.capsules), static=True)
    if plain:
        stream.log(f"{path}/boxes", boxes(plain), static=True)


def _drawn(mesh: MeshFile, part: MeshPart) -> rr.Mesh3D:
    """Part of a mesh at its place on the body."""
    placed = part.placed(mesh)
    return rr.Mesh3D(
        vertex_positions=placed.vertices,
        vertex_normals=placed.normals,
        triangle_indices=placed.faces,
        albedo_factor=placed.colour,
    )


def send_poses(
    stream: rr.RecordingStream,
    time: Float[np.ndarray, " time"],
    body: Body,
    at: Int[np.ndarray, " chosen"],
    timelines: Sequence[str] = (TIMELINE,),
) -> None:
    """Send the pose of a body at the chosen samples."""
    orientation = np.roll(body.orientation[at], -1, axis=-1)  # rerun: x, y, z, w
    poses = rr.Transform3D.columns(translation=body.position[at], quaternion=orientation)
    stream.send_columns(body_path(body), seconds(time[at], timelines), poses)


def send_strips(
    stream: rr.RecordingStream,
    path: str,
    strips: Sequence[Float[np.ndarray, "_ 3"]],
    colour: str,
    radius: float,
) -> None:
    """Send static lines [m], if there are any."""
    if strips:
        colours, thinned = [palette.rgba(colour)], [thin(strip) for strip in strips]
        stream.log(path, rr.LineStrips3D(thinned, radii=radius, colors=colours), static=True)


def send_dot(
    stream: rr.RecordingStream,
    name: str,
    time: Float[np.ndarray, " time"],
    path: Float[np.ndarray, "time 3"],
    colour: str,
) -> None:
    """Send a dot that moves along a path."""
    look = rr.Points3D.from_fields(radii=[0.012], colors=[palette.rgba(colour)])
    stream.log(f"world/now/{name}", look, static=True)
    at = samples(time, POSE_RATE)
    columns = rr.Points3D.columns(positions=path[at])
    stream.send_columns(f"world/now/{name}", seconds(time[at]), columns)


def boxes(shapes: tuple[Box, ...]) -> rr.Boxes3D:
    """Solid boxes."""
    return rr.Boxes3D(
        centers=[s.centre for s in shapes],
        half_sizes=[s.half_size for s in shapes],
        colors=[s.colour for s in shapes],
        labels=[s.name for s in shapes],
        show_labels=False,
        fill_mode=rr.components.FillMode.Solid,
    )


def capsules(shapes: tuple[Capsule, ...]) -> rr.Capsules3D:
    """Solid capsules, moved by transforms: in Rerun, capsules start at the origin, along z."""
    start, end = (np.array([getattr(s, at) for s in shapes]) for at in ("start", "end"))
    axis = end - start
    length = np.linalg.norm(axis, axis=1)
    direction = axis / np.maximum(length, 1e-12)[:, None]
    # A rotation by pi about the bisector of z and the axis maps z to the axis: the quaternion
    # is (0, bisector). The small x component makes x the bisector if z and the axis are
    # opposite.
    half = direction + np.array([1e-9, 0.0, 1.0])
    normal = half / np.linalg.norm(half, axis=1, keepdims=True)
    return rr.Capsules3D(
        lengths=length,
        radii=[s.radius for s in shapes],
        translations=start,
        quaternions=np.concatenate([normal, np.zeros((len(shapes), 1))], axis=1),
        colors=[s.colour for s in shapes],
        fill_mode=rr.components.FillMode.Solid,
    )


_LETTER = 0.011, 0.03
"""Width of a legend's letter relative to the curves, in tabs with one and with two columns."""
_TICKS = 7
"""Steps of an axis from which on the viewer labels every tenth step only."""


def tab_view(tab: Tab, time: Float[np.ndarray, " time"] | None = None) -> rrb.Grid:
    """Layout of one tab.

    Args:
        tab: The tab.
        time: Times of all its values [s]; the plots show the time from the first to the last
            value that is finite and not 0, with legends to its right, and no plot has 0 as its
            only labelled tick. None: values will be added, and the plots show the newest.
    """
    span, plots = None, tab.plots
    if time is not None:
        values = np.hstack([curves.values for plot in plots for curves in plot.curves])
        known = time[(np.isfinite(values) & (values != 0.0)).any(axis=1)]
        if len(known) > 1:
            names = [name for p in plots if p.legend for c in p.curves for name in c.names]
            legend = max(map(len, names), default=0) * _LETTER[min(tab.columns, 2) - 1]
            span = known[0], known[-1] + legend * (known[-1] - known[0])
        plots = [_with_range(plot) for plot in plots]
    return rrb.Grid(
        contents=[plot_view(plot, span) for plot in plots],
        grid_columns=max(1, min(tab.columns, len(tab.plots))),
        name=tab.title,
    )


def _with_range(plot: Plot) -> Plot:
    """Plot with a range in which another tick than 0 has a label.

    The viewer labels powers of ten and, if there is space, their tenths.
    """
    values = np.concatenate([curves.values.ravel() for curves in plot.curves])
    values = values[np.isfinite(values)]
    if plot.range is not None or len(values) == 0 or (extent := np.ptp(values)) == 0.0:
        return plot
    step = 1.05 * 10.0 ** math.ceil(math.log10(extent / _TICKS))
    low, high = values.min(), values.max()
    if max(-low, high) >= step:
        return plot
    return replace(plot, range=(-step if low < 0 else 0.0, step if high > 0 else 0.0))


def plot_view(plot: Plot, span: Sequence[float] | None = None) -> rrb.TimeSeriesView:
    """Layout of one plot, with the first and last time that it shows [s]; None: newest data."""
    ends = [rrb.TimeRangeBoundary.absolute(seconds=t) for t in span or ()]
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"/{curves.path}" for curves in plot.curves],
        name=plot.title,
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(*ends)) if ends else None,
        axis_y=None if plot.range is None else rrb.ScalarAxis(range=plot.range),
        # The newest data are at the right.
        plot_legend=rrb.PlotLegend("RightTop" if ends else "LeftTop", visible=plot.legend),
    )


def dashboard(
    left: Sequence[rrb.Container | rrb.View],
    right: Sequence[rrb.Container | rrb.View],
    *,
    row_shares: tuple[int, ...] = (1,),
    column_shares: tuple[int, ...] = (1, 1),
    timeline: str = TIMELINE,
) -> rrb.Blueprint:
    """Layout of a dashboard: views above one another, with further columns to their right.

    Args:
        left: Views above one another; if there are none, the columns take the whole width.
        right: The columns.
        row_shares: Heights of the views, in proportion.
        column_shares: Widths of all columns, in proportion.
        timeline: Timeline of the views.
    """
    columns = [*right]
    if left:
        columns.insert(0, rrb.Vertical(contents=left, row_shares=row_shares[: len(left)]))
    return rrb.Blueprint(
        rrb.Horizontal(contents=columns, column_shares=column_shares[-len(columns) :]),
        rrb.TimePanel(state="collapsed", timeline=timeline),
        collapse_panels=True,
    )


def send_summary(stream: rr.RecordingStream, markdown: str) -> None:
    """Send the text of the view "/summary"."""
    text = rr.TextDocument(markdown, media_type="text/markdown")
    stream.log("summary", text, static=True)


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Lines of a table."""
    cells = [heads, ["---"] * len(heads), *rows]
    return [f"| {' | '.join(map(str, row))} |" for row in cells]


def frame_view(
    path: Float[np.ndarray, "n 3"],
    *,
    base: bool = True,
    direction: tuple[float, float, float] = (1.05, 0.65, 0.6),
    nearest: float = 0.5,
) -> rrb.EyeControls3D:
    """Viewpoint that shows the whole path, by default from in front of the robot and to its
    left.

    Args:
        path: Points to show [m].
        base: Show the base of the robot as well.
        direction: Vector from the middle of the points to the eye, relative to their extent.
        nearest: Smallest extent [m].
    """
    points = np.concatenate([path, np.zeros((1, 3))]) if base else path
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), nearest)
    return rrb.EyeControls3D(
        position=middle + reach * np.array(direction),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )


def samples(time: Float[np.ndarray, " time"], rate: float) -> Int[np.ndarray, " chosen"]:
    """Indices of about `rate` samples per second, including the first and the last."""
    wanted = np.arange(time[0], time[-1], 1.0 / rate)
    return np.unique(np.append(np.searchsorted(time, wanted), len(time) - 1))


def thin(path: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "m d"]:
    """Path reduced to at most a few hundred points, including both ends."""
    if len(path) <= _PATH_POINTS:
        return path
    return path[np.linspace(0, len(path) - 1, _PATH_POINTS).astype(int)]


_CROSS = 60.0  # half the size of the mark of the target [px]
_ROOT = "world/camera/image"


class CameraStream:
    """Sends the frustum of a camera, its images, and marks over them."""

    def __init__(self, stream: rr.RecordingStream, still: StaticShapes):
        """Send to a recording stream.

        Args:
            stream: Recording stream into a file or to a viewer.
            still: Sender of the static shapes.
        """
        self._stream, self._still, self._images = stream, still, 0

    def send_images(self, camera: CameraRecording) -> None:
        """Send the frustum, and the images that were not sent before."""
        model = camera.model
        place = rr.Transform3D(translation=model.pose[:3, 3], mat3x3=model.pose[:3, :3])
        pinhole = rr.Pinhole(
            image_from_camera=model.matrix,
            resolution=[model.width, model.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25,
            color=palette.rgba(palette.SKY),
        )
        key = (model.pose.tobytes(), model.matrix.tobytes())
        self._still.send("world/camera", place, pinhole, key=key)
        new = camera.images[self._images :]
        if new:
            index, kinds = seconds(camera.image_time[self._images :]), ["image/jpeg"] * len(new)
            images = rr.EncodedImage.columns(blob=[*map(_jpeg, new)], media_type=kinds)
            self._stream.send_columns(_ROOT, index, images)
        self._images += len(new)

    def send_overlays(
        self,
        time: Float[np.ndarray, " time"],
        camera: CameraRecording,
        at: Int[np.ndarray, " chosen"],
        ends: Int[np.ndarray, " ends"],
    ) -> None:
        """Send feature, target and path of the feature.

        Args:
            time: Time of the whole run [s].
            camera: Camera recording of the whole run.
            at: Samples at which the marks are sent.
            ends: Samples at which the path so far is sent.
        """
        crosses = [_cross(pixel) for pixel in camera.target[at]]
        self._send_lines(f"{_ROOT}/target", time[at], crosses, palette.TARGET)
        seen = np.asarray(np.isfinite(camera.feature).all(axis=-1))
        trails = [[thin(camera.feature[: end + 1][seen[: end + 1]])] for end in ends]
        self._send_lines(f"{_ROOT}/path", time[ends], trails, palette.SKY)
        orange = [palette.rgba(palette.ORANGE)]
        # A negative radius is in screen points, independent of the zoom.
        dot = rr.Points2D.from_fields(radii=[-5.0], colors=orange, draw_order=30.0)
        self._still.send(f"{_ROOT}/feature", dot)
        # A sample without points removes the mark while the feature is not seen.
        columns = rr.Points2D.columns(positions=camera.feature[at][seen[at]])
        marks = columns.partition(seen[at].astype(int))
        self._stream.send_columns(f"{_ROOT}/feature", seconds(time[at]), marks)

    def _send_lines(
        self,
        path: str,
        time: Float[np.ndarray, " samples"],
        strips: list[list[Float[np.ndarray, "_ 2"]]],
        colour: str,
    ) -> None:
        """Send lines over the image, any number of them at each sample."""
        colours = [palette.rgba(colour)]
        look = rr.LineStrips2D.from_fields(radii=[-2.0], colors=colours, draw_order=20.0)
        self._still.send(path, look)
        columns = rr.LineStrips2D.columns(strips=[strip for here in strips for strip in here])
        counts = [len(here) for here in strips]
        self._stream.send_columns(path, seconds(time), columns.partition(counts))


def _cross(pixel: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "2 2"]]:
    """Two strokes across a pixel; no strokes if there is no target."""
    if not np.isfinite(pixel).all():
        return []
    strokes = np.array([[[-1, 0], [1, 0]], [[0, -1], [0, 1]]])
    return [*(pixel + _CROSS * strokes)]


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=75)
    return buffer.getvalue()
