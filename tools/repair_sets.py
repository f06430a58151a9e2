"""Does a repair leave alone what it must, and does LeRobot train on what it makes?

Sound and damaged datasets of every version are made, others are given by their path. Each is
repaired. Then every command, and every column that switches between few levels, must be what it
was in the frames that are left; LeRobot must open the result and decode its first and last
frame; and where there are actions its ACT, small and untrained, must take one step of training.

    python tools/repair_sets.py path/to/dataset
"""

import argparse
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import av  # noqa: E402
import numpy as np  # noqa: E402
import pyarrow as pa  # noqa: E402
from broken_copies import STATE, Copy  # noqa: E402
from clean_sets import SETS, SIZE, demonstration, write_set  # noqa: E402
from lerobot_folders import (  # noqa: E402
    one_step_of_act,
    read_info,
    rewrite,
    write_folder,
    write_info,
)
from value_defects import VALUES  # noqa: E402

from hrc_learn.demos import check_dataset, repair_dataset  # noqa: E402
from hrc_learn.demos.read.dataset_folder import DatasetFolder, open_folder  # noqa: E402
from hrc_learn.demos.read.frames import read_frames  # noqa: E402
from hrc_learn.demos.read.quantities import INDEX_KEYS  # noqa: E402

NAMES = [*(f"joint{i}.pos" for i in range(1, 7)), "gripper.pos"]
HAND_NAMES = [*NAMES[:6], "hand.pos"]
HEAD = (
    "| set | episodes changed | frames | commands and switches touched | others changed "
    "| errors | LeRobot | loss of ACT |"
)
FEW = 0.1
"""Fraction of the frames below which the number of values marks a switching column."""


def damaged(root: Path, *kinds: str) -> Path:
    """Damage a dataset in several ways."""
    for kind in kinds:
        VALUES[kind].damage(Copy(root))
    return root


def without_indices(root: Path) -> Path:
    """A dataset whose files lack the columns by which LeRobot counts."""
    gone = ["frame_index", "index", "task_index"]
    for file in sorted((root / "data").glob("*/*.parquet")):
        rewrite(file, lambda table: table.drop_columns(gone))
    info = read_info(root)
    write_info(root, info | {"features": _less(info["features"], gone)})
    return root


def _less(features: dict, gone: list[str]) -> dict:
    return {key: value for key, value in features.items() if key not in gone}


def with_images(root: Path) -> Path:
    """Images in a column of the table instead of a video."""
    write_set(root, "v2.1")
    info = read_info(root)
    key, shape = "observation.images.front", [*SIZE, 3]
    names = ["height", "width", "channels"]
    info["features"][key] = {"dtype": "image", "shape": shape, "names": names}
    write_info(root, info)
    for file in sorted((root / "data").glob("*/*.parquet")):

        def add(table: pa.Table) -> pa.Table:
            images = [{"bytes": picture(k % 250), "path": None} for k in range(len(table))]
            return table.append_column(key, pa.array(images))

        rewrite(file, add)
    return root


def picture(shade: int) -> bytes:
    """A PNG image of one shade."""
    stream = av.CodecContext.create("png", "w")
    stream.height, stream.width, stream.pix_fmt = *SIZE, "rgb24"
    stream.time_base = Fraction(1, 30)
    frame = av.VideoFrame.from_ndarray(np.full((*SIZE, 3), shade, np.uint8), format="rgb24")
    return b"".join(bytes(packet) for packet in [*stream.encode(frame), *stream.encode()])


def two_hands(root: Path) -> Path:
    """Two arms with hands whose commands have two levels that lie nearly a turn apart."""
    episodes = []
    for seed in range(4):
        left, right = demonstration(seed), demonstration(seed + 10)
        frames = min(len(left["action"]), len(right["action"]))
        episode = {}
        for column in (STATE, "action"):
            sides = [side[column][:frames].copy() for side in (left, right)]
            for values in sides:
                values[:, 6] = np.where(values[:, 6] > 0.5, 3.0, -3.0)
            episode[column] = np.concatenate(sides, axis=1)
        episodes.append(episode)
    names = [
        f"{side}_{name}" for side in ("left", "right") for name in (*NAMES[:6], "hand.pos")
    ]
    return write_folder(root, episodes, {STATE: names, "action": names}, version="v2.1", fps=30)


REST, TURN, STALE = "a long rest first", "a turn that wrapped", "frames recorded three times"
V3, V21, V20 = SETS.values()
MADE: dict[str, Callable[[Path], Path]] = {
    "v3.0, camera": lambda root: write_set(root, **V3),
    "v3.0, camera, a rest, a turn": lambda root: damaged(write_set(root, **V3), REST, TURN),
    "v2.1, camera, degrees": lambda root: write_set(root, **V21),
    "v2.1, camera, degrees, a turn": lambda root: damaged(write_set(root, **V21), TURN),
    "v2.0": lambda root: write_set(root, **V20),
    "v2.0, a rest, frames thrice, no indices": lambda root: without_indices(
        damaged(write_set(root, **V20), STALE, REST)
    ),
    "v2.1, column of images": with_images,
    "v2.1, two arms, hands of two levels": two_hands,
}


def numbers(folder: DatasetFolder) -> Iterator[dict[str, np.ndarray]]:
    """Numeric columns of each episode but those that only count."""
    keys = [key for key, f in folder.features.items() if f.numeric and key not in INDEX_KEYS]
    for _, frames in read_frames(folder, folder.episodes, keys):
        yield {key: frames[key] for key in keys}


def untouched(old: Path, new: Path) -> tuple[int, int, int]:
    """Compare commands and what switches.

    Returns:
        Columns that were compared over all episodes, those that differ, and measured columns
        that were changed.
    """
    compared = differing = changed = 0
    for before, after in zip(numbers(open_folder(old)), numbers(open_folder(new)), strict=True):
        first = offset(before, after)
        for key, values in before.items():
            left = values[first : first + len(after[key])]
            for k in range(values.shape[1]):
                levels = len({*values[:, k].tolist()})
                same = np.array_equal(left[:, k], after[key][:, k], equal_nan=True)
                if key.startswith("action") or levels < FEW * len(values):
                    compared, differing = compared + 1, differing + (not same)
                else:
                    changed += not same
    return compared, differing, changed


def offset(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> int:
    """First frame that is left of an episode, by the column that is there as it was."""
    frames = len(next(iter(after.values())))
    for first in range(len(next(iter(before.values()))) - frames + 1):
        if any(np.array_equal(v[first : first + frames], after[k]) for k, v in before.items()):
            return first
    raise SystemExit("no column is what it was in any part of the episode")


def opened(root: Path) -> int:
    """Frames that LeRobot counts; the first and the last are decoded."""
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("local/repaired", root=root, video_backend="pyav")
    assert dataset[0].keys() == dataset[len(dataset) - 1].keys()
    return len(dataset)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", nargs="*", type=Path, help="datasets besides our own")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    failed = 0
    print(HEAD, "|---" * 8 + "|", sep="\n")
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        os.environ["HF_DATASETS_CACHE"] = str(work / "cache")
        sets = {
            name: make(work / f"set{number}")
            for number, (name, make) in enumerate(MADE.items())
        } | {path.name: path for path in args.dataset}
        for number, (name, root) in enumerate(sets.items()):
            new = work / f"repaired{number}"
            report = repair_dataset(root, new)
            compared, differing, changed = untouched(root, new)
            errors, frames = len(check_dataset(new).errors), opened(new)
            # ACT finds its actions by this name alone.
            named = "action" in read_info(new)["features"]
            loss = one_step_of_act(new) if named else None
            wrong = loss is not None and not np.isfinite(loss)
            failed += bool(differing or errors or wrong)
            print(
                f"| {name} | {report.changed} of {len(report.changes)} "
                f"| {report.frames} of {report.frames_before} | {differing} of {compared} "
                f"| {changed} | {errors} | opens {frames} "
                f"| {'no `action`' if loss is None else f'{loss:.2f}'} |",
                flush=True,
            )
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
