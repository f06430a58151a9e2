"""Film of five demonstrations that become a thousand, by `hrc multiply`.

First the arm plays the demonstrations, then some of the new motions, each with its own object,
while the paths of all of them appear. Counts are those of the dataset.

hrc record expert --scenario grasping --episodes 5 --out outputs/five \
    --config robot.object_pose=true
hrc multiply outputs/five --episodes 1000 --out outputs/thousand
python tools/docs/multiply_film.py --five outputs/five --thousand outputs/thousand
"""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from film_pictures import IMAGES, camera_at, write_film
from jaxtyping import Float
from PIL import Image, ImageDraw

from hrc_learn import cli
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda
from hrc_learn.log import RunRecording
from hrc_learn.sim import RecordedWorld, World
from hrc_learn.sim.cameras import OffscreenRenderer
from hrc_learn.sim.scene import SceneConfig
from hrc_learn.sim.workplace import Workplace
from hrc_learn.store import read_json
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated

SIZE, FINE = (576, 360), 2
"""Size of the pictures [px]; paths are drawn at a multiple of it, for smooth lines."""
EYE, TOWARDS, FOCAL = (1.05, 1.25, 0.80), (0.14, 0.36, 0.19), 1.3
"""View of arm and table [m], and its focal length by the picture's height."""
SECONDS, SHOWN, PLAYED = 11.5, 0.35, 4
"""Duration of the film between its titles [s], fraction with the demonstrations, and number of
new motions that the arm plays."""
POINTS = 40
"""Points of a drawn path."""
FIVE, THOUSAND = palette.VERMILION, palette.BLUE
FAINT = {FIVE: (255, 2 * FINE), THOUSAND: (28, FINE)}
"""Opacity from 0 to 255 and width [px] of the paths of motions that are not played."""
DIFFERS = 6
"""Grey levels by which a picture with the arm differs from one without, where the arm is."""
AXES = tuple(f"object.{axis}.pos" for axis in ("x", "y", "z", "wx", "wy", "wz"))
"""Columns of the object's pose: position [m] and rotation vector [rad]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to film."""

    five: Path = Path("outputs/five")
    """Demonstrations of `hrc record expert --scenario grasping`."""
    thousand: Path = Path("outputs/thousand")
    """Dataset that `hrc multiply` made from them."""
    out: Path = IMAGES / "multiply.webp"
    """Receives the film as a moving picture."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """An episode of a dataset."""

    joints: Float[np.ndarray, "frames joints"]
    """Joint positions [rad]."""
    gripper: Float[np.ndarray, " frames"]
    """Opening [m]."""
    item: Float[np.ndarray, "frames 4 4"]
    """Pose of the object."""
    path: Float[np.ndarray, "points 3"]
    """Path of the tool [m]."""
    duration: float
    """Duration [s]."""
    tried: int = 1
    """Number of motions that were judged for this episode: those that failed, and this one."""
    judged_by: str = ""
    """Description of the judge."""


def main(args: Args) -> None:
    five, thousand = motions(args.five), motions(args.thousand)
    film(args.out, five, thousand)


def motions(folder: Path) -> list[Motion]:
    """All episodes of a dataset."""
    info = read_json(folder / "meta" / "info.json")
    names = info["features"]["observation.state"]["names"]
    joints = [names.index(f"{name}.pos") for name in panda.chain.joint_names]
    pose, gripper = [names.index(axis) for axis in AXES], names.index("gripper.pos")
    columns = ["episode_index", "observation.state"]
    rows = pq.read_table(sorted(folder.glob("data/*/*.parquet")), columns=columns)
    state = np.stack(rows.column("observation.state").to_numpy()).astype(float)
    ends = np.flatnonzero(np.diff(rows.column("episode_index").to_numpy())) + 1
    listed = pq.read_table(sorted(folder.glob("meta/episodes/*/*.parquet")))
    origins = [{"failed": {}, "judged_by": ""}] * listed.num_rows
    if "provenance" in listed.column_names:
        origins = [json.loads(text) for text in listed.column("provenance").to_pylist()]
    found = []
    for rows, origin in zip(np.split(state, ends), origins, strict=True):
        kept = np.linspace(0, len(rows) - 1, POINTS).round().astype(int)
        item = np.tile(np.eye(4), (len(rows), 1, 1))
        item[:, :3, 3] = rows[:, pose[:3]]
        turn = torch.from_numpy(rows[:, pose[3:]])
        item[:, :3, :3] = quaternion.to_matrix(quaternion.exp(turn)).numpy()
        tool = panda.forward(torch.from_numpy(rows[kept][:, joints]))
        found.append(
            Motion(
                joints=rows[:, joints],
                gripper=rows[:, gripper],
                item=item,
                path=tool.position.numpy(),
                duration=len(rows) / info["fps"],
                tried=1 + len(origin["failed"]),
                judged_by=origin["judged_by"],
            )
        )
    return found


def film(out: Path, five: list[Motion], thousand: list[Motion]) -> None:
    """Write the film of a dataset and of the motions made of it."""
    scene = Workplace.of(panda).scene
    world, camera = World(scene), camera_at(SIZE, EYE, TOWARDS, FOCAL)
    sheet, turns = Sheet(scene, camera), SHOWN * SECONDS
    with closing(OffscreenRenderer(world, *SIZE)) as renderer:

        def at(motion: Motion, fraction: float) -> Picture:
            """The arm and its object at a fraction of a motion."""
            frame = min(int(fraction * len(motion.joints)), len(motion.joints) - 1)
            objects = {scene.objects[0].name: motion.item[frame]}
            world.reset(motion.joints[frame], objects, motion.gripper[frame])
            return renderer.render(camera)

        def picture(time: float) -> Picture:
            if time < turns:
                number, fraction = divmod(len(five) * time / turns, 1.0)
                motion, shown = five[int(number)], int(number) + 1
                sheet.draw([], THOUSAND)
                sheet.draw(five[: int(number)], FIVE)
                path, colour = motion.path[: 2 + int(fraction * (POINTS - 2))], FIVE
                text = f"Demonstration {shown} of {len(five)}"
                slot = turns / len(five)
                labels = [("demonstrated", FIVE)]
            else:
                passed = min((time - turns) / (SECONDS - turns), 1.0)
                number, fraction = divmod(min(PLAYED * passed, PLAYED - 1e-6), 1.0)
                made = count(passed, len(thousand))
                begun = count(number / PLAYED, len(thousand))
                motion, slot = thousand[begun - 1], (SECONDS - turns) / PLAYED
                sheet.draw(thousand[:made], THOUSAND)
                sheet.draw(five, FIVE)
                path, colour = motion.path, THOUSAND
                text = f"{made} new motions: {share(thousand[:made])}"
                labels = [("demonstrated", FIVE), ("new motions for new objects", THOUSAND)]
            clock = f"{motion.duration / slot:.0f} ×"
            arm = at(motion, fraction)
            return annotated(sheet.picture(arm, path, colour), text, clock, labels)

        first = f"{len(five)} demonstrations become {len(thousand)}"
        write_film(out, picture, (0.8 * SECONDS, 0.0, SECONDS), (first, share(thousand)))


def share(made: Sequence[Motion]) -> str:
    """Share of the motions that the judge accepted."""
    tried = sum(motion.tried for motion in made)
    judge, _, _ = made[0].judged_by.partition(":")
    test = "succeed in physics" if judge == "physics" else "keep limits and distances"
    return f"{len(made)} of {tried} {test}"


def count(passed: float, most: int) -> int:
    """Number of motions that are shown at a fraction of the time; few at first."""
    return max(1, round(most * passed**2))


class Sheet:
    """The scene without its arm, with paths, in front of which the arm is drawn."""

    def __init__(self, scene: SceneConfig, camera: CameraModel):
        self._camera, still = camera, np.zeros((1, 3))
        boxes, none = tuple(scene.boxes()), np.zeros((1, 0))
        empty = RunRecording(
            title="",
            time=np.zeros(1),
            joint_names=(),
            joint_position=none,
            position=still,
            boxes=boxes,
        )
        with closing(OffscreenRenderer(RecordedWorld(empty), *SIZE)) as renderer:
            self._empty = renderer.render(camera)
        self._begin()

    def _begin(self) -> None:
        """Start with the scene alone."""
        fine = FINE * SIZE[0], FINE * SIZE[1]
        self._paths = Image.fromarray(self._empty).resize(fine, Image.Resampling.BILINEAR)
        self._drawn = {FIVE: 0, THOUSAND: 0}

    def draw(self, motions: Sequence[Motion], colour: str) -> None:
        """Draw the paths of motions and the places of their objects, unless they are there."""
        if self._drawn[colour] > len(motions):
            self._begin()
        for motion in motions[self._drawn[colour] :]:
            self._draw(self._paths, motion.path, colour, *FAINT[colour])
            (place,) = self._pixels(motion.item[:1, :3, 3]).tolist()
            dot = (*palette.rgba(colour)[:3], 200)
            ImageDraw.Draw(self._paths, "RGBA").circle(place, 2 * FINE, fill=dot)
        self._drawn[colour] = len(motions)

    def picture(self, arm: Picture, path: np.ndarray, colour: str) -> Picture:
        """The paths so far and the path of the motion that the arm plays, behind the arm."""
        sheet = self._paths.copy()
        self._draw(sheet, path, colour, 255, 3 * FINE)
        behind = np.asarray(sheet.resize(SIZE, Image.Resampling.BOX))
        covered = np.abs(arm.astype(np.int16) - self._empty).max(axis=-1) > DIFFERS
        return np.where(covered[..., None], arm, behind)

    def _draw(
        self, sheet: Image.Image, path: np.ndarray, colour: str, opacity: int, width: int
    ) -> None:
        points = [*map(tuple, self._pixels(path).tolist())]
        fill = (*palette.rgba(colour)[:3], opacity)
        ImageDraw.Draw(sheet, "RGBA").line(points, fill=fill, width=width, joint="curve")

    def _pixels(self, points: np.ndarray) -> np.ndarray:
        return FINE * (self._camera.project(points) + 0.5)


if __name__ == "__main__":
    cli.run(main, Args)
