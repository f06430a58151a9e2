"""Demonstrations by the scripted expert: of visual servoing, and of placing with hand and
body shape at once.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down, panda
from hrc_learn.sim import HAND_MARKER, Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.cartesian_motion import nearest_configuration
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_target import OBJECT_FEATURE
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.interaction_force import PullSpell
from hrc_learn.teleoperation.paired_demonstrations import TeachingConfig, teach
from hrc_learn.teleoperation.scripted_expert import GuidedPath, ScriptedExpert, Tremor

# The expert shows the camera's image: moves the marked hand about, and ends above an object.
#
# The image Jacobian is learned from the motion, and from the ends where to aim and how the hand
# is turned to go on to the object.


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
    world: World,
    workplace: Workplace,
    sensor: MarkerSensor,
    lesson: AimingLesson,
    rng: np.random.Generator,
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
    target = sensor.detect().get(item.marker.id)
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
        feature = sensor.detect().get(HAND_MARKER)
        last = last if feature is None else feature
        return {
            "feature": last,
            "feature_visible": feature is not None,
            OBJECT_FEATURE: np.array([*target, 1.0]),
        }

    return list(teach(world, expert, lesson.duration + lesson.settle, lesson, observe))


# The expert shows how a thing is put on a shelf: hand and body shape at once.

# The elbow is led around the open door: first away from the cabinet, then over beside it.
BODY_SHAPE = (
    PullSpell(start=0.5, duration=5.0, towards=(0.20, 0.25, 0.58)),
    PullSpell(start=4.5, duration=11.0, towards=(0.25, -0.10, 0.65)),
)


@dataclass(frozen=True, kw_only=True)
class PlacingLesson(TeachingConfig):
    """How the expert teaches placing."""

    duration: float = 14.0
    """From home to the shelf [s]."""
    spread: float = 0.015
    """Standard deviation of where demonstrations start, around home [m]."""
    shape_body: bool = True
    """Whether the expert pulls the elbow past the cabinet's open door."""
    lift: float = 0.03
    """How far above its last height the hand crosses the board's front edge [m]."""


def placing_expert(
    workplace: Workplace, shelf: str, lesson: PlacingLesson, rng: np.random.Generator
) -> ScriptedExpert:
    """The expert who puts a thing on a shelf.

    Args:
        workplace: Where.
        shelf: Which.
        lesson: How.
        rng: Source of the hand's unsteadiness and of where it starts.
    """
    goal, front = workplace.shelf(shelf).position, workplace.shelf_front(shelf).position
    # The hand is not quite level yet at the edge: what it carries hangs a little lower.
    lifted = torch.tensor([0.0, 0.0, lesson.lift], dtype=torch.float64)
    inside = goal + 0.3 * (front - goal)
    start = workplace.home().position + lesson.spread * torch.from_numpy(rng.standard_normal(3))
    waypoints = torch.stack([start, front + lifted, inside + lifted, goal]).numpy()
    return ScriptedExpert(
        panda,
        GuidedPath(waypoints, lesson.duration),
        spells=BODY_SHAPE if lesson.shape_body else (),
        tremor=Tremor(lesson.tremor, rng),
    )


def teach_placing_cleanly(
    world: World,
    workplace: Workplace,
    shelf: str,
    lesson: PlacingLesson,
    rng: np.random.Generator,
    attempts: int = 3,
) -> tuple[list[Frame], int]:
    """Demonstrate until nothing is touched on the way, as a person would.

    Returns:
        The recorded frames, and how many demonstrations were thrown away.

    Raises:
        TaskFailedError: If something was touched each time.
    """
    for attempt in range(attempts):
        frames, touches = teach_placing(world, workplace, shelf, lesson, rng)
        if not touches:
            return frames, attempt
    raise TaskFailedError(f"{attempts} demonstrations in a row hit the cabinet: {touches[0]}")


def teach_placing(
    world: World,
    workplace: Workplace,
    shelf: str,
    lesson: PlacingLesson,
    rng: np.random.Generator,
) -> tuple[list[Frame], list[Touch]]:
    """Demonstrate one placing motion, from home to a shelf with the thing in hand.

    Returns:
        The recorded frames, and all touches of the cabinet by arm or thing on the way.
    """
    expert = placing_expert(workplace, shelf, lesson, rng)
    offset = torch.from_numpy(expert.path.position(0.0)) - workplace.home().position
    world.hold(workplace.scene.objects[0].name, workplace.home_joints(offset).numpy())
    frames = list(teach(world, expert, lesson.duration + lesson.settle, lesson))
    return frames, world.cabinet_contacts.touches + world.object_contacts.touches
