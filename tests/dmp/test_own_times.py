"""Motions each at times of their own: any grid gives what any other gives."""

import subprocess
import sys

import pytest
import torch
from demo_motions import arm_motion
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    ExponentialPhase,
    GaussianBasis,
    JointDMP,
    LearnedGaussianBasis,
    PeriodicBasis,
    SplineBasis,
    SpringDamper,
    response_of,
)
from hrc_learn.dmp._system.own_times import motion

BASES = {
    "gaussian": (GaussianBasis(count=12), 0.0),
    "in phase": (GaussianBasis(count=12, domain="phase"), 0.0),
    "fades early": (GaussianBasis(count=12, phase=ExponentialPhase(decay=60.0)), 1.0),
    "approach": (GaussianBasis(count=12), 0.7),
    "spline": (SplineBasis(count=12), 0.0),
    "periodic": (PeriodicBasis(count=9), 0.0),
    "learned": (LearnedGaussianBasis(centres=(0.1, 0.2, 0.9), widths=(0.1, 0.05, 0.3)), 0.3),
}
SPRINGS = (
    SpringDamper(),
    SpringDamper(alpha=30.0, beta=2.0),
    SpringDamper(alpha=12.0, beta=20.0),
)


def random_motions(basis, batch=3, dtype=torch.float64, seed=0):
    rng = torch.Generator().manual_seed(seed)
    x = torch.randn(batch, 2, basis.count + 3, generator=rng, dtype=torch.float64)
    s = 2.5 * torch.rand(batch, 30, generator=rng, dtype=torch.float64)
    s[:, :3] = torch.tensor([0.0, 1.0, 1e3])
    return s, x.to(dtype)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("spring", SPRINGS, ids=str)
@pytest.mark.parametrize(("basis", "approach"), BASES.values(), ids=BASES)
def test_polynomials_give_what_the_response_gives(basis, approach, spring, order):
    response = response_of(spring, basis, approach)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-6)):
        s, x = random_motions(basis, dtype=dtype)
        expected = (x.double() @ response.evaluate(s)[..., order, :].mT).mT
        y = motion(response, s, x, order)
        assert y.dtype == dtype
        assert (y - expected).abs().max() < tolerance * expected.abs().max()


@pytest.mark.parametrize(("basis", "approach"), BASES.values(), ids=BASES)
def test_derivatives_of_any_order_and_direction(basis, approach):
    response = response_of(SpringDamper(), basis, approach)
    s, x = random_motions(basis, batch=2)
    s, x = (0.2 + 0.6 * s[:, 3:6] / 2.5).requires_grad_(), x[:, :1].requires_grad_()
    for order in (0, 1):

        def y(s, x, order=order):
            return motion(response, s, x, order)

        assert torch.autograd.gradcheck(
            y, (s, x), atol=1e-6, check_forward_ad=True, check_batched_grad=True
        )
        assert torch.autograd.gradgradcheck(y, (s, x), atol=1e-4, rtol=1e-3)


@pytest.fixture(scope="module")
def batch():
    time, position = zip(*(arm_motion(80, n_joints=3, seed=k) for k in range(5)), strict=True)
    return JointDMP.fit(torch.stack(time), torch.stack(position), 12)


@pytest.mark.parametrize("output", ["position", "velocity", "acceleration"])
def test_ragged_is_a_loop(batch, output):
    rng = torch.Generator().manual_seed(1)
    duration = 1 + torch.rand(5, generator=rng, dtype=torch.float64)
    time = (3 * torch.rand(5, 40, generator=rng, dtype=torch.float64)).sort(-1).values
    for times in (time, time[0]):
        together = getattr(batch.rollout(times, duration=duration), output)
        for i, one in enumerate(batch):
            own = times if times.ndim == 1 else times[i]
            alone = getattr(one.rollout(own, duration=duration[i]), output)
            torch.testing.assert_close(together[i], alone, rtol=1e-9, atol=1e-9)


def test_one_primitive_at_many_durations(batch):
    time = torch.linspace(0, 2, 30, dtype=torch.float64)
    duration = torch.tensor([[0.8, 1.0], [1.5, 3.0]], dtype=torch.float64)
    together = batch[2].rollout(time, duration=duration)
    assert together.position.shape == (2, 2, 30, 3)
    alone = batch[2].rollout(time, duration=1.5)
    torch.testing.assert_close(together.velocity[1, 0], alone.velocity)


@shapes_unchecked()
@pytest.mark.parametrize("output", ["position", "velocity", "acceleration"])
def test_maps_over_durations(batch, output):
    one, time = batch[1], torch.linspace(0, 2, 30, dtype=torch.float64)
    duration = torch.tensor([0.8, 1.0, 1.7], dtype=torch.float64)

    def path(tau, goal):
        return getattr(one.rollout(time, duration=tau, goal=goal), output)

    expected = torch.stack([path(tau, one.goal) for tau in duration])
    mapped = torch.func.vmap(path, in_dims=(0, None))(duration, one.goal)
    torch.testing.assert_close(mapped, expected)
    rates = torch.func.vmap(torch.func.jacfwd(path), in_dims=(0, None))(duration, one.goal)
    backwards = torch.func.vmap(torch.func.jacrev(path), in_dims=(0, None))(duration, one.goal)
    torch.testing.assert_close(rates, backwards)
    h = 1e-6
    central = (path(duration[0] + h, one.goal) - path(duration[0] - h, one.goal)) / (2 * h)
    torch.testing.assert_close(rates[0], central, rtol=1e-6, atol=1e-5)


COMPILED = """
import torch
from hrc_learn.dmp import JointDMP, LimitedDMP, OrientationDMP
from hrc_learn.geometry import quaternion

t = torch.linspace(0, 2, 60, dtype=torch.float64)
y = torch.stack([torch.sin(t), t**2, torch.cos(t)], -1)
kinds = (
    (JointDMP.fit(t, y, 12), "acceleration"),
    (OrientationDMP.fit(t, quaternion.exp(y), 12), "orientation"),
    (LimitedDMP.fit(t, y, -20.0, 20.0, 12), "position"),
)
durations = torch.tensor([0.8, 1.0, 1.7], dtype=torch.float64)
for dmp, output in kinds:
    for times in (t, None):
        def path(tau):
            goal = dmp.goal.expand(*tau.shape, -1)
            return getattr(dmp.rollout(times, goal=goal, duration=tau), output)
        torch._dynamo.reset()
        compiled = torch.compile(path, fullgraph=True, backend="aot_eager")
        for tau in (durations[1], durations):
            torch.testing.assert_close(compiled(tau), path(tau))
"""


@pytest.mark.slow
def test_compiles_without_a_break():
    """In a process of its own: a compiler cannot follow the shape checks of these tests."""
    subprocess.run([sys.executable, "-c", COMPILED], check=True)
