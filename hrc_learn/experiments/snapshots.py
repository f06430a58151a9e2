"""Rendered pictures of the arm at chosen moments of a run."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from hrc_learn.experiments.collaboration_trial import CollaborationRun
from hrc_learn.experiments.placing_trial import PlacingRun
from hrc_learn.experiments.run_measures import spans
from hrc_learn.experiments.run_recorder import push_arrows
from hrc_learn.geometry import Body, quaternion
from hrc_learn.sim import Arrow, OffscreenRenderer, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import INTERACT, RELEASE
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.figure_parts import STYLE, WIDTH

Image = UInt8[np.ndarray, "height width 3"]

type Snapshots = Mapping[str, Sequence[tuple[str, Image]]]
"""Rendered pictures with their titles, by the name of their figure."""

_WIDTH, _HEIGHT = 1200, 900
# Focal length relative to the height of the picture: 45 degrees from top to bottom.
_FOCAL = 1.2
# Eye and target of the pictures of placing: from the far corner of the table to the cabinet.
_PLACING_VIEW = (1.30, 0.95, 1.10), (0.24, -0.30, 0.30)
# Eye and target of the pictures of collaboration [m].
_COLLABORATION_VIEW = (1.55, 1.45, 1.25), (0.0, 0.25, 0.30)
# The x axis of the object lies along the closing direction of the fingers, its top towards the
# palm.
_IN_GRIPPER = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
# Fraction of the largest displacement of the elbow at which the drag still goes on.
_NEARLY = 0.9


def viewpoint(
    eye: tuple[float, float, float], towards: tuple[float, float, float]
) -> CameraModel:
    """Camera for pictures in reports.

    Args:
        eye: Position of the camera [m].
        towards: Point in the middle of the picture [m].
    """
    upright = CameraModel(
        width=_WIDTH,
        height=_HEIGHT,
        focal=(_FOCAL * _HEIGHT, _FOCAL * _HEIGHT),
        principal=((_WIDTH - 1) / 2, (_HEIGHT - 1) / 2),
    )
    return upright.look_at(np.array(eye), np.array(towards))


def snapshots_figure(pictures: Sequence[tuple[str, Image]], columns: int = 2) -> Figure:
    """Pictures side by side, each with its title above."""
    rows = -(-len(pictures) // columns)
    height, width = pictures[0][1].shape[:2]
    with matplotlib.rc_context(STYLE):
        each = WIDTH / columns
        figure = Figure(figsize=(WIDTH, rows * (each * height / width + 0.28)))
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, (title, picture) in zip(grid, pictures, strict=False):
            axes.imshow(picture, interpolation="lanczos")
            axes.set_title(title, fontsize=9)
    return figure


class Photographer:
    """Renders the arm in any posture, with the object in the gripper."""

    def __init__(self, workplace: Workplace):
        """Open a renderer at the far corner of the table, looking at the cabinet.

        Raises:
            RenderingUnavailableError: If this machine cannot render without a screen.
        """
        self._world = World(workplace.scene)
        self._item = workplace.scene.objects[0]
        self._camera = viewpoint(*_PLACING_VIEW)
        self._renderer = OffscreenRenderer(self._world, self._camera.width, self._camera.height)

    def picture(
        self, joints: Float[np.ndarray, " joints"], touching: Iterable[str] = ()
    ) -> Image:
        """Picture of the arm.

        Args:
            joints: Joint positions [rad].
            touching: Names of geoms in contact, which are highlighted.
        """
        tool = self._world.arm.robot.chain.forward(torch.from_numpy(joints)).matrix().numpy()
        width = 2 * self._item.half_size[0]
        self._world.reset(joints, {self._item.name: tool @ _IN_GRIPPER}, gripper_width=width)
        return self._renderer.render(self._camera, touching=touching)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def placing_snapshots(run: PlacingRun) -> Snapshots:
    """Pictures of demonstration and reproduction, and of the arm at each shelf.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    last = {
        shelf: run.placings["pose", shelf].joint_position[-1]
        for shelf in run.workplace.shelf_names()
    }
    with closing(Photographer(run.workplace)) as photographer:
        return {
            "snapshots": _motion_pictures(run, photographer),
            "shelves": [
                (f"{shelf} shelf", photographer.picture(q)) for shelf, q in last.items()
            ],
        }


def _motion_pictures(run: PlacingRun, photographer: Photographer) -> list[tuple[str, Image]]:
    """Two moments of the demonstration and two of its reproduction, as in the paper."""
    demonstration, reproduction = run.demonstration, run.reproduction
    assert demonstration.joint_position is not None
    moments = (
        ("(a) demonstration", demonstration.time, demonstration.joint_position, 0.35),
        ("(b) demonstration", demonstration.time, demonstration.joint_position, 0.80),
        ("(c) reproduction", reproduction.time, reproduction.joint_position, 0.35),
        ("(d) reproduction", reproduction.time, reproduction.joint_position, 1.0),
    )
    taken = []
    for title, time, joints, fraction in moments:
        wanted = time[0] + fraction * (time[-1] - time[0])
        k = min(int(np.searchsorted(time, wanted)), len(time) - 1)
        picture = photographer.picture(joints[k])
        taken.append((f"{title}, t = {time[k] - time[0]:.1f} s", picture))
    return taken


def collaboration_snapshots(run: CollaborationRun) -> list[tuple[str, Image]]:
    """Pictures of a job near a worker, at the moments of the paper's figure, with titles.

    A violet line joins the nearest points of worker and robot; an orange arrow at the elbow
    shows the direction of the drag.

    Args:
        run: Run with a worker.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    assert run.visit is not None
    world, camera = World(run.world.config), viewpoint(*_COLLABORATION_VIEW)
    bodies = {body.name: body for body in run.motion.bodies()}
    log, items = run.cell.log, [item.name for item in run.workplace.scene.objects]
    pictures = []
    with closing(OffscreenRenderer(world, camera.width, camera.height)) as renderer:
        for letter, (title, k) in zip("abcdef", moments(run), strict=False):
            q = log["joint_position"][k] - run.world.arm.encoder_offset
            poses = {name: _pose_matrix(bodies[name], k) for name in items}
            world.reset(q, poses, gripper_width=float(log["gripper"][k]))
            time = float(log["time"][k])
            world.move_worker(run.visit.capsules_at(time).ends, run.visit.item_at(time))
            picture = renderer.render(camera, _arrows(run, k))
            pictures.append((f"({letter}) t = {time:.1f} s: {title}", picture))
    return pictures


def moments(run: CollaborationRun) -> list[tuple[str, int]]:
    """Titles and steps of those moments of the paper's figure that occurred in the run.

    Args:
        run: Run with a worker.
    """
    assert run.visit is not None
    log = run.cell.log
    found = [
        ("before the worker comes", 0.0),
        ("the worker puts something on the bench", run.visit.released),
    ]
    for begin, end in spans(log, INTERACT)[:1]:
        reached = [span for span in run.visit.reaches if begin <= span[0] < end]
        if reached:
            found.append(("the worker reaches under the arm", float(reached[0].mean())))
        if (dragged := _time_of_drag(run, begin, end)) is not None:
            found.append(("the expert drags joint 4 aside", dragged))
    found += [("an object on its shelf", end) for _, end in spans(log, RELEASE)[:1]]
    last = float(log["time"][-1])
    found.append(("the end of the job", last))
    steps = np.searchsorted(log["time"], [min(time, last) for _, time in found])
    return [(title, int(step)) for (title, _), step in zip(found, steps, strict=True)]


def _time_of_drag(run: CollaborationRun, begin: float, end: float) -> float | None:
    """Time at which the elbow first nears its largest displacement [s]; None without a drag."""
    log = run.cell.log
    during = (log["time"] >= begin) & (log["time"] < end)
    push = push_arrows(run.cell.chain, log["joint_position"], log["nullspace_input"])
    during &= np.isfinite(push[:, 0, 0])
    if not during.any():
        return None
    elbow = push[during, 0]
    moved = np.linalg.norm(elbow - elbow[0], axis=-1)
    return float(log["time"][during][(moved >= _NEARLY * moved.max()).argmax()])


def _pose_matrix(body: Body, step: int) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    orientation = torch.from_numpy(body.orientation[step])
    pose[:3, :3] = quaternion.to_matrix(orientation).numpy()
    pose[:3, 3] = body.position[step]
    return pose


def _arrows(run: CollaborationRun, step: int) -> list[Arrow]:
    """Line to the nearest point of the worker, and arrow of the drag."""
    near, far = map(_point, run.motion.nearest(step + 1)[step].points)
    arrows = [Arrow(start=near, end=far, colour=_rgba(palette.PURPLE), width=0.008, head=False)]
    log, rows = run.cell.log, slice(step, step + 1)
    q, d = log["joint_position"][rows], log["nullspace_input"][rows]
    (push,) = push_arrows(run.cell.chain, q, d)
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
