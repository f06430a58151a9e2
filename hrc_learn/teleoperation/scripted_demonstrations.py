"""Record demonstrations of a scripted expert: visual servoing, and placing with pulls at the
elbow.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import UnreachableError, coarse_orientation, gripper_down
from hrc_learn.protocols import Camera, Human, HumanInput
from hrc_learn.sim import HAND_MARKER, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation.hand_guiding import (
    CombinedInput,
    Frame,
    GuidedStep,
    HandGuidedArm,
    HandGuidingConfig,
)
from hrc_learn.teleoperation.scripted_expert import (
    GuidedPath,
    ScriptedExpert,
    ScriptedForce,
    ScriptedPerturbation,
    Tremor,
)
from hrc_learn.vision import angle, centre


@dataclass(frozen=True, kw_only=True)
class DemonstrationConfig:
    """Settings of hand guiding and recording."""

    duration: float
    """Duration of the motion [s]."""
    tremor: float = 4e-4
    """Amplitude of the tremor of the person's hand [m]."""
    settle: float = 1.0
    """Rest at the end of a demonstration [s]."""
    record_every: int = 2
    """Number of control steps from one recorded frame to the next."""

    def __post_init__(self) -> None:
        positive = "duration", "record_every"
        check_settings(self, positive=positive, not_negative=("tremor", "settle"))

    @property
    def fps(self) -> float:
        """Recorded frames per second."""
        return 1.0 / (HandGuidingConfig.dt * self.record_every)


def guided_frames(
    world: World,
    human: Human,
    config: DemonstrationConfig,
    observe: Callable[[], Mapping[str, Any]] = dict,
) -> Iterator[dict[str, Any]]:
    """Let a person guide the arm of a world, and yield the frames to record.

    Args:
        world: World with the arm at the start of the demonstration.
        human: Gives end-effector motion and null-space input.
        config: Duration and rate.
        observe: Returns further columns of a frame; called when the frame is recorded.

    Yields:
        A frame every `record_every` control steps.
    """
    arm = HandGuidedArm(world.arm.robot.chain, world.arm, human)
    dt = arm.config.dt
    for k in range(round((config.duration + config.settle) / dt)):
        step = arm.step()
        if k % config.record_every == 0:
            yield {**step.frame(), **observe()}
        world.advance(dt)


@dataclass(frozen=True, kw_only=True)
class ServoDemonstrationConfig(DemonstrationConfig):
    """Scripted demonstration of visual servoing."""

    duration: float = 9.0
    """Duration of the motion from the first point to the point above the object [s]."""
    points: int = 4
    """Number of random points that the path passes before the object."""
    descent: float = 0.06
    """Height of the final vertical descent [m]."""
    reach: tuple[float, float, float] = (0.10, 0.08, 0.06)
    """Largest horizontal distances of points and object from the middle of the table, and
    largest height of the points above the hover pose [m]."""
    yaw: float = math.pi
    """Largest turn of the object on the table, either way [rad]."""
    wobble: float = 0.12
    """Amplitude of small rotations during the motion [rad]; the images show their effect."""
    record_every: int = 4
    """Number of control steps from one recorded frame, with its image, to the next frame."""
    markerless: bool = False
    """True films a scene without markers; False records the pixels of markers."""


FILM = "front"
"""Name of the camera that films demonstrations."""


def servo_expert(
    workplace: Workplace,
    above: Float[np.ndarray, "3"],
    config: ServoDemonstrationConfig,
    rng: np.random.Generator,
    turned: float = 0.0,
) -> ScriptedExpert:
    """Expert that moves over the table and ends at `above` [m], with the gripper down.

    On the way, the gripper turns by `turned` [rad] about the vertical. The motions train the
    image Jacobian. The end points define the goal pixel of the marker and the orientation of
    the approach.
    """
    middle = workplace.hover().position.numpy()
    size = workplace.robot.hand_size
    spread = rng.uniform(-1, 1, (config.points, 3)) * workplace.scaled(config.reach)
    spread[:, 2] = np.abs(spread[:, 2])
    higher = above + np.array([0.0, 0.0, size * config.descent])
    path = GuidedPath(np.vstack([middle + spread, higher, above]), config.duration)
    # Three incommensurate rotations, each about once in 5 s, excite all directions.
    rates, phases = rng.uniform(0.8, 1.6, 3), rng.uniform(0, 2 * np.pi, 3)

    def orientation(_position: torch.Tensor, time: float) -> torch.Tensor:
        # The rotations fade out before the end, where the tool rests above the object.
        fading = float(np.clip((0.75 * path.end - time) / 1.0, 0.0, 1.0))
        turn = config.wobble * fading * np.sin(rates * time + phases)
        # In the middle of the motion, the gripper turns to the orientation of the object.
        progress, _ = minimum_jerk((time / path.end - 0.2) / 0.5)
        turn[2] += turned * progress
        return quaternion.multiply(quaternion.exp(torch.from_numpy(turn)), gripper_down())

    return ScriptedExpert(
        workplace.robot.chain, path, orientation, Tremor(size * config.tremor, rng)
    )


def demonstrate_servoing(
    world: World,
    workplace: Workplace,
    sensor: MarkerSensor,
    config: ServoDemonstrationConfig,
    rng: np.random.Generator,
) -> list[Frame]:
    """Demonstrate one motion that ends above an object.

    The object is detected before the arm can hide it; every frame contains this first pixel.
    An object that the camera does not see is moved elsewhere.

    Args:
        world: World, which is reset for the demonstration.
        workplace: Workplace of the demonstration.
        sensor: Marker detector of the camera.
        config: Timing and heights.
        rng: Source of objects, paths and tremor.

    Raises:
        ValueError: The camera does not see the object anywhere.
    """
    expert, target = _arranged(world, workplace, sensor, config, rng)
    last = np.zeros((4, 2))

    def observe() -> Frame:
        nonlocal last
        corners = sensor.corners().get(HAND_MARKER)
        last = last if corners is None else corners
        return {
            "feature": centre(last) if last.any() else last[0],
            "feature_visible": corners is not None,
            OBJECT_FEATURE: np.array([*centre(target), 1.0]),
            ANGLE_FEATURE: np.array([angle(last), angle(target)]),
        }

    return list(guided_frames(world, expert, config, observe))


def film_servoing(
    world: World,
    workplace: Workplace,
    sensor: MarkerSensor,
    camera: Camera,
    config: ServoDemonstrationConfig,
    rng: np.random.Generator,
) -> Iterator[dict[str, Any]]:
    """Demonstrate one motion that ends above an object, and film it.

    Args:
        world: World, which is reset for the demonstration.
        workplace: Workplace of the demonstration.
        sensor: Detects if the object is in view; its pixels are not recorded.
        camera: Camera that films.
        config: Timing and heights.
        rng: Source of objects, paths and tremor.

    Yields:
        A frame with the camera's image.
    """
    expert, _ = _arranged(world, workplace, sensor, config, rng)
    name, dt = workplace.scene.objects[0].name, 1 / config.fps
    pose = world.object_pose(name)

    def image() -> dict[str, Any]:
        return {"images": {FILM: camera.read()}}

    start = torch.from_numpy(world.arm.read().joint_position)
    # On the way from home to the start, the camera still sees the object.
    path = joint_line(workplace.home_joints(), start, _LEAD_SPEED, dt).numpy()
    for k, (q, velocity) in enumerate(zip(path, np.gradient(path, dt, axis=0), strict=True)):
        world.reset(q, {name: pose})
        state = replace(world.arm.read(), time=k * dt, joint_velocity=velocity)
        tool = world.arm.robot.chain.forward(q)
        step = GuidedStep(state=state, human_input=HumanInput(), pose=tool, command=velocity)
        yield {**step.frame(), **image()}
    shift = len(path) * dt - world.time
    for frame in guided_frames(world, expert, config, image):
        yield {**frame, "time": frame["time"] + shift}


def _arranged(
    world: World,
    workplace: Workplace,
    sensor: MarkerSensor,
    config: ServoDemonstrationConfig,
    rng: np.random.Generator,
) -> tuple[ScriptedExpert, Float[np.ndarray, "4 2"]]:
    """Reset the world; return the expert and the corner pixels of the object's marker."""
    item, home = workplace.scene.objects[0], workplace.home_joints().numpy()
    for _ in range(_DRAWS):
        pose = workplace.random_object_pose(workplace.scaled(config.reach), rng, config.yaw)
        world.reset(home, {item.name: pose})
        target = sensor.corners().get(item.marker.id)
        if target is not None:
            break
    else:
        raise ValueError(
            f"the camera does not see marker {item.marker.id}, wherever on the table it lies: "
            "move the camera, or choose a smaller reach of the demonstrations."
        )
    above = np.append(pose[:2, 3], workplace.hover_height)
    refused: UnreachableError | None = None
    for _ in range(_DRAWS):
        expert = servo_expert(workplace, above, config, rng, _turn_for(pose, workplace))
        start = torch.from_numpy(expert.path.position(0.0))
        goal = Pose(start, expert.orientation(start, 0.0))
        try:
            q = workplace.robot.inverse(goal, near=workplace.hover_joints())
        except UnreachableError as error:
            refused = error  # small arms can tilt little at the highest points
        else:
            world.reset(q.numpy(), {item.name: pose})
            return expert, target
    assert refused is not None
    raise refused


def _turn_for(pose: Float[np.ndarray, "4 4"], workplace: Workplace) -> float:
    """Turn of the gripper, within the turns that the arm can reach (`hover_turns`) [rad].

    With this turn, the gripper closes along the object's x axis. If the arm reaches no such
    turn, the result is the nearest end of the range.
    """
    low, high = workplace.hover_turns
    yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
    turn = low + (yaw - low) % np.pi
    return min(turn, high) if turn - high <= low + np.pi - turn else low


# Number of object poses and of paths tried: a camera that sees half of the table misses twenty
# random poses in a row once in a million.
_DRAWS = 20
# Speed of the fastest joint on the way to a filmed demonstration [rad/s].
_LEAD_SPEED = 1.2
# Number of attempts at a demonstration without contact.
_ATTEMPTS = 3
# Largest final distance from the place on the shelf [m]: ten times the error from tremor and
# the lag of the arm.
_ARRIVED = 0.02

# Pulls of the elbow around the cabinet's open door: first away from the cabinet, then to its
# side.
ELBOW_FORCES = (
    ScriptedForce(start=0.5, duration=5.0, towards=(0.20, 0.25, 0.58)),
    ScriptedForce(start=4.5, duration=11.0, towards=(0.25, -0.10, 0.65)),
)


@dataclass(frozen=True, kw_only=True)
class PlacingDemonstrationConfig(DemonstrationConfig):
    """Scripted demonstration of placing."""

    duration: float = 14.0
    """Duration from home to the shelf [s]."""
    spread: float = 0.015
    """Standard deviation of the initial positions around home [m]."""
    pull_elbow: bool = True
    """True if the expert pulls the elbow past the cabinet's open door."""
    lift: float = 0.03
    """Height of the end effector over the board's front edge, above the final height [m]."""


def placing_expert(
    world: World,
    workplace: Workplace,
    shelf: str,
    config: PlacingDemonstrationConfig,
    rng: np.random.Generator,
) -> Human:
    """Reset a world for placing, and return the expert that puts the object on a shelf.

    Args:
        world: World; afterwards, its arm is near home with the object in the gripper.
        workplace: Workplace with the shelves.
        shelf: Name of the shelf.
        config: Timing and heights.
        rng: Random source of the tremor and of the initial position.
    """
    size = workplace.robot.hand_size
    offset = size * config.spread * torch.from_numpy(rng.standard_normal(3))
    world.hold(workplace.scene.objects[0].name, workplace.home_joints(offset).numpy())
    waypoints = workplace.path_to_shelf(shelf, config.lift)
    waypoints[0] += offset
    chain = workplace.robot.chain
    expert = ScriptedExpert(
        chain,
        GuidedPath(waypoints.numpy(), config.duration),
        lambda position, _: coarse_orientation(position, workplace.level_at),
        Tremor(size * config.tremor, rng),
    )
    # An arm without a free arm angle has its elbow where the end effector requires it.
    if not config.pull_elbow or workplace.robot.null_space != "arm angle":
        return expert
    return CombinedInput(expert, ScriptedPerturbation(chain, ELBOW_FORCES))


def demonstrate_placing(
    world: World,
    workplace: Workplace,
    shelf: str,
    config: PlacingDemonstrationConfig,
    rng: np.random.Generator,
) -> tuple[list[Frame], int]:
    """Carry the object in the gripper from home to a shelf; repeat until there is no contact.

    Args:
        world: World, which is reset for each demonstration.
        workplace: Workplace of the demonstration.
        shelf: Name of the shelf.
        config: Timing and heights.
        rng: Source of the tremor and of the initial position.

    Returns:
        The recorded frames, and the number of discarded demonstrations.

    Raises:
        TaskFailedError: Each demonstration touched something or missed its place.
    """
    goal, why = workplace.shelf(shelf).position.numpy(), ""
    for attempt in range(_ATTEMPTS):
        expert = placing_expert(world, workplace, shelf, config, rng)
        frames = list(guided_frames(world, expert, config))
        touches = world.cabinet_contacts.touches + world.object_contacts.touches
        off = float(np.linalg.norm(frames[-1]["position"] - goal))
        if not touches and off < _ARRIVED:
            return frames, attempt
        why = str(touches[0]) if touches else f"the arm ended {100 * off:.0f} cm from its place"
    raise TaskFailedError(f"{_ATTEMPTS} demonstrations in a row failed: {why}")
