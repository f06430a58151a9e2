"""`hrc record servoing`: demonstrations of visual servoing with an uncalibrated camera."""

from collections.abc import Iterator

import numpy as np
from rich.progress import track

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import configuration, write_json
from hrc_learn.cli.arguments.record import RecordServoing as Args
from hrc_learn.sim import World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import OBJECT_FEATURE, OBJECT_FEATURE_NAMES
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    demonstrate_servoing,
    write_demonstrations,
)


def run(args: Args) -> None:
    args = resolved(args)
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
        details={"scene": "hrc_learn workplace", "recorded with": configuration(args)},
        overwrite=args.overwrite,
    )
    print(f"{args.episodes} demonstrations in {args.out}, marker seen {100 * min(seen):.0f} %")
    if args.json is not None:
        write_json(args.json, {"episodes": args.episodes, "marker_seen_min": min(seen)})
