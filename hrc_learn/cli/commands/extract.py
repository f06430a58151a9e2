"""`hrc extract`: markers found in a dataset's videos."""

import time

import numpy as np
from rich.progress import track

from hrc_learn.cli._values import write_json
from hrc_learn.cli.arguments.dataset import Extract as Args
from hrc_learn.demos import Detector, extract_features
from hrc_learn.vision import MarkerDetector, centre


def run(args: Args) -> None:
    """Look at every image that was not looked at before."""
    if not 0 <= args.marker < 50:
        raise ValueError(f"--marker must be from 0 to 49, got {args.marker}")
    start = time.perf_counter()
    done = extract_features(
        args.dataset,
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
        write_json(args.json, values)


def look_for(marker: int) -> Detector:
    """A detector that follows one marker."""
    markers = MarkerDetector([marker])

    def detect(image: np.ndarray) -> np.ndarray | None:
        corners = markers.detect(image).get(marker)
        return None if corners is None else centre(corners)

    return detect
