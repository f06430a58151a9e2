"""Films of runs: captions on the pictures, drawings without OpenGL, and the MP4 file."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from hrc_learn.geometry import Box, quaternion
from hrc_learn.geometry.shapes import Line
from hrc_learn.log import CameraRecording, RunRecording
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette

Picture = UInt8[np.ndarray, "height width 3"]

_BAR = 36  # height of the line of text below [px]
_TEXT, _SMALL = 17, 13  # sizes of text [px]
_MARGIN = 10  # [px]
_INSET = 0.27  # width of the camera's image relative to the picture
_SHADE = (24, 26, 30, 200)
_SKY = (228, 233, 238)
_OUTLINE = 0.35  # brightness of outlines

# With these settings, a film of 16 s at 720 x 450 px takes 0.3 MB, so that a report with it can
# be mailed.
_CODEC = {"preset": "veryfast", "crf": "27"}


def film_mp4(pictures: Iterable[Picture], rate: float) -> bytes:
    """An MP4 file (H.264) that browsers play.

    Args:
        pictures: At least one RGB image; width and height are even, and the same for all.
        rate: Pictures per second [1/s].
    """
    import av

    stream = None
    # Write to a file, not to memory: its index can then be moved to the front, so that a
    # browser can play the film while loading it.
    with TemporaryDirectory(prefix="hrc_film_") as folder:
        path = Path(folder) / "film.mp4"
        with av.open(path, "w", options={"movflags": "+faststart"}) as container:
            for picture in pictures:
                if stream is None:
                    height, width = picture.shape[:2]
                    assert height % 2 == width % 2 == 0, "chroma is halved"
                    exact = Fraction(rate).limit_denominator(1001)
                    stream: Any = container.add_stream("libx264", rate=exact, options=_CODEC)
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                content = np.ascontiguousarray(picture)
                frame = av.VideoFrame.from_ndarray(content, format="rgb24")
                container.mux(stream.encode(frame))
            assert stream is not None, "a film needs a picture"
            container.mux(stream.encode())
        return path.read_bytes()


def annotated(
    picture: Picture,
    text: str,
    clock: str,
    labels: Sequence[tuple[str, str]] = (),
    inset: UInt8[np.ndarray, "inset_height inset_width 3"] | None = None,
) -> Picture:
    """Picture with caption, time, legend and the image of the camera.

    Args:
        picture: RGB image.
        text: Caption below the picture.
        clock: Time, to the right of the caption.
        labels: Names and colours ("#RRGGBB") of the legend, at the top left.
        inset: Image at the bottom right, above the caption.
    """
    image = Image.fromarray(picture)
    width, height = image.size
    draw = ImageDraw.Draw(image, "RGBA")
    draw.rectangle((0, height - _BAR, width, height), fill=_SHADE)
    middle = height - _BAR // 2
    draw.text((_MARGIN, middle), text, font=_font(_TEXT), fill="white", anchor="lm")
    draw.text((width - _MARGIN, middle), clock, font=_font(_TEXT), fill="white", anchor="rm")
    for row, (name, colour) in enumerate(labels):
        y = _MARGIN + row * (_SMALL + 9)
        length = draw.textlength(name, font=_font(_SMALL))
        draw.rectangle((_MARGIN, y, _MARGIN + length + 30, y + _SMALL + 6), fill=_SHADE)
        draw.rectangle((_MARGIN + 6, y + 6, _MARGIN + 18, y + 13), fill=colour)
        draw.text((_MARGIN + 24, y + 2), name, font=_font(_SMALL), fill="white")
    if inset is not None:
        small = Image.fromarray(inset)
        left = width - small.width - _MARGIN
        top = height - _BAR - small.height - _MARGIN
        frame = left - 2, top - 2, left + small.width + 1, top + small.height + 1
        draw.rectangle(frame, fill=_SHADE)
        image.paste(small, (left, top))
    return np.asarray(image)


def camera_inset(camera: CameraRecording, width: int) -> Callable[[int, float], Picture]:
    """Function that returns the camera's image at a step and its time [s], with marks on the
    feature and its target.

    Args:
        camera: Recording with images.
        width: Width of the pictures of the film [px].
    """
    scale = _INSET * width / camera.model.width
    size = round(_INSET * width), round(scale * camera.model.height)
    images = [Image.fromarray(image).resize(size) for image in camera.images]

    def at(step: int, time: float) -> Picture:
        last = int(np.searchsorted(camera.image_time, time, side="right")) - 1
        image = images[max(last, 0)].copy()
        draw = ImageDraw.Draw(image, "RGBA")
        marks = {palette.GREEN: camera.target, palette.VERMILION: camera.feature}
        for colour, pixel in ((colour, path[step]) for colour, path in marks.items()):
            if np.isfinite(pixel).all():
                u, v = (scale * pixel).tolist()
                draw.ellipse((u - 5, v - 5, u + 5, v + 5), outline=colour, width=3)
        below = Image.new("RGB", (image.width, image.height + 18), _SHADE[:3])
        below.paste(image)
        text, place = "tool orange, target green", (5, image.height + 9)
        ImageDraw.Draw(below).text(place, text, font=_font(10), fill="white", anchor="lm")
        return np.asarray(below)

    return at


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    # Matplotlib ships this font, so that it is always available.
    fonts = Path(matplotlib.get_data_path()) / "fonts/ttf"
    return ImageFont.truetype(fonts / "DejaVuSans.ttf", size)


def draw_run(
    run: RunRecording, step: int, camera: CameraModel, lines: Sequence[Line] = ()
) -> Picture:
    """Draw a moment of a run without OpenGL: capsules and edges of boxes, the farthest first.

    Args:
        run: The run.
        step: Step of the run.
        camera: Camera without distortion.
        lines: Lines drawn over the scene.
    """
    shown = [line for box in run.boxes for line in _edges(box)]
    for body in run.bodies:
        R = quaternion.to_matrix(torch.from_numpy(body.orientation[step])).numpy()
        origin = body.position[step]
        parts = [line for box in body.boxes for line in _edges(box)]
        parts += [
            Line(
                start=np.array(capsule.start),
                end=np.array(capsule.end),
                colour=capsule.colour,
                width=2 * capsule.radius,
            )
            for capsule in body.capsules
        ]
        shown += [
            replace(part, start=R @ part.start + origin, end=R @ part.end + origin)
            for part in parts
        ]
    image = Image.new("RGB", (camera.width, camera.height), _SKY)
    draw = ImageDraw.Draw(image)
    for line in [*sorted(shown, key=lambda line: -_depth(line, camera)), *lines]:
        _draw_line(draw, line, camera)
    return np.asarray(image)


def _draw_line(draw: ImageDraw.ImageDraw, line: Line, camera: CameraModel) -> None:
    """Draw a line with round ends and a dark outline, unless it reaches behind the camera."""
    points = camera.project(np.stack([line.start, line.end]))
    if not np.isfinite(points).all():
        return
    thick = camera.focal[0] * line.width / max(_depth(line, camera), 0.01)
    for light, width in ((_OUTLINE, thick + 3), (1.0, thick)):
        r, g, b = (round(255 * light * channel) for channel in line.colour[:3])
        draw.line(points.ravel().tolist(), fill=(r, g, b), width=max(1, round(width)))
        for u, v in points.tolist():
            box = (u - width / 2, v - width / 2, u + width / 2, v + width / 2)
            draw.ellipse(box, fill=(r, g, b))


def _edges(box: Box) -> list[Line]:
    return [Line(start=a, end=b, colour=box.colour) for a, b in box.edges()]


def _depth(line: Line, camera: CameraModel) -> float:
    """Distance of the middle of a line in front of the camera [m]."""
    return float(camera.to_camera((line.start + line.end) / 2)[2])
