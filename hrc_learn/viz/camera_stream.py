"""Sending what a camera saw to Rerun, and what was made of it."""

from io import BytesIO

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8
from PIL import Image

from hrc_learn.viz import palette
from hrc_learn.viz.recordings import CameraRecording
from hrc_learn.viz.rerun_stream import StaticShapes, seconds, thin

_CROSS = 60.0  # half the size of the mark of the target [px]
_ROOT = "world/camera/image"


class CameraStream:
    """Sends the frustum of a camera, its images, and marks over them."""

    def __init__(self, stream: rr.RecordingStream, still: StaticShapes, quality: int):
        """Send to a recording stream.

        Args:
            stream: Into a file or to a viewer.
            still: What was sent of what stands still.
            quality: Of the JPEG images, 1 to 95.
        """
        self._stream, self._still, self._quality = stream, still, quality
        self._images = 0

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
        self._still.send(
            "world/camera",
            (model.pose.tobytes(), model.matrix.tobytes()),
            lambda: (place, pinhole),
        )
        new = camera.images[self._images :]
        if new:
            self._stream.send_columns(
                _ROOT,
                seconds(camera.image_time[self._images :]),
                rr.EncodedImage.columns(
                    blob=[_jpeg(image, self._quality) for image in new],
                    media_type=["image/jpeg"] * len(new),
                ),
            )
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
            time: Of the whole run [s].
            camera: What it saw in the whole run.
            at: Samples at which the marks are sent.
            ends: Samples at which the path so far is sent.
        """
        crosses = [_cross(pixel) for pixel in camera.target[at]]
        self._send_lines(f"{_ROOT}/target", time[at], crosses, palette.TARGET)
        seen = np.asarray(np.isfinite(camera.feature).all(axis=-1))
        trails = [[thin(camera.feature[: end + 1][seen[: end + 1]])] for end in ends]
        self._send_lines(f"{_ROOT}/path", time[ends], trails, palette.SKY)
        self._still.send(
            f"{_ROOT}/feature",
            None,
            lambda: rr.Points2D.from_fields(
                radii=[-5.0],  # negative: in points of the screen, whatever the zoom
                colors=[palette.rgba(palette.ORANGE)],
                draw_order=30.0,
            ),
        )
        # A sample without points takes the mark away while the feature is not seen.
        columns = rr.Points2D.columns(positions=camera.feature[at][seen[at]])
        self._stream.send_columns(
            f"{_ROOT}/feature", seconds(time[at]), columns.partition(seen[at].astype(int))
        )

    def _send_lines(
        self,
        path: str,
        time: Float[np.ndarray, " samples"],
        strips: list[list[Float[np.ndarray, "_ 2"]]],
        colour: str,
    ) -> None:
        """Lines over the image, any number of them at each sample."""
        self._still.send(
            path,
            None,
            lambda: rr.LineStrips2D.from_fields(
                radii=[-2.0], colors=[palette.rgba(colour)], draw_order=20.0
            ),
        )
        columns = rr.LineStrips2D.columns(strips=[strip for here in strips for strip in here])
        counts = [len(here) for here in strips]
        self._stream.send_columns(path, seconds(time), columns.partition(counts))


def _cross(pixel: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "2 2"]]:
    """Two strokes across a pixel; none where there is no target."""
    if not np.isfinite(pixel).all():
        return []
    return [
        pixel + _CROSS * np.array([[-1, 0], [1, 0]]),
        pixel + _CROSS * np.array([[0, -1], [0, 1]]),
    ]


def _jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()
