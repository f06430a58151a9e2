"""Make a film of a run a moving picture, which Markdown shows anywhere.

python tools/docs/moving_picture.py outputs/so101_played/film.mp4 docs/images/so101.webp

`tools/build_gallery.py` lists the commands of all pictures.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import av
import tyro
from PIL import Image

from hrc_learn import cli


@dataclass(frozen=True, kw_only=True)
class Args:
    """Make a film a moving picture."""

    film: Annotated[Path, tyro.conf.Positional]
    """Film that a run wrote, such as film.mp4."""
    out: Annotated[Path, tyro.conf.Positional]
    """File .webp."""
    width: int = 480
    """Width of the pictures [px]."""
    rate: float = 15.0
    """Most pictures per second [1/s]; the film's own if it has fewer."""
    quality: int = 45
    """Quality from 0 to 100, which decides the size of the file."""


def main(args: Args) -> None:
    if args.out.suffix != ".webp":
        raise ValueError(f"{args.out}: name a file .webp")
    with av.open(str(args.film)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate is not None
        own = float(stream.average_rate)
        every = max(1, round(own / args.rate))
        pictures = [
            frame.to_image()
            for number, frame in enumerate(container.decode(stream))
            if number % every == 0
        ]
    height = round(args.width * pictures[0].height / pictures[0].width)
    first, *others = [
        p.resize((args.width, height), Image.Resampling.LANCZOS) for p in pictures
    ]
    first.save(
        args.out,
        save_all=True,
        append_images=others,
        duration=round(1000 * every / own),
        loop=0,
        quality=args.quality,
        method=4,
    )
    print(f"{args.out}: {len(pictures)} pictures, {args.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    cli.run(main, Args)
