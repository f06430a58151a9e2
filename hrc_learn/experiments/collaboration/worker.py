"""A worker beside the robot in a run: who comes, what the robot sees of him, how near he is."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.kinematics import CapsuleArm, GraspedBox, separation
from hrc_learn.protocols import PersonTracker
from hrc_learn.sim import (
    MotionLog,
    ObjectConfig,
    Touch,
    Worker,
    WorkerConfig,
    WorkerVisit,
    World,
    random_visit,
)
from hrc_learn.sim.workplace import Workplace
from hrc_learn.viz import LoggedSteps, StepLog


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
    world.move_worker(visit.capsules_at(world.time).ends, visit.item_at(world.time))


class SensedDistance:
    """Notes how near the robot believes the worker to be: from its own joints and its tracker.

    Attributes:
        log: Columns "distance" to the nearest [m] and "age" of the observation [s], a row a
            step; NaN as long as there is no observation.
    """

    def __init__(self, tracker: PersonTracker, arm: CapsuleArm, items: Sequence[ObjectConfig]):
        """Begin with an empty log.

        Args:
            tracker: Sees the worker.
            arm: Capsules of arm and tool.
            items: What the robot may hold.
        """
        self._tracker, self._arm = tracker, arm
        self._items = {item.name: item for item in items}
        self.log = StepLog()

    def note(
        self, time: float, joint_position: Float[np.ndarray, " joints"], held: Sequence[str]
    ) -> None:
        """Look now.

        Args:
            time: Now [s].
            joint_position: As the arm reads it [rad].
            held: Names of the objects between the fingers; of several the first counts.
        """
        seen = self._tracker.read()
        if seen is None:
            self.log.append(distance=np.nan, age=np.nan)
            return
        grasped = None
        if held:
            # Objects are gripped along their x, with their tops towards the palm.
            a, b, c = self._items[held[0]].half_size
            grasped = GraspedBox(half_size=(b, a, c))
        found = separation(
            self._arm,
            torch.from_numpy(joint_position),
            torch.from_numpy(seen.ends),
            torch.from_numpy(seen.radius),
            grasped,
        )
        self.log.append(distance=float(found.distance.min()), age=time - seen.time)


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
