"""Films of runs: captions on the pictures, drawings without OpenGL, and the MP4 file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from hrc_learn.geometry import Body, Box, quaternion
from hrc_learn.geometry.shapes import Colour, Line
from hrc_learn.log import CameraRecording, RunRecording
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette

Picture = UInt8[np.ndarray, "height width 3"]

_BAR = 36  # height of the line of text below [px]
_TEXT, _SMALL = 17, 13  # sizes of text [px]
_MARGIN = 10  # [px]
_INSET = 0.27  # of the picture's width
_SHADE = (24, 26, 30, 200)
_SKY = (228, 233, 238)
_BACK, _EDGE = 0.72, 0.35  # brightness of a face turned away from the light, and of outlines
_UPRIGHT = np.eye(3)

# A film of 16 s at 720 x 450 px is 0.3 MB then: a report that holds it can be mailed.
_CODEC = {"preset": "veryfast", "crf": "27"}


def film_mp4(pictures: Iterable[Picture], rate: float) -> bytes:
    """An MP4 file (H.264) that browsers play.

    Args:
        pictures: RGB, one at least, all of the same even size.
        rate: Pictures per second [1/s].
    """
    # In a file, which the index can be moved to the front of, so that it plays while it loads.
    with TemporaryDirectory(prefix="hrc_film_") as folder:
        path = Path(folder) / "film.mp4"
        _encode(path, pictures, rate)
        return path.read_bytes()


def _encode(path: Path, pictures: Iterable[Picture], rate: float) -> None:
    import av

    stream = None
    with av.open(path, "w", options={"movflags": "+faststart"}) as container:
        for picture in pictures:
            if stream is None:
                height, width = picture.shape[:2]
                assert height % 2 == width % 2 == 0, "chroma is halved"
                stream: Any = container.add_stream(
                    "libx264", rate=Fraction(rate).limit_denominator(1001), options=_CODEC
                )
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        assert stream is not None, "a film needs a picture"
        container.mux(stream.encode())


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
        text: Caption below.
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
        draw.rectangle(
            (left - 2, top - 2, left + small.width + 1, top + small.height + 1), fill=_SHADE
        )
        image.paste(small, (left, top))
    return np.asarray(image)


class CameraInset:
    """Camera image of a run at each step, with the marker and its target."""

    def __init__(self, camera: CameraRecording, width: int):
        """Scale the images.

        Args:
            camera: Recording with images.
            width: Width of the pictures of the film [px].
        """
        self._camera = camera
        self._scale = _INSET * width / camera.model.width
        size = round(_INSET * width), round(self._scale * camera.model.height)
        self._images = [Image.fromarray(image).resize(size) for image in camera.images]

    def at(self, step: int, time: float) -> Picture:
        """Image at a step.

        Args:
            step: Step of the run.
            time: Time of that step [s].
        """
        last = int(np.searchsorted(self._camera.image_time, time, side="right")) - 1
        image = self._images[max(last, 0)].copy()
        draw = ImageDraw.Draw(image, "RGBA")
        for pixel, colour in (
            (self._camera.target[step], palette.GREEN),
            (self._camera.feature[step], palette.VERMILION),
        ):
            if np.isfinite(pixel).all():
                u, v = (self._scale * pixel).tolist()
                draw.ellipse((u - 5, v - 5, u + 5, v + 5), outline=colour, width=3)
        draw.rectangle((0, image.height - 18, image.width, image.height), fill=_SHADE)
        draw.text(
            (5, image.height - 9),
            "marker red, target green",
            font=_font(10),
            fill="white",
            anchor="lm",
        )
        return np.asarray(image)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    # Matplotlib ships this font, so that it is always available.
    return ImageFont.truetype(
        Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size
    )


def draw_run(
    run: RunRecording, step: int, camera: CameraModel, lines: Sequence[Line] = ()
) -> Picture:
    """Draw a moment of a run without OpenGL: capsules and boxes, the farthest first.

    Args:
        run: The run.
        step: Step of the run.
        camera: Camera without distortion.
        lines: Lines drawn over the scene.
    """
    image = Image.new("RGB", (camera.width, camera.height), _SKY)
    draw = ImageDraw.Draw(image)
    still = [part for box in run.boxes for part in _faces(box, _UPRIGHT, np.zeros(3), camera)]
    moving = [part for body in run.bodies for part in _body_parts(body, step, camera)]
    # Furniture first: a large board has no one depth, and what moves is in front of most of it.
    for parts in (still, moving):
        for _, part in sorted(parts, key=lambda part: -part[0]):
            part.draw(draw)
    for line in lines:
        ends, colour = np.stack([line.start, line.end]), _bytes(line.colour)
        (part,) = _capsule(ends, line.width, colour, camera)
        part[1].draw(draw)
    return np.asarray(image)


@dataclass(frozen=True)
class _Part:
    """A polygon, or a thick line, in pixels."""

    points: list[tuple[float, float]]
    colour: tuple[int, int, int]
    width: float | None = None
    """Width of a line [px]; None for a polygon."""

    def draw(self, draw: ImageDraw.ImageDraw) -> None:
        if not np.isfinite(self.points).all():  # behind the camera
            return
        if self.width is None:
            draw.polygon(self.points, fill=self.colour, outline=_dimmed(self.colour, _EDGE))
            return
        outline = _dimmed(self.colour, _EDGE)
        for colour, width in ((outline, self.width + 3), (self.colour, self.width)):
            draw.line(self.points, fill=colour, width=max(1, round(width)))
            r = width / 2
            for u, v in self.points:
                draw.ellipse((u - r, v - r, u + r, v + r), fill=colour)


def _body_parts(body: Body, step: int, camera: CameraModel) -> list[tuple[float, _Part]]:
    R, origin = _matrix(body.orientation[step]), body.position[step]
    parts = [part for box in body.boxes for part in _faces(box, R, origin, camera)]
    for capsule in body.capsules:
        ends = np.array([capsule.start, capsule.end]) @ R.T + origin
        parts += _capsule(ends, 2 * capsule.radius, _bytes(capsule.colour), camera)
    return parts


def _capsule(
    ends: Float[np.ndarray, "2 3"],
    width: float,
    colour: tuple[int, int, int],
    camera: CameraModel,
) -> list[tuple[float, _Part]]:
    depth = float(camera.to_camera(ends)[:, 2].mean())
    points = [(float(u), float(v)) for u, v in camera.project(ends)]
    return [(depth, _Part(points, colour, camera.focal[0] * width / max(depth, 0.01)))]


def _faces(
    box: Box, R: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"], camera: CameraModel
) -> list[tuple[float, _Part]]:
    """Visible faces of a box, each with its depth [m]."""
    parts = []
    eye = camera.pose[:3, 3]
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = side
            others = np.delete(np.eye(3), axis, axis=0)
            square = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) @ others
            corners = (square + normal) * box.half_size + box.centre
            corners = corners @ R.T + origin
            outwards = R @ normal
            if outwards @ (eye - corners[0]) <= 0:
                continue
            light = _BACK + (1 - _BACK) * max(float(outwards[2]), 0.0)
            depth = float(camera.to_camera(corners)[:, 2].mean())
            points = [(float(u), float(v)) for u, v in camera.project(corners)]
            parts.append((depth, _Part(points, _dimmed(_bytes(box.colour), light))))
    return parts


def _matrix(orientation: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    return quaternion.to_matrix(torch.from_numpy(orientation)).numpy()


def _bytes(colour: Colour) -> tuple[int, int, int]:
    r, g, b = (round(255 * c) for c in colour[:3])
    return r, g, b


def _dimmed(colour: tuple[int, int, int], light: float) -> tuple[int, int, int]:
    r, g, b = colour
    return round(light * r), round(light * g), round(light * b)
