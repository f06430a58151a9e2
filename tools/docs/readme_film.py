"""Film of the README: an expert takes the elbow of the arm while a worker reaches under it.

The program runs the collaboration once and renders its recording: a title over the most
telling picture, 15 pictures a second, the image of the camera first, a close-up of the shelf
while the arm carries, and the measured place error as the end title. The expert is a force
without a body in the simulation. The film draws a body whose hand is at the elbow where and
while the force acts; worker and arm are those of the run.

hrc demo
python tools/docs/readme_film.py --models outputs/demo
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

import numpy as np
from film_pictures import FIRST, IMAGES, LAST, RATE, camera_at, moving_picture, titled
from PIL import Image

from hrc_learn import cli
from hrc_learn.experiments import run_recorder as recorder
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.experiment import evaluate_all
from hrc_learn.geometry.shapes import Line
from hrc_learn.log import RunRecording
from hrc_learn.sim import RecordedWorld
from hrc_learn.sim.cameras import OffscreenRenderer
from hrc_learn.sim.worker import COLOURS, PARTS, Posture, Worker
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated, camera_inset

SIZE = 640, 400
"""Of the pictures [px]."""
SECONDS = 15.0
"""Duration of the film between its titles [s]."""
TITLE = "A robot arm works with people"
AFTER_RELEASE = 7.0
"""Time after the release at which the film ends [s]."""
EYE, TOWARDS, FOCAL = (1.62, 1.42, 1.02), (0.10, 0.06, 0.36), 1.07
"""View of cabinet, arm, expert and worker [m], and its focal length by the picture's height."""
CLOSE_UP = np.array([0.22, 0.50, 0.20])
"""From the place of the release to the eye of the close-up, through the open front [m]."""
INSET = 0.27
"""Of the picture's width."""
DISTANCE, SIDE = 0.55, math.radians(-60)
"""From the elbow to the place of the expert [m], and its direction: between arm and cabinet."""
REACHING, WALKING = 0.8, 2.5
"""Durations in which the expert reaches for the elbow, and walks up to it [s]."""
AWAY = 1.6
"""Distance from which the expert comes, along x [m]."""
GRIP = 0.05
"""From the axis of the elbow to the hand around it [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to film."""

    models: Path = Path("outputs/demo")
    """Folder of `hrc demo`, with the learned models."""
    out: Path = IMAGES / "film.webp"
    """Receives the film as a moving picture."""
    seed: int = 0
    """Seed of the run."""


def main(args: Args) -> None:
    experiment = CollaborationExperiment(
        aiming=args.models / "aiming", placing=args.models / "placing", worker=True
    )
    run = experiment.run(args.seed)
    results = evaluate_all(experiment, run, args.seed, [])
    if results.failure:
        raise ValueError(f"the run failed, choose another --seed: {results.failure}")
    error = next(m.shown for m in results.table if m.name == "place error")
    content = moving_picture(frames(experiment.recordings(run)["run"], f"placed, {error} off"))
    args.out.write_bytes(content)
    print(f"{args.out}: {len(content) / 1e6:.1f} MB")


def frames(run: RunRecording, ending: str) -> Iterator[Picture]:
    """Pictures of a run that placed its object, titled at both ends.

    The first one, which is all that some pages show, is from the time at which the person pulls
    and the worker reaches.
    """
    width, height = SIZE
    begun = {event.text: event.time for event in run.phases}
    shelf = run.position[np.searchsorted(run.time, begun["release"])]
    view = camera_at(SIZE, EYE, TOWARDS, FOCAL)
    close = camera_at(SIZE, shelf + CLOSE_UP, shelf - [0.0, 0.0, 0.05], 1.5)
    assert run.camera is not None, "the run servoed"
    inset, expert = camera_inset(run.camera, width), expert_in(run)
    small = round(INSET * width), round(INSET * width * 3 / 4)
    world = RecordedWorld(run)
    end = begun["release"] + AFTER_RELEASE
    with closing(OffscreenRenderer(world, width, height)) as renderer:

        def at(time: float) -> Picture:
            step = int(np.searchsorted(run.time, time))
            world.show(step)
            body, holds = expert(time)
            legend = [("a worker reaches under the arm", "#336B9E")] if near(run, step) else []
            if holds:
                legend.append(("a person pulls the elbow aside", palette.PERSON))
            picture = renderer.render(view, body)
            if time < begun.get("home", begun["transfer"]):
                corner = inset(step, time)
            else:
                shot = Image.fromarray(renderer.render(close, [])).crop(
                    ((width - height * 4 // 3) // 2, 0, (width + height * 4 // 3) // 2, height)
                )
                corner = np.asarray(shot.resize(small))
            clock = f"{time - run.time[0]:.0f} s   {(end - run.time[0]) / SECONDS:.1f} ×"
            return annotated(picture, said(run, step), clock, legend, corner)

        times = np.linspace(run.time[0], end, round(RATE * SECONDS)).tolist()
        yield from repeat(titled(at(telling(run, times)), TITLE), round(RATE * FIRST))
        for time in times:
            shown = at(time)
            yield shown
    yield from repeat(titled(shown, ending), round(RATE * LAST))


def telling(run: RunRecording, times: Sequence[float]) -> float:
    """Time at which the person pulls, the worker is nearest if one is there [s]."""
    expert = expert_in(run)
    pulled = [time for time in times if expert(time)[1]]
    assert pulled, "somebody pulls in this run"
    if run.worker_nearest is None:
        return pulled[len(pulled) // 2]
    gaps = np.linalg.norm(run.worker_nearest[:, 1] - run.worker_nearest[:, 0], axis=1)
    return min(pulled, key=lambda time: gaps[np.searchsorted(run.time, time)])


def said(run: RunRecording, step: int) -> str:
    """Caption of the phase; the distance still to go while the arm servoes."""
    text = recorder.caption(run, float(run.time[step]))
    phase = [event.text for event in run.phases if event.time <= run.time[step]][-1]
    if phase != "servo" or run.camera is None:
        return text
    error = run.camera.error[step]
    left = f"{error:.0f} px to go" if np.isfinite(error) else "looks for its marker"
    return f"Servoes with an uncalibrated camera: {left}"


def near(run: RunRecording, step: int) -> bool:
    """True while the worker is within reach of the arm."""
    pairs = run.worker_nearest
    return pairs is not None and float(np.linalg.norm(pairs[step][1] - pairs[step][0])) < 0.4


def expert_in(run: RunRecording) -> Callable[[float], tuple[list[Line], bool]]:
    """Function of the time [s]: body of the expert, and True while the hand pulls.

    The expert walks up before the first pull, holds the elbow while a pull lasts, and leaves
    after the last one.
    """
    assert run.push is not None, "somebody pulls in this run"
    rows = np.isfinite(run.push).all(axis=(1, 2))
    pulls, elbows = run.time[rows], run.push[rows, 0]
    middle = elbows.mean(axis=0)[:2]
    outward = np.array([math.cos(SIDE), math.sin(SIDE)])
    worker = Worker()
    colours = [
        palette.rgba(palette.PERSON)
        if "chest" in part or "arm" in part or part == "shoulders"
        else None
        for part in PARTS
    ]

    def at(time: float) -> tuple[list[Line], bool]:
        nearest = int(np.abs(pulls - time).argmin())
        gap = abs(float(pulls[nearest]) - time)
        hold = _smooth(1 - gap / REACHING)
        before, after = pulls[0] - REACHING - time, time - pulls[-1] - REACHING
        absent = max(before, after, 0.0) / WALKING
        if absent > 1:
            return [], False
        place = middle + DISTANCE * outward + np.array([AWAY * absent, 0.0])
        # The expert comes along -x, faces the elbow, and leaves along x.
        facing, walking = SIDE + math.pi, 0.0 if after > 0 else math.pi
        heading = facing + _smooth(4 * absent) * (walking - facing)
        elbow = elbows[nearest] + GRIP * np.append(outward, 0.0)
        own = elbow - np.append(place, worker.config.floor)
        c, s = math.cos(heading), math.sin(heading)
        own = np.array([c * own[0] + s * own[1], -s * own[0] + c * own[1], own[2]])
        hands = worker.hanging_hands()
        hands[1] += hold * (own - hands[1])
        lean = worker.lean_to(own, 1) if hold > 0 else 0.0
        paces = 2 * math.pi * AWAY * absent / 1.3  # a pair of steps is 1.3 m long
        walks = 1.0 if absent > 0 else 0.0
        posture = Posture(
            place=place,
            heading=np.array(heading),
            lean=np.array(hold * (0.3 if lean is None else lean)),
            stride=np.array(0.22 * walks * math.sin(paces)),
            swing=np.array(walks * math.cos(paces)),
            hands=hands,
        )
        lines = []  # MuJoCo takes the width of a line for its radius
        ends = worker.ends(posture)
        for pair, radius, own_colour, shirt in zip(
            ends, worker.radius, COLOURS, colours, strict=True
        ):
            r, g, b = own_colour[:3] if shirt is None else (x / 255 for x in shirt[:3])
            lines.append(Line(start=pair[0], end=pair[1], colour=(r, g, b, 1.0), width=radius))
        return lines, gap < 0.1

    return at


def _smooth(fraction: float) -> float:
    x = min(max(fraction, 0.0), 1.0)
    return x * x * (3 - 2 * x)


if __name__ == "__main__":
    cli.run(main, Args)
