"""Pictures of the arm at moments of its motion, as somebody beside it sees them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float, UInt8

from hrc_learn.experiments.placing.experiment import PlacingExperiment, ShownWay
from hrc_learn.kinematics import panda
from hrc_learn.sim import OffscreenRenderer, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import CameraModel

Image = UInt8[np.ndarray, "height width 3"]

_WIDTH, _HEIGHT = 1200, 900
_EYE, _TOWARDS = (1.30, 0.95, 1.10), (0.24, -0.30, 0.30)
_TOUCHING = (0.84, 0.37, 0.0, 1.0)  # colour of a link that touches something
# The object's x lies along the fingers' line of closing, its top towards the hand.
_IN_HAND = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


class Photographer:
    """Puts the arm anywhere, with its load in the hand, and takes a picture."""

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
        hand = panda.forward(torch.from_numpy(joints)).matrix().numpy()
        width = 2 * self._item.half_size[0]
        self._world.reset(joints, {self._item.name: hand @ _IN_HAND}, gripper_width=width)
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


def take_pictures(experiment: PlacingExperiment) -> dict[str, list[tuple[str, Image]]]:
    """All of an experiment, with their titles, by what they show.

    Raises:
        RenderingUnavailableError: If this machine cannot render without a screen.
    """
    camera = Photographer(experiment.workplace)
    try:
        return {
            "motion": _motion(experiment, camera),
            "shelves": _shelves(experiment, camera),
            "body_shape": _body_shape(experiment, camera),
        }
    finally:
        camera.close()


def _motion(experiment: PlacingExperiment, camera: Photographer) -> list[tuple[str, Image]]:
    """Two moments of the demonstration and two of its reproduction, as in the paper."""
    demo, run = experiment.demonstration, experiment.reproduction
    assert demo.joint_position is not None
    taken = []
    for letter, share in (("a", 0.35), ("b", 0.80)):
        k = _at(demo.time, share)
        title = f"({letter}) demonstration, t = {demo.time[k] - demo.time[0]:.1f} s"
        taken.append((title, camera.picture(demo.joint_position[k])))
    for letter, share in (("c", 0.35), ("d", 1.0)):
        k = _at(run.time, share)
        title = f"({letter}) reproduction, t = {run.time[k]:.1f} s"
        taken.append((title, camera.picture(run.joint_position[k])))
    return taken


def _body_shape(experiment: PlacingExperiment, camera: Photographer) -> list[tuple[str, Image]]:
    """The arm without its body shaped when it hits the cabinet, and the same moment with it."""
    untaught, taught = experiment.untaught, experiment.taught
    hits = untaught.met_by_arm
    moment = hits[0].start if hits else float(untaught.time[-1])

    def at(shown: ShownWay) -> np.ndarray:
        return shown.joint_position[int(np.searchsorted(shown.time, moment)) - 1]

    without = camera.picture(at(untaught), {touch.first for touch in hits[:1]})
    end = f"t = {moment:.1f} s"
    return [
        (
            f"(a) hand alone shown, {end}: " + ("the arm hits the door" if hits else "free"),
            without,
        ),
        (f"(b) body shown as well, {end}", camera.picture(at(taught))),
    ]


def _shelves(experiment: PlacingExperiment, camera: Photographer) -> list[tuple[str, Image]]:
    """The arm at each shelf, planned in task space, before it lets go."""
    return [
        (f"{shelf} shelf", camera.picture(experiment.runs["pose", shelf].joint_position[-1]))
        for shelf in experiment.workplace.shelf_names()
    ]


def _at(time: Float[np.ndarray, " samples"], share: float) -> int:
    """Index of the sample at a share of the motion."""
    wanted = time[0] + share * (time[-1] - time[0])
    return min(int(np.searchsorted(time, wanted)), len(time) - 1)
