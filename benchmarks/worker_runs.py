"""Run many arms at their job, each near a worker, in one batch.

The joints follow commands with delay and servo lag, and encoders and trackers have errors as in
`Imperfections`; forces are not simulated. All other parts are those of a work cell: the person
watch and `ArmLoop`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils import _pytree
from worker_job import JobCycle
from worker_tables import Workers, WorkerTables
from working_worker import WorkingWorkers

from hrc_learn.controller import Distances, WayMakingConfig
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmReading,
    FollowPath,
    WatchedPeople,
)
from hrc_learn.controller.contact_limits import ContactLimits, PersonMode, region_numbers
from hrc_learn.controller.joint_path import JointPaths
from hrc_learn.experiments.surroundings import margin_to_stop
from hrc_learn.kinematics import CapsuleArm, Separation, panda, separation
from hrc_learn.sim import CommandChannel, Imperfections, WorkerConfig
from hrc_learn.sim.worker import REGIONS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.person_watch import (
    NEAR_PEOPLE,
    PersonWatchConfig,
    watched_people,
)
from hrc_learn.teleoperation import ScriptedForce

# Distance above which a pair of capsules is not computed [m].
_FAR = 10.0
# Largest change of the speed of a point of the arm or its load in one step of 10 ms [m/s]: the
# acceleration limits of a Panda's joints, with levers from 0.85 m at the first joint down to
# zero.
_FASTER = 0.3
# Number of arms whose distances are computed together: their tensors stay in the cache.
_BLOCK = 48
# Largest distance that is recorded as the smallest one [m].
_RANGE = 0.5
# Links of the elbow, which the null space moves: from the upper arm to the forearm.
_ELBOW_LINKS = (2, 3, 4, 5)
CRUSHING_GAP = 0.12
"""Gap between arm and body that avoids crushing [m]: ISO 13854:2017, table 1."""
_STEP = 1e-4  # step of a difference quotient along a motion [s]
_PARTS = 3  # number of spheres that cover a capsule in bounds of distances


class Experts(Protocol):
    """Experts who pull a joint of each arm."""

    joint: int
    """Number of this joint, counted from 1."""

    def forces(
        self, time: float, runs: Int[Tensor, " some"], at: Float[Tensor, "some 3"]
    ) -> Float[Tensor, "some 3"]:
        """Pulls at some of the arms [N], called at each control step.

        Args:
            time: Time [s].
            runs: Numbers of the arms.
            at: Positions of their joints [m].
        """
        ...


class ScriptedExperts:
    """Experts whose pulls are known beforehand, one for each arm."""

    def __init__(self, pulls: Sequence[ScriptedForce]):
        """Begin.

        Args:
            pulls: Pull at each arm, all at the same joint.
        """
        self._pulls, self.joint = pulls, pulls[0].joint

    def forces(
        self, time: float, runs: Int[Tensor, " some"], at: Float[Tensor, "some 3"]
    ) -> Float[Tensor, "some 3"]:
        """Pulls at some of the arms [N]; see `Experts`."""
        force = torch.zeros_like(at)
        for k, run in enumerate(runs.tolist()):
            if self._pulls[run].strength(time):
                force[k] = torch.from_numpy(self._pulls[run].force(time, at[k].numpy()))
        return force


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """Task of the arms, and the workers near them; the same for all reactions."""

    workplace: Workplace
    arm: CapsuleArm
    """Capsules of arm and tool."""
    cycles: Sequence[JobCycle]
    """Different cycles of the job."""
    cycle: Int[Tensor, " runs"]
    """Index of the cycle of each arm."""
    workers: WorkerTables | WorkingWorkers
    """Workers who follow a script, or who react to their arm."""
    bodies: Sequence[WorkerConfig]
    """Sizes of the workers."""
    experts: Experts
    """Experts who pull the elbows."""
    encoder_offset: Float[Tensor, "runs joints"]
    """Offset of the encoders: measured minus true [rad]."""
    encoder_noise: Float[Tensor, "runs steps joints"]
    """Noise of each reading, repeated after the last [rad]."""
    sizes: Imperfections


@dataclass(frozen=True, kw_only=True)
class Reaction:
    """Reaction of the arms to workers."""

    way_making: WayMakingConfig = field(default_factory=lambda: WayMakingConfig(mode="none"))
    """Source of null-space motion."""
    stop_distance: float | None = None
    """Distance within which the arm rests, without any other reaction [m]. None: the arm keeps
    the protective distance and slows down or stops for it."""
    mode: PersonMode = "ssm"
    """Separation monitoring, or power and force limiting."""
    padding: float = math.inf
    """Stiffness of a padding of the arm [N/mm]; infinite: none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorkerRuns:
    """Results of each run. Distances are true ones, from the arm and its load to the worker."""

    cycle_time: Float[Tensor, " runs"]
    """Duration of the cycle [s]; infinite if it did not end within the time limit."""
    undisturbed: Float[Tensor, " runs"]
    """Duration without a worker [s]."""
    waited: Float[Tensor, " runs"]
    """Time lost to the worker [s]."""
    violations: Int[Tensor, " runs"]
    """Steps in which the arm could not have stopped before the worker (`margin_to_stop`)."""
    margin: Float[Tensor, " runs"]
    """Smallest difference between the distance and the stopping distance [m]; infinite if the
    worker was never near."""
    closing: Float[Tensor, " runs"]
    """Smallest distance between a part of the arm and a part of the worker that it approached
    [m]."""
    least: Float[Tensor, " runs"]
    """Smallest distance, also while the arm rested [m]."""
    elbow: Float[Tensor, " runs"]
    """Smallest distance from upper arm, elbow and forearm [m]."""
    crowded: Float[Tensor, " runs"]
    """Time with less than `CRUSHING_GAP` between arm and worker [s]."""
    present: Float[Tensor, " runs"]
    """Time of the cycle during the worker's visit [s]."""
    off_path: Float[Tensor, " runs"]
    """Largest distance of the end effector from its path [m]."""
    unsolved: Int[Tensor, " runs"]
    """Steps in which the constraint solver ran out of iterations, and the arm braked."""
    touches: Int[Tensor, " runs"]
    """Number of contacts into which the arm moved, from `contact_forces`."""
    run_into: Int[Tensor, " runs"]
    """Number of contacts in which the worker moved into an arm at rest."""
    exceedances: Int[Tensor, " runs"]
    """Number of contacts into which the arm moved with more than the allowed force or pressure.
    """
    of_limit: Float[Tensor, " runs"]
    """Largest force or pressure of such a contact, as a fraction of its limit."""

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
def run_near_workers(
    job: Job,
    reaction: Reaction,
    config: ArmLoopConfig,
    limit: float,
    report: Callable[[float], None] = lambda fraction: None,
    trace: list[tuple[Tensor, Tensor]] | None = None,
) -> WorkerRuns:
    """Let all arms do their cycle.

    Args:
        job: Task of the arms, and the workers near them.
        reaction: Reaction to workers.
        config: Settings of the loop.
        limit: Longest duration of a run [s].
        report: Called now and then with the fraction of the runs that have ended.
        trace: Receives the true joint positions of all arms [rad], and a mask of those that
            hold the object, at each step.
    """
    batch = _Batch(job, reaction, config)
    for step in range(round(limit / config.dt)):
        if not len(batch.live):
            break
        batch.step(step)
        if trace is not None:
            trace.append(batch.now)
        if step % 100 == 0:
            report(1 - len(batch.live) / len(job.cycle))
    report(1.0)
    return batch.found


class _Batch:
    """The arms. `live` lists the arms whose cycle has not ended; the state of the loop contains
    only these arms.
    """

    def __init__(self, job: Job, reaction: Reaction, config: ArmLoopConfig):
        self._job, self._reaction = job, reaction
        self._load = job.cycles[0].load
        safety = job.sizes.plant(config.safety)
        contact = replace(safety.separation.contact, padding=reaction.padding)
        self._separation = replace(safety.separation, mode=reaction.mode, contact=contact)
        safety = replace(safety, separation=self._separation)
        self._regions = region_numbers(REGIONS)
        self._limits = self._true_limits = None
        if reaction.mode != "ssm":
            boxes, config_used = job.workplace.scene.boxes(), self._separation.contact
            whole = replace(self._separation, contact=replace(config_used, used=1.0))
            self._limits, self._true_limits = (
                ContactLimits(job.arm, separation, boxes)
                for separation in (self._separation, whole)
            )
        constraints = NEAR_PEOPLE if reaction.stop_distance is None else None
        self._config = replace(
            config,
            safety=replace(safety, constraints=constraints),
            command_delay=job.sizes.following_delay,
            way_making=reaction.way_making,
        )
        clearance = partial(_clearance, job.workplace, config.clearance)
        self._loop = ArmLoop(panda, self._config, clearance)
        self._paths = JointPaths.of(panda, [cycle.path for cycle in job.cycles], config.dt)
        longest = self._paths.position.shape[1]
        self._holding = torch.stack(
            [
                torch.from_numpy(cycle.holding)[
                    torch.arange(longest).clamp(max=len(cycle.path) - 1)
                ]
                for cycle in job.cycles
            ]
        )
        self._watch = PersonWatchConfig()
        runs = len(job.cycle)
        self.live = torch.arange(runs)
        begin = self._paths.position[job.cycle, 0]
        # At rest where the encoders read the start of the path.
        self._q = begin - job.encoder_offset
        self._v = torch.zeros_like(self._q)
        self._holds = torch.zeros(runs, dtype=torch.bool)
        acceleration = panda.limits.acceleration.numpy()
        # The jitter of commands is the same for all arms, whatever the batch.
        drawn = job.sizes.draw(np.random.default_rng(0))
        self._channel = CommandChannel(
            drawn, np.broadcast_to(acceleration, self._q.shape).copy()
        )
        request = FollowPath(paths=self._paths, path=job.cycle)
        self._state = self._loop.path_law.begin(
            self._loop.initial_state(self._q.clone()), begin, request
        )
        zeros, count = torch.zeros(runs, dtype=torch.float64), torch.zeros(runs).long()
        self.found = WorkerRuns(
            cycle_time=zeros + torch.inf,
            undisturbed=self._paths.last[job.cycle].double() * config.dt,
            waited=zeros.clone(),
            violations=count.clone(),
            margin=zeros + torch.inf,
            closing=zeros + _RANGE,
            least=zeros + _RANGE,
            elbow=zeros + _RANGE,
            crowded=zeros.clone(),
            present=zeros.clone(),
            off_path=zeros.clone(),
            unsolved=count.clone(),
            touches=count.clone(),
            run_into=count.clone(),
            exceedances=count.clone(),
            of_limit=zeros.clone(),
        )

    def step(self, step: int) -> None:
        """One control step of the arms whose cycle has not ended."""
        self._measure(step)
        reading = self._reading(step)
        request = FollowPath(paths=self._paths, path=self._job.cycle[self.live])
        command, self._state, report = self._loop.step(self._state, reading, request)
        if report.safety.constraints is not None:
            self.found.unsolved[self.live] += ~report.safety.constraints.solved
        self.found.waited[self.live] += (1 - self._state.pace.people_scale) * self._config.dt
        self._move(step, command)
        if isinstance(self._job.workers, WorkingWorkers):
            self._job.workers.act(step, self._q)
        ended = self._state.path.finished
        if bool(ended.any()):
            self.found.cycle_time[self.live[ended]] = step * self._config.dt
            self.live = self.live[~ended]
            self._state = _pytree.tree_map(lambda x: x[~ended], self._state)

    @property
    def now(self) -> tuple[Tensor, Tensor]:
        """True joint positions of all arms, and a mask of those that hold the object."""
        return self._q.float(), self._holds.clone()

    def _move(self, step: int, command: Tensor) -> None:
        """Let the arms follow for a step."""
        dt, every = self._config.dt, torch.zeros_like(self._q)
        every[self.live] = command
        self._channel.send(step * dt, every.numpy())
        self._v = torch.from_numpy(self._channel.advance(step * dt, dt))
        self._q[self.live] += dt * self._v[self.live]

    def _progress(self) -> tuple[Tensor, Tensor]:
        """Cycle of each live arm, and the sample of its path."""
        path = self._state.path
        return self._job.cycle[self.live], torch.minimum(path.progress, path.last)

    def _reading(self, step: int) -> ArmReading:
        """Encoders, tracker and expert of each live arm."""
        live, job, noise = self.live, self._job, self._job.encoder_noise
        q = self._q[live] + job.encoder_offset[live] + noise[live, step % noise.shape[1]]
        cycle, progress = self._progress()
        holding = self._holding[cycle, progress.long()]
        people, stop = self._look(step, q, holding)
        pose, jacobian = panda.forward_and_jacobian(q)
        pulls = self._reaction.way_making.expert
        return ArmReading(
            joint_position=q,
            pose=pose,
            jacobian=jacobian,
            nullspace_input=self._pulled(step, q) if pulls else torch.zeros_like(q),
            pause=torch.zeros_like(stop),
            people=people,
            stop=stop,
        )

    def _look(
        self, step: int, measured: Tensor, holding: Tensor
    ) -> tuple[WatchedPeople | None, Bool[Tensor, " live"]]:
        """People near the arms, and True where an arm must rest."""
        seen, age = self._job.workers.seen(step, self.live)
        # Arms rest as long as nothing was seen.
        stop, age = age.isnan(), age.nan_to_num()
        scale = torch.ones_like(age)
        bound = self._bound(measured, holding, seen)
        if self._reaction.stop_distance is not None:
            limit = self._reaction.stop_distance
            for rows, found, _ in self._near(measured, holding, seen, bound, bound < limit):
                stop[rows] |= found.distance.amin((-2, -1)) < limit
            return None, stop
        gain = self._watch.acceleration * (age + self._separation.reaction_time)
        towards = gain.unsqueeze(-1) + seen.velocity.norm(dim=-1).amax(-1)
        allowed = self._separation.highest_speed(bound - age.unsqueeze(-1) * towards, towards)
        speed = self._point_speed(measured, self._state.safety.velocity)
        relevant = allowed < speed.unsqueeze(-1) + _FASTER
        way = self._reaction.way_making
        if way.automatic:
            relevant |= bound < way.far + age.unsqueeze(-1) * towards
        shape = (len(age), self._watch.pairs)
        distance = measured.new_full(shape, _FAR)
        gradient, approach = measured.new_zeros(*shape, 7), measured.new_zeros(shape)
        touch, cap = measured.new_zeros(shape), torch.full_like(scale, math.inf)
        for rows, found, columns in self._near(measured, holding, seen, bound, relevant):
            contact, load = None, bool(holding[rows[0]])
            if self._limits is not None:
                regions = self._regions[columns]
                contact = self._limits.speeds(found, measured[rows], regions, load)
            observed = (
                found,
                seen.velocity[rows.unsqueeze(-1), columns],
                age[rows],
                self._separation,
                self._watch,
                contact,
            )
            people = watched_people(*observed)
            scale[rows], cap[rows] = people.speed_scale, people.speed_cap
            part = people.distances
            distance[rows] = part.distance
            gradient[rows], approach[rows] = part.gradient, part.approach_speed
            if part.contact_speed is not None:
                touch[rows] = part.contact_speed
        distances = Distances(
            distance=distance,
            gradient=gradient,
            approach_speed=approach,
            person=torch.ones(shape, dtype=torch.bool),
            contact_speed=touch,
        )
        nearest = distance.amin(-1)
        people = WatchedPeople(
            distances=distances, nearest=nearest, age=age, speed_scale=scale, speed_cap=cap
        )
        return people, stop

    def _bound(self, q: Tensor, holding: Tensor, workers: Workers) -> Float[Tensor, "live H"]:
        """Lower bounds of the distances between the workers' capsules and the arms [m]."""
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
        """Speed of the fastest end of the arm's capsules [m/s]."""
        now, then = self._job.arm.segments(torch.stack([q, q + _STEP * v]))
        return ((then - now).norm(dim=-1) / _STEP).amax((-2, -1))

    def _near(
        self,
        q: Tensor,
        holding: Tensor,
        workers: Workers,
        bound: Float[Tensor, "live H"],
        relevant: Bool[Tensor, "live H"],
    ) -> Iterator[tuple[Int[Tensor, " some"], Separation, Int[Tensor, "some columns"]]]:
        """Distances from the relevant capsules of the workers, for some arms at a time."""
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

    def _pulled(self, step: int, measured: Tensor) -> Float[Tensor, "live joints"]:
        """Null-space input of the experts' pulls at the elbow [N m]."""
        experts = self._job.experts
        origin = panda.joint_origins(measured)[:, experts.joint - 1]
        force = experts.forces(step * self._config.dt, self.live, origin)
        d, active = torch.zeros_like(measured), (force != 0).any(-1)
        if bool(active.any()):
            J = panda.joint_jacobian(measured[active], experts.joint)[:, :3]
            d[active] = (J.mT @ force[active].unsqueeze(-1)).squeeze(-1)
        return d

    def _measure(self, step: int) -> None:
        """Record the true distances now."""
        live, found, dt = self.live, self.found, self._config.dt
        q, v, tables = self._q[live], self._v[live], self._job.workers
        workers = tables.truth(step, live)
        found.present[live] += tables.present(step, live) * dt
        cycle, progress = self._progress()
        holding = self._holding[cycle, progress.long()]
        self._holds[live] = holding
        self._measure_deviation(q, cycle, progress)
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
            contact = None
            if self._true_limits is not None:
                regions, load = self._regions[columns], bool(holding[rows[0]])
                contact = self._true_limits.speeds(near, q[rows], regions, load).first
            spare = margin_to_stop(near, v[rows], speed, self._separation, contact)
            margin, runs = spare.amin((-2, -1)), live[rows]
            closing = near.distance.masked_fill(spare.isinf(), torch.inf)
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

    def _measure_deviation(self, q: Tensor, cycle: Tensor, progress: Tensor) -> None:
        """Record the distance of the end effector from its path, by the arm's own encoders."""
        live, paths = self.live, self._paths
        goal = paths.interpolated(paths.position, cycle, progress)
        pose, J = panda.forward_and_jacobian(goal)
        off = panda.forward(q + self._job.encoder_offset[live]).position - pose.position
        wanted = paths.interpolated(paths.velocity, cycle, progress)
        way = (J[:, :3] @ wanted.unsqueeze(-1)).squeeze(-1)
        # Servos lag along the path, which is no deviation from it.
        square = (way * way).sum(-1, keepdim=True)
        along = (off * way).sum(-1, keepdim=True) / square.clamp(min=1e-6)
        off = (off - along * way).norm(dim=-1)
        self.found.off_path[live] = torch.maximum(self.found.off_path[live], off)


def _clearance(
    workplace: Workplace, margin: float, q: Float[Tensor, "postures *batch 7"]
) -> Float[Tensor, "postures *batch"]:
    """Clearance of arms, or a lower bound where all postures of an arm keep the margin."""
    clearance = _clear_bound(workplace, q)
    near = (clearance < margin).any(0)
    if bool(near.any()):
        clearance[:, near] = workplace.arm_clearance(q[:, near])
    return clearance


def _clear_bound(workplace: Workplace, q: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
    """Lower bound of the arm's clearance [m]."""
    body = panda.body
    clear = panda.whole.pair_distances(q).amin(-1)
    # The base does not move.
    moving = [k for k, link in enumerate(body.links) if link > 0]
    points, half = _covering(body.segments(q)[..., moving, :, :])
    radius = half + body.radius[moving].unsqueeze(-1)
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
