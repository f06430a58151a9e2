"""A worker beside the robot in a run: who comes, and whom he touches."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from hrc_learn.controller import SeparationConfig
from hrc_learn.kinematics import CapsuleArm, GraspedBox, separation
from hrc_learn.sim import (
    MotionLog,
    Touch,
    Worker,
    WorkerConfig,
    WorkerVisit,
    World,
    random_visit,
)
from hrc_learn.sim.workplace import Workplace
from hrc_learn.viz import LoggedSteps


def somebody_comes(workplace: Workplace, rng: np.random.Generator) -> WorkerVisit:
    """A visit of somebody to the table.

    Args:
        workplace: Whose table, and where the arm works.
        rng: Source of chance: who, when, and what they do.
    """
    return random_visit(
        Worker(WorkerConfig.draw(rng)),
        rng,
        bench=workplace.scene.table,
        under=workplace.table_centre,
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
    stop = replace(config, reaction_time=0.0, clearance=0.0)
    time = log["time"]
    q = torch.from_numpy(log["joint_position"] - encoder_offset)
    v = torch.from_numpy(log["joint_velocity"])
    margin = np.full(len(time), np.inf)

    def measure(steps: np.ndarray, load: GraspedBox | None) -> None:
        there = visit.capsules_at(time[steps])
        ends, speed = torch.from_numpy(there.ends), torch.from_numpy(there.velocity)
        radius = torch.from_numpy(there.radius).expand(len(steps), -1)
        found = separation(arm, q[steps], ends, radius, load)
        closing = -found.rate(v[steps], torch.zeros_like(speed))
        coming = -found.rate(torch.zeros_like(v[steps]), speed)
        spare = found.distance - stop.protective_distance(closing, coming)
        spare = torch.where(closing > _AT_REST, spare, torch.inf)
        margin[steps] = spare.amin((-2, -1)).numpy()

    rest = np.ones(len(time), dtype=bool)
    for load, held in [*loads.values(), (None, rest)]:
        steps = np.flatnonzero(held & rest)
        rest[steps] = False
        for k in range(0, len(steps), _AT_ONCE):
            measure(steps[k : k + _AT_ONCE], load)
    return margin
