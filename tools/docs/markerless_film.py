"""Film of a grasp without any marker: the camera's picture with all findings, and the scene.

The program grasps once with a camera that was moved after the demonstrations, keeps what the
detector found in each image, and draws it over the image: the outline and the matched points
of arm and object, their pixels with two standard deviations, and the target of servoing.

hrc demo --markerless --robot ur5e --out outputs/demo_ur5e
python tools/docs/markerless_film.py --aiming outputs/demo_ur5e/aiming_markerless
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from film_pictures import IMAGES, SECONDS, camera_at, write_film
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from hrc_learn import cli
from hrc_learn.experiments.experiment import evaluate_all
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.grasping_trial import GraspingRun, GraspingScene
from hrc_learn.experiments.run_recorder import caption, record
from hrc_learn.experiments.simulated_cell import plan_checker, simulated_cell
from hrc_learn.experiments.surroundings import unmarked_for
from hrc_learn.kinematics import ArmChoice
from hrc_learn.log import RunRecording
from hrc_learn.sim import RecordedWorld, World
from hrc_learn.sim.cameras import EGLCamera, OffscreenRenderer
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import Grasping, GraspJob
from hrc_learn.skills.marker_sensor import LandmarkSensor
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import TaskFailedError, WorkCellConfig
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.vision.landmarks import Finding, Landmarks
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated

CAMERA, SCENE, BAR = (360, 270), (290, 270), 36
"""Sizes of the camera's picture and of the view of the scene; height of the caption [px]."""
FINE = 2
"""Findings are drawn at this multiple of the size, for smooth lines."""
EYE, TOWARDS, FOCAL = (1.35, 1.35, 0.95), (0.16, 0.34, 0.28), 1.05
"""View of arm and table [m], and its focal length by the picture's height."""
KEEP_EVERY = 8
"""Control steps between two pictures of the camera."""
BEFORE, AFTER = 0.6, 1.0
"""From the begin of the film to the servoing, and from the lift to the end of the film [s]."""
TELLING = 60.0
"""Distance of the arm from its target in the first picture [px]."""
ARM, OBJECT, TARGET = palette.YELLOW, palette.SKY, "#00E08A"


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to film."""

    aiming: Path = Path("outputs/demo_ur5e/aiming_markerless")
    """Model that `hrc demo --markerless` learned."""
    robot: str = "ur5e"
    """Arm of the demonstrations, by name."""
    out: Path = IMAGES / "markerless.webp"
    """Receives the film as a moving picture."""
    seed: int = 3003
    """Seed of scene, camera and imperfections."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A picture of the camera and what was found in it."""

    time: float
    image: Image.Image
    found: Mapping[str, Finding]


class FilmedSensor(LandmarkSensor):
    """Sensor that keeps its pictures, small, and the findings in them."""

    def __init__(self, world: World, eye: EGLCamera, landmarks: Landmarks, names: dict):
        super().__init__(_OneImage(world, eye), landmarks, names)
        self._world, self.seen = world, list[Seen]()

    def read(self) -> Picture:
        """Take an image, and keep it with the findings since the last one."""
        image, fine = self._camera.read(), (FINE * CAMERA[0], FINE * CAMERA[1])
        small = Image.fromarray(image).resize(fine, Image.Resampling.BOX)
        found = dict(self._found) if self._is_fresh else {}
        self._is_fresh = False
        self.seen.append(Seen(time=self._world.time, image=small, found=found))
        return np.asarray(small)


class _OneImage:
    """Camera that renders once at a time of the world."""

    def __init__(self, world: World, eye: EGLCamera):
        self._world, self._eye, self._time = world, eye, -1.0

    def read(self) -> Picture:
        if self._world.time != self._time:
            self._time, self._image = self._world.time, self._eye.read()
        return self._image


def main(args: Args) -> None:
    experiment = GraspingExperiment(
        aiming=args.aiming, look=UnmarkedLook(), robot=ArmChoice(args.robot)
    )
    run, sensor = grasp(experiment, args.seed)
    results = evaluate_all(experiment, run, args.seed, [])
    if results.failure:
        raise ValueError(f"the run failed, choose another --seed: {results.failure}")
    offset = next(m.shown for m in results.table if m.name == "grasp offset")
    recording = record("Grasping", run.cell, run.world, run.motion)
    film(args.out, recording, sensor.seen, f"Lifted: gripped {offset} from its middle")


def grasp(experiment: GraspingExperiment, seed: int) -> tuple[GraspingRun, FilmedSensor]:
    """Grasp once, as the experiment does, with a sensor that keeps its pictures."""
    skill, look = VisualServoSkill.load(experiment.aiming), experiment.look
    assert look is not None
    workplace = unmarked_for(Workplace.of(experiment.robot.work_arm()), skill, look, seed)
    rng, sizes = np.random.default_rng(seed), experiment.imperfections
    scene = GraspingScene.draw(workplace, experiment.scene, rng, "synthetic", sizes)
    scene = replace(scene, workplace=scene.workplace.approached(skill.approach))
    world, rng = scene.world(), np.random.default_rng([seed, 1])
    item, landmarks = scene.workplace.scene.objects[0], skill.landmarks
    assert landmarks is not None
    eye = EGLCamera(world, rng=rng, noise=world.imperfections.sizes.camera_noise)
    names = {scene.workplace.tool_marker: "tool", item.marker.id: next(iter(landmarks.objects))}
    sensor = FilmedSensor(world, eye, landmarks, names)
    job, failure = GraspJob(item=item), ""
    person = ScriptedPerturbation(scene.workplace.robot.chain, ())
    config = WorkCellConfig(keep_image_every=KEEP_EVERY)
    with simulated_cell(world, human=person, sensor=sensor, config=config, rng=rng) as parts:
        cell, motion = parts
        task = Grasping(cell, scene.workplace, skill, check=plan_checker(world))
        try:
            task.grasp(job)
            task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    run = GraspingRun(
        scene=scene,
        world=world,
        cell=cell,
        motion=motion,
        item=item,
        result=None if failure else job,
        failure=failure,
    )
    return run, sensor


def film(path: Path, run: RunRecording, seen: list[Seen], ending: str) -> None:
    """Write the film of a run."""
    assert run.camera is not None
    camera, world = run.camera, RecordedWorld(run)
    begun = {event.text: event.time for event in reversed(run.phases)}
    begin, end = max(begun["servo"] - BEFORE, 0.0), begun["lift"] + AFTER
    scale = FINE * CAMERA[0] / camera.model.width
    kept = np.array([one.time for one in seen])
    near = (run.time > begun["servo"]) & (camera.error < TELLING)
    telling = float(run.time[near.argmax()])
    scene = camera_at(SCENE, EYE, TOWARDS, FOCAL)
    with closing(OffscreenRenderer(world, *SCENE)) as renderer:

        def picture(time: float) -> Picture:
            step = min(int(np.searchsorted(run.time, time)), len(run.time) - 1)
            world.show(step)
            one = seen[max(int(np.searchsorted(kept, time, side="right")) - 1, 0)]
            found = dict(one.found)
            target = camera.target[step]
            if time >= begun["grasp"]:
                found.pop(next((name for name in found if name != "tool"), ""), None)
                target = np.full(2, np.nan)
            shown, labels = drawn(one.image, found, target, scale)
            sheet = Image.new("RGB", (CAMERA[0] + SCENE[0], CAMERA[1] + BAR))
            sheet.paste(shown)
            sheet.paste(Image.fromarray(renderer.render(scene)), (CAMERA[0], 0))
            text = caption(run, time)
            if time < begun["grasp"] and np.isfinite(camera.error[step]):
                text = f"Servoes without markers: {camera.error[step]:.0f} px to go"
            clock = f"{time - begin:.0f} s   {max((end - begin) / SECONDS, 1.0):.1f} ×"
            return annotated(np.asarray(sheet), text, clock, labels)

        write_film(path, picture, (telling, begin, end), ("No marker anywhere", ending))


def drawn(
    image: Image.Image, found: Mapping[str, Finding], target: np.ndarray, scale: float
) -> tuple[Image.Image, list[tuple[str, str]]]:
    """A picture with findings and target, in its final size, and the legend.

    Args:
        image: Picture of the camera, fine.
        found: Findings by name [px of the camera].
        target: Pixel of the target; NaN: none.
        scale: Size of the picture by that of the camera's images.
    """
    image, labels = image.copy(), []
    draw = ImageDraw.Draw(image)
    for name, one in found.items():
        colour, called = (ARM, "arm") if name == "tool" else (OBJECT, "object")
        points = scale * one.points
        outline = points[ConvexHull(points).vertices]
        draw.polygon([tuple(p) for p in outline.tolist()], outline=colour, width=3)
        for u, v in points.tolist():
            draw.ellipse((u - 3, v - 3, u + 3, v + 3), fill=colour)
        u, v = (scale * one.pixel).tolist()
        for reach, dark in ((9, "black"), (7, colour)):
            draw.line((u - 2 * reach, v, u + 2 * reach, v), fill=dark, width=reach // 2)
            draw.line((u, v - 2 * reach, u, v + 2 * reach), fill=dark, width=reach // 2)
        text = f"{called}: {len(points)} points, ± {one.deviation:.1f} px"
        labels.append((text, colour))
    if np.isfinite(target).all():
        u, v = (scale * target).tolist()
        draw.ellipse((u - 16, v - 16, u + 16, v + 16), outline="black", width=9)
        draw.ellipse((u - 15, v - 15, u + 15, v + 15), outline=TARGET, width=6)
        labels.append(("target of the servoing", TARGET))
    return image.resize(CAMERA, Image.Resampling.BOX), labels


if __name__ == "__main__":
    cli.run(main, Args)
