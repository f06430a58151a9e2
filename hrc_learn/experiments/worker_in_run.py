"""A worker near the robot in a run: the visit, its contacts, and the distance left to stop."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import SeparationConfig
from hrc_learn.kinematics import CapsuleArm, GraspedBox, Separation, panda, separation
from hrc_learn.log import LoggedSteps
from hrc_learn.sim import (
    MotionLog,
    Touch,
    Worker,
    WorkerConfig,
    WorkerVisit,
    World,
    random_visit,
    whole_arm,
)
from hrc_learn.sim.worker_visit import turned_about_base
from hrc_learn.sim.workplace import Workplace

# Arrival at the elbow [s] and number of reaches: a robot waits above its first object 11 s
# after the start, and the worker is to reach under it then.
_ARRIVES, _REACHES = (4.0, 9.0), (3, 5)
# Distance that people keep from a resting arm in their view, the thickness of a sleeve [m];
# time between checks of it [s]; and workers drawn until one can reach like that.
_KEPT_CLEAR, _CHECKED_EVERY, _DRAWS = 0.03, 0.05, 200
# Joints at the ends of the forearm, from 0.
_FOREARM = slice(3, 5)
# Speed up to which a part of the arm counts as at rest [m/s]: servos that hold a pose against a
# push creep.
_AT_REST = 0.01
# Steps that are computed together: some 100 MB.
_BLOCK = 250


def draw_visit(
    workplace: Workplace, rng: np.random.Generator, *, beside_elbow: bool = False
) -> WorkerVisit:
    """Draw a visit of a worker to the table.

    Args:
        workplace: Table and arm.
        rng: Source of the worker's body, times and motions.
        beside_elbow: True: the worker comes to the side of the table where the elbow is, while
            the robot waits above its first object, and reaches under the forearm, as in the
            paper's Experiment 3. False: to the far side, reaching past the end effector.

    Raises:
        ValueError: No worker can reach under the arm that waits.
    """
    table = workplace.scene.table
    if not beside_elbow:
        worker = Worker(WorkerConfig.draw(rng))
        return random_visit(worker, rng, bench=table, under=workplace.table_centre)
    # Visits are drawn to the side of +y, as if the side of -x were there, and turned.
    arm, waiting = whole_arm(workplace.scene.arm), workplace.hover_joints()
    elbow, wrist = panda.joint_origins(waiting)[_FOREARM].tolist()
    x, y = (elbow[0] + wrist[0]) / 2, (elbow[1] + wrist[1]) / 2
    (a, b, c), (half_a, half_b, half_c) = table.centre, table.half_size
    bench = replace(table, centre=(b, -a, c), half_size=(half_b, half_a, half_c))
    for _ in range(_DRAWS):
        worker = Worker(WorkerConfig.draw(rng))
        radius = torch.from_numpy(worker.radius)

        def is_clear(ends: Float[np.ndarray, "time parts 2 3"], radius=radius) -> bool:
            """True if the body stays clear of the arm that waits, as people do."""
            there = torch.from_numpy(turned_about_base(ends, np.pi / 2))
            found = separation(arm, waiting, there, radius)
            return bool((found.distance >= _KEPT_CLEAR).all())

        try:
            visit = random_visit(
                worker,
                rng,
                bench=bench,
                under=(y, -x),
                begin=_ARRIVES,
                reaches=_REACHES,
                is_clear=is_clear,
            )
        except ValueError:
            continue  # a small person who stands where the arm hinders them
        on_the_way = np.arange(visit.begin, visit.end, _CHECKED_EVERY)
        if is_clear(visit.capsules_at(on_the_way).ends):
            return visit.turned(np.pi / 2)
    raise ValueError(
        f"none of {_DRAWS} workers can reach under the arm that waits over "
        f"({workplace.table_centre[0]:g}, {workplace.table_centre[1]:g}) m: move the table's "
        "centre away from the arm's base."
    )


def move_worker(world: World, visit: WorkerVisit) -> None:
    """Move the simulated worker to the posture of the visit at this time."""
    ends = visit.ends_at(world.time)
    world.move_worker(ends, visit.item_at(world.time, ends))


def worker_contacts(world: World, log: LoggedSteps, motion: MotionLog) -> tuple[Touch, ...]:
    """Contacts of the worker with the robot, or with the object in its gripper.

    Args:
        world: Simulation at the end of the run.
        log: Log of the run.
        motion: Motion of everything in it.
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
) -> tuple[Float[Tensor, "*batch C H"], Bool[Tensor, "*batch C H"]]:
    """Margin of each distance over the one within which the arm can stop before a person [m].

    Args:
        found: True distances.
        joint_velocity: Joint velocity of the arm [rad/s].
        person_velocity: Velocity of both ends of the person's capsules [m/s].
        config: Protective distance, with the deceleration of the arm.

    Returns:
        d - v_h v/a - v^2/(2 a), infinite where the arm does not approach; and True where it
        does.
    """
    stop = replace(config, reaction_time=0.0, clearance=0.0)
    closing = -found.rate(joint_velocity, torch.zeros_like(person_velocity))
    coming = -found.person_rate(person_velocity)
    spare = found.distance - stop.protective_distance(closing, coming)
    moves = closing > _AT_REST
    return torch.where(moves, spare, torch.inf), moves


def separation_margin(
    log: LoggedSteps,
    visit: WorkerVisit,
    arm: CapsuleArm,
    config: SeparationConfig,
    *,
    encoder_offset: Float[np.ndarray, " joints"],
    loads: Mapping[str, tuple[GraspedBox, Bool[np.ndarray, " steps"]]],
) -> Float[np.ndarray, " steps"]:
    """Margin of the true distance from the worker over the stopping distance, at each step [m].

    The stopping distance is v_h v/a + v^2/(2 a), for a part of the arm that approaches a part
    of the worker at speed v while that comes at v_h: the protective distance without reaction
    time and uncertainty. The result is the smallest margin over all parts, infinite while the
    arm approaches none.

    Args:
        log: Log of the run.
        visit: Motion of the worker.
        arm: Capsules of arm and tool.
        config: Protective distance, with the deceleration of the arm.
        encoder_offset: Offset of the logged joint positions: measured minus true [rad].
        loads: Objects in the gripper, and the steps in which they were.
    """
    time = log["time"]
    q = torch.from_numpy(log["joint_position"] - encoder_offset)
    v = torch.from_numpy(log["joint_velocity"])
    margin = np.full(len(time), np.inf)

    def measure(steps: np.ndarray, load: GraspedBox | None) -> None:
        there = visit.capsules_at(time[steps])
        ends, speed = torch.from_numpy(there.ends), torch.from_numpy(there.velocity)
        radius = torch.from_numpy(there.radius).expand(len(steps), -1)
        found = separation(arm, q[steps], ends, radius, load)
        spare, _ = margin_to_stop(found, v[steps], speed, config)
        margin[steps] = spare.amin((-2, -1)).numpy()

    rest = np.ones(len(time), dtype=bool)
    for load, held in [*loads.values(), (None, rest)]:
        steps = np.flatnonzero(held & rest)
        rest[steps] = False
        for k in range(0, len(steps), _BLOCK):
            measure(steps[k : k + _BLOCK], load)
    return margin
