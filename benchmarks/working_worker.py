"""Workers with goals of their own near a batch of arms: they fetch parts, and react to the arm.

A worker stands at the bench and fetches parts that lie under or beside the arm. With a human
delay, the worker takes the first part whose way is clear of the arm, waits where none is, and
draws the hand back where the arm comes too near. `WorkingWorkers` replaces the `WorkerTables`
of workers who follow a fixed script.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from worker_tables import Workers

from hrc_learn.kinematics import CapsuleArm, separation
from hrc_learn.sim import Imperfections, Worker, WorkerConfig
from hrc_learn.sim.worker import IMAGE_RATE, PARTS
from hrc_learn.sim.worker_visit import (
    HAND_OVER_BENCH,
    STEP,
    HumanSpeeds,
    PoseWriter,
    WorkerPose,
    WorkerVisit,
    in_worker_frame,
)
from hrc_learn.sim.workplace import Workplace

Where = Literal["hand", "forearm", "elbow", "across", "beside"]
"""Place of the parts: beside the gripper that works at the bench, under the forearm, under the
elbow, across the bench seen from its end near the elbow, or away from the arm."""
PLACES: tuple[Where, ...] = ("hand", "forearm", "elbow", "across", "beside")

# Areas of the parts on the bench: least and greatest x and y [m]. While the Panda works at the
# bench, its elbow is above (-0.1 to 0.1, 0.1 to 0.3) m, its gripper above (0.24 +- 0.10,
# 0.54 +- 0.08) m.
_AREAS: dict[Where, tuple[tuple[float, float], tuple[float, float]]] = {
    "hand": ((0.04, 0.44), (0.46, 0.62)),
    "forearm": ((0.00, 0.20), (0.30, 0.44)),
    "elbow": ((-0.08, 0.10), (0.23, 0.36)),
    "across": ((0.02, 0.36), (0.40, 0.56)),
    "beside": ((0.45, 0.62), (0.66, 0.80)),
}
# Half the width of the gripper with its load, within which no hand can work [m].
_GRIPPER = 0.11
# Step back from the end of the bench that is near the elbow [m]: closer workers block an arm
# that keeps its distance for good.
_STEP_BACK = {"elbow": 0.25, "across": 0.12}
# Postures on the way of a hand that a worker looks at before reaching.
_LOOKED_AT = (0.3, 0.5, 0.7, 0.85, 1.0)
# Body parts that a worker takes care of, besides those of the reaching arm.
_CARED_FOR = ("head",)
_TRIES = 200
# Interval at which a worker looks at the arm [s], and time of starting, stopping or reversing a
# motion of the hand [s].
_LOOKS, _TURNS = 0.1, 0.15
# Clearance of the arm from the way to a part below which an expert acts [m]; delay [s],
# strength [N] and rise [s] of the pull: as in worker_study.py and the paper's Experiment 3.
_NOTICED, _EXPERT_DELAY, _PULL, _RAMP = 0.25, 0.4, 60.0, 0.4
# Number of images over which the tracker averages velocities, as `WorkerSensor` does (0.1 s).
_AVERAGED = 3


@dataclass(frozen=True, kw_only=True)
class HumanConfig:
    """Reactions of a worker to an arm."""

    delay: float = 0.3
    """Time from a motion of the arm to the worker's reaction [s]: choice reaction times are 0.2
    to 0.4 s."""
    wanted: float = 0.08
    """Clearance of the whole way from the arm that a worker wants before reaching [m]."""
    endured: float = 0.04
    """Clearance below which a worker draws the hand back [m]."""
    hesitation: float = 0.5
    """Time at the edge of the bench after drawing back [s]."""


class Work(NamedTuple):
    """Work of one worker: the ways of a hand to all parts and back, one after another."""

    visit: WorkerVisit
    """Way to each part from hands at the edge of the bench, and back."""
    spans: Float[np.ndarray, "parts 4"]
    """Times of the visit at which a hand leaves for a part, arrives, has finished, and is back
    [s]."""
    sides: Int[np.ndarray, " parts"]
    """Hand that fetches a part: 0 left, 1 right."""
    pause: float
    """Time between two parts [s]."""

    @property
    def duration(self) -> float:
        """Time for all parts without an arm [s]."""
        return float((self.spans[:, 3] - self.spans[:, 0]).sum()) + self.pause * (
            len(self.spans) - 1
        )


def draw_work(
    workplace: Workplace,
    where: Where,
    pause: float,
    duration: float,
    rng: np.random.Generator,
) -> Work:
    """Draw a worker and the parts to fetch.

    Args:
        workplace: Table, shelves and arm.
        where: Place of the parts.
        pause: Time between two parts [s].
        duration: Time that the work takes without an arm, at least [s].
        rng: Source of worker, parts and speeds.

    Raises:
        ValueError: The worker cannot reach a part there.
    """
    worker, table = Worker(WorkerConfig.draw(rng)), workplace.scene.table
    h, top = worker.config.stature, table.centre[2] + table.half_size[2]
    from_side = where in _STEP_BACK
    away = 0.1 * h + rng.uniform(0, 0.05)
    area = np.array(_AREAS[where])
    if from_side:
        away += _STEP_BACK[where]
        stand = np.array([table.centre[0] - table.half_size[0] - away, area[1].mean()])
        facing = rng.uniform(-0.15, 0.15)
    else:
        aside = np.clip(area[0].mean() + rng.uniform(-0.15, 0.15), -0.1, 0.6)
        stand = np.array([aside, table.centre[1] + table.half_size[1] + away])
        facing = -np.pi / 2 + rng.uniform(-0.15, 0.15)
    above = top + 0.12 - worker.config.floor
    ready = np.array([[0.10 * h, s * 0.13 * h, above] for s in (1, -1)])
    pose = WorkerPose(stand, facing, 0.0, ready)
    writer = PoseWriter(pose, 0.0, HumanSpeeds().drawn(rng), h)
    spans, points, sides = [], [], []
    spent = -pause
    while spent < duration:
        point = _part(worker, workplace, where, stand, facing, top, rng)
        target = in_worker_frame(worker, stand, facing, point)
        side = int(target[1] < 0)
        hands, lean = ready.copy(), worker.lean_to(target, side)
        assert lean is not None  # `_part` draws parts within reach
        hands[side] = target
        begin = writer.times[-1]
        writer.go(hands=hands, lean=lean)
        arrived = writer.times[-1]
        writer.wait(rng.uniform(0.8, 1.6))
        finished = writer.times[-1]
        writer.go(hands=ready, lean=0.0)
        spans.append((begin, arrived, finished, writer.times[-1]))
        points.append(point)
        sides.append(side)
        spent += writer.times[-1] - begin + pause
    visit = WorkerVisit(
        worker=worker,
        time=np.array(writer.times),
        poses=np.array(writer.rows),
        step=STEP * h,
        side=1,
        released=np.inf,
        markers=np.array(points),
        reaches=np.array([span[1:3] for span in spans]),
    )
    return Work(visit, np.array(spans), np.array(sides), pause)


def _part(
    worker: Worker,
    workplace: Workplace,
    where: Where,
    stand: np.ndarray,
    facing: float,
    top: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Position of a hand at a part within reach [m]."""
    centre = np.array(workplace.table_centre)
    low, high = np.array(_AREAS[where]).T
    for _ in range(_TRIES):
        x, y = rng.uniform(low, high)
        if where == "hand" and abs(x - centre[0]) < _GRIPPER:
            continue
        point = np.array([x, y, top + HAND_OVER_BENCH])
        target = in_worker_frame(worker, stand, facing, point)
        if worker.lean_to(target, int(target[1] < 0)) is not None:
            return point
    raise ValueError(
        f"a worker of {worker.config.stature:.2f} m cannot reach the parts ({where})."
    )


class WorkingWorkers:
    """Workers near several arms, one for each, who react to their arm.

    Attributes:
        radius: Radii of the capsules, (runs, H) [m].
        done_at: Time at which each worker has fetched all parts (runs,) [s]; infinite before.
        unhindered: Time for all parts without an arm (runs,) [s].
        wants: True where a worker is on the way to a part, works there, or waits (runs,).
        near: Clearance of the arm, as the worker sees it, from the wanted way (runs,) [m].
        goal: Position of the wanted part (runs, 3) [m].
    """

    def __init__(
        self,
        works: Sequence[Work],
        sizes: Imperfections,
        arm: CapsuleArm,
        dt: float,
        seed: int,
        human: HumanConfig | None = None,
    ):
        """Begin the work.

        Args:
            works: Work of each worker.
            sizes: Noise, delay and loss of the trackers.
            arm: Capsules of arm and tool.
            dt: Control step [s].
            seed: Seed of the trackers.
            human: Reactions of the workers.
        """
        self.works, self._arm, self._dt = works, arm, dt
        self._human, self._sizes = human or HumanConfig(), sizes
        self._generator = torch.Generator().manual_seed(seed)
        runs, most = len(works), max(len(work.spans) for work in works)
        self.radius = _stacked([work.visit.worker.radius for work in works])
        tables = [
            work.visit.ends_at(np.arange(0.0, work.visit.end + 2 * dt, dt)) for work in works
        ]
        self._ends = _stacked(tables)
        # Spans in rows of the tables; workers with fewer parts than others have done the rest.
        self._spans = torch.zeros(runs, most, 4, dtype=torch.float64)
        self._points = torch.zeros(runs, most, 3, dtype=torch.float64)
        self._done = torch.ones(runs, most, dtype=torch.bool)
        for run, work in enumerate(works):
            count = len(work.spans)
            self._spans[run, :count] = torch.from_numpy(work.spans / dt)
            self._points[run, :count] = torch.from_numpy(work.visit.markers)
            self._done[run, :count] = False
        self._look_at(works)
        self._pause = torch.tensor([work.pause for work in works], dtype=torch.float64)
        self.unhindered = torch.tensor([work.duration for work in works], dtype=torch.float64)
        self._row = self._spans[:, 0, 0].clone()
        self._rate = torch.zeros(runs, dtype=torch.float64)
        self._current = torch.full((runs,), -1)
        self._aim = torch.zeros(runs, dtype=torch.float64)
        self._until = torch.zeros(runs, dtype=torch.float64)
        self.done_at = torch.full((runs,), torch.inf, dtype=torch.float64)
        self.wants = torch.zeros(runs, dtype=torch.bool)
        self.near = torch.full((runs,), torch.inf, dtype=torch.float64)
        self.goal = self._points[:, 0].clone()
        self._history: list[tuple[Tensor, Tensor]] = []
        self._arms: deque[Tensor] = deque(maxlen=round(self._human.delay / dt) + 1)
        self._images = 0
        self._pending: deque[tuple[float, Tensor, Tensor, Tensor]] = deque()
        self._seen_ends = torch.zeros_like(self._ends[:, 0])
        self._seen_velocity = torch.zeros_like(self._seen_ends)
        self._seen_time = torch.full((runs,), torch.nan, dtype=torch.float64)
        # Former images of each worker, the oldest first, from which velocities follow.
        self._former = self._ends[:, :1].expand(-1, _AVERAGED, -1, -1, -1).clone()
        self._former_time = torch.zeros(runs, _AVERAGED, dtype=torch.float64)
        self._former_time[:] = -torch.arange(_AVERAGED, 0, -1) / IMAGE_RATE

    def _look_at(self, works: Sequence[Work]) -> None:
        """Tabulate the postures on the way to each part that a worker looks at."""
        runs, most = self._spans.shape[:2]
        self._way_rows = torch.lerp(
            self._spans[..., :1],
            self._spans[..., 1:2],
            torch.tensor(_LOOKED_AT, dtype=torch.float64),
        )
        rows = self._way_rows.round().long()
        every = torch.arange(runs)[:, None, None]
        names = [
            [*(f"{part}_{side}" for part in ("hand", "forearm", "upper_arm")), *_CARED_FOR]
            for side in ("left", "right")
        ]
        columns = torch.tensor([[PARTS.index(name) for name in each] for each in names])
        sides = torch.zeros(runs, most, dtype=torch.int64)
        for run, work in enumerate(works):
            sides[run, : len(work.sides)] = torch.from_numpy(work.sides)
        parts = columns[sides]
        self._way = self._ends[
            every[..., None], rows[..., None], parts[:, :, None]
        ]  # (runs, parts, postures, capsules, 2, 3)
        self._way_radius = self.radius[torch.arange(runs)[:, None, None], parts]

    @property
    def left(self) -> Float[Tensor, " runs"]:
        """Time for the parts that are left, without an arm [s]."""
        spans = self._dt * (self._spans[..., 3] - self._spans[..., 0])
        open_parts = ~self._done
        pauses = self._pause * (open_parts.sum(-1) - 1).clamp(min=0)
        rest = (spans * open_parts).sum(-1) + pauses
        begun = torch.where(self._current >= 0, self._row - self._gathered(0), 0.0)
        resting = (self._until - self._dt * len(self._history)).clamp(min=0)
        resting = torch.where((self._current < 0) & open_parts.any(-1), resting, 0.0)
        return rest - self._dt * begun.clamp(min=0) + resting

    def present(self, step: int, runs: Int[Tensor, " some"]) -> Bool[Tensor, " some"]:
        """True while a worker has not fetched all parts."""
        return self.done_at[runs] > step * self._dt

    def truth(self, step: int, runs: Int[Tensor, " some"]) -> Workers:
        """Workers near some of the arms at the current or an earlier control step."""
        row, rate = self._history[step] if step < len(self._history) else self._now()
        return self._at(row[runs], rate[runs], runs)

    def seen(
        self, step: int, runs: Int[Tensor, " some"]
    ) -> tuple[Workers, Float[Tensor, " some"]]:
        """Newest observations of the workers near some of the arms.

        Returns:
            The observations, and their age [s]; NaN before the first observation.
        """
        now = step * self._dt + 1e-9
        while self._images / IMAGE_RATE <= now:
            self._take(self._images / IMAGE_RATE)
            self._images += 1
        while self._pending and self._pending[0][0] <= now:
            _, ends, velocity, time = self._pending.popleft()
            kept = ~time.isnan()
            self._seen_ends[kept] = ends[kept]
            self._seen_velocity[kept] = velocity[kept]
            self._seen_time[kept] = time[kept]
        age = step * self._dt - self._seen_time[runs]
        return Workers(self._seen_ends[runs], self._seen_velocity[runs], self.radius[runs]), age

    def act(self, step: int, q: Float[Tensor, "runs n"]) -> None:
        """One control step of all workers.

        Args:
            step: Number of the step.
            q: True joint positions of the arms [rad].
        """
        self._history.append(self._now())
        self._arms.append(q.clone())
        time = step * self._dt
        if step % round(_LOOKS / self._dt) == 0:
            self._decide(time)
        change = (self._aim - self._rate).clamp(-self._dt / _TURNS, self._dt / _TURNS)
        self._rate = self._rate + change
        self._row = self._row + self._rate
        busy = self._current >= 0
        begin, end = self._gathered(0), self._gathered(3)
        back, drawn_back = busy & (self._row >= end), busy & (self._row <= begin)
        drawn_back &= self._aim < 0
        run = torch.nonzero(back).squeeze(-1)
        self._done[run, self._current[run]] = True
        self._until = torch.where(back, time + self._pause, self._until)
        self._until = torch.where(drawn_back, time + self._human.hesitation, self._until)
        idle = back | drawn_back
        self._row = torch.where(back, end, torch.where(drawn_back, begin, self._row))
        self._rate = self._rate.masked_fill(idle, 0.0)
        self._aim = self._aim.masked_fill(idle, 0.0)
        self._current = self._current.masked_fill(idle, -1)
        finished = self._done.all(-1) & self.done_at.isinf()
        self.done_at = torch.where(finished, time + self._dt, self.done_at)

    def _now(self) -> tuple[Tensor, Tensor]:
        return self._row.clone(), self._rate.clone()

    def _gathered(self, which: int) -> Float[Tensor, " runs"]:
        """Row at which the current part's way begins (0), arrives, has finished or ends (3)."""
        spans = self._spans[torch.arange(len(self._row)), self._current.clamp(min=0)]
        return spans[:, which]

    def _at(self, row: Tensor, rate: Tensor, runs: Tensor) -> Workers:
        low = row.long().clamp(max=self._ends.shape[1] - 2)
        first, second = self._ends[runs, low], self._ends[runs, low + 1]
        part = (row - low)[:, None, None, None]
        velocity = (second - first) * (rate / self._dt)[:, None, None, None]
        return Workers(torch.lerp(first, second, part), velocity, self.radius[runs])

    def _take(self, time: float) -> None:
        """Take an image of every worker, as `WorkerSensor` does."""
        every = torch.arange(len(self._row))
        true = self._at(*self._now(), every).ends
        noise = torch.randn(true.shape, generator=self._generator, dtype=true.dtype)
        lost = torch.rand(len(every), generator=self._generator) < self._sizes.person_loss
        ends, kept = true + self._sizes.person_noise * noise, ~lost
        span = (time - self._former_time[:, 0])[:, None, None, None]
        velocity = (ends - self._former[:, 0]) / span
        newest = torch.cat([self._former[:, 1:], ends.unsqueeze(1)], dim=1)
        self._former[kept] = newest[kept]
        times = torch.nn.functional.pad(self._former_time[:, 1:], (0, 1), value=time)
        self._former_time[kept] = times[kept]
        arrival = time + self._sizes.person_delay
        taken = torch.full_like(self._seen_time, time).masked_fill(lost, torch.nan)
        self._pending.append((arrival, ends, velocity, taken))

    def _decide(self, time: float) -> None:
        """Let every worker look at the arm of some time ago, and choose what to do."""
        q = self._arms[0]
        runs = torch.nonzero(~self._done.all(-1)).squeeze(-1)
        self.wants = torch.zeros_like(self.wants)
        if not len(runs):
            return
        clear = self._clear(q[runs], runs)  # (some, parts, postures)
        current, row = self._current[runs], self._row[runs]
        busy = current >= 0
        index = torch.arange(len(runs))
        ahead = self._way_rows[runs, current.clamp(min=0)] >= row[:, None] - 1
        # At the part, the last posture remains.
        ahead[:, -1] = True
        on_way = clear[index, current.clamp(min=0)].masked_fill(~ahead, torch.inf).amin(-1)
        finished = row >= self._gathered(2)[runs]
        forward = finished | (on_way >= self._human.endured)
        aim = 2.0 * forward.double() - 1.0

        free = clear.amin(-1).masked_fill(self._done[runs], -torch.inf)
        possible = free >= self._human.wanted
        first = torch.where(possible, 0, 1).argmin(-1)
        starts = ~busy & possible.any(-1) & (time >= self._until[runs])
        chosen = torch.where(starts, first, current)
        self._current[runs] = chosen
        begun = self._spans[runs, first, 0]
        self._row[runs] = torch.where(starts, begun, row)
        self._aim[runs] = torch.where(starts, 1.0, torch.where(busy, aim, 0.0))
        # The part that a waiting worker wants is the first one that is left.
        wanted = torch.where(chosen >= 0, chosen, self._done[runs].long().argmin(-1))
        self.goal[runs] = self._points[runs, wanted]
        self.near[runs] = torch.where(busy, on_way, clear[index, wanted].amin(-1))
        due = time >= self._until[runs]
        self.wants[runs] = torch.where(chosen >= 0, ~finished, due)

    def _clear(self, q: Tensor, runs: Tensor) -> Float[Tensor, "some parts postures"]:
        """Clearance of the arms from the postures on the way to each part [m]."""
        way = self._way[runs]
        some, parts, postures, capsules = way.shape[:4]
        radius = self._way_radius[runs][:, :, None].expand(-1, -1, postures, -1)
        found = separation(self._arm, q, way.flatten(1, 3), radius.flatten(1, 3))
        nearest = found.distance.amin(-2)
        return nearest.view(some, parts, postures, capsules).amin(-1)


def _stacked(arrays: Sequence[np.ndarray]) -> Tensor:
    """Arrays of different lengths side by side, the last row of each repeated."""
    longest = max(len(array) for array in arrays)
    rows = [array[np.minimum(np.arange(longest), len(array) - 1)] for array in arrays]
    return torch.from_numpy(np.stack(rows))


class WatchingExperts:
    """Experts who pull the elbow of each arm away from the part that a worker wants.

    Attributes:
        joint: Number of the pulled joint, counted from 1.
    """

    joint = 4

    def __init__(self, workers: WorkingWorkers, dt: float):
        """Begin to watch.

        Args:
            workers: Workers near the arms.
            dt: Control step [s].
        """
        self._workers, self._dt = workers, dt
        self._wanted: deque[Tensor] = deque(maxlen=round(_EXPERT_DELAY / dt) + 1)
        self._level = torch.zeros_like(workers.near)

    def forces(
        self, time: float, runs: Int[Tensor, " some"], at: Float[Tensor, "some 3"]
    ) -> Float[Tensor, "some 3"]:
        """Pulls at the elbows of some of the arms [N], one control step after the last call.

        Args:
            time: Time [s].
            runs: Numbers of the arms.
            at: Positions of their elbows [m].
        """
        workers = self._workers
        self._wanted.append(workers.wants & (workers.near < _NOTICED))
        change = self._wanted[0].double() - self._level
        self._level = self._level + change.clamp(-self._dt / _RAMP, self._dt / _RAMP)
        away = at - workers.goal[runs]
        return _PULL * self._level[runs, None] * away / away.norm(dim=-1, keepdim=True)
