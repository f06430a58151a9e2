"""Contacts that the evaluator of the worker study finds, against closed forms."""

import math

import numpy as np
import pytest
import torch
from contact_forces import Motion, contacts, impact

from hrc_learn.kinematics import panda
from hrc_learn.sim import Worker, WorkerConfig
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace

WORKPLACE, BODY, DT, STEPS = Workplace(), WorkerConfig(), 0.01, 50
HOVER = WORKPLACE.hover_joints().numpy()


def recorded(rate, part, place, come=(0.0, 0.0, 0.0), from_joints=HOVER):
    """An arm that moves evenly, and a part of a worker upright at a place, moving evenly."""
    q = from_joints + np.asarray(rate) * DT * np.arange(STEPS)[:, None]
    worker = Worker(BODY)
    ends = np.tile(worker.ends(worker.standing()) + np.array([0.0, 6.0, 0.0]), (STEPS, 1, 1, 1))
    k = PARTS.index(part)
    half = np.array([0.0, 0.0, np.linalg.norm(ends[0, k, 1] - ends[0, k, 0]) / 2])
    at = np.asarray(place) + np.asarray(come) * DT * np.arange(STEPS)[:, None]
    ends[:, k] = np.stack([at - half, at + half], axis=1)
    motion = Motion(dt=DT, joints=q, holding=np.zeros(STEPS, dtype=bool), ends=ends)
    return contacts(motion, WORKPLACE.scene, BODY, rows=range(1, STEPS - 1))


def aside(step, ahead):
    """Tool at a step of a turn about the vertical, and its velocity there."""
    rate = np.array([0.8, 0, 0, 0, 0, 0, 0])
    q = torch.from_numpy(HOVER + rate * DT * step)
    v = panda.jacobian(q).numpy()[:3] @ rate
    return rate, panda.forward(q).position.numpy() + ahead * v / np.linalg.norm(v), v


def test_an_impact_is_that_of_two_masses_and_a_spring():
    for m, M in ((3.5, 0.6), (2.0, np.inf)):
        assert impact(0.8, m, M, 75e3) == pytest.approx(
            0.8 * math.sqrt(75e3 / (1 / m + 1 / M)), rel=1e-5
        )


def test_a_hand_in_the_way_is_met_with_the_speed_and_mass_of_the_tool():
    rate, place, v = aside(30, 0.06)
    found = recorded(rate, "hand_right", place)
    assert found
    assert all(contact.by_arm and not contact.clamped for contact in found)
    hardest = max(found, key=lambda contact: contact.force)
    assert hardest.arm_speed <= np.linalg.norm(v) * 1.1
    assert 1.5 < hardest.mass < 6.0
    mu = 1 / (1 / hardest.mass + 1 / 0.6)
    assert hardest.force == pytest.approx(hardest.speed * math.sqrt(mu * 75e3), rel=1e-4)
    assert hardest.of_limit == pytest.approx(hardest.force / 280, rel=1e-6)


def test_nobody_may_touch_a_head():
    rate, place, _ = aside(30, 0.12)
    found = recorded(rate, "head", place)
    assert found
    assert all(math.isinf(contact.of_limit) for contact in found)


def test_a_worker_who_runs_into_an_arm_at_rest_is_told_apart():
    _, place, _ = aside(0, 0.0)
    found = recorded(
        np.zeros(7), "forearm_left", place + np.array([0.0, 0.35, 0.0]), (0.0, -0.8, 0.0)
    )
    assert found
    assert not any(contact.by_arm for contact in found)
    assert max(contact.speed for contact in found) > 0.5


def test_a_hand_between_gripper_and_table_is_clamped():
    tip = panda.forward(HOVER).position.numpy()
    table = WORKPLACE.scene.table
    top = table.centre[2] + table.half_size[2]
    down = torch.linalg.pinv(panda.jacobian(torch.from_numpy(HOVER))).numpy() @ np.array(
        [0.0, 0.0, -0.3, 0.0, 0.0, 0.0]
    )
    found = recorded(down, "hand_right", [tip[0], tip[1], top + 0.09])
    assert any(contact.clamped and contact.by_arm for contact in found)
    assert max(contact.of_limit for contact in found if contact.clamped) > 1
