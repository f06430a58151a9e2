"""Find a marker in the videos of a LeRobot dataset and keep its pixels beside the dataset.

The result lies in NAME.features, where `load_demos` finds it; the dataset is not touched. What
was broken off goes on where it was.

    extract_features.py grasping --marker 3 --camera front
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.progress import track

from hrc_learn import cli
from hrc_learn.demos import Detector, extract_features
from hrc_learn.vision import MarkerDetector, centre


@dataclass(frozen=True, kw_only=True)
class Args:
    path: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, with its videos."""
    marker: int
    """Number of the marker, of OpenCV's ArUco dictionary 4x4_50."""
    camera: str | None = None
    """Name of the camera; may be left out where there is only one."""
    json: Path | None = None
    """Receives the counts as one flat object."""


def main(args: Args) -> None:
    """Look at every image that was not looked at before."""
    if not 0 <= args.marker < 50:
        raise ValueError(f"--marker must be from 0 to 49, got {args.marker}")
    start = time.perf_counter()
    done = extract_features(
        args.path,
        f"marker_{args.marker}",
        lambda: look_for(args.marker),
        camera=args.camera,
        progress=lambda episodes: track(episodes, description="Looking at episodes"),
    )
    rate = done.frames / max(time.perf_counter() - start, 1e-9)
    share = done.seen / done.frames if done.frames else 1.0
    print(
        f"{done.name}: {done.episodes} episodes looked at, {done.known} known before; seen in "
        f"{100 * share:.1f} % of {done.frames} frames, {done.without_image} without an image"
    )
    if args.json:
        values = {
            "episodes": done.episodes,
            "episodes_known_before": done.known,
            "frames": done.frames,
            "seen_share": share,
            "frames_without_image": done.without_image,
            "frames_per_s": rate,
        }
        cli.write_json(args.json, values)


def look_for(marker: int) -> Detector:
    """A detector that follows one marker."""
    markers = MarkerDetector([marker])

    def detect(image: np.ndarray) -> np.ndarray | None:
        corners = markers.detect(image).get(marker)
        return None if corners is None else centre(corners)

    return detect


if __name__ == "__main__":
    cli.run(main, Args)
