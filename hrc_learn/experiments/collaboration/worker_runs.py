"""Many arms at their job, each beside a worker, step by step in one batch.

Joints move as they are told, late and with the lag of servos, and encoders and trackers err as
`Imperfections` says; forces are not simulated. Everything else is what the work cell runs: the
watch for people, the null space that yields, the safety filter, paths that wait.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller import (
    Distances,
    SafetyFilter,
    SafetyState,
    WayMakingConfig,
    scale_null_space,
    way_making_velocity,
)
from hrc_learn.experiments.collaboration.job_cycle import JobCycle
from hrc_learn.experiments.collaboration.worker import margin_to_stop
from hrc_learn.experiments.collaboration.worker_tables import Workers, WorkerTables
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import CapsuleArm, Separation, panda, separation
from hrc_learn.sim import CommandChannel, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import (
    LOOK_AHEAD,
    kept_clear,
    null_space_giving_way,
    null_space_slowdown,
    resolved_rate,
)
from hrc_learn.skills.null_space_yielding import (
    CHANGE_OF_RATE,
    LEAST_INPUT,
    NARROW,
    STUCK,
    changed_rate,
    eased_null_velocity,
    eased_way_back,
    may_not_find_back,
    nears_singularity,
    share_of_motion,
    share_of_push,
    smallest_singular_value,
    stays_aside,
    straightness,
    waited_for,
)
from hrc_learn.skills.pace import people_bind
from hrc_learn.skills.path_following import behind_path
from hrc_learn.skills.person_watch import (
    BESIDE_PEOPLE,
    PersonWatchConfig,
    share_of_speed,
    urgent_distances,
)
from hrc_learn.skills.work_cell import WorkCellConfig
from hrc_learn.teleoperation import ScriptedForce

# Pairs of capsules farther apart than any that is looked for [m].
_FAR = 10.0
# By how much a point of the arm may get faster in a step, its load included [m/s]: by the
# accelerations of a Panda's joints, on levers from 0.85 m at the first down, for 10 ms.
_FASTER = 0.3
# Arms whose distances are computed at once: their tensors stay in the cache.
_BLOCK = 48
# Distance from which on the smallest one is not told apart from farther ones [m].
_RANGE = 0.5
# Links of the elbow, which the null space moves: from the upper arm to the forearm.
_ELBOW_LINKS = (2, 3, 4, 5)
# Gap that an arm needs so as not to be crushed [m]: ISO 13854:2017, table 1.
CRUSHING_GAP = 0.12
_STEP = 1e-4  # of a difference quotient along a motion [s]
# Parts of a capsule that a sphere is put around, and by how much the ways of its ends are
# longer than their velocities tell [m]: arms that look 0.15 s ahead at 0.5 m/s on a radius of
# 0.5 m.
_PARTS, _BENT = 3, 0.006


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """What the arms do and beside whom, the same however they react."""

    workplace: Workplace
    arm: CapsuleArm
    """Capsules of arm and tool."""
    cycles: Sequence[JobCycle]
    """Different ones."""
    cycle: Int[Tensor, " runs"]
    """Which of them each arm does."""
    workers: WorkerTables
    pulls: Sequence[ScriptedForce]
    """Of the expert at the elbow of each arm, where there is one."""
    encoder_offset: Float[Tensor, "runs joints"]
    """What encoders read too much [rad]."""
    encoder_noise: Float[Tensor, "runs steps joints"]
    """Of each reading, repeated after the last [rad]."""
    sizes: Imperfections


@dataclass(frozen=True, kw_only=True)
class Reaction:
    """How the arms react to workers."""

    way_making: WayMakingConfig = field(default_factory=lambda: WayMakingConfig(mode="none"))
    """Who moves the null space."""
    stop_distance: float | None = None
    """Distance within which the arm rests [m]: stop and wait, without any other reaction. None:
    the protective distance is kept, slower or at rest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorkerRuns:
    """What became of each run. Distances are true ones, from all of the arm and its load."""

    cycle_time: Float[Tensor, " runs"]
    """[s]; infinite: it did not end within the time allowed."""
    undisturbed: Float[Tensor, " runs"]
    """The same without a worker [s]."""
    waited: Float[Tensor, " runs"]
    """Time that the path did not go on for the worker's sake [s]."""
    violations: Int[Tensor, " runs"]
    """Steps in which the arm could not have stopped before the worker (`margin_to_stop`)."""
    margin: Float[Tensor, " runs"]
    """Least of what distances exceeded that by [m]; infinite where nothing came near."""
    closing: Float[Tensor, " runs"]
    """Smallest distance from a part of the worker that a part of the arm closed in on [m]."""
    least: Float[Tensor, " runs"]
    """Smallest distance of all, also while the arm rested [m]."""
    elbow: Float[Tensor, " runs"]
    """Smallest distance from upper arm, elbow and forearm [m]."""
    crowded: Float[Tensor, " runs"]
    """Time with less than `CRUSHING_GAP` between arm and worker [s]."""
    present: Float[Tensor, " runs"]
    """Time of the cycle during the worker's visit [s]."""
    off_path: Float[Tensor, " runs"]
    """Largest distance of the end effector from its path [m]."""
    unsolved: Int[Tensor, " runs"]
    """Steps in which the constraints' solver had not steps enough, and the arm braked."""

    @classmethod
    def joined(cls, parts: Sequence[WorkerRuns]) -> WorkerRuns:
        """The runs of several batches."""
        return cls(
            **{
                f.name: torch.cat([getattr(part, f.name) for part in parts])
                for f in fields(cls)
            }
        )


@torch.inference_mode()
def run_beside_workers(
    job: Job,
    reaction: Reaction,
    config: WorkCellConfig,
    limit: float,
    tell: Callable[[float], None] = lambda share: None,
) -> WorkerRuns:
    """Let all arms do their cycle.

    Args:
        job: What they do, and beside whom.
        reaction: How they react.
        config: How the loop runs.
        limit: Longest time of a run [s].
        tell: Told now and then which share of the runs has ended.
    """
    batch = _Batch(job, reaction, config)
    for step in range(round(limit / config.dt)):
        if not len(batch.live):
            break
        batch.step(step)
        if step % 100 == 0:
            tell(1 - len(batch.live) / len(job.cycle))
    tell(1.0)
    return batch.result()


class _Paths(NamedTuple):
    """Of all cycles, padded by their ends."""

    position: Float[Tensor, "cycles steps joints"]
    velocity: Float[Tensor, "cycles steps joints"]
    narrow: Bool[Tensor, "cycles steps"]
    """Whether the arm could not follow beside its path."""
    narrow_ahead: Bool[Tensor, "cycles steps"]
    """Whether it could not somewhere on the way on which a path stops."""
    holding: Bool[Tensor, "cycles steps"]
    length: Int[Tensor, " cycles"]

    @classmethod
    def of(cls, cycles: Sequence[JobCycle]) -> _Paths:
        longest, columns = max(len(cycle.path) for cycle in cycles), []
        for cycle in cycles:
            path = torch.from_numpy(cycle.path)
            velocity = torch.from_numpy(np.gradient(cycle.path, cycle.dt, axis=0))
            narrow = smallest_singular_value(panda, path) < NARROW
            ahead = narrow.clone()
            for k in range(1, round(CHANGE_OF_RATE / cycle.dt) + 1):
                ahead[:-k] |= narrow[k:]
            parts = (path, velocity, narrow, ahead, torch.from_numpy(cycle.holding))
            index = torch.arange(longest).clamp(max=len(path) - 1)
            columns.append([part[index] for part in parts])
        position, velocity, narrow, ahead, holding = (
            torch.stack(part) for part in zip(*columns, strict=True)
        )
        length = torch.tensor([len(cycle.path) for cycle in cycles])
        return cls(position, velocity, narrow, ahead, holding, length)

    def between(
        self, samples: Tensor, cycle: Tensor, at: Float[Tensor, " some"]
    ) -> Float[Tensor, "some joints"]:
        """Samples of some cycles between two of their times, or at their ends."""
        last = self.length[cycle] - 1
        k = torch.minimum(at.long(), last)
        following = samples[cycle, torch.minimum(k + 1, last)]
        first = samples[cycle, k]
        return first + (at - k).unsqueeze(-1) * (following - first)


class _Command(NamedTuple):
    """Of one step."""

    joint_velocity: Tensor
    goal: Tensor
    """Where on the path the joints should be [rad]."""
    wanted: Tensor
    """Along the path [rad/s]."""
    waits: Tensor
    """Whether the arm, pushed aside, would meet something if the path went on."""
    stops: Tensor
    """Whether it might not find back to a path that goes on, or nears a singularity."""
    off: Tensor
    """How far its joints are from the path [rad]."""


class _Batch:
    """The arms. `live` lists those whose cycle has not ended; what has no index is of these."""

    def __init__(self, job: Job, reaction: Reaction, config: WorkCellConfig):
        self._job, self._config, self._reaction = job, config, reaction
        self._way, self._paths = reaction.way_making, _Paths.of(job.cycles)
        self._load = job.cycles[0].load
        safety = job.sizes.plant(config.safety)
        self._separation = safety.separation
        constraints = None
        if reaction.stop_distance is None:
            constraints = BESIDE_PEOPLE
        self._safety = SafetyFilter(panda.limits, replace(safety, constraints=constraints))
        margin = safety.margin + config.limit_room
        self._room = SafetyFilter(panda.limits, replace(safety, margin=margin))
        self._watch = PersonWatchConfig()
        self._delay = job.sizes.following_delay
        runs = len(job.cycle)
        self.live = torch.arange(runs)
        # At rest where their encoders tell that the path begins.
        self._q = self._paths.position[job.cycle, 0] - job.encoder_offset
        self._v = torch.zeros_like(self._q)
        acceleration = panda.limits.acceleration.numpy()
        # Jitter of commands is one for all arms, whatever the batch.
        drawn = job.sizes.draw(np.random.default_rng(0))
        self._channel = CommandChannel(
            drawn, np.broadcast_to(acceleration, self._q.shape).copy()
        )
        self._guard = self._safety.initial_state(self._q.clone())
        zeros = torch.zeros(runs, dtype=torch.float64)
        self._progress, self._waiting = zeros.clone(), zeros.clone()
        self._nearest = zeros + torch.inf
        self._rate, self._pace, self._share = zeros + 1, zeros + 1, zeros + 1
        self._aside, self._lost = torch.zeros(2, runs, dtype=torch.bool)
        self._null, self._back = torch.zeros_like(self._q), torch.zeros_like(self._q)
        far, count = zeros + _RANGE, torch.zeros(runs, dtype=torch.int64)
        self._found = WorkerRuns(
            cycle_time=zeros + torch.inf,
            undisturbed=(self._paths.length[job.cycle] - 1).double() * config.dt,
            waited=zeros.clone(),
            violations=count.clone(),
            margin=zeros + torch.inf,
            closing=far.clone(),
            least=far.clone(),
            elbow=far.clone(),
            crowded=zeros.clone(),
            present=zeros.clone(),
            off_path=zeros.clone(),
            unsolved=count.clone(),
        )

    def result(self) -> WorkerRuns:
        return self._found

    def step(self, step: int) -> None:
        """One control step of the arms whose cycle has not ended."""
        live, config, job = self.live, self._config, self._job
        self._measure(step)
        measured = self._measured(step)
        here = self._progress[live].long()
        holding = self._paths.holding[job.cycle[live], here]
        distances, stop, known = self._look(step, measured, holding)
        self._feel(step, measured, distances)
        command = self._command(measured, here)
        guard, share = _taken(self._guard, live), self._share[live]
        J = panda.jacobian(measured)
        safe, guard, report = self._safety.step(
            guard,
            measured,
            share.unsqueeze(-1) * command.joint_velocity,
            config.dt,
            jacobian=J,
            distances=distances,
            stop=stop | ~known,
        )
        _put(self._guard, live, guard)
        kept, held = report.constraints, stop | (share < 1)
        if distances is not None and kept is not None:
            held = held | people_bind(distances, safe, kept, self._safety.config)
            self._found.unsolved[live] += ~kept.solved
        asked = (J @ command.joint_velocity.unsqueeze(-1)).squeeze(-1)
        done = (J @ safe.unsqueeze(-1)).squeeze(-1)
        pace = torch.where(held | ~known, share_of_motion(asked, done), 1.0)
        pace = torch.minimum(pace, self._pace[live] + config.dt / CHANGE_OF_RATE)
        self._pace[live] = pace
        self._found.waited[live] += (1 - pace) * config.dt
        self._move(step, safe)
        self._go_on(step, here, command)

    def _measured(self, step: int) -> Float[Tensor, "live joints"]:
        """Readings of the joints [rad]."""
        live, noise = self.live, self._job.encoder_noise
        return (
            self._q[live] + self._job.encoder_offset[live] + noise[live, step % noise.shape[1]]
        )

    def _move(self, step: int, safe: Tensor) -> None:
        """Let the arms follow for a step."""
        dt, command = self._config.dt, torch.zeros_like(self._q)
        command[self.live] = safe
        self._channel.send(step * dt, command.numpy())
        self._v = torch.from_numpy(self._channel.advance(step * dt, dt))
        live = self.live
        self._q[live] += dt * self._v[live]

    def _look(
        self, step: int, measured: Tensor, holding: Tensor
    ) -> tuple[Distances | None, Bool[Tensor, " live"], Bool[Tensor, " live"]]:
        """Distances to keep, whether somebody is near enough for the arm to stop, and whether
        anything was seen yet.
        """
        seen, age = self._job.workers.seen(step, self.live)
        known = ~age.isnan()
        age = age.nan_to_num()
        stop = torch.zeros_like(known)
        bound = self._bound(measured, holding, seen)
        if self._reaction.stop_distance is not None:
            limit = self._reaction.stop_distance
            for rows, found, _ in self._near(measured, holding, seen, bound, bound < limit):
                stop[rows] = found.distance.amin((-2, -1)) < limit
            return None, stop, known
        gain = self._watch.acceleration * (age + self._separation.reaction_time)
        towards = gain.unsqueeze(-1) + seen.velocity.norm(dim=-1).amax(-1)
        allowed = self._separation.highest_speed(bound - age.unsqueeze(-1) * towards, towards)
        speed = self._point_speed(measured, _taken(self._guard, self.live).velocity)
        relevant = allowed < speed.unsqueeze(-1) + _FASTER
        if self._way.automatic:
            relevant |= bound < self._way.far + age.unsqueeze(-1) * towards
        shape = (len(known), self._watch.pairs)
        distance = measured.new_full(shape, _FAR)
        self._share[self.live] = 1.0
        gradient, approach = measured.new_zeros(*shape, 7), measured.new_zeros(shape)
        for rows, found, columns in self._near(measured, holding, seen, bound, relevant):
            velocity = seen.velocity[rows.unsqueeze(-1), columns]
            part = urgent_distances(found, velocity, age[rows], self._separation, self._watch)
            self._share[self.live[rows]] = share_of_speed(
                found, velocity, age[rows], self._separation, self._watch
            )
            distance[rows] = part.distance
            gradient[rows], approach[rows] = part.gradient, part.approach_speed
        person = torch.ones(shape, dtype=torch.bool)
        return (
            Distances(
                distance=distance, gradient=gradient, approach_speed=approach, person=person
            ),
            stop,
            known,
        )

    def _bound(self, q: Tensor, holding: Tensor, workers: Workers) -> Float[Tensor, "live H"]:
        """Lower bounds of the distances of the workers' capsules from the arms [m]."""
        arm = self._job.arm
        middle, half = _covering(arm.segments(q))
        radius = half + arm.radius.unsqueeze(-1)
        points, sizes = middle.flatten(-3, -2), radius.flatten(-2)
        if bool(holding.any()):
            # The load lies about the tool's centre.
            box = torch.tensor(self._load.half_size, dtype=q.dtype).norm()
            points = torch.cat([points, panda.forward(q).position.unsqueeze(-2)], dim=-2)
            load = torch.where(holding, box, -_FAR).unsqueeze(-1)
            sizes = torch.cat([sizes, load], dim=-1)
        other, size = _covering(workers.ends)
        apart = torch.cdist(points, other.flatten(-3, -2)) - sizes.unsqueeze(-1)
        nearest = apart.amin(-2).unflatten(-1, other.shape[-3:-1]) - size
        return nearest.amin(-1) - workers.radius

    def _point_speed(self, q: Tensor, v: Tensor) -> Float[Tensor, " live"]:
        """Of the fastest end of the arm's capsules [m/s]."""
        arm = self._job.arm
        now, then = arm.segments(torch.stack([q, q + _STEP * v]))
        return ((then - now).norm(dim=-1) / _STEP).amax((-2, -1))

    def _near(
        self,
        q: Tensor,
        holding: Tensor,
        workers: Workers,
        bound: Float[Tensor, "live H"],
        relevant: Bool[Tensor, "live H"],
    ) -> Iterator[tuple[Int[Tensor, " some"], Separation, Int[Tensor, "some columns"]]]:
        """Distances from those capsules of the workers that matter, some arms at a time."""
        count = relevant.sum(-1)
        order = bound.masked_fill(~relevant, torch.inf).argsort(dim=-1)
        for load, group in ((None, ~holding), (self._load, holding)):
            members = torch.nonzero(group & (count > 0)).squeeze(-1)
            if not len(members):
                continue
            members = members[count[members].argsort()]
            for rows in members.split(_BLOCK):
                columns = order[rows, : int(count[rows].max())]
                pick = rows.unsqueeze(-1), columns
                found = separation(
                    self._job.arm, q[rows], workers.ends[pick], workers.radius[pick], load
                )
                yield rows, found, columns

    def _feel(self, step: int, measured: Tensor, distances: Distances | None) -> None:
        """Take in what the expert and the repulsion want of the null space."""
        asked = torch.zeros_like(measured)
        if self._way.expert:
            asked += self._pulled(step, measured) / self._config.damping
        if self._way.automatic and distances is not None:
            asked += way_making_velocity(distances, self._way)
        live = self.live
        asked *= self._share[live].unsqueeze(-1)
        before = self._null[live]
        some = torch.nonzero((asked != 0).any(-1) | (before != 0).any(-1)).squeeze(-1)
        if not len(some):
            return
        bounds = self._room.velocity_bounds(measured[some])
        eased, *_ = eased_null_velocity(
            panda,
            measured[some],
            panda.jacobian(measured[some]),
            before[some],
            asked[some],
            bounds,
            self._config.dt,
            self._config,
        )
        over = (asked[some] == 0).all(-1)
        over &= self._config.damping * eased.abs().amax(-1) < LEAST_INPUT
        self._null[live[some]] = torch.where(over.unsqueeze(-1), 0.0, eased)

    def _pulled(self, step: int, measured: Tensor) -> Float[Tensor, "live joints"]:
        """Null-space input of the experts who pull at the elbow now [N m]."""
        time, pulls = step * self._config.dt, self._job.pulls
        d = torch.zeros_like(measured)
        active = [k for k, run in enumerate(self.live.tolist()) if pulls[run].strength(time)]
        if active:
            joint = pulls[0].joint
            origin = panda.joint_origins(measured[active])[:, joint - 1].numpy()
            force = np.stack(
                [
                    pulls[int(self.live[k])].force(time, at)
                    for k, at in zip(active, origin, strict=True)
                ]
            )
            J = panda.joint_jacobian(measured[active], joint)[:, :3]
            d[active] = (J.mT @ torch.from_numpy(force).unsqueeze(-1)).squeeze(-1)
        return d

    def _command(self, measured: Tensor, here: Tensor) -> _Command:
        """What the arms are told: along their paths, or beside them."""
        live, config, paths = self.live, self._config, self._paths
        cycle, progress, rate = self._job.cycle[live], self._progress[live], self._rate[live]
        goal = paths.between(paths.position, cycle, progress)
        later = (progress + rate * self._delay / config.dt).clamp(min=0)
        wanted = rate.unsqueeze(-1) * paths.between(paths.velocity, cycle, later)
        error = goal - measured
        command = wanted + config.pose_gain * error
        waits, stops = torch.zeros(2, len(live), dtype=torch.bool)
        pushed, aside = (self._null[live] != 0).any(-1), self._aside[live]
        gone = (~paths.narrow[cycle, here] | aside) & stays_aside(pushed, aside, error)
        self._aside[live] = gone
        some = torch.nonzero(gone).squeeze(-1)
        back = torch.zeros_like(measured)
        if len(some):
            away = null_projection(panda.jacobian(measured[some]), error[some])
            goes = (rate[some] <= 0) | ~pushed[some]
            these, straight = live[some], straightness(away, error[some])
            waited = self._lost[these] & ~pushed[some]
            lost = may_not_find_back(error[some], straight, waited)
            near = nears_singularity(panda, measured[some], self._guard.velocity[these])
            self._lost[these], stops[some] = lost, lost | near
            push = self._null[these]
            push = share_of_push(push, away, straight).unsqueeze(-1) * push
            away = away * goes.unsqueeze(-1)
            back[some] = eased_way_back(self._back[these], away, config.dt, config)
            command[some], waits[some] = self._beside(
                some, measured[some], goal[some], wanted[some], wanted[some] + back[some] + push
            )
        self._back[live] = back
        return _Command(command, goal, wanted, waits, stops, error.norm(dim=-1))

    def _beside(
        self, some: Tensor, q: Tensor, goal: Tensor, wanted: Tensor, null: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Joint velocities of arms aside: the end effector keeps to its path."""
        config, live = self._config, self.live[some]
        J = panda.jacobian(q + self._delay * self._guard.velocity[live])
        there = panda.forward(goal)
        twist = panda.jacobian(goal + self._delay * wanted) @ wanted.unsqueeze(-1)
        correction = config.pose_gain * panda.forward(q).twist_to(there)
        task = resolved_rate(J, twist.squeeze(-1) + correction, torch.zeros_like(q))
        null = null_projection(J, null)
        null = null * null_space_slowdown(panda, q, null).unsqueeze(-1)
        null, waits = self._kept_clear(q, task, null)
        room = self._room.velocity_bounds(q)
        gives = null_space_giving_way(J, task, null, *room)
        changed = (gives != null).any(-1)
        if bool(changed.any()):
            slower = null_space_slowdown(panda, q, gives).unsqueeze(-1)
            gives = torch.where(changed.unsqueeze(-1), gives * slower, gives)
        bounds = self._safety.velocity_bounds(q)
        return task + scale_null_space(task, gives, *bounds), waits

    def _kept_clear(self, q: Tensor, task: Tensor, null: Tensor) -> tuple[Tensor, Tensor]:
        """`kept_clear`, computed for those arms that furniture or the arm itself is near to."""
        margin, clearance = self._config.clearance, self._job.workplace.arm_clearance
        reach = LOOK_AHEAD * (_capsule_speeds(q, task) + _capsule_speeds(q, null)) + _BENT
        near = torch.nonzero(_clear_bound(self._job.workplace, q, reach) < margin).squeeze(-1)
        waits = torch.zeros(len(q), dtype=torch.bool)
        if len(near):
            null = null.clone()
            clear = kept_clear(q[near], task[near], null[near], clearance, margin)
            null[near], waits[near] = clear.null, clear.waits
        return null, waits

    def _go_on(self, step: int, here: Tensor, command: _Command) -> None:
        """Let paths go on, wait or go back, and note the ends of cycles."""
        live, config, paths = self.live, self._config, self._paths
        cycle, rate, aside = self._job.cycle[live], self._rate[live], self._aside[live]
        behind, waiting = torch.zeros_like(rate), self._waiting[live]
        some = torch.nonzero(aside).squeeze(-1)
        if len(some):
            at = self._q[live[some]] + self._job.encoder_offset[live[some]]
            goal, wanted = command.goal[some], command.wanted[some]
            J = panda.jacobian(goal + self._delay * wanted)
            off = panda.forward(at).twist_to(panda.forward(goal))
            behind[some] = behind_path(off, (J @ wanted.unsqueeze(-1)).squeeze(-1))
        behind = torch.where(command.waits, torch.inf, behind)
        pushed = (self._null[live] != 0).any(-1)
        counts = ~pushed & (self._pace[live] == 1)
        waiting, nearest = waited_for(
            waiting, self._nearest[live], command.off, rate, counts, config.dt
        )
        waiting = torch.where(aside, waiting, 0.0)
        self._waiting[live], self._nearest[live] = waiting, nearest
        backs = (waiting > STUCK) & (self._progress[live] > 0)
        stops = ~backs & aside & (paths.narrow_ahead[cycle, here] | command.stops)
        behind = torch.where(stops, torch.inf, behind)
        direction = torch.where(backs, -1, 1).numpy()
        rate = torch.from_numpy(
            changed_rate(rate.numpy(), (2.0 - behind).numpy(), config.dt, direction)
        )
        self._rate[live] = rate
        progress = (self._progress[live] + rate * self._pace[live]).clamp(min=0)
        over = progress > paths.length[cycle] - 1
        self._progress[live] = torch.minimum(progress, (paths.length[cycle] - 1).double())
        self._found.cycle_time[live[over]] = (step + 1) * config.dt
        self.live = live[~over]

    def _measure(self, step: int) -> None:
        """What is true now."""
        live, found, dt = self.live, self._found, self._config.dt
        q, v = self._q[live], self._v[live]
        workers = self._job.workers.truth(step, live)
        tables = self._job.workers
        there = (step >= tables.first[live]) & (step < tables.first[live] + tables.rows[live])
        found.present[live] += there * dt
        progress, cycle = self._progress[live], self._job.cycle[live]
        holding = self._paths.holding[cycle, progress.long()]
        self._note_deviation(q, cycle, progress)
        bound = self._bound(q, holding, workers)
        stop = replace(self._separation, reaction_time=0.0, clearance=0.0)
        coming = workers.velocity.norm(dim=-1).amax(-1)
        needed = stop.protective_distance(
            (self._point_speed(q, v) + _FASTER).unsqueeze(-1).expand_as(coming), coming
        )
        so_far = torch.maximum(found.elbow[live], found.closing[live]).clamp(min=CRUSHING_GAP)
        relevant = bound < torch.maximum(needed, so_far.unsqueeze(-1))
        elbow = [k for k, link in enumerate(self._job.arm.links) if link in _ELBOW_LINKS]
        for rows, near, columns in self._near(q, holding, workers, bound, relevant):
            speed = workers.velocity[rows.unsqueeze(-1), columns]
            spare, moves = margin_to_stop(near, v[rows], speed, self._separation)
            margin, runs = spare.amin((-2, -1)), live[rows]
            closing = near.distance.masked_fill(~moves, torch.inf)
            least = near.distance.amin((-2, -1))
            for kept, value in (
                (found.margin, margin),
                (found.closing, closing.amin((-2, -1))),
                (found.least, least),
                (found.elbow, near.distance[:, elbow].amin((-2, -1))),
            ):
                kept[runs] = torch.minimum(kept[runs], value)
            found.violations[runs] += margin < 0
            found.crowded[runs] += (least < CRUSHING_GAP) * dt

    def _note_deviation(self, q: Tensor, cycle: Tensor, progress: Tensor) -> None:
        """Of the end effector from its path, as the arm's own encoders show it."""
        live, paths = self.live, self._paths
        goal = paths.between(paths.position, cycle, progress)
        pose, J = panda.forward_and_jacobian(goal)
        off = panda.forward(q + self._job.encoder_offset[live]).position - pose.position
        wanted = paths.between(paths.velocity, cycle, progress)
        way = (J[:, :3] @ wanted.unsqueeze(-1)).squeeze(-1)
        # Servos lag along the path, which is no departure from it.
        square = (way * way).sum(-1, keepdim=True)
        along = (off * way).sum(-1, keepdim=True) / square.clamp(min=1e-6)
        off = (off - along * way).norm(dim=-1)
        self._found.off_path[live] = torch.maximum(self._found.off_path[live], off)


def _capsule_speeds(q: Tensor, v: Tensor) -> Float[Tensor, "some capsules"]:
    """Of the faster end of each of the arm's own capsules [m/s]."""
    now, then = panda.whole.segments(torch.stack([q, q + _STEP * v]))
    return (then - now).norm(dim=-1).amax(-1) / _STEP


def _clear_bound(
    workplace: Workplace, q: Tensor, reach: Float[Tensor, "some capsules"]
) -> Float[Tensor, " some"]:
    """Lower bound of the arm's clearance while its capsules move by no more than so far [m]."""
    own, body = panda.whole, panda.body
    first, second = torch.tensor(own.pairs).mT
    clear = (own.pair_distances(q) - reach[:, first] - reach[:, second]).amin(-1)
    # The body has the first of the capsules, all but the hand's.
    moving = [k for k, link in enumerate(body.links) if link > 0]
    points, half = _covering(body.segments(q)[:, moving])
    radius = half + (body.radius[moving] + reach[:, moving]).unsqueeze(-1)
    boxes = workplace.scene.boxes()
    centre, size = (
        q.new_tensor([getattr(box, name) for box in boxes]) for name in ("centre", "half_size")
    )
    outside = ((points.unsqueeze(-2) - centre).abs() - size).clamp(min=0).norm(dim=-1)
    return torch.minimum(clear, (outside.amin(-1) - radius).amin((-2, -1)))


def _covering(
    axes: Float[Tensor, "*batch capsules 2 3"],
) -> tuple[Float[Tensor, "*batch capsules parts 3"], Float[Tensor, "*batch capsules parts"]]:
    """Middles of the parts of capsules' axes, and half the length of each [m]."""
    at = (torch.arange(_PARTS, dtype=axes.dtype) + 0.5) / _PARTS
    points = torch.lerp(axes[..., :1, :], axes[..., 1:, :], at[:, None])
    half = (axes[..., 1, :] - axes[..., 0, :]).norm(dim=-1) / (2 * _PARTS)
    return points, half.unsqueeze(-1).expand(points.shape[:-1])


def _taken(state: SafetyState, index: Tensor) -> SafetyState:
    """Some elements of a batch."""
    return _pytree.tree_map(lambda x: x[index], state)


def _put(state: SafetyState, index: Tensor, part: SafetyState) -> None:
    """Replace some elements of a batch."""
    _pytree.tree_map(lambda x, new: x.index_copy_(0, index, new), state, part)
