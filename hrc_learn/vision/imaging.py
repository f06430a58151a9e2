"""Realistic images, with lens distortion, blur and sensor noise, and a camera without OpenGL.

The camera draws only markers, by exact ray casting, on a static background. Markers are enough
for visual servoing, and drawing them takes a fraction of a renderer's time. Sweeps and machines
without OpenGL use this camera in place of the simulator's.
"""

import zlib
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, UInt8

from hrc_learn.vision.camera_model import NONE, CameraModel, Coefficients
from hrc_learn.vision.markers import PLATE_MODULES, Marker, marker_texture

# Number of noise samples drawn for an image; each row takes a random window of them (`_noise`).
_POOL = 1 << 16


@dataclass(frozen=True, kw_only=True)
class ImageNoise:
    """Blur and sensor noise, the same for every camera of the simulation."""

    blur: float = 0.7
    """Standard deviation of the Gaussian blur [px]; 0 switches it off."""
    noise: float = 2.0
    """Standard deviation of the noise, in grey levels of 255; 0 switches it off."""

    def __post_init__(self) -> None:
        if not (0 <= self.blur < np.inf and 0 <= self.noise < np.inf):
            raise ValueError(f"blur and noise must not be negative: {self.blur}, {self.noise}.")

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
        """Gaussian noise (int16) in which each row is a random window of one pool of samples.

        Independent samples for a 1440x1080 frame cost 50 ms, windows of a pool 2 ms. Rows reuse
        samples at random shifts, which no corner detector can notice. Parts of a frame smaller
        than the pool get independent samples.
        """
        rows, row = shape[0], int(np.prod(shape[1:]))
        if rows * row <= _POOL:
            noise = self.noise * rng.standard_normal(shape, dtype=np.float32)
            return np.rint(noise).astype(np.int16)
        pool = self.noise * rng.standard_normal(max(_POOL, 4 * row), dtype=np.float32)
        windows = np.lib.stride_tricks.sliding_window_view(np.rint(pool).astype(np.int16), row)
        return windows[rng.integers(len(windows), size=rows)].reshape(shape)


class Lens:
    """Turns the image of an ideal pinhole camera into the image of a camera with a lens.

    Renderers make pinhole images: render `pinhole`, then `apply` the lens. With barrel
    distortion, a lens sees more than a pinhole of the same size, so `pinhole` is wider.

    Attributes:
        model: The camera to imitate.
        pinhole: Camera to render: same pose, no distortion, square pixels, centred principal
            point, just large enough to fill every pixel of `model`.
    """

    def __init__(self, model: CameraModel):
        self.model = model
        f = max(model.focal)
        # A margin of two pixels for the interpolation at the edge.
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
        rays = pixel_rays(model)
        self._map = (rays * self.pinhole.focal + self.pinhole.principal).astype(np.float32)

    def apply(self, image: UInt8[np.ndarray, "ph pw 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The image of `model` from the image of `pinhole`."""
        import cv2

        assert image.shape[:2] == (self.pinhole.height, self.pinhole.width)
        out = cv2.remap(image, self._map, None, cv2.INTER_LINEAR)  # pyright: ignore[reportCallIssue, reportArgumentType]
        return np.asarray(out, dtype=np.uint8)


def pixel_rays(model: CameraModel) -> Float32[np.ndarray, "h w 2"]:
    """Normalised (x/z, y/z) direction seen by every pixel, accurate to 1e-3 px."""
    return _rays((model.height, model.width), model.focal, model.principal, model.distortion)


# The cameras of a study differ only in pose: reuse the rays, whose computation takes half a
# second.
@lru_cache(maxsize=4)
def _rays(
    shape: tuple[int, int],
    focal: tuple[float, float],
    principal: tuple[float, float],
    distortion: Coefficients,
) -> Float32[np.ndarray, "h w 2"]:
    v, u = np.indices(shape, dtype=np.float64)
    lens = CameraModel(focal=focal, principal=principal, distortion=distortion)
    return lens.to_normalised(np.stack([u, v], axis=-1)).astype(np.float32)


MarkerPoses = Callable[[], Mapping[int, Float[np.ndarray, "4 4"]]]
"""Returns the pose of each marker now, by its id: p_base = pose @ p_marker."""


# Texture resolutions [px per module], one octave apart: bilinear sampling of a texture that is
# much finer than the image causes aliasing.
_MODULE_PIXELS = (1, 2, 4, 8, 16, 32, 64)
# Grey levels of a lit print: white is not 255, black not 0.
_PAPER, _INK = 235.0, 25.0
# `_PRINT`: texels along the longer edge of a carton's print.
# `_WOOD`: texels along each edge of a picture of wood grain.
_PRINT, _WOOD = 512, 1024
# A plate closer to the camera plane than this is not drawn: its projection diverges [m].
_NEAR = 0.02


class SyntheticCamera:
    """Implements the `Camera` protocol: `read()` returns the scene's markers as seen now.

    A plate is drawn only where it can be seen: facing the camera, in front of it, inside the
    image, and not reported by `hidden`. Nearer plates cover farther ones.
    """

    def __init__(
        self,
        model: CameraModel,
        markers: Iterable[Marker],
        poses: MarkerPoses,
        *,
        rng: np.random.Generator,
        noise: ImageNoise | None = None,
        hidden: Callable[[], Set[int]] = frozenset,
    ):
        """Draw everything that stays the same from frame to frame.

        Args:
            model: Camera, with its pose and lens.
            markers: The markers that may appear.
            poses: Called at each frame; markers without a pose are not drawn.
            rng: Source of the noise.
            noise: Blur and noise of the sensor; the defaults of `ImageNoise` when None.
            hidden: Called at each frame; returns the ids that are occluded.

        Raises:
            ValueError: Two markers have the same id.
        """
        self.model = model
        self.markers = _by_id(markers)
        self._poses, self._hidden = poses, hidden
        self._rng, self._noise = rng, noise or ImageNoise()
        self._clean = table_top(model.width, model.height)
        self._background = self._noise.degrade(self._clean, rng)
        self._canvas = self._clean.copy()  # equals `_clean` between frames
        self._rays = pixel_rays(model)
        self._textures = {id: _octaves(id) for id in self.markers}
        # Wide enough that the blur of a plate's edge ends inside the redrawn region.
        self._margin = 2 + int(np.ceil(3 * self._noise.blur))

    def read(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image now, RGB."""
        drawn = [self._draw(marker, pose) for marker, pose in self._visible()]
        image = self._background.copy()
        for roi in drawn:
            image[roi] = self._noise.degrade(self._canvas[roi], self._rng)
        for roi in drawn:
            self._canvas[roi] = self._clean[roi]
        return image

    def _visible(self) -> list[tuple[Marker, Float[np.ndarray, "4 4"]]]:
        """Markers with their front in view, and their base-frame poses, farthest first."""
        hidden = self._hidden()
        eye = self.model.pose[:3, 3]
        seen = []
        for id, pose in self._poses().items():
            to_eye = eye - pose[:3, 3]
            if id not in self.markers or id in hidden or to_eye @ pose[:3, 2] <= 0:
                continue
            corners = self.markers[id].plate_corners @ pose[:3, :3].T + pose[:3, 3]
            in_front = self.model.to_camera(corners)[:, 2].min() > _NEAR
            if in_front and self.model.in_view(corners).any():
                seen.append((float(to_eye @ to_eye), self.markers[id], pose))
        seen.sort(key=lambda entry: -entry[0])
        return [(marker, pose) for _, marker, pose in seen]

    def _draw(self, marker: Marker, pose: Float[np.ndarray, "4 4"]) -> tuple[slice, slice]:
        """Draw a plate on the canvas and return the region it touched."""
        import cv2

        corners = marker.plate_corners @ pose[:3, :3].T + pose[:3, 3]
        pixels = self.model.project(corners)
        roi = self._around(pixels)
        texture = self._textures[marker.id][_octave(pixels)]
        where = self._texture_coordinates(
            self._rays[roi], pose, marker.plate_size, len(texture) - 2
        )
        grey_alpha = np.asarray(cv2.remap(texture, where, None, cv2.INTER_LINEAR))  # pyright: ignore[reportCallIssue, reportArgumentType]
        grey, alpha = grey_alpha[..., :1], grey_alpha[..., 1:]
        # Grey is already weighted by opacity, so this is exact at the soft edges too.
        self._canvas[roi] = np.rint(grey + (1.0 - alpha) * self._canvas[roi])
        return roi

    def _around(self, pixels: Float[np.ndarray, "corners 2"]) -> tuple[slice, slice]:
        """Part of the image around some pixels, with a margin for the blur."""
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - self._margin, 0)
        high = np.maximum(np.ceil(pixels.max(axis=0)).astype(int) + self._margin + 1, 0)
        return np.s_[low[1] : high[1], low[0] : high[0]]  # slices end at the image's edge

    def _texture_coordinates(
        self,
        rays: Float32[np.ndarray, "h w 2"],
        pose: Float[np.ndarray, "4 4"],
        plate_size: float,
        pixels: int,
    ) -> Float32[np.ndarray, "h w 2"]:
        """Texture coordinates where each ray meets the plate; the texture has a border of one
        pixel.
        """
        R = self.model.pose[:3, :3].T @ pose[:3, :3]
        t = self.model.to_camera(pose[:3, 3])
        # [R_x R_y t] maps points of the plate to rays; its inverse maps rays to the plate.
        to_plate = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))
        density, middle = pixels / plate_size, (pixels + 1) / 2
        to_texture = np.array([[density, 0, middle], [0, -density, middle], [0, 0, 1]])
        H = (to_texture @ to_plate).astype(np.float32)
        homogeneous = rays @ H[:, :2].T + H[:, 2]
        return np.ascontiguousarray(homogeneous[..., :2] / homogeneous[..., 2:])


def _by_id(markers: Iterable[Marker]) -> dict[int, Marker]:
    by_id: dict[int, Marker] = {}
    for marker in markers:
        if marker.id in by_id:
            raise ValueError(
                f"Markers {by_id[marker.id]} and {marker} both have id {marker.id}: a detector "
                "could not tell them apart. Give each marker of a scene its own id."
            )
        by_id[marker.id] = marker
    return by_id


def table_top(width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """A plain wooden surface, lit from one side."""
    u = np.linspace(-1, 1, width)[None, :, None]
    v = np.linspace(-1, 1, height)[:, None, None]
    light = 1.0 - 0.12 * u - 0.08 * v - 0.1 * (u * u + v * v)
    return np.rint(light * [168.0, 148.0, 124.0]).clip(0, 255).astype(np.uint8)


def carton(
    name: str, colour: tuple[float, float, float, float]
) -> UInt8[np.ndarray, "height width 3"]:
    """Print of a carton: stripes, a badge and words, all drawn from the carton's name."""
    import cv2

    rng = np.random.default_rng(zlib.crc32(name.encode()))
    base = 255 * np.array(colour[:3])
    image = np.empty((_PRINT, _PRINT // 2, 3), np.uint8)
    image[:] = base
    inks = [rng.uniform(0, 255, 3).tolist() for _ in range(4)] + [(250, 250, 245), (20, 20, 25)]
    for _ in range(4):
        a, b = rng.integers(0, _PRINT, 2)
        ink = inks[rng.integers(len(inks))]
        cv2.line(image, (0, int(a)), (_PRINT // 2, int(b)), ink, int(rng.integers(4, 24)))
    middle = (int(rng.integers(60, 200)), int(rng.integers(90, 420)))
    cv2.circle(image, middle, int(rng.integers(30, 60)), inks[0], -1)
    cv2.circle(image, middle, int(rng.integers(12, 28)), inks[4], -1)
    for row in range(5):
        word = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ23456789"), 6))
        place = (int(rng.integers(0, 90)), 60 + 90 * row + int(rng.integers(0, 50)))
        size = float(rng.uniform(0.6, 1.8))
        cv2.putText(image, word, place, cv2.FONT_HERSHEY_DUPLEX, size, inks[4 + row % 2], 3)
    return image


def wood_grain(rng: np.random.Generator) -> UInt8[np.ndarray, "side side 3"]:
    """Wood grain along x: stretched noise on a wood colour."""
    import cv2

    noise = rng.standard_normal((_WOOD, _WOOD)).astype(np.float32)
    grain = cv2.GaussianBlur(noise, (0, 0), sigmaX=40, sigmaY=1.5)
    level = 1 + 0.06 * grain / grain.std()
    return (level[..., None] * (205, 185, 160)).clip(0, 255).astype(np.uint8)


def _octaves(id: int) -> list[Float32[np.ndarray, "n n 2"]]:
    """Textures of a plate with a transparent border, one for each of `_MODULE_PIXELS`.

    The first channel is grey level times opacity, the second is opacity.
    """
    octaves = []
    for module in _MODULE_PIXELS:
        white = marker_texture(id, module * PLATE_MODULES) / 255.0
        grey = _INK + (_PAPER - _INK) * white
        grey_alpha = np.stack([grey, np.ones_like(grey)], axis=-1)
        octaves.append(np.pad(grey_alpha, ((1, 1), (1, 1), (0, 0))).astype(np.float32))
    return octaves


def _octave(plate_pixels: Float[np.ndarray, "4 2"]) -> int:
    """Index of the texture with a resolution nearest to that of the plate in the image.

    Edges in the image are then blurred over about one pixel.
    """
    edges = np.linalg.norm(plate_pixels - np.roll(plate_pixels, 1, axis=0), axis=1)
    octave = np.log2(max(edges.mean() / PLATE_MODULES, 1.0))
    return min(int(np.rint(octave)), len(_MODULE_PIXELS) - 1)
