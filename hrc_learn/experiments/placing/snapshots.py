"""Rendered snapshots of the arm, as somebody beside it sees it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float, UInt8

from hrc_learn.experiments.placing.arm_angle_ablation import SimulatedDemonstration
from hrc_learn.experiments.placing.trial import PlacingRun
from hrc_learn.kinematics import panda
from hrc_learn.sim import OffscreenRenderer, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import CameraModel

Image = UInt8[np.ndarray, "height width 3"]

type Snapshots = Mapping[str, Sequence[tuple[str, Image]]]
"""Rendered pictures with their titles, by what they show."""

_WIDTH, _HEIGHT = 1200, 900
_EYE, _TOWARDS = (1.30, 0.95, 1.10), (0.24, -0.30, 0.30)
_TOUCHING = (0.84, 0.37, 0.0, 1.0)  # colour of a link that touches something
# The object's x lies along the fingers' line of closing, its top towards the palm.
_IN_GRIPPER = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


class Photographer:
    """Puts the arm anywhere, with the object in the gripper, and takes a picture."""

    def __init__(self, workplace: Workplace):
        """Stand at the far corner of the table, looking at the cabinet.

        Raises:
            RenderingUnavailableError: If this machine cannot render without a screen.
        """
        self._world = World(workplace.scene)
        self._item = workplace.scene.objects[0]
        upright = CameraModel(
            width=_WIDTH,
            height=_HEIGHT,
            focal=(1.2 * _HEIGHT, 1.2 * _HEIGHT),
            principal=((_WIDTH - 1) / 2, (_HEIGHT - 1) / 2),
        )
        self._camera = upright.look_at(np.array(_EYE), np.array(_TOWARDS))
        self._renderer = OffscreenRenderer(self._world, _WIDTH, _HEIGHT)

    def picture(self, joints: Float[np.ndarray, "7"], touching: Iterable[str] = ()) -> Image:
        """The arm there; geoms that touch something stand out.

        Args:
            joints: Joint positions [rad].
            touching: Names of those geoms.
        """
        tool = panda.forward(torch.from_numpy(joints)).matrix().numpy()
        width = 2 * self._item.half_size[0]
        self._world.reset(joints, {self._item.name: tool @ _IN_GRIPPER}, gripper_width=width)
        with self._coloured(touching):
            return self._renderer.render(self._camera)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    @contextmanager
    def _coloured(self, geoms: Iterable[str]) -> Iterator[None]:
        colours = self._world.model.geom_rgba
        before = colours.copy()
        for name in geoms:
            colours[self._world.model.geom(name).id] = _TOUCHING
        try:
            yield
        finally:
            colours[:] = before


def take_snapshots(run: PlacingRun) -> Snapshots:
    """Motion, shelves and null-space posture.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    camera = Photographer(run.workplace)
    try:
        return {
            "snapshots": _motion(run, camera),
            "shelves": [
                (
                    f"{shelf} shelf",
                    camera.picture(run.placings["pose", shelf].joint_position[-1]),
                )
                for shelf in run.workplace.shelf_names()
            ],
            "null_space_posture": _null_space_posture(run, camera),
        }
    finally:
        camera.close()


def _motion(run: PlacingRun, camera: Photographer) -> list[tuple[str, Image]]:
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
        taken.append((f"{title}, t = {time[k] - time[0]:.1f} s", camera.picture(joints[k])))
    return taken


def _null_space_posture(run: PlacingRun, camera: Photographer) -> list[tuple[str, Image]]:
    """The arm when it hits the cabinet without the posture, and the same moment with it."""
    without, taught = run.ablation.without_posture, run.ablation.with_posture
    hits = without.arm_contacts
    moment = hits[0].start if hits else float(without.time[-1])

    def at(demonstration: SimulatedDemonstration) -> np.ndarray:
        step = int(np.searchsorted(demonstration.time, moment)) - 1
        return demonstration.joint_position[step]

    end = "the arm hits the door" if hits else "free"
    picture = camera.picture(at(without), {touch.first for touch in hits[:1]})
    return [
        (f"(a) without, t = {moment:.1f} s: {end}", picture),
        (f"(b) with null-space posture, t = {moment:.1f} s", camera.picture(at(taught))),
    ]
