"""Where in the image the hand's marker should be, to stand right above an object.

The hand's marker and the object's are at different heights and places, so aiming is not
bringing one upon the other. With an uncalibrated camera the offset has to be learned: each
demonstration ends with the hand right above an object, and tells one pair of pixels.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

OBJECT_FEATURE = "observation.object_feature"
"""Column of a dataset with the object's marker in the image."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Affine map from the pixel of an object's marker to that of the hand's marker above it.

    Affine is exact for a camera that looks straight down through a perfect lens, and good to a
    few pixels for one that does not; `error` tells.
    """

    matrix: Float[np.ndarray, "2 3"]
    """Maps (u, v, 1) of the object's marker to (u, v) of the hand's [px]."""
    error: float
    """Leave-one-out error, root mean square [px]; NaN from fewer than five demonstrations."""

    @classmethod
    def fit(
        cls, objects: Float[np.ndarray, "demos 2"], hands: Float[np.ndarray, "demos 2"]
    ) -> "VisualTarget":
        """Fit to the ends of demonstrations.

        Args:
            objects: Pixels of the object's marker [px].
            hands: Pixels of the hand's marker when the hand stood right above it [px].

        Raises:
            ValueError: If there are fewer than three demonstrations, or they lie on a line.
        """
        design = np.column_stack([objects, np.ones(len(objects))])
        if np.linalg.matrix_rank(design - design.mean(axis=0)) < 2:
            raise ValueError(
                f"{len(objects)} demonstrations do not determine where to aim: at least three "
                "are needed, with objects that do not lie on one line in the image."
            )
        solution, *_ = np.linalg.lstsq(design, hands, rcond=None)
        # Leave-one-out residuals of a linear fit, from its hat matrix (Allen 1974, PRESS).
        leverage = np.einsum("ij,ji->i", design, np.linalg.pinv(design))
        error = float("nan")
        if len(objects) > 4:
            press = (hands - design @ solution) / (1.0 - leverage)[:, None]
            error = float(np.sqrt((press**2).sum(axis=1).mean()))
        return cls(matrix=solution.T, error=error)

    def __call__(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Where the hand's marker should be for an object's marker at `pixel` [px]."""
        return self.matrix @ np.append(pixel, 1.0)

    def save(self, path: Path) -> None:
        """Write to a JSON file, whole or not at all."""
        partial = path.with_suffix(".partial")
        error = None if np.isnan(self.error) else self.error
        content = {"version": 1, "matrix": self.matrix.tolist(), "error_px": error}
        partial.write_text(json.dumps(content, indent=2))
        partial.replace(path)

    @classmethod
    def load(cls, path: Path) -> "VisualTarget":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is not one of ours.
        """
        content = json.loads(path.read_text())
        if content.get("version") != 1 or "matrix" not in content:
            raise ValueError(f"{path} is not a visual target of a known version: fit it again.")
        error = content["error_px"]
        return cls(
            matrix=np.array(content["matrix"]),
            error=float("nan") if error is None else float(error),
        )
