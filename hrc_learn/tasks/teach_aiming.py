"""The expert shows the camera's image: moves the marked hand about, and ends above an object.

The image Jacobian is learned from the motion, and from the ends where to aim and how the hand
is turned to go on to the object.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..geometry import Pose, quaternion
from ..human import GuidedPath, ScriptedExpert, Tremor, gripper_down
from ..kinematics import panda
from ..sim import HAND_MARKER, World
from .eye import Eye
from .teaching import Frame, TeachingConfig, teach
from .visual_target import OBJECT_FEATURE
from .workplace import Workplace, nearest_configuration


@dataclass(frozen=True, kw_only=True)
class AimingLesson(TeachingConfig):
    """How the expert teaches aiming."""

    duration: float = 9.0
    """From the first point to above the object [s]."""
    points: int = 4
    """Random points passed before the object."""
    descent: float = 0.06
    """Height from which the hand at last comes straight down, as onto the object [m]."""
    reach: tuple[float, float, float] = (0.10, 0.08, 0.06)
    """How far from the middle of the table the points lie, and how far above hovering [m]."""
    wobble: float = 0.12
    """Amplitude of small turns of the hand on the way, which show how turning acts [rad]."""
    record_every: int = 4
    """Control steps from one recorded frame, and image, to the next."""


def aiming_expert(
    workplace: Workplace,
    above: Float[np.ndarray, "3"],
    lesson: AimingLesson,
    rng: np.random.Generator,
) -> ScriptedExpert:
    """The expert who wanders over the table and ends at a given point, hand pointing down."""
    middle = workplace.hover().position.numpy()
    spread = rng.uniform(-1, 1, (lesson.points, 3)) * lesson.reach
    spread[:, 2] = np.abs(spread[:, 2])
    higher = above + np.array([0.0, 0.0, lesson.descent])
    path = GuidedPath(np.vstack([middle + spread, higher, above]), lesson.duration)
    rates, phases = rng.uniform(0.8, 1.6, 3), rng.uniform(0, 2 * np.pi, 3)

    def orientation(_position: torch.Tensor, time: float) -> torch.Tensor:
        # The turns die away before the end, where the hand stands still above the object.
        fading = float(np.clip((0.75 * path.end - time) / 1.0, 0.0, 1.0))
        turn = lesson.wobble * fading * np.sin(rates * time + phases)
        return quaternion.multiply(quaternion.exp(torch.from_numpy(turn)), gripper_down())

    return ScriptedExpert(
        panda, path, tremor=Tremor(lesson.tremor, rng), orientation=orientation
    )


def teach_aiming(
    world: World, workplace: Workplace, eye: Eye, lesson: AimingLesson, rng: np.random.Generator
) -> list[Frame]:
    """Demonstrate one motion that ends above an object.

    The object is seen before the arm comes between it and the camera; its pixel is kept in
    every frame, as the camera saw it then.

    Raises:
        ValueError: If the camera does not see the object.
    """
    item = workplace.scene.objects[0]
    pose = workplace.random_object_pose(lesson.reach, rng)
    world.reset(workplace.home_joints().numpy(), {item.name: pose})
    target = eye.look().get(item.marker.id)
    if target is None:
        raise ValueError(
            f"the camera does not see marker {item.marker.id} on the table: move the camera or "
            "put the object into its view."
        )
    above = np.append(pose[:2, 3], workplace.hover_height)
    expert = aiming_expert(workplace, above, lesson, rng)
    start = torch.from_numpy(expert.path.position(0.0))
    goal = Pose(start, expert.orientation(start, 0.0))
    q = nearest_configuration(goal, near=workplace.hover_joints())
    world.reset(q.numpy(), {item.name: pose})
    last = np.zeros(2)

    def observe() -> Frame:
        nonlocal last
        feature = eye.look().get(HAND_MARKER)
        last = last if feature is None else feature
        return {
            "feature": last,
            "feature_visible": feature is not None,
            OBJECT_FEATURE: np.array([*target, 1.0]),
        }

    return list(teach(world, expert, lesson.duration + lesson.settle, lesson, observe))
