"""`hrc record servoing`: demonstrations of aiming with an uncalibrated camera."""

from collections.abc import Iterator

import numpy as np
from rich.progress import track

from hrc_learn.cli._options import resolved
from hrc_learn.cli._values import configuration, write_json
from hrc_learn.cli.arguments.record import RecordServoing as Args
from hrc_learn.sim import World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import Eye
from hrc_learn.skills.visual_target import OBJECT_FEATURE, OBJECT_FEATURE_NAMES
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.paired_demonstrations import write_lessons
from hrc_learn.teleoperation.scripted_demonstrations import teach_aiming


def run(args: Args) -> None:
    args = resolved(args)
    if args.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {args.episodes}.")
    workplace = Workplace()
    world = World(workplace.scene)
    rng = np.random.default_rng(args.seed)
    eye = Eye.on(open_camera(world, args.camera, rng=rng), workplace.scene)
    seen = []

    def lessons() -> Iterator[list[Frame]]:
        for _ in track(range(args.episodes), description="Aiming demonstrations"):
            frames = teach_aiming(world, workplace, eye, args.lesson, rng)
            seen.append(float(np.mean([bool(frame["feature_visible"]) for frame in frames])))
            yield frames

    write_lessons(
        args.out,
        lessons(),
        "aim at the box",
        args.lesson.fps,
        features={OBJECT_FEATURE: OBJECT_FEATURE_NAMES},
        details={"scene": "hrc_learn workplace", "recorded with": configuration(args)},
        overwrite=args.overwrite,
    )
    print(f"{args.episodes} demonstrations in {args.out}, marker seen {100 * min(seen):.0f} %")
    if args.json is not None:
        write_json(args.json, {"episodes": args.episodes, "marker_seen_min": min(seen)})
