"""A camera and a marker detector together: images in, pixels of markers out."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, UInt8

from ..protocols import Camera
from ..sim import HAND_MARKER, SceneConfig
from ..vision import MarkerDetector, centre


class Eye:
    """Finds the centres of markers in a camera's images."""

    def __init__(self, camera: Camera, marker_ids: Iterable[int]):
        self._camera = camera
        self._detector = MarkerDetector(list(marker_ids))

    @classmethod
    def on(cls, camera: Camera, scene: SceneConfig) -> "Eye":
        """An eye that looks for the markers of a scene."""
        return cls(camera, [HAND_MARKER, *(item.marker.id for item in scene.objects)])

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Take an image, RGB."""
        return self._camera.read()

    def look(self, ids: Iterable[int] | None = None) -> dict[int, Float[np.ndarray, "2"]]:
        """Take an image; return the pixel (u, v) of each marker in it, by number.

        Args:
            ids: Markers that matter now; None: all. Looking for one that is out of sight
                takes ten times as long as following one that is seen.
        """
        found = self._detector.detect(self.read(), ids)
        return {id: centre(corners) for id, corners in found.items()}
