"""Jobs beside workers in one batch: the laws that hold whatever the numbers are."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import WayMakingConfig
from hrc_learn.experiments.collaboration import worker_runs
from hrc_learn.experiments.collaboration.job_cycle import JobCycle
from hrc_learn.experiments.collaboration.worker import separation_margin, somebody_comes
from hrc_learn.experiments.collaboration.worker_runs import (
    Job,
    Reaction,
    WorkerRuns,
    run_beside_workers,
)
from hrc_learn.experiments.collaboration.worker_study import (
    WorkerStudy,
    WorkerStudyConfig,
    draw_job,
    expert_pull,
    smallest_distance,
)
from hrc_learn.experiments.collaboration.worker_tables import WorkerTables
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import GraspedBox, panda, separation
from hrc_learn.log import StepLog
from hrc_learn.sim import Imperfections, WorkerSensor, WorkerVisit, whole_arm
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line, nearest_configuration
from hrc_learn.skills.null_space_yielding import CHANGE_OF_RATE, FAR_ASIDE
from hrc_learn.skills.work_cell import WorkCellConfig

WORKPLACE, DT = Workplace(), 0.01
CELL = WorkCellConfig(dt=DT)
SEED = WorkerStudyConfig.seed
IDEAL, NOMINAL = Imperfections.ideal(), Imperfections.nominal()


@pytest.fixture(autouse=True)
def _unchecked():
    """Batches of control steps take many times as long with every shape checked."""
    with shapes_unchecked():
        yield


def beside_the_table(times: int) -> JobCycle:
    """To and fro where a worker works, without a load."""
    hover = WORKPLACE.hover_joints()
    pose = panda.forward(hover)
    aside = Pose(pose.position + pose.position.new_tensor([0.12, 0.1, 0.0]), pose.orientation)
    there = joint_line(hover, nearest_configuration(aside, near=hover), 0.4, DT)
    path = torch.cat([part for _ in range(times) for part in (there, there.flip(0))]).numpy()
    return JobCycle(
        shelf="middle",
        dt=DT,
        path=path,
        holding=np.zeros(len(path), dtype=bool),
        load=GraspedBox(half_size=(0.04, 0.022, 0.03)),
    )


CYCLE, ONCE = beside_the_table(3), beside_the_table(1)


def visit_of(run: int) -> WorkerVisit:
    return somebody_comes(WORKPLACE, np.random.default_rng([SEED, run]))


def job(runs: list[int], sizes: Imperfections = NOMINAL, early: float = 0.0) -> Job:
    """Arms at work, whose workers come so much earlier than drawn [s]."""
    config = WorkerStudyConfig(imperfections=sizes, cell=CELL)
    drawn = draw_job(WORKPLACE, [CYCLE], runs, config)
    tables, steps = drawn.workers, round(early / DT)
    earlier = replace(
        tables,
        first=tables.first - steps,
        newest=tables.newest[:, steps:],
        observed=tables.observed - steps,
        seen_time=tables.seen_time - early,
    )
    return replace(drawn, workers=earlier)


def reaching(run: int) -> float:
    """A second before the worker lets go of what he brings and reaches for the markers [s]."""
    return round(visit_of(run).released / DT - 100) * DT


def making_way(mode: str) -> Reaction:
    return Reaction(way_making=WayMakingConfig(mode=mode))  # pyright: ignore[reportArgumentType]


def recorded(drawn: Job, reaction: Reaction, steps: int) -> tuple[Tensor, Tensor, WorkerRuns]:
    """Joint positions and velocities of a single arm at the beginning of each step."""
    batch, q, v = worker_runs._Batch(drawn, reaction, CELL), [], []
    with torch.inference_mode():
        for step in range(steps):
            if not len(batch.live):
                break
            q.append(batch._q[0].clone())
            v.append(batch._v[0].clone())
            batch.step(step)
    return torch.stack(q), torch.stack(v), batch.result()


@pytest.mark.parametrize("reaction", [making_way("none"), Reaction(stop_distance=0.3)])
def test_without_a_worker_a_cycle_takes_as_long_as_its_path(reaction):
    drawn = replace(job([0]), workers=WorkerTables.nobody(1, DT), cycles=[ONCE])
    found = run_beside_workers(drawn, reaction, CELL, 30.0)
    assert float(found.undisturbed) == pytest.approx(ONCE.duration)
    assert float(found.cycle_time - found.undisturbed) == pytest.approx(DT)
    assert float(found.waited) == 0
    assert int(found.violations) == 0
    assert float(found.off_path) < 1e-3
    assert found.margin.isinf().all()


def test_a_run_that_is_given_too_little_time_does_not_end():
    drawn = replace(job([0]), workers=WorkerTables.nobody(1, DT))
    found = run_beside_workers(drawn, making_way("none"), CELL, 0.5)
    assert found.cycle_time.isinf().all()


def test_who_stops_and_waits_rests_while_anybody_is_within_the_distance():
    limit, drawn = 0.3, job([3], IDEAL, reaching(3) - 3.0)
    q, v, found = recorded(drawn, Reaction(stop_distance=limit), 500)
    one, near = torch.tensor([0]), []
    for step in range(len(q)):
        there = drawn.workers.truth(step, one)
        here = separation(drawn.arm, q[step], there.ends[0], there.radius[0])
        near.append(here.distance.min())
    # Between two images he comes nearer or goes by less than 7 cm.
    inside = torch.stack(near) < limit - 0.07
    # For as long as the joints take to stop from their highest speed on this path.
    stopped = torch.tensor([k >= 30 and bool(inside[k - 30 : k].all()) for k in range(len(q))])
    assert stopped.sum() > 30
    assert float(v[stopped].abs().max()) < 1e-6
    assert float(v[~inside].abs().max()) > 0.1
    assert float(found.waited) > 0.5


@pytest.mark.parametrize(
    ("size", "straight", "astray", "share"),
    [
        (1.0, 0.6, True, 0.0),
        (1.0, 0.725, False, 0.5),
        (1.0, 0.95, False, 1.0),
        (0.25, 0.6, False, 1.0),
        (2.0, 0.95, True, 1.0),
    ],
)
def test_pushed_far_aside_the_paths_wait_as_those_of_the_work_cell(
    size, straight, astray, share
):
    """Where `test_path_following.py` has a single arm wait, and as much of a push."""
    drawn = replace(job([0], IDEAL), workers=WorkerTables.nobody(1, DT))
    batch = worker_runs._Batch(drawn, making_way("expert"), CELL)
    joints = torch.from_numpy(CYCLE.path[:1])
    first, *_, null = np.linalg.svd(panda.jacobian(joints[0]).numpy())[2]

    def aside(size: float, straight: float) -> Tensor:
        error = size * (straight * null + np.sqrt(1 - straight**2) * first)
        return joints[0] + torch.from_numpy(error)

    batch._paths.position[0, 0] = aside(size, straight)
    batch._null[0] = torch.from_numpy(-0.05 * null)
    # So slow on its way back that all the motion is of the push.
    batch._config = replace(CELL, pose_gain=1e-6)
    with torch.inference_mode():
        command = batch._command(joints, torch.zeros(1, dtype=torch.long))
        assert bool(command.stops) == astray
        assert float(command.joint_velocity[0].numpy() @ null) / -0.05 == pytest.approx(
            share, abs=1e-3
        )
        # As if the end effector were on its path.
        command = command._replace(goal=joints, wanted=torch.zeros_like(joints))
        batch._go_on(0, torch.zeros(1, dtype=torch.long), command)
        assert float(batch._rate) == pytest.approx(1.0 - astray * DT / CHANGE_OF_RATE)
        # Who was astray is, once let go, until they are well on their way back.
        batch._progress[0] = 0.0
        for push, size, straight, still in (
            (0.0, 1.6, 0.95, True),
            (0.0, 1.0, 0.75, True),
            (0.05, 1.6, 0.95, False),
            (0.0, 2.0, 0.95, True),
            (0.0, 1.3, 0.85, False),
        ):
            batch._null[0] = torch.from_numpy(push * null)
            batch._paths.position[0, 0] = aside(size, straight)
            command = batch._command(joints, torch.zeros(1, dtype=torch.long))
            assert bool(command.stops) == (still and (astray or size > FAR_ASIDE))


def test_pushed_near_a_singularity_the_paths_wait():
    drawn = replace(job([0], IDEAL), workers=WorkerTables.nobody(1, DT))
    batch = worker_runs._Batch(drawn, making_way("expert"), CELL)
    stretched = torch.tensor([[0.0, 0.0, 0.0, -0.1, 0.0, 0.1, 0.0]], dtype=torch.float64)
    batch._null[0] = 0.05
    with torch.inference_mode():
        for joints, astray in ((torch.from_numpy(CYCLE.path[:1]), False), (stretched, True)):
            batch._paths.position[0, 0] = joints[0]
            command = batch._command(joints, torch.zeros(1, dtype=torch.long))
            assert bool(command.stops) == astray


def test_the_margin_is_that_of_a_logged_run():
    early = reaching(3)
    q, v, found = recorded(job([3], IDEAL, early), making_way("none"), 300)
    log = StepLog()
    for k in range(len(q)):
        log.append(
            time=k * DT + early, joint_position=q[k].numpy(), joint_velocity=v[k].numpy()
        )
    margin = separation_margin(
        log,
        visit_of(3),
        whole_arm(WORKPLACE.scene.arm),
        IDEAL.plant(CELL.safety).separation,
        encoder_offset=np.zeros(7),
        loads={},
    )
    assert np.isfinite(margin).any()
    assert float(found.margin) == pytest.approx(margin.min(), abs=1e-9)
    assert int(found.violations) == int((margin < 0).sum())


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["none", "both"])
def test_a_run_is_the_same_in_whichever_batch(mode):
    early = min(reaching(run) for run in (3, 4))
    every = run_beside_workers(job([3, 4], early=early), making_way(mode), CELL, 5.0)
    for k, run in enumerate((3, 4)):
        single = run_beside_workers(job([run], early=early), making_way(mode), CELL, 5.0)
        for field in fields(WorkerRuns):
            both, own = getattr(every, field.name)[k], getattr(single, field.name)[0]
            torch.testing.assert_close(both, own, rtol=0, atol=1e-6, msg=field.name)


def test_workers_are_where_their_visits_say_and_seen_as_their_trackers_tell():
    visit, runs = visit_of(5), torch.tensor([1, 0])
    visits = [visit_of(6), visit]
    tables = WorkerTables.of(visits, NOMINAL, [np.random.default_rng(k) for k in range(2)], DT)
    for time in (visit.begin - 0.4, visit.released, visit.end - 0.1, visit.end + 3.0):
        step = round(time / DT)
        there, capsules = tables.truth(step, runs), visit.capsules_at(step * DT)
        np.testing.assert_allclose(there.ends[0], capsules.ends, atol=2e-4)
        np.testing.assert_allclose(there.radius[0], capsules.radius)
    now = 0.0
    sensor = WorkerSensor(visit, lambda: now, NOMINAL, np.random.default_rng(1))
    for step in range(600):
        now = step * DT
        seen = sensor.read()
        workers, age = tables.seen(step, runs)
        if seen is None:
            assert age[0].isnan()
            continue
        assert float(age[0]) == pytest.approx(now - seen.time)
        np.testing.assert_allclose(workers.ends[0], seen.ends)
        np.testing.assert_allclose(workers.velocity[0], seen.velocity)
    # After he has left, the last second of images again and again.
    late, again = tables.observed[1] + 40, tables.observed[1] + 340
    (first, age), (second, later) = tables.seen(int(late), runs), tables.seen(int(again), runs)
    torch.testing.assert_close(first.ends[0], second.ends[0])
    assert float(age[0]) == pytest.approx(float(later[0]))


@pytest.mark.parametrize("held", [True, False])
def test_no_distance_is_below_its_bound(held):
    drawn = job([3, 4], IDEAL, reaching(3))
    batch = worker_runs._Batch(drawn, making_way("none"), CELL)
    q = batch._q + 0.3 * torch.randn(2, 7, generator=torch.Generator().manual_seed(0)).double()
    holding = torch.tensor([held, held])
    for step in (0, 150, 300):
        there = drawn.workers.truth(step, batch.live)
        load = CYCLE.load if held else None
        true = separation(drawn.arm, q, there.ends, there.radius, load).distance.amin(-2)
        bound = batch._bound(q, holding, there)
        assert (bound <= true + 1e-9).all()
        assert float((true - bound).min()) < 0.1


def test_an_arm_said_to_be_clear_is_clear_on_all_that_it_looks_ahead_to():
    rng = torch.Generator().manual_seed(1)
    q = panda.ready + 0.5 * torch.randn(200, 7, generator=rng, dtype=torch.float64)
    v = 0.4 * torch.randn(200, 7, generator=rng, dtype=torch.float64)
    ahead = worker_runs.LOOK_AHEAD
    reach = ahead * worker_runs._capsule_speeds(q, v) + worker_runs._BENT
    bound = worker_runs._clear_bound(WORKPLACE, q, reach)
    true = torch.stack([WORKPLACE.arm_clearance(q + s * ahead * v) for s in (0.0, 0.5, 1.0)])
    clear = bound >= CELL.clearance
    assert clear.sum() > 20
    assert (true[:, clear] >= CELL.clearance - 0.02).all()


def test_the_expert_draws_the_elbow_away_from_the_worker_while_he_reaches():
    visit = visit_of(3)
    pull = expert_pull(visit)
    assert pull.joint == 4
    assert pull.start > visit.released
    assert pull.end < visit.end
    elbow = panda.joint_origins(WORKPLACE.hover_joints())[3].numpy()
    force = pull.force((pull.start + pull.end) / 2, elbow)
    place = visit.posture(np.array(pull.start)).place
    assert np.linalg.norm(force) == pytest.approx(60.0)
    assert force[:2] @ (elbow[:2] - place) > 0


def runs_with(cycle_time: float, closing: float, violations: int = 0) -> WorkerRuns:
    one = torch.ones(20, dtype=torch.float64)
    values = {field.name: one for field in fields(WorkerRuns)}
    values |= {"cycle_time": cycle_time * one, "closing": closing * one}
    return WorkerRuns(**values | {"violations": violations * one.long()})


def test_stop_and_wait_is_compared_at_the_same_smallest_distance():
    study = WorkerStudy(
        making_way={"none": runs_with(35.0, 0.15), "both": runs_with(30.0, 0.5)},
        stopping={
            0.1: runs_with(40.0, 0.1, violations=3),
            0.3: runs_with(60.0, 0.2),
            0.6: runs_with(80.0, 0.4),
        },
    )
    assert smallest_distance(study.making_way["none"]) == pytest.approx(0.15)
    assert study.stop_and_wait(0.15) == pytest.approx(50.0)
    figures = study.figures()
    assert figures["none_shorter_at_same_distance"] == pytest.approx(0.3)
    assert "both_shorter_at_same_distance" not in figures  # farther than any that was tried
    assert figures["both_shorter_than_safe_stop"] == pytest.approx(0.5)
    assert figures["stop_100_mm_violated_runs"] == 20
