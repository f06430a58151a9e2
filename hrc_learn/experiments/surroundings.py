"""Surroundings of a run: objects on the table, a worker, a person handing over an object."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import SeparationConfig
from hrc_learn.controller.contact_limits import ContactLimits, region_numbers
from hrc_learn.dmp import InteractionPrimitive
from hrc_learn.geometry import Box, Pose, minimum_jerk, quaternion
from hrc_learn.jacobian.perspective import MARKER
from hrc_learn.kinematics import Arm, CapsuleArm, GraspedBox, Separation, separation
from hrc_learn.kinematics.collision import segment_distance
from hrc_learn.log import LoggedSteps
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import (
    Imperfections,
    MotionLog,
    ObjectConfig,
    Touch,
    Worker,
    WorkerConfig,
    WorkerSensor,
    WorkerVisit,
    World,
    random_visit,
    whole_arm,
)
from hrc_learn.sim.hand_over import HAND_OVER, HandOver, random_hand_over
from hrc_learn.sim.scene import UnmarkedLook, unmarked
from hrc_learn.sim.worker import IMAGE_RATE, PARTS, REGIONS
from hrc_learn.sim.worker_visit import turned_about_base
from hrc_learn.sim.workplace import Workplace, pose_on_table
from hrc_learn.skills.receiving import MovementWatch, ReceivingConfig
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import read_toml

THREE_OBJECTS = read_toml(
    Path(__file__).with_name("three_objects.toml"), dict[str, tuple[ObjectConfig, ...]]
)["objects"]
"""Three boxes that fit into the gripper."""
# Added to the seed of a run's look, because demonstrations use the looks of small seeds.
_OTHER_LOOK = 10_000


def unmarked_for(
    workplace: Workplace, skill: VisualServoSkill, look: UnmarkedLook, seed: int
) -> Workplace:
    """Workplace without markers for a skill that was learned without them.

    Args:
        workplace: Workplace with markers.
        skill: Skill with landmarks; metrics use the point of the tool that the skill sees.
        look: Look of the scene.
        seed: Seed of clutter and light.

    Raises:
        ValueError: The skill needs markers.
    """
    camera = skill.jacobian.camera
    if skill.landmarks is None or camera is None:
        raise ValueError(
            "--markerless needs a model that was learned without markers: fit one by `hrc fit "
            "image-jacobian --markerless`, or leave out --aiming to use that of `hrc demo`."
        )
    look = replace(look, seed=seed + _OTHER_LOOK)
    scene = unmarked(workplace.scene, look, camera[MARKER].numpy())
    return replace(workplace, scene=scene)


OBJECT_REACH = (0.10, 0.08, 0.0)
"""Largest distance of a single object from the middle of the table [m]."""
OBJECTS_REACH = (0.12, 0.10)
"""Largest distance of several objects from the middle of the table along x and y [m]."""

# Smallest distance between two objects [m]. Open fingers around one object then do not touch
# the other, in any orientation: the outside of a finger is 0.06 m from the centre of its
# object, and the farthest corner of an object is 0.046 m from the object's centre.
_APART = 0.118
# Largest number of arrangements of the objects that are tried.
_ARRANGEMENTS = 10_000

# `_ENTERS`: range of the time at which the worker enters [s]. The robot waits above its first
# object 11 s after the start, and the worker should then reach under the arm.
# `_REACHES`: range of the number of reaches.
_ENTERS, _REACHES = (4.0, 9.0), (3, 5)
# `_KEPT_CLEAR`: distance that people keep from a resting arm that they see [m]: the thickness
# of a sleeve. `_CHECKED_EVERY`: time between checks of this distance [s]. `_DRAWS`: largest
# number of workers that are drawn to find one that can reach under the arm at this distance.
_KEPT_CLEAR, _CHECKED_EVERY, _DRAWS = 0.03, 0.05, 60
# The search ends if none of this many drawn workers can reach under the arm. If there is enough
# room, one worker in three can reach under it.
_HOPELESS = 30
# Speed up to which a part of the arm counts as at rest [m/s]: servos that hold a pose against a
# push creep.
_AT_REST = 0.01
# Number of steps that are computed at once, which takes some 100 MB.
_BLOCK = 250
# Demonstrated visits by different people: 30 hand-overs among 120 other movements.
_VISITS = 30
# Number of basis functions for a movement of about a second. In a test on twelve other visits,
# models with four functions recognised every kind of movement from its first half. Models with
# six and eight functions fit the noise of the tracker.
_BASIS_FUNCTIONS = 4
# Waiting position of the end effector relative to its hover position over the table [m].
_WAITING_OFFSET = (0.05, -0.16, 0.25)
# Parts of a tracked person whose movements are watched: body and hand.
_WATCHED = PARTS.index("pelvis"), PARTS.index("hand_right")
# Fewest images of a movement to learn from.
_FEWEST_IMAGES = 8
# `_APPROACHED`, `_RESTED`: the person brings the object to the robot's hand after this hand has
# moved this far [m] and then rested this long [s]. `_PERCEPTION_NOISE`: standard deviation with
# which the person perceives the position of the robot's hand [m]. `_RELEASE_AFTER`: time for
# which the robot has held the object when the person releases it [s].
_APPROACHED, _RESTED, _PERCEPTION_NOISE, _RELEASE_AFTER = 0.05, 0.5, 0.004, 0.3
# Speed below which the robot's hand counts as at rest [m/s], and longest time for which the
# person holds out the object [s].
_RESTING_SPEED, _GIVE_UP_AFTER = 0.02, 25.0


def with_objects(workplace: Workplace, items: Sequence[ObjectConfig]) -> Workplace:
    """Workplace with these objects on its table."""
    return replace(workplace, scene=replace(workplace.scene, objects=tuple(items)))


def workplace_for(shelves: Sequence[str], robot: Arm) -> Workplace:
    """Workplace of an arm with one object for each shelf.

    Raises:
        ValueError: If no shelf is named, or if there are more shelves than objects.
    """
    if not 1 <= len(shelves) <= len(THREE_OBJECTS):
        text = f"{len(shelves)} shelves are named, but there are 1 to {len(THREE_OBJECTS)}"
        raise ValueError(f"{text} objects, each with a shelf of its own.")
    items = [item.scaled(robot.hand_size) for item in THREE_OBJECTS[: len(shelves)]]
    return with_objects(Workplace.of(robot), items)


def draw_object_poses(
    workplace: Workplace, world: World, yaw: float, rng: np.random.Generator
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Random poses of all objects on the table, clear of each other.

    Args:
        workplace: Workplace of the world.
        world: World with the true height of the table and the true object sizes.
        yaw: Largest rotation about the vertical, either way [rad].
        rng: Source of positions and rotations.

    Raises:
        ValueError: If the objects do not fit.
    """
    items = world.config.objects
    size = workplace.robot.hand_size
    reach = size * np.array(OBJECT_REACH[:2] if len(items) == 1 else OBJECTS_REACH)
    for _ in range(_ARRANGEMENTS):
        positions = workplace.table_centre + rng.uniform(-1, 1, (len(items), 2)) * reach
        gaps = np.linalg.norm(positions[:, None] - positions, axis=-1)
        if (gaps + np.eye(len(items)) >= size * _APART).all():
            return {
                item.name: pose_on_table(
                    position, rng.uniform(-yaw, yaw), world.table_top + item.half_size[2]
                )
                for item, position in zip(items, positions, strict=True)
            }
    text = f"{len(items)} objects do not fit within {reach[0]:g} and {reach[1]:g} m of the"
    raise ValueError(f"{text} middle with clearance for the fingers: use fewer objects.")


def points_to_see(workplace: Workplace, world: World) -> Float[np.ndarray, "points 3"]:
    """Points that a camera must see: the region of the objects and of the gripper's marker [m].

    Args:
        workplace: Workplace of the world.
        world: World with the true place of the marker on the gripper.
    """
    reach = workplace.robot.hand_size * np.array([*OBJECTS_REACH, 0.0])
    corners = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)])
    hover, offset = workplace.hover(), torch.from_numpy(world.hand_marker_offset())
    turns = torch.linspace(*workplace.hover_turns, 7, dtype=torch.float64)
    about_z = torch.stack([0 * turns, 0 * turns, turns], dim=-1)
    orientations = quaternion.multiply(quaternion.exp(about_z), hover.orientation)
    markers = (hover.position + quaternion.rotate(orientations, offset)).numpy()
    on_table = np.array([*workplace.table_centre, workplace.scene.objects[0].half_size[2]])
    # The plate of a marker extends 3 cm from its centre; the rest is margin.
    return np.concatenate(
        [middle + corners * (reach + 0.05) for middle in (on_table, *markers)]
    )


def draw_visit(workplace: Workplace, rng: np.random.Generator) -> WorkerVisit:
    """Draw a visit of a worker to the table.

    The worker comes to the side of the table where the elbow is, and reaches under the forearm
    while the robot waits above its first object. This is as in the paper's Experiment 3.

    Args:
        workplace: Table and arm.
        rng: Source of the worker's body, times and motions.

    Raises:
        ValueError: No worker can reach under the waiting arm.
    """
    # `random_visit` draws visits at a table's side +y. The table is therefore turned by -90
    # degrees, so that its side -x faces +y, and the visit is turned back afterwards.
    table = workplace.scene.table
    arm, waiting = whole_arm(workplace.scene.arm), workplace.hover_joints()
    links = arm.segments(waiting)[:, None]
    origins = workplace.robot.joint_origins(waiting)
    lengths = (origins[1:] - origins[:-1]).norm(dim=-1)
    # The forearm is the last long link.
    elbow = int((lengths > lengths.max() / 2).nonzero()[-1])
    x, y, z = origins[elbow : elbow + 2].mean(dim=0).tolist()
    (a, b, c), (half_a, half_b, half_c) = table.centre, table.half_size
    bench = replace(table, centre=(b, -a, c), half_size=(half_b, half_a, half_c))
    number, reached = 0, False
    while number < (_DRAWS if reached else _HOPELESS):
        number += 1
        worker = Worker(WorkerConfig.draw(rng))
        radius = torch.from_numpy(worker.radius)

        def is_clear(ends: Float[np.ndarray, "time parts 2 3"], radius=radius) -> bool:
            """True if the body stays clear of the waiting arm, as people do."""
            there = torch.from_numpy(turned_about_base(ends, np.pi / 2))
            apart = segment_distance(links, there.unsqueeze(-4))
            return bool((apart >= arm.radius[:, None] + radius + _KEPT_CLEAR).all())

        try:
            visit = random_visit(
                worker,
                rng,
                bench=bench,
                under=(y, -x),
                begin=_ENTERS,
                reaches=_REACHES,
                is_clear=is_clear,
            )
        except ValueError:
            continue  # for example, the arm is in the way of a small person
        reached = True
        on_the_way = np.arange(visit.begin, visit.end, _CHECKED_EVERY)
        if is_clear(visit.capsules_at(on_the_way).ends):
            return visit.turned(np.pi / 2)
    raise ValueError(
        f"none of {number} workers can reach under the arm, which waits over "
        f"({workplace.table_centre[0]:g}, {workplace.table_centre[1]:g}) m, its forearm "
        f"{z - c - half_c:.2f} m above the table: move the table's centre away from the arm's "
        "base, or choose an arm with a higher elbow (panda, ur5e, iiwa7 or gen3)."
    )


def worker_contacts(world: World, log: LoggedSteps, motion: MotionLog) -> tuple[Touch, ...]:
    """Contacts of the worker with the robot, or with the object in its gripper.

    Args:
        world: Simulation at the end of the run.
        log: Log of the run.
        motion: True poses of everything that moved.
    """
    objects = {item.name for item in world.config.objects}
    time = log["time"] if len(log) else np.empty(0)

    def counts(touch: Touch) -> bool:
        if touch.first not in objects:
            return True
        during = (time >= touch.start) & (time <= touch.end)
        # A contact may be shorter than a step: the step in which it began counts as well.
        during[max(int(np.searchsorted(time, touch.start, side="right")) - 1, 0)] = True
        return bool((during & motion.held(touch.first)[: len(time)]).any())

    return tuple(touch for touch in world.worker_contacts.touches if counts(touch))


def margin_to_stop(
    found: Separation,
    joint_velocity: Float[Tensor, "*batch joints"],
    person_velocity: Float[Tensor, "*batch H 2 3"],
    config: SeparationConfig,
    contact: Float[Tensor, "*batch C H"] | None = None,
) -> Float[Tensor, "*batch C H"]:
    """Margin of each distance over the distance that the arm needs to stop in time [m].

    Args:
        found: True distances.
        joint_velocity: Joint velocity of the arm [rad/s].
        person_velocity: Velocity of both ends of the person's capsules [m/s].
        config: Protective distance, with the deceleration of the arm.
        contact: Highest relative speeds of contacts [m/s]; None: no contact is allowed.

    Returns:
        d - v_h v/a - v^2/(2 a), with the distance d and the other symbols of `near_worker`. It
        is infinite where the arm does not approach the person, or would touch the person within
        the limits of power and force limiting.
    """
    stop = replace(config, reaction_time=0.0, clearance=0.0)
    closing = -found.rate(joint_velocity, torch.zeros_like(person_velocity))
    coming = -found.person_rate(person_velocity)
    spare = found.distance - stop.protective_distance(closing, coming)
    gentle = config.touches_gently(closing, coming, contact)
    return torch.where((closing > _AT_REST) & ~gentle, spare, torch.inf)


class NearWorker(NamedTuple):
    """Measures of an arm near a worker, with one value for each step."""

    margin: Float[np.ndarray, " steps"]
    """Smallest margin of the distance over the stopping distance [m]."""
    force: Float[np.ndarray, " steps"]
    """Peak force or pressure of a contact into which the arm moves, as a fraction of its limit;
    zero without a contact, infinite where no contact is allowed."""


def near_worker(
    log: LoggedSteps,
    visit: WorkerVisit,
    arm: CapsuleArm,
    config: SeparationConfig,
    *,
    encoder_offset: Float[np.ndarray, " joints"],
    loads: Mapping[str, tuple[GraspedBox, Bool[np.ndarray, " steps"]]],
    furniture: Sequence[Box] = (),
) -> NearWorker:
    """Margin of the true distance from the worker over the stopping distance, and the force of
    contacts, at each step.

    The stopping distance is v_h v/a + v^2/(2 a). The arm approaches the worker at the speed v
    and brakes with the deceleration a; the worker approaches the arm at the speed v_h. This is
    the protective distance without reaction time and uncertainty. The margin is the smallest
    over all parts of the body. It is infinite while the arm approaches no part, and for
    contacts within the limits of power and force limiting.

    Args:
        log: Log of the run.
        visit: Motion of the worker.
        arm: Capsules of arm and tool.
        config: Protective distance, with the deceleration of the arm.
        encoder_offset: Offset of the logged joint positions: measured minus true [rad].
        loads: Objects by name, each with the steps in which it was in the gripper.
        furniture: Boxes against which the arm may clamp the worker.
    """
    whole = replace(config, contact=replace(config.contact, used=1.0))
    limits = ContactLimits(arm, whole, furniture)
    regions = region_numbers(REGIONS)
    time = log["time"]
    q = torch.from_numpy(log["joint_position"] - encoder_offset)
    v = torch.from_numpy(log["joint_velocity"])
    margin, force = np.full(len(time), np.inf), np.zeros(len(time))

    def measure(steps: np.ndarray, load: GraspedBox | None) -> None:
        there = visit.capsules_at(time[steps])
        ends, speed = torch.from_numpy(there.ends), torch.from_numpy(there.velocity)
        radius = torch.from_numpy(there.radius).expand(len(steps), -1)
        found = separation(arm, q[steps], ends, radius, load)
        contact = limits.speeds(found, q[steps], regions, load is not None).first
        spare = margin_to_stop(found, v[steps], speed, config, contact)
        margin[steps] = spare.amin((-2, -1)).numpy()
        pushes = -found.rate(v[steps], torch.zeros_like(speed)) > _AT_REST
        # The force grows with the relative speed.
        part = -found.rate(v[steps], speed).clamp(max=0) / contact
        touches = pushes & (found.distance <= 0)
        part = torch.where(touches, part.nan_to_num(torch.inf, torch.inf), 0.0)
        force[steps] = part.amax((-2, -1)).numpy()

    rest = np.ones(len(time), dtype=bool)
    for load, held in [*loads.values(), (None, rest)]:
        steps = np.flatnonzero(held & rest)
        rest[steps] = False
        for k in range(0, len(steps), _BLOCK):
            measure(steps[k : k + _BLOCK], load)
    return NearWorker(margin, force)


class GivingPerson:
    """Person that hands over an object, and reacts to the motion of the robot's hand.

    Attributes:
        hand_over: Actions of the person that are decided so far.
    """

    def __init__(self, world: World, item: ObjectConfig, rng: np.random.Generator):
        """Place the person at some distance, waiting.

        Args:
            world: World with the person and the object.
            item: Object in the hand of the person.
            rng: Random generator.
        """
        assert world.config.worker is not None
        self._world, self._item, self._rng = world, item, rng
        self.worker = Worker(world.config.worker)
        later = random_hand_over(
            self.worker, rng, bench=world.config.table, thickness=item.half_size[2]
        )
        # The person waits until the robot is free.
        self.hand_over = later.starting(1e6)
        self._begun, self._brought, self._gone = False, False, False
        self._start, self._at_rest, self._held = np.zeros(3), 0.0, 0.0
        self._before, self._time = self._tool(), world.time
        self.update()

    def begin(self, time: float) -> None:
        """Start the hand-over at a time [s]; the person enters 1 to 3 s later."""
        if not self._begun:
            self.hand_over = self.hand_over.starting(time - 1e6)
            self._begun, self._start = True, self._tool()

    def ends_at(self, time: float) -> Float[np.ndarray, "parts 2 3"]:
        """Ends of the capsules of the person at a time [m], for a tracker."""
        return self.hand_over.visit.ends_at(time)

    def update(self) -> None:
        """Move the person, and the object in their hand, to the present positions."""
        world, now = self._world, self._world.time
        passed, self._time = now - self._time, now
        tool = self._tool()
        rests = np.linalg.norm(tool - self._before) < _RESTING_SPEED * max(passed, 1e-9)
        self._before, self._at_rest = tool, self._at_rest + passed if rests else 0.0
        if self._begun and not self._gone:
            self._go_on(tool, now, passed)
        world.move_worker(self.ends_at(now))
        if not self._gone:
            pose = np.eye(4)
            pose[:3, 3] = self.hand_over.object_position(now)
            world.carry(self._item.name, pose)

    def _go_on(self, tool: np.ndarray, now: float, passed: float) -> None:
        plan = self.hand_over
        waiting = now - plan.visit.end
        if waiting < 0:
            return
        if not self._brought:
            come = np.linalg.norm(tool - self._start) > _APPROACHED
            if come and self._at_rest > _RESTED:
                there = tool + _PERCEPTION_NOISE * self._rng.standard_normal(3)
                self.hand_over, self._brought = plan.brought_to(there, now), True
        else:
            held = self._world.holds(self._item.name)
            self._held = self._held + passed if held else 0.0
        if self._held > _RELEASE_AFTER or waiting > _GIVE_UP_AFTER:
            self.hand_over, self._gone = self.hand_over.left(now), True

    def _tool(self) -> Float[np.ndarray, "3"]:
        """True position of the robot's hand [m]."""
        return self._world.arm.tcp_pose()[:3, 3].copy()


def waiting_pose(workplace: Workplace) -> Pose:
    """Waiting pose of the end effector: above the table, nearer to the robot."""
    home, over = workplace.home(), workplace.hover().position
    return Pose(over + over.new_tensor(_WAITING_OFFSET), home.orientation)


def shown_hand_overs(
    workplace: Workplace, sizes: Imperfections, item: ObjectConfig
) -> InteractionPrimitive:
    """Model of hand-overs, learned from thirty people seen by the same tracker.

    In the demonstrations, the robot's hand moves from its waiting pose to the place where the
    person holds out the object.

    Args:
        workplace: Workplace of the hand-overs.
        sizes: Noise, delay and loss of the tracker.
        item: Object that is handed over.
    """
    rng = np.random.default_rng(0)
    home, table = waiting_pose(workplace).position.numpy(), workplace.scene.table
    shown: list[tuple[np.ndarray, np.ndarray, np.ndarray, str]] = []
    for _ in range(_VISITS):
        worker = Worker(WorkerConfig.draw(rng))
        plan = random_hand_over(worker, rng, bench=table, thickness=item.half_size[2])
        shown += _movements(plan, home, sizes, rng)
    time, person, robot, kinds = zip(*shown, strict=True)
    return InteractionPrimitive.fit(
        [torch.from_numpy(t) for t in time],
        [torch.from_numpy(p) for p in person],
        [torch.from_numpy(r) for r in robot],
        kinds,
        n_basis=_BASIS_FUNCTIONS,
    )


def _movements(
    plan: HandOver, home: np.ndarray, sizes: Imperfections, rng: np.random.Generator
) -> Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, str]]:
    """Movements of one visit: times, positions of the person's and the robot's hand, kind."""
    now = plan.visit.begin
    sensor = WorkerSensor(plan.visit.ends_at, plan.visit.worker.radius, lambda: now, sizes, rng)
    watch, found = MovementWatch(ReceivingConfig(), *_WATCHED), []
    newest: PersonObservation | None = None
    for reach in plan.reaches:
        times: list[float] = []
        hand: list[np.ndarray] = []
        while newest is None or newest.time < reach.end:
            now += 1 / IMAGE_RATE
            seen = sensor.read()
            if seen is None or seen is newest:
                continue
            newest = seen
            # Samples count only until the hand arrives: later samples show a resting hand.
            if watch.see(seen) and seen.time < reach.end:
                times, hand = watch.times.copy(), watch.hand.copy()
        if len(times) >= _FEWEST_IMAGES and times[-1] > reach.begin:
            u = (np.array(times) - times[0]) / (times[-1] - times[0])
            met = plan.place if reach.kind == HAND_OVER else home
            progress = minimum_jerk(torch.from_numpy(u))[0].numpy()
            robot = home + progress[:, None] * (met - home)
            found.append((np.array(times) - times[0], np.stack(hand), robot, reach.kind))
    return found
