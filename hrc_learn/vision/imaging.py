"""What a real camera does to a perfect image: lens distortion, blur, sensor noise."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, UInt8

from hrc_learn.vision.camera_model import NONE, CameraModel, undistort

# Samples of noise drawn for an image, of which rows are random windows (see `_noise`).
_POOL = 1 << 16
# Rows whose rays are computed at a time: 16 of 1440 pixels fit into the processor's cache.
_BAND = 16


@dataclass(frozen=True, kw_only=True)
class ImageNoise:
    """Blur and sensor noise, the same for every camera of the simulation."""

    blur: float = 0.7
    """Standard deviation of the Gaussian blur [px]; 0 switches it off."""
    noise: float = 2.0
    """Standard deviation of the noise, in grey levels of 255; 0 switches it off."""

    def __post_init__(self) -> None:
        if min(self.blur, self.noise) < 0:
            raise ValueError(
                f"blur and noise must not be negative, but are {self.blur} and {self.noise}."
            )

    def degrade(
        self, image: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """A blurred and noisy copy of an image."""
        import cv2

        if self.blur > 0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur), dtype=np.uint8)
        if self.noise > 0:
            noise = self._noise(image.shape, rng)
            return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)
        return image.copy() if self.blur == 0 else image

    def _noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Gaussian noise, int16. Rows are random windows of one pool of samples.

        Drawing every sample of a 1440x1080 frame costs 50 ms, this costs 2 ms. Rows that
        share samples do so at random shifts, which no detector of corners can notice. Parts
        of a frame that are smaller than the pool get samples of their own.
        """
        rows, row = shape[0], int(np.prod(shape[1:]))
        if rows * row <= _POOL:
            noise = self.noise * rng.standard_normal(shape, dtype=np.float32)
            return np.rint(noise).astype(np.int16)
        pool = self.noise * rng.standard_normal(max(_POOL, 4 * row), dtype=np.float32)
        windows = np.lib.stride_tricks.sliding_window_view(np.rint(pool).astype(np.int16), row)
        return windows[rng.integers(len(windows), size=rows)].reshape(shape)


class Lens:
    """Turns the image of an ideal pinhole, which renderers make, into that of a camera.

    Where the lens sees more than a pinhole of the same size (barrel distortion), the pinhole
    has to be wider: render `pinhole`, then `apply` the lens.

    Attributes:
        model: The camera to imitate.
        pinhole: What to render: same pose, no distortion, square pixels, centred principal
            point, just large enough to fill every pixel of `model`.
    """

    def __init__(self, model: CameraModel):
        self.model = model
        f = max(model.focal)
        # Two pixels to spare for the interpolation at the edge.
        half = f * np.abs(model.to_normalised(model.border())).max(axis=0) + 2.0
        width, height = (2 * np.ceil(half)).astype(int).tolist()
        self.pinhole = replace(
            model,
            width=width,
            height=height,
            focal=(f, f),
            principal=((width - 1) / 2, (height - 1) / 2),
            distortion=NONE,
        )
        self._map = self._source_pixels()

    def _source_pixels(self) -> Float32[np.ndarray, "h w 2"]:
        normalised = pixel_rays(self.model)
        return (normalised * self.pinhole.focal + self.pinhole.principal).astype(np.float32)

    def apply(self, image: UInt8[np.ndarray, "ph pw 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The image of `model` from the image of `pinhole`."""
        import cv2

        expected = (self.pinhole.height, self.pinhole.width)
        if image.shape[:2] != expected:
            raise ValueError(
                f"image must be {expected[1]}x{expected[0]}, as Lens.pinhole says, but is "
                f"{image.shape[1]}x{image.shape[0]}."
            )
        out = cv2.remap(image, self._map, None, cv2.INTER_LINEAR)  # pyright: ignore[reportCallIssue, reportArgumentType]
        return np.asarray(out, dtype=np.uint8)


def pixel_rays(model: CameraModel) -> Float32[np.ndarray, "h w 2"]:
    """Normalised (x/z, y/z) direction seen by every pixel, to 1e-3 px."""
    rays = np.empty((model.height, model.width, 2), dtype=np.float32)
    # A band of rows at a time stays in the processor's cache: five times as fast.
    for top in range(0, model.height, _BAND):
        band = rays[top : top + _BAND]
        v, u = np.indices(band.shape[:2], dtype=np.float32)
        (fx, fy), (cx, cy) = model.focal, model.principal
        distorted = np.stack([(u - cx) / fx, (v + (top - cy)) / fy], axis=-1)
        band[:] = undistort(distorted, model.distortion)
    return rays
