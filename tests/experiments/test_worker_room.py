"""What room an arm leaves a worker, against counts and distances of MuJoCo."""

import math
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from hrc_learn.experiments.collaboration import worker_room
from hrc_learn.experiments.collaboration.worker import somebody_comes
from hrc_learn.experiments.collaboration.worker_room import (
    CLEAR,
    free_volume,
    least_lean,
    over_bench,
    reach_rooms,
)
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda, panda_capsules
from hrc_learn.sim import whole_arm
from hrc_learn.sim.workplace import Workplace

# pyright: reportAttributeAccessIssue=false

WORKPLACE = Workplace()
ARM = whole_arm(WORKPLACE.scene.arm)
WAITING = WORKPLACE.hover_joints()
VISIT = somebody_comes(WORKPLACE, np.random.default_rng(3), beside_elbow=True)
FAR = torch.tensor([-1.5, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8], dtype=torch.float64)
"""Turned to the other side, away from the bench."""


def test_the_free_volume_of_an_empty_box_is_all_of_it():
    box = Box(centre=(0.2, 0.5, 0.2), half_size=(0.1, 0.06, 0.08))
    assert free_volume(ARM, FAR, box) == pytest.approx(8 * 0.1 * 0.06 * 0.08)


def test_what_an_arm_takes_is_the_volume_of_its_links_and_a_margin():
    """One capsule, by the formula for a capsule whose radius is larger by the margin."""
    alone = SimpleNamespace(capsules=panda_capsules.capsules[3:4])
    one = type(panda_capsules)(panda, alone.capsules)
    (first, second), r = one.segments(WAITING)[0], float(one.radius[0])
    middle = tuple(((first + second) / 2).tolist())
    box = Box(centre=middle, half_size=(0.4, 0.4, 0.4))
    grown, length = r + 0.10, float((second - first).norm())
    taken = math.pi * grown**2 * length + 4 / 3 * math.pi * grown**3
    assert 0.8**3 - free_volume(one, WAITING, box) == pytest.approx(taken, rel=0.02)


def test_nobody_in_the_way_the_least_lean_is_the_workers_own():
    marker = VISIT.markers[0]
    lean = least_lean(ARM, FAR, VISIT, marker)
    worker, needed = VISIT.worker, []
    heading = float(VISIT.posture(np.array(VISIT.released)).heading)
    place = VISIT.posture(np.array(VISIT.released)).place
    for step in np.linspace(-0.45, 0.45, 13):
        at = place + step * np.array([-math.sin(heading), math.cos(heading)])
        c, s = math.cos(heading), math.sin(heading)
        x, y = marker[:2] - at
        own = np.array([c * x + s * y, c * y - s * x, marker[2] - worker.config.floor])
        needed += [a for side in (0, 1) if (a := worker.lean_to(own, side)) is not None]
    step = math.radians(3.0)
    assert lean == pytest.approx(math.ceil(min(needed) / step - 1e-9) * step, abs=1e-9)


def test_an_arm_in_the_way_costs_a_lean_or_the_reach_and_the_posture_is_clear(monkeypatch):
    """The postures that are taken for clear are so by the simulator's distances."""
    tried = []
    worker = VISIT.worker
    ends_of = worker.ends
    monkeypatch.setattr(worker, "ends", lambda p: tried.append(p) or ends_of(p))
    free = [least_lean(ARM, FAR, VISIT, marker) for marker in VISIT.markers]
    beside = [least_lean(ARM, WAITING, VISIT, marker) for marker in VISIT.markers]
    assert all(b >= a or math.isnan(b) for a, b in zip(free, beside, strict=True))
    assert np.nansum(beside) > sum(free) or np.isnan(beside).any()
    # Of the last marker that can be reached: one posture of that lean is clear, none of less.
    k = int(np.flatnonzero(np.isfinite(beside))[-1])
    posture = tried[len(VISIT.markers) + k]
    distance = np.array([smallest(ends) for ends in ends_of(posture)])
    clear = posture.lean[distance >= CLEAR - 1e-6]
    assert clear.min() == pytest.approx(beside[k])


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
                fromto=[*first, *(second + [0, 0, 1e-9])],
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
    log = {
        "time": time,
        "joint_position": np.repeat(WAITING.numpy()[None] + offset, len(time), axis=0),
    }
    box = over_bench((0.05, 0.35), WORKPLACE.scene.table.centre[2] + 0.02)
    rooms = reach_rooms(log, VISIT, ARM, box, offset)
    # The run ended before the others.
    assert len(rooms) == 2
    for room, marker, (begin, end) in zip(rooms, VISIT.markers, VISIT.reaches, strict=False):
        assert begin <= room.time <= end + 0.1
        assert room.free_volume == pytest.approx(free_volume(ARM, WAITING, box))
        assert room.lean == pytest.approx(least_lean(ARM, WAITING, VISIT, marker), nan_ok=True)
    assert box.centre[2] - box.half_size[2] == pytest.approx(
        WORKPLACE.scene.table.centre[2] + 0.02
    )


def test_a_marker_out_of_reach_has_no_lean():
    assert math.isnan(least_lean(ARM, FAR, VISIT, np.array([3.0, 0.0, 0.0])))
    nobody = replace(VISIT, markers=np.zeros((0, 3)), reaches=np.zeros((0, 2)))
    log = {"time": np.zeros(1), "joint_position": WAITING.numpy()[None]}
    assert reach_rooms(log, nobody, ARM, over_bench((0, 0), 0), np.zeros(7)) == []
    assert worker_room.CLEAR > 0
