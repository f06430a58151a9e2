"""A worker beside the robot in a run: who comes, and whom he touches."""

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

# When he comes beside the elbow [s] and how often he reaches: a robot waits above the first
# object 11 s after it began, and he is to reach under it then.
_COMES, _REACHES = (4.0, 9.0), (3, 5)
# Distance that people keep from an arm at rest which they see, as far as a sleeve stands out
# [m]; how often that is looked at [s]; and how many are drawn until one can reach like that.
_KEPT_CLEAR, _LOOKED_AT, _DRAWS = 0.03, 0.05, 200
# Joints at the ends of the forearm, from 0.
_FOREARM = slice(3, 5)


def somebody_comes(
    workplace: Workplace, rng: np.random.Generator, *, beside_elbow: bool = False
) -> WorkerVisit:
    """A visit of somebody to the table.

    Args:
        workplace: Whose table, and where the arm works.
        rng: Source of chance: who, when, and what they do.
        beside_elbow: Whether they come to the side of the table where the elbow is, while the
            robot waits above its first object, and reach under the forearm, as in the paper's
            Experiment 3. Else they come to the far side, and reach beside the end effector.
    """
    table = workplace.scene.table
    if not beside_elbow:
        worker = Worker(WorkerConfig.draw(rng))
        return random_visit(worker, rng, bench=table, under=workplace.table_centre)
    # Visits are to the side of +y: drawn as if the side of -x were there.
    arm, waiting = whole_arm(workplace.scene.arm), workplace.hover_joints()
    elbow, wrist = panda.joint_origins(waiting)[_FOREARM].tolist()
    x, y = (elbow[0] + wrist[0]) / 2, (elbow[1] + wrist[1]) / 2
    (a, b, c), (half_a, half_b, half_c) = table.centre, table.half_size
    bench = replace(table, centre=(b, -a, c), half_size=(half_b, half_a, half_c))
    for _ in range(_DRAWS):
        worker = Worker(WorkerConfig.draw(rng))
        radius = torch.from_numpy(worker.radius)

        def is_clear(ends: Float[np.ndarray, "time parts 2 3"], radius=radius) -> bool:
            """Of the arm that waits: nobody leans into steel, however awkward it gets."""
            there = torch.from_numpy(turned_about_base(ends, np.pi / 2))
            found = separation(arm, waiting, there, radius)
            return bool((found.distance >= _KEPT_CLEAR).all())

        try:
            visit = random_visit(
                worker,
                rng,
                bench=bench,
                under=(y, -x),
                begin=_COMES,
                reaches=_REACHES,
                is_clear=is_clear,
            )
        except ValueError:
            continue  # a small person who stands where the arm hinders them
        on_the_way = np.arange(visit.begin, visit.end, _LOOKED_AT)
        if is_clear(visit.capsules_at(on_the_way).ends):
            return visit.turned(np.pi / 2)
    raise ValueError(
        f"none of {_DRAWS} workers can reach under the arm that waits over "
        f"({workplace.table_centre[0]:g}, {workplace.table_centre[1]:g}) m: move the table's "
        "centre away from the arm's base."
    )


def move_worker(world: World, visit: WorkerVisit) -> None:
    """Put the worker where he is now."""
    ends = visit.ends_at(world.time)
    world.move_worker(ends, visit.item_at(world.time, ends))


def worker_contacts(world: World, log: LoggedSteps, motion: MotionLog) -> tuple[Touch, ...]:
    """Touches of the worker and the robot, or what it held then.

    Args:
        world: As the run left it.
        log: The run's.
        motion: Of everything in it.
    """
    objects = {item.name for item in world.config.objects}
    time = log["time"] if len(log) else np.empty(0)

    def counts(touch: Touch) -> bool:
        if touch.first not in objects:
            return True
        during = (time >= touch.start) & (time <= touch.end)
        # A touch may be shorter than a step: the one that it began in counts as well.
        during[max(int(np.searchsorted(time, touch.start, side="right")) - 1, 0)] = True
        return bool((during & motion.held(touch.first)[: len(time)]).any())

    return tuple(touch for touch in world.worker_contacts.touches if counts(touch))


# Speed up to which a part of the arm is at rest: servos that hold a pose against a push creep
# [m/s].
_AT_REST = 0.01
# Steps that are computed at once: some 100 MB.
_AT_ONCE = 250


def margin_to_stop(
    found: Separation,
    joint_velocity: Float[Tensor, "*batch joints"],
    person_velocity: Float[Tensor, "*batch H 2 3"],
    config: SeparationConfig,
) -> tuple[Float[Tensor, "*batch C H"], Bool[Tensor, "*batch C H"]]:
    """What distances exceed the one by which the arm can stop before a person [m].

    Args:
        found: True distances.
        joint_velocity: Of the arm [rad/s].
        person_velocity: Of both ends of the person's capsules [m/s].
        config: With the deceleration of the arm.

    Returns:
        d - v_h v/a - v^2/(2 a), infinite where the arm does not close in; and whether it does.
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
    """By how much the worker truly was further away than the arm needed to stop before him [m].

    That is the protective distance of what is true, with nothing unknown and nothing to wait
    for: v_h v/a + v^2/(2 a), for each part of the arm that closes in on one of his with the
    speed v while he comes with v_h. The least over all of them; infinite while none closes in.

    Args:
        log: Of the run.
        visit: Where he was.
        arm: Capsules of arm and tool.
        config: With the deceleration of the arm.
        encoder_offset: What the joint positions of the log are too large by [rad].
        loads: What the arm held at times, and when.
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
        for k in range(0, len(steps), _AT_ONCE):
            measure(steps[k : k + _AT_ONCE], load)
    return margin
