"""Rendered pictures of a job beside a worker, at the moments of the paper's figure.

A violet line joins worker and robot where they are nearest to each other; an orange arrow at
the elbow shows where the expert drags it.
"""

from contextlib import closing

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.collaboration.trial import CollaborationRun
from hrc_learn.experiments.run_recording import pushes, spans
from hrc_learn.experiments.snapshots import Image, viewpoint
from hrc_learn.geometry import quaternion
from hrc_learn.sim import Arrow, OffscreenRenderer, World
from hrc_learn.skills.pick_and_place import INTERACT, RELEASE
from hrc_learn.viz import palette

EYE, TOWARDS = (1.55, 1.45, 1.25), (0.0, 0.25, 0.30)
"""Where the pictures are taken from, and what is in their middle [m]."""
# Fraction of the way aside at which the drag is still on.
_NEARLY = 0.9


def moments(run: CollaborationRun) -> list[tuple[str, int]]:
    """What is to be seen, and at which step: as many of the paper's moments as there were.

    Args:
        run: With a worker.
    """
    assert run.visit is not None
    log = run.cell.log
    found = [("before he comes", 0.0), ("he puts something on the bench", run.visit.released)]
    for begin, end in spans(log, INTERACT)[:1]:
        reached = [span for span in run.visit.reaches if begin <= span[0] < end]
        if reached:
            found.append(("he reaches under the arm", float(reached[0].mean())))
        if (dragged := _furthest_aside(run, begin, end)) is not None:
            found.append(("the expert drags joint 4 aside", dragged))
    found += [("an object on its shelf", end) for _, end in spans(log, RELEASE)[:1]]
    last = float(log["time"][-1])
    found.append(("all is done", last))
    steps = np.searchsorted(log["time"], [min(time, last) for _, time in found])
    return [(what, int(step)) for (what, _), step in zip(found, steps, strict=True)]


def take_snapshots(run: CollaborationRun) -> list[tuple[str, Image]]:
    """Pictures of the moments, with their titles.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    assert run.visit is not None
    world, camera = World(run.world.config), viewpoint(EYE, TOWARDS)
    bodies = {body.name: body for body in run.motion.bodies()}
    log, items = run.cell.log, [item.name for item in run.workplace.scene.objects]
    pictures = []
    with closing(OffscreenRenderer(world, camera.width, camera.height)) as renderer:
        for letter, (what, k) in zip("abcdef", moments(run), strict=False):
            q = log["joint_position"][k] - run.world.arm.encoder_offset
            poses = {name: _matrix(bodies[name], k) for name in items}
            world.reset(q, poses, gripper_width=float(log["gripper"][k]))
            time = float(log["time"][k])
            world.move_worker(run.visit.capsules_at(time).ends, run.visit.item_at(time))
            picture = renderer.render(camera, _arrows(run, k))
            pictures.append((f"({letter}) t = {time:.1f} s: {what}", picture))
    return pictures


def _furthest_aside(run: CollaborationRun, begin: float, end: float) -> float | None:
    """When the elbow is nearly as far aside as it gets, on the way there."""
    log = run.cell.log
    during = (log["time"] >= begin) & (log["time"] < end)
    push = pushes(run.cell.chain, log["joint_position"], log["nullspace_input"])
    during &= np.isfinite(push[:, 0, 0])
    if not during.any():
        return None
    elbow = push[during, 0]
    aside = np.linalg.norm(elbow - elbow[0], axis=-1)
    return float(log["time"][during][(aside >= _NEARLY * aside.max()).argmax()])


def _matrix(body, step: int) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    turn = torch.from_numpy(body.orientation[step])
    pose[:3, :3] = quaternion.to_matrix(turn).numpy()
    pose[:3, 3] = body.position[step]
    return pose


def _arrows(run: CollaborationRun, step: int) -> list[Arrow]:
    """To the nearest point of the worker, and where the elbow is dragged."""
    near, far = map(_point, run.motion.nearest(step + 1)[step].points)
    arrows = [Arrow(start=near, end=far, colour=_rgba(palette.PURPLE), width=0.008, head=False)]
    log, rows = run.cell.log, slice(step, step + 1)
    (push,) = pushes(run.cell.chain, log["joint_position"][rows], log["nullspace_input"][rows])
    if np.isfinite(push).all():
        elbow, tip = map(_point, push)
        arrows.append(Arrow(start=elbow, end=tip, colour=_rgba(palette.PERSON), width=0.03))
    return arrows


def _point(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _rgba(colour: str) -> tuple[float, float, float, float]:
    r, g, b = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return r, g, b, 1.0
