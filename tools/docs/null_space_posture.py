"""Picture of placing without and with the null-space posture: the door of the cabinet stops the
arm, or the arm passes it.

The program demonstrates the same motion of the end effector twice, as
`benchmarks/arm_angle_ablation.py` does. The left half shows the time of the first contact
between arm and cabinet without the posture, the right half the same time with it.

python tools/docs/null_space_posture.py
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from hrc_learn import cli
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import World
from hrc_learn.sim.cameras import OffscreenRenderer
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    guided_frames,
    placing_expert,
)
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated

SIZE = 500, 420
"""Size of each half [px]."""
GAP = 6
"""White space between the halves [px]."""
EYE, TOWARDS, FOCAL = np.array([1.30, 0.95, 1.10]), np.array([0.20, -0.24, 0.37]), 1.25
"""Viewpoint and point looked at [m]; focal length, relative to the height of the picture."""
MARK = 22
"""Radius of the circle round a contact [px]."""
CAMERA = CameraModel(
    width=SIZE[0],
    height=SIZE[1],
    focal=(FOCAL * SIZE[1], FOCAL * SIZE[1]),
    principal=((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2),
).look_at(EYE, TOWARDS)


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which demonstrations to draw."""

    out: Path = Path(__file__).parents[2] / "docs" / "images" / "null_space_posture.png"
    """File of the picture."""
    shelf: str = "middle"
    """Shelf at which the motion ends."""
    seed: int = 0
    """Seed of the tremor and of the start."""


def main(args: Args) -> None:
    hit, time = half(args, moves_elbow=False)
    if time is None:
        raise ValueError("the arm hits nothing without the posture: choose another --seed")
    free, _ = half(args, moves_elbow=True, until=time)
    gap = np.full((SIZE[1], GAP, 3), 255, dtype=np.uint8)
    picture = Image.fromarray(np.concatenate([hit, gap, free], axis=1))
    picture.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        args.out, "PNG", optimize=True
    )
    print(f"{args.out}: {args.out.stat().st_size / 1e3:.0f} kB")


def half(
    args: Args, moves_elbow: bool, until: float | None = None
) -> tuple[Picture, float | None]:
    """Picture of a demonstration at the first contact of the arm, or at a time.

    Args:
        args: Shelf and seed.
        moves_elbow: True if the expert also moves the elbow.
        until: Time of the picture [s]; None: the first contact between arm and cabinet.

    Returns:
        The picture, and the time of the first contact so far [s]; None without a contact.
    """
    workplace = Workplace.of(ArmChoice("panda").work_arm())
    world = World(workplace.scene)
    config = PlacingDemonstrationConfig(pull_elbow=moves_elbow)
    expert = placing_expert(
        world, workplace, args.shelf, config, np.random.default_rng(args.seed)
    )
    with closing(OffscreenRenderer(world, *SIZE)) as renderer:
        hits = []
        for _ in guided_frames(world, expert, config):
            touches = world.cabinet_contacts.touches
            hits = [touch for touch in touches if touch.first.startswith("link")]
            if hits if until is None else world.data.time >= until:
                break
        clock = f"{world.data.time:.1f} s"
        posture = "With the null-space posture" if moves_elbow else "Without null-space posture"
        if not hits:
            return annotated(renderer.render(CAMERA), f"{posture}: free", clock), None
        text = f"{posture}: the arm hits the door"
        picture = annotated(renderer.render(CAMERA), text, clock)
        return circled(picture, CAMERA.project(contacts(world))), hits[0].start


def contacts(world: World) -> np.ndarray:
    """Points at which a link of the arm touches the cabinet, shape (n, 3) [m]."""
    contact = world.data.contact
    watched = world.cabinet_contacts.watched[contact.geom[:, 0], contact.geom[:, 1]]
    return contact.pos[watched & (contact.dist < 0)]


def circled(picture: Picture, pixels: np.ndarray) -> Picture:
    """Picture with circles round pixels, shape (n, 2)."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    for u, v in pixels.tolist():
        draw.circle((u, v), MARK, outline=palette.LIMIT, width=4)
    return np.asarray(image)


if __name__ == "__main__":
    cli.run(main, Args)
