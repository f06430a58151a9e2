"""Steps whose times are read as numbers against those whose times stay tensors."""

import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP, SpringDamper
from hrc_learn.dmp._closed_loop_step import host_values

SPRINGS = [
    SpringDamper(),
    SpringDamper(alpha=30.0, beta=2.0),
    SpringDamper(alpha=12.0, beta=20.0),
]


@pytest.mark.parametrize("spring", SPRINGS)
def test_a_step_alone_is_that_of_a_batch(spring):
    """From before the end of the forcing to long after it; a batch is never read."""
    dmp = JointDMP.fit(*arm_motion(moving_start=True), 20, spring=spring)
    one, many = dmp.initial_state(), dmp.initial_state(duration=dmp.duration[None])
    for dt in (1e-3, 1.3, 1.3, 0.8, 0.0, 4.0):
        one, many = dmp.step(one, dt), dmp.step(many, dt)
        for name in ("position", "rate", "s", "forced"):
            alone, batched = getattr(one, name), getattr(many, name)[0]
            torch.testing.assert_close(alone, batched, rtol=1e-12, atol=1e-11)


def test_derivatives_by_times_are_kept():
    """Backward, forward and mapped, all through one step of one motion."""
    dmp = JointDMP.fit(*arm_motion(), 12)
    state = dmp.step(dmp.initial_state(), 0.4)

    def position(dt):
        return dmp.step(state, dt).position

    dt = torch.tensor(0.2, dtype=torch.float64)
    velocity = dmp.step(state, dt).velocity
    backward = torch.autograd.functional.jacobian(position, dt)
    forward = torch.func.jvp(position, (dt,), (torch.ones_like(dt),))[1]
    torch.testing.assert_close(backward, velocity)
    torch.testing.assert_close(forward, velocity)
    lengths = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    expected = torch.stack([position(length) for length in lengths])
    torch.testing.assert_close(torch.func.vmap(position)(lengths), expected)


def test_only_single_plain_times_are_read():
    time = torch.tensor(0.5, dtype=torch.float64)
    assert host_values(time, time) == (0.5, 0.5)
    for kept in (time[None], time.clone().requires_grad_()):
        assert host_values(time, kept) == (time, kept)
