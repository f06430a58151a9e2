"""Simulated person handing an object to the robot, and the model learned from hand-overs."""

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
from hrc_learn.sim.worker_tracking import IMAGE_RATE
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.receiving import MovementWatch, ReceivingConfig

# Demonstrated visits by different people: 30 hand-overs among 120 other movements.
_VISITS = 30
# Basis functions for a movement of about a second: on twelve other visits four functions
# recognised every kind from its first half; six and eight fit the noise of the tracker.
_BASIS_FUNCTIONS = 4
# Waiting position of the end effector relative to its hover position over the table [m].
_WAITING_OFFSET = (0.05, -0.16, 0.25)
# Fewest images of a movement to learn from.
_FEWEST_IMAGES = 8
# The person brings the object to the robot's hand after it has moved this far [m] and rested
# this long [s], perceives its position with this standard deviation [m], and releases the
# object after the robot has held it this long [s].
_APPROACHED, _RESTED, _PERCEPTION_NOISE, _RELEASE_AFTER = 0.05, 0.5, 0.004, 0.3
# Speed below which a hand rests [m/s], and longest time for which the object is held out [s].
_RESTING_SPEED, _GIVE_UP_AFTER = 0.02, 25.0


def giver(seed: int) -> Worker:
    """Person of the run with this seed."""
    return Worker(WorkerConfig.draw(np.random.default_rng([seed, 4])))


class GivingPerson:
    """Moves a person with an object in their hand, reacting to the robot's hand.

    Attributes:
        hand_over: Actions of the person, as far as decided.
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
        """Let the person come from this time on [s]."""
        if not self._begun:
            self.hand_over = self.hand_over.starting(time - 1e6)
            self._begun, self._start = True, self._tool()

    def ends_at(self, time: float) -> Float[np.ndarray, "parts 2 3"]:
        """Ends of the capsules of the person at a time [m], for a tracker."""
        return self.hand_over.visit.ends_at(time)

    def update(self) -> None:
        """Move the person and the object in their hand to where they are now."""
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
            pose[:3, 3] = self.hand_over.thing_at(now)
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

    In the demonstrations the robot's hand moves from its waiting pose to where the object is
    held out.

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
    """Times, hand of the person, hand of the robot, and kind of each movement of one visit."""
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
            # Until the hand arrives: the watch adds samples of a resting hand after that.
            if watch.see(seen) and seen.time < reach.end:
                times, hand = watch.times.copy(), watch.hand.copy()
        if len(times) >= _FEWEST_IMAGES and times[-1] > reach.begin:
            u = (np.array(times) - times[0]) / (times[-1] - times[0])
            met = plan.place if reach.kind == HAND_OVER else home
            progress = minimum_jerk(torch.from_numpy(u))[0].numpy()
            robot = home + progress[:, None] * (met - home)
            found.append((np.array(times) - times[0], np.stack(hand), robot, reach.kind))
    return found


def movement_watch(config: ReceivingConfig) -> MovementWatch:
    """Watch on the right hand of a tracked worker."""
    return MovementWatch(config, PARTS.index("pelvis"), PARTS.index("hand_right"))
