"""A person who hands an object to the robot in a run, and how that was shown before."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.dmp import InteractionPrimitive
from hrc_learn.geometry import Pose, minimum_jerk
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import ObjectConfig, Worker, WorkerConfig, WorkerSensor, World
from hrc_learn.sim.hand_over import HAND_OVER, HandOver, random_hand_over
from hrc_learn.sim.imperfections import Imperfections
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.worker_sensor import IMAGE_RATE
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.receiving import MovementWatch, ReceivingConfig

# Visits that were shown, other people in each: 30 hand-overs among 120 other movements.
_SHOWN = 30
# Of a movement that takes about a second: on twelve other visits four functions told every kind
# apart from its first half; six and eight take on what the tracker's noise looks like.
_FUNCTIONS = 4
# Where the end effector waits, from where it hovers over the table [m].
_WAITS = (0.05, -0.16, 0.25)
# Fewest images of a movement that is learned from.
_FEWEST = 8
# He brings the thing on once the robot's hand has come so far and rested so long [m, s], sees
# where it is to within so much [m], and lets go after it was held for so long [s].
_COME, _SEEN_AT_REST, _SEES, _LETS_GO = 0.05, 0.5, 0.004, 0.3
# Speed below which a hand rests [m/s]; for which he holds the thing out at the longest [s].
_RESTS, _GIVES_UP = 0.02, 25.0


def giver(seed: int) -> Worker:
    """Who comes in a run."""
    return Worker(WorkerConfig.draw(np.random.default_rng([seed, 4])))


class GivingPerson:
    """Moves a person and the object in their hand, who sees the robot's hand come.

    Attributes:
        hand_over: What they do, as far as it is settled.
    """

    def __init__(self, world: World, item: ObjectConfig, rng: np.random.Generator):
        """They wait at some distance.

        Args:
            world: Whose worker and object they are.
            item: In their hand.
            rng: Source of chance.
        """
        assert world.config.worker is not None
        self._world, self._item, self._rng = world, item, rng
        self.worker = Worker(world.config.worker)
        later = random_hand_over(
            self.worker, rng, bench=world.config.table, thickness=item.half_size[2]
        )
        # Until the robot is free for them.
        self.hand_over = later.starting(1e6)
        self._begun, self._brought, self._gone = False, False, False
        self._start, self._at_rest, self._held = np.zeros(3), 0.0, 0.0
        self._before, self._time = self._tool(), world.time
        self.update()

    def begin(self, time: float) -> None:
        """They come from now on [s]."""
        if not self._begun:
            self.hand_over = self.hand_over.starting(time - 1e6)
            self._begun, self._start = True, self._tool()

    def ends_at(self, time: float) -> Float[np.ndarray, "parts 2 3"]:
        """Where they are, for a tracker."""
        return self.hand_over.visit.ends_at(time)

    def update(self) -> None:
        """Put the person, and what they have in their hand, where they are now."""
        world, now = self._world, self._world.time
        passed, self._time = now - self._time, now
        tool = self._tool()
        rests = np.linalg.norm(tool - self._before) < _RESTS * max(passed, 1e-9)
        self._before, self._at_rest = tool, self._at_rest + passed if rests else 0.0
        if self._begun and not self._gone:
            self._go_on(tool, now, passed)
        world.move_worker(self.ends_at(now))
        if not self._gone:
            pose = np.eye(4)
            pose[:3, 3] = self.hand_over.thing_at(now)
            world.carry(self._item.name, pose)

    def _go_on(self, tool: np.ndarray, now: float, passed: float) -> None:
        plan = self.hand_over
        waiting = now - plan.visit.end
        if waiting < 0:
            return
        if not self._brought:
            come = np.linalg.norm(tool - self._start) > _COME
            if come and self._at_rest > _SEEN_AT_REST:
                there = tool + _SEES * self._rng.standard_normal(3)
                self.hand_over, self._brought = plan.brought_to(there, now), True
        else:
            held = self._world.holds(self._item.name)
            self._held = self._held + passed if held else 0.0
        if self._held > _LETS_GO or waiting > _GIVES_UP:
            self.hand_over, self._gone = self.hand_over.left(now), True

    def _tool(self) -> Float[np.ndarray, "3"]:
        """Where the robot's hand truly is [m]."""
        return self._world.arm.tcp_pose()[:3, 3].copy()


def waiting(workplace: Workplace) -> Pose:
    """Where the end effector waits for a hand-over: above the table, nearer to the robot."""
    home, over = workplace.home(), workplace.hover().position
    return Pose(over + over.new_tensor(_WAITS), home.orientation)


def shown_hand_overs(
    workplace: Workplace, sizes: Imperfections, item: ObjectConfig
) -> InteractionPrimitive:
    """What thirty people showed, who each handed a thing over once, seen by the same tracker.

    The robot's hand was led from where it waits to where they held the thing out meanwhile.

    Args:
        workplace: Where.
        sizes: Of the tracker's noise, delay and loss.
        item: The thing.
    """
    rng = np.random.default_rng(0)
    home, table = waiting(workplace).position.numpy(), workplace.scene.table
    shown: list[tuple[np.ndarray, np.ndarray, np.ndarray, str]] = []
    for _ in range(_SHOWN):
        worker = Worker(WorkerConfig.draw(rng))
        plan = random_hand_over(worker, rng, bench=table, thickness=item.half_size[2])
        shown += _movements(plan, home, sizes, rng)
    time, person, robot, kinds = zip(*shown, strict=True)
    return InteractionPrimitive.fit(
        [torch.from_numpy(t) for t in time],
        [torch.from_numpy(p) for p in person],
        [torch.from_numpy(r) for r in robot],
        kinds,
        n_basis=_FUNCTIONS,
    )


def _movements(
    plan: HandOver, home: np.ndarray, sizes: Imperfections, rng: np.random.Generator
) -> Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, str]]:
    """Times, the person's hand, the robot's, and kind, as a tracker sees one visit."""
    now = plan.visit.begin
    sensor = WorkerSensor(plan.visit, lambda: now, sizes, rng)
    watch, found = movement_watch(ReceivingConfig()), []
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
            # Until he is there: what the watch adds after that is of a hand at rest.
            if watch.see(seen) and seen.time < reach.end:
                times, hand = watch.times.copy(), watch.hand.copy()
        if len(times) >= _FEWEST and times[-1] > reach.begin:
            u = (np.array(times) - times[0]) / (times[-1] - times[0])
            met = plan.place if reach.kind == HAND_OVER else home
            robot = home + minimum_jerk(u)[0][:, None] * (met - home)
            found.append((np.array(times) - times[0], np.stack(hand), robot, reach.kind))
    return found


def movement_watch(config: ReceivingConfig) -> MovementWatch:
    """Of the right hand of a tracked worker."""
    return MovementWatch(config, PARTS.index("pelvis"), PARTS.index("hand_right"))
