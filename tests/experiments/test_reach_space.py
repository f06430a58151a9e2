"""What room an arm leaves a worker, against counts and distances of MuJoCo."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from hrc_learn.experiments.reach_space import (
    CLEAR,
    bench_places,
    free_volume,
    least_leans,
    reach_spaces,
    space_over_bench,
)
from hrc_learn.experiments.worker_in_run import draw_visit
from hrc_learn.geometry import Box
from hrc_learn.kinematics import CapsuleArm, panda
from hrc_learn.log import StepLog
from hrc_learn.sim import whole_arm
from hrc_learn.sim.workplace import Workplace

# pyright: reportAttributeAccessIssue=false

WORKPLACE = Workplace()
ARM = whole_arm(WORKPLACE.scene.arm)
WAITING = WORKPLACE.hover_joints()
VISIT = draw_visit(WORKPLACE, np.random.default_rng(3), beside_elbow=True)
FAR = torch.tensor([-1.5, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8], dtype=torch.float64)
"""Turned to the other side, away from the bench."""


def test_the_free_volume_of_an_empty_box_is_all_of_it():
    box = Box(centre=(0.2, 0.5, 0.2), half_size=(0.1, 0.06, 0.08))
    assert free_volume(ARM, FAR, box) == pytest.approx(8 * 0.1 * 0.06 * 0.08)


def test_what_an_arm_takes_is_the_volume_of_its_links_and_a_margin():
    """One capsule, by the formula for a capsule whose radius is larger by the margin."""
    # With the base's, which is far below the box.
    forearm = panda.whole.capsules[10]
    one = CapsuleArm(panda, [panda.whole.capsules[0], forearm])
    first, second = one.segments(WAITING)[1]
    r = forearm.radius
    middle = ((first + second) / 2).tolist()
    box = Box(centre=(middle[0], middle[1], middle[2]), half_size=(0.25, 0.25, 0.25))
    grown, length = r + 0.10, float((second - first).norm())
    taken = math.pi * grown**2 * length + 4 / 3 * math.pi * grown**3
    assert 0.5**3 - free_volume(one, WAITING, box) == pytest.approx(taken, rel=0.02)


def test_nobody_in_the_way_the_least_lean_is_the_workers_own():
    lean = least_leans(ARM, FAR, VISIT, VISIT.markers)
    worker, standing = VISIT.worker, VISIT.posture(np.array(VISIT.released))
    heading, step = float(standing.heading), math.radians(5.0)
    c, s = math.cos(heading), math.sin(heading)
    for marker, found in zip(VISIT.markers, lean, strict=True):
        needed = []
        for aside in np.linspace(-0.45, 0.45, 7):
            at = standing.place + aside * np.array([-s, c])
            x, y = marker[:2] - at
            own = np.array([c * x + s * y, c * y - s * x, marker[2] - worker.config.floor])
            needed += [a for side in (0, 1) if (a := worker.lean_to(own, side)) is not None]
        # Of the arm's base, which stays where it is, he keeps clear besides.
        least = math.ceil(min(needed) / step - 1e-9) * step
        assert least - 1e-9 <= found <= least + 3 * step


def test_an_arm_in_the_way_costs_a_lean_or_the_reach_and_the_posture_is_clear(monkeypatch):
    """Beside the gripper. The postures that are taken for clear are so by the simulator."""
    worker, tried = VISIT.worker, []
    ends_of = worker.ends
    monkeypatch.setattr(worker, "ends", lambda p: tried.append(p) or ends_of(p))
    markers = np.array([[0.15, 0.5, VISIT.markers[0, 2]], [0.2, 0.5, VISIT.markers[0, 2]]])
    free, beside = (least_leans(ARM, q, VISIT, markers) for q in (FAR, WAITING))
    assert beside[0] >= free[0]
    assert math.isnan(beside[1])
    assert np.isfinite(free[1])
    posture = tried[-1]
    ends = ends_of(posture)
    reached = np.linalg.norm(worker.grip(ends, 0) - markers[0], axis=-1) < 1e-6
    reached |= np.linalg.norm(worker.grip(ends, 1) - markers[0], axis=-1) < 1e-6
    assert 10 < reached.sum() < len(ends)
    distance = np.array([smallest(e) for e in ends[reached]])
    clear = posture.lean[reached][distance >= CLEAR - 1e-6]
    assert clear.min() == pytest.approx(beside[0])


def smallest(ends) -> float:
    """Distance of capsules from those of the waiting arm, each pair by MuJoCo."""
    spec = mujoco.MjSpec()
    theirs = [(e, r) for e, r in zip(ends, VISIT.worker.radius, strict=True)]
    ours = [
        (e.numpy(), float(r)) for e, r in zip(ARM.segments(WAITING), ARM.radius, strict=True)
    ]
    for kind, capsules in (("a", ours), ("w", theirs)):
        for i, ((first, second), radius) in enumerate(capsules):
            spec.worldbody.add_geom(
                name=f"{kind}{i}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[*first, *second],
                size=[radius, 0, 0],
            )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return min(
        mujoco.mj_geomDistance(
            model, data, model.geom(f"a{i}").id, model.geom(f"w{k}").id, 9, None
        )
        for i in range(len(ours))
        for k in range(len(theirs))
    )


def test_rooms_are_of_the_true_joints_while_a_hand_is_there():
    time = np.arange(0.0, VISIT.reaches[1].mean() + 0.5, 0.1)
    offset = np.full(7, 0.01)
    log = StepLog()
    for t in time:
        log.append(time=t, joint_position=WAITING.numpy() + offset)
    top = WORKPLACE.scene.table.centre[2] + 0.02
    box = space_over_bench((0.05, 0.35), top)
    rooms = reach_spaces(log, VISIT, ARM, box, offset)
    # The run ended before the others.
    assert len(rooms) == 2
    leans = least_leans(ARM, WAITING, VISIT, bench_places(box))
    for room, (begin, end) in zip(rooms, VISIT.reaches, strict=False):
        assert begin <= room.time <= end + 0.1
        assert room.free_volume == pytest.approx(free_volume(ARM, WAITING, box))
        assert room.reachable == np.isfinite(leans).mean()
        assert room.comfortable == (leans <= math.radians(20.0) + 1e-9).mean()
        assert 0 < room.comfortable < room.reachable < 1
    assert box.centre[2] - box.half_size[2] == pytest.approx(top)
    places = bench_places(box)
    assert len(places) == 25
    # On the bench, up to the edges of the box.
    np.testing.assert_allclose(places.max(axis=0)[:2] - box.centre[:2], box.half_size[:2])
    np.testing.assert_allclose(places[:, 2], top + 0.05)


def test_a_marker_out_of_reach_has_no_lean():
    assert np.isnan(least_leans(ARM, FAR, VISIT, np.array([[3.0, 0.0, 0.0]]))).all()
    nobody = replace(VISIT, markers=np.zeros((0, 3)), reaches=np.zeros((0, 2)))
    log = StepLog()
    log.append(time=0.0, joint_position=WAITING.numpy())
    box = space_over_bench((0.0, 0.0), 0.0)
    assert reach_spaces(log, nobody, ARM, box, np.zeros(7)) == []
