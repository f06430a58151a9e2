from dataclasses import replace

import sampling
import torch

from hrc_learn.controller.resolved_rate import PoseDrift, measure_drift, planned_motion
from hrc_learn.kinematics import panda


def start(q: torch.Tensor) -> PoseDrift:
    zero = torch.zeros(*q.shape[:-1], 6, dtype=q.dtype)
    return PoseDrift(
        drift=zero,
        joint_position=q,
        jacobian=panda.jacobian(q),
        planned=zero,
        active=torch.ones(q.shape[:-1], dtype=torch.bool),
    )


def test_the_drift_is_what_the_tool_did_beyond_the_plan():
    """Against forward kinematics, over a step of 1 ms at 0.5 rad/s."""
    rng = sampling.generator()
    q = panda.ready + 0.2 * torch.randn(50, 7, generator=rng, dtype=torch.float64)
    moved = q + 0.0005 * torch.randn(50, 7, generator=rng, dtype=torch.float64)
    active = torch.ones(50, dtype=torch.bool)
    drift = measure_drift(start(q), moved, panda.jacobian(moved), active)
    true = panda.forward(q).twist_to(panda.forward(moved))
    # The trapezoidal rule errs by the third power of the step, here about 1e-3 rad.
    torch.testing.assert_close(drift.drift, -true, rtol=0, atol=1e-9)


def test_a_motion_that_was_planned_is_no_drift():
    q = panda.ready
    v = torch.tensor([0.1, -0.2, 0.1, 0.3, 0.0, 0.1, -0.1], dtype=torch.float64)
    J = panda.jacobian(q)
    drift = start(q)
    drift = replace(drift, planned=planned_motion(J @ v, J @ v, J @ v, 1e-4))
    moved = q + 1e-4 * v
    drift = measure_drift(drift, moved, panda.jacobian(moved), torch.tensor(True))
    assert drift.drift.norm() < 1e-8


def test_limits_that_slow_the_task_leave_no_drift():
    J = panda.jacobian(panda.ready)
    v = torch.tensor([0.1, -0.2, 0.1, 0.3, 0.0, 0.1, -0.1], dtype=torch.float64)
    twist = J @ v

    def planned(velocity, task=twist, whole=twist):
        return planned_motion(task, whole, J @ velocity, 0.01)

    torch.testing.assert_close(planned(0.3 * v), 0.003 * twist)
    # What goes beyond the plan, backwards, or at all is not planned motion.
    torch.testing.assert_close(planned(2 * v), 0.01 * twist)
    assert (planned(-v).abs() < 1e-12).all()
    assert (planned(v, task=torch.zeros_like(twist)) == 0).all()


def test_correcting_noise_does_not_count_against_a_slow_task():
    """Of a task slower than the correction all is planned that the limits let pass."""
    J = panda.jacobian(panda.ready)
    v = torch.tensor([0.1, -0.2, 0.1, 0.3, 0.0, 0.1, -0.1], dtype=torch.float64)
    whole = J @ v
    for task in (-0.2 * whole, 0.1 * whole.flip(0), 1e-9 * whole):
        for done in (1.0, 0.4):
            planned = planned_motion(task, whole, done * whole, 0.01)
            torch.testing.assert_close(planned, done * 0.01 * task, rtol=1e-6, atol=0)


def test_at_rest_all_of_a_plan_is_carried_out():
    """Where correction and task cancel, and nothing moves, the task is not put off."""
    task, still = 1e-3 * torch.ones(6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    planned = planned_motion(task, still, still, 0.01)
    torch.testing.assert_close(planned, 0.01 * task)


def test_it_forgets_where_it_does_not_hold_and_cannot_wind_up():
    q = panda.ready.expand(2, 7)
    moved = q + 0.1
    drift = measure_drift(start(q), moved, panda.jacobian(moved), torch.tensor([True, False]))
    assert drift.drift[0].abs().max() == 0.005
    assert (drift.drift[1] == 0).all()


def test_the_first_step_of_an_effort_forgets_what_is_old():
    q = panda.ready
    old = replace(start(q - 0.5), active=torch.tensor(False))
    drift = measure_drift(old, q, panda.jacobian(q), torch.tensor(True))
    assert (drift.drift == 0).all()
    assert drift.active
    drift = measure_drift(drift, q + 1e-3, panda.jacobian(q + 1e-3), torch.tensor(True))
    assert drift.drift.norm() > 1e-4
