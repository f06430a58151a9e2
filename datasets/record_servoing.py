"""Record demonstrations of visual servoing to an object in the image of an uncalibrated camera.

The scripted expert moves the marked end effector over the table and ends right above an object.
The camera's pose and lens are in none of the columns. Writes a LeRobot dataset of version 3.0.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track

from hrc_learn import cli
from hrc_learn.sim import CameraKind, World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_target import OBJECT_FEATURE, OBJECT_FEATURE_NAMES
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    ServoDemonstrationConfig,
    demonstrate_servoing,
    write_demonstrations,
)


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to record."""

    out: Path
    """Folder of the new dataset."""
    episodes: int = 8
    """Demonstrations to record."""
    camera: CameraKind = "synthetic"
    """Camera: rendered by "egl", or "synthetic", which draws the markers only but is fast."""
    demonstration: ServoDemonstrationConfig = field(default_factory=ServoDemonstrationConfig)
    """How the expert demonstrates."""
    seed: int = 1
    """Seed of objects, paths and image noise."""
    overwrite: bool = False
    """Replace an older dataset in that folder."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    workplace = Workplace()
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    sensor = MarkerSensor(open_camera(world, args.camera, rng=rng), workplace.scene.marker_ids)
    seen = []

    def demonstrations() -> Iterator[list[Frame]]:
        for _ in track(range(args.episodes), description="Servoing demonstrations"):
            frames = demonstrate_servoing(world, workplace, sensor, args.demonstration, rng)
            seen.append(float(np.mean([bool(frame["feature_visible"]) for frame in frames])))
            yield frames

    write_demonstrations(
        args.out,
        demonstrations(),
        "servo to the box",
        args.demonstration.fps,
        features={OBJECT_FEATURE: OBJECT_FEATURE_NAMES},
        details={"scene": "hrc_learn workplace"},
        overwrite=args.overwrite,
    )
    print(f"{args.episodes} demonstrations in {args.out}, marker seen {100 * min(seen):.0f} %")
    if args.json is not None:
        cli.write_json(args.json, {"episodes": args.episodes, "marker_seen_min": min(seen)})


if __name__ == "__main__":
    cli.run(main, Args)
