"""Draw the pictures of docs/concepts/dmp_gallery.md: one of every kind of movement primitive.

python tools/docs/dmp_gallery.py --out docs/images
python tools/docs/dmp_gallery.py --out /tmp/pictures --only joint pose
"""

import io
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from dmp_pictures import joint_pictures, loop_pictures, space_pictures
from dmp_pictures.drawing import Picture
from matplotlib.figure import Figure

from hrc_learn import cli
from hrc_learn.viz.figures import STYLE, WIDTH

DPI = 120
PICTURES: dict[str, tuple[Picture, float]] = {
    "joint": (joint_pictures.joint, 2.8),
    "scalings": (joint_pictures.scalings, 2.7),
    "approach": (joint_pictures.approach, 2.6),
    "rhythm": (joint_pictures.rhythm, 2.4),
    "distribution": (joint_pictures.distribution, 2.7),
    "via_points": (joint_pictures.via_points, 2.6),
    "context": (joint_pictures.context, 3.2),
    "moving_goal": (joint_pictures.moving_goal, 2.6),
    "goal_filter": (loop_pictures.goal_filter, 2.6),
    "stopping": (loop_pictures.stopping, 2.6),
    "obstacles": (loop_pictures.obstacles, 2.7),
    "force": (loop_pictures.force, 2.8),
    "orientation": (space_pictures.orientation, 3.1),
    "pose": (space_pictures.pose, 3.4),
    "bases": (joint_pictures.bases, 2.4),
}
"""Pictures by name, with their heights [inch]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Draw the pictures of docs/concepts/dmp_gallery.md."""

    out: Path
    """Folder for the pictures dmp_NAME.png."""
    only: tuple[str, ...] = ()
    """Names of the pictures to draw; all of them by default."""


def draw(name: str) -> bytes:
    """Picture as PNG."""
    picture, height = PICTURES[name]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height))
        picture(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, dpi=DPI)
    return buffer.getvalue()


def main(args: Args) -> None:
    unknown = set(args.only) - PICTURES.keys()
    if unknown:
        raise ValueError(
            f"no picture {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.only or PICTURES:
        (args.out / f"dmp_{name}.png").write_bytes(draw(name))
        print(args.out / f"dmp_{name}.png")


if __name__ == "__main__":
    cli.run(main, Args)
