"""Motions each at times of their own: any grid gives what any other gives."""

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from numpy.polynomial.chebyshev import cheb2poly, poly2cheb
from scipy.linalg import expm
from torch.utils._python_dispatch import TorchDispatchMode
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    ExponentialPhase,
    GaussianBasis,
    JointDMP,
    PeriodicBasis,
    SplineBasis,
    SpringDamper,
    response_of,
)
from hrc_learn.dmp.ragged_times import (
    CHUNK,
    LONG,
    _lowest_degree,
    _table,
    blocks,
    chunks,
    motion,
    power_by_power,
    spring_rows,
)

BASES = {
    "gaussian": (GaussianBasis(count=12), 0.0),
    "in phase": (GaussianBasis(count=12, domain="phase"), 0.0),
    "fades early": (GaussianBasis(count=12, phase=ExponentialPhase(decay=60.0)), 1.0),
    "approach": (GaussianBasis(count=12), 0.7),
    "spline": (SplineBasis(count=12), 0.0),
    "approach between knots": (SplineBasis(count=12), 0.7),
    "periodic": (PeriodicBasis(count=9), 0.0),
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


def test_sums_power_by_power_are_weighted_sums_of_rows():
    """As a GPU makes them."""
    rng = torch.Generator().manual_seed(0)
    rows, powers = torch.randn(3, 4, 5, 2, generator=rng), torch.randn(3, 6, 5, generator=rng)
    piece = torch.randint(4, (3, 6), generator=rng)
    flat = (piece + 4 * torch.arange(3)[:, None]).view(-1)
    chosen = rows[torch.arange(3)[:, None], piece]
    expected = torch.einsum("btkd,btk->btd", chosen, powers)
    torch.testing.assert_close(power_by_power(rows, flat, powers), expected)


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
    s, x = 0.2 + 0.6 * s[:, 3:6] / 2.5, x[:, :1].requires_grad_()
    for order, times in enumerate((s, s.sort(-1).values)):
        s = times.clone().requires_grad_()

        def y(s, x, order=order):
            return motion(response, s, x, order)

        assert torch.autograd.gradcheck(
            y,
            (s, x),
            atol=1e-6,
            check_forward_ad=True,
            check_batched_grad=True,
            fast_mode=True,
        )
        assert torch.autograd.gradgradcheck(y, (s, x), atol=1e-4, rtol=1e-3, fast_mode=True)


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


@shapes_unchecked()
def test_second_derivatives_by_durations_are_right_or_refused(batch):
    """PyTorch would lose the second of two forward derivatives of a rollout without a word."""
    time = torch.linspace(0, 2.5, 30, dtype=torch.float64)
    single, jacfwd, jacrev = batch[0], torch.func.jacfwd, torch.func.jacrev

    def of_a_batch(tau):
        return batch.rollout(time, duration=tau).position.square().sum()

    def of_steps(tau):
        state = single.initial_state(duration=tau[0])
        # At times all over the motion, and beyond its end.
        ends = [single.step(state, tau[1] + t).position for t in torch.linspace(0, 2, 9)]
        return torch.stack(ends).square().sum()

    for function, at in ((of_a_batch, [1.5, 2.0, 2.2, 2.7, 3.0]), (of_steps, [1.5, 0.07])):
        tau = torch.tensor(at, dtype=torch.float64)
        expected = jacrev(jacrev(function))(tau)
        assert expected.abs().max() > 0.1
        torch.testing.assert_close(jacfwd(jacrev(function))(tau), expected)
        torch.testing.assert_close(jacrev(jacfwd(function))(tau), expected)
    torch.testing.assert_close(jacfwd(jacfwd(of_steps))(tau), expected)
    with pytest.raises(NotImplementedError, match=r"use jacfwd\(jacrev\(f\)\)"):
        jacfwd(jacfwd(of_a_batch))(torch.ones(5, dtype=torch.float64))


def recordings(n, lengths, velocity=False):
    """Motions with timestamps of their own, in lists."""
    rng = torch.Generator().manual_seed(3)
    times, positions = [], []
    for k in range(n):
        time, position = arm_motion(lengths[k], 3, 1.0 + k, seed=k)
        spacing = time.diff() * (0.2 + torch.rand(len(time) - 1, generator=rng).double())
        times.append(torch.cat([time[:1], spacing.cumsum(0)]))
        positions.append(position)
    rates = [torch.gradient(y, dim=0)[0] for y in positions] if velocity else None
    return times, positions, rates


# Of 14 samples 12 functions cannot be told apart: those are solved by themselves.
@pytest.mark.parametrize("velocity", [False, True], ids=["positions", "velocities"])
@pytest.mark.parametrize("lengths", [(200, 200, 200), (90, 200, 140), (200, 14, 90)], ids=str)
@pytest.mark.parametrize("basis", [GaussianBasis(count=12), SplineBasis(count=12)], ids=repr)
def test_fits_of_own_timestamps_are_a_loop(basis, lengths, velocity):
    times, positions, rates = recordings(3, lengths, velocity)
    together = JointDMP.fit(times, positions, velocity=rates, basis=basis)
    for i, (time, position) in enumerate(zip(times, positions, strict=True)):
        rate = rates[i] if rates else None
        alone = JointDMP.fit(time, position, velocity=rate, basis=basis)
        shown = alone.rollout(time)
        torch.testing.assert_close(
            together[i].rollout(time).position, shown.position, rtol=0, atol=1e-8
        )
        size = shown.acceleration.abs().max().item()
        torch.testing.assert_close(
            together[i].rollout(time).acceleration, shown.acceleration, rtol=0, atol=1e-6 * size
        )


def test_samples_that_do_not_count_change_no_fit():
    time, position = zip(*(arm_motion(80, 3, 1.0 + k, seed=k) for k in range(3)), strict=True)
    time, position = torch.stack(time), torch.stack(position)
    time = time + 1e-3 * torch.rand(time.shape, generator=torch.Generator().manual_seed(0))
    mask = torch.ones_like(time).bool()
    mask[0, 30:40] = mask[2, 70:] = mask[1, 0] = False
    velocity = torch.gradient(position, dim=1)[0]
    together = JointDMP.fit(time, position, 12, velocity, mask)
    for i in range(3):
        kept = mask[i]
        alone = JointDMP.fit(time[i, kept], position[i, kept], 12, velocity[i, kept])
        torch.testing.assert_close(together[i].weights, alone.weights, rtol=1e-6, atol=1e-5)
        torch.testing.assert_close(together[i].start_velocity, alone.start_velocity)


def test_a_long_recording_is_fitted_piece_by_piece(monkeypatch):
    """As in one piece, but for rounding."""
    time, position = arm_motion(300, 3, 2.0)
    options = {"n_basis": 12, "smooth": True}
    position = position + 1e-3 * torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    whole = JointDMP.fit(time, position, **options)
    monkeypatch.setattr("hrc_learn.dmp.solvers.LONG", 200)
    monkeypatch.setattr("hrc_learn.dmp.trajectory.LONG", 200)
    monkeypatch.setitem(CHUNK, "cpu", 64)
    pieces = JointDMP.fit(time, position, **options)
    torch.testing.assert_close(pieces.weights, whole.weights, rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(pieces.rollout().position, whole.rollout().position)
    torch.testing.assert_close(pieces.fit_report.rmse, whole.fit_report.rmse)


class LargestTensor(TorchDispatchMode):
    """Largest number of values in a result while the mode is active."""

    size = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in result if isinstance(result, tuple | list) else (result,):
            if isinstance(x, torch.Tensor):
                self.size = max(self.size, x.untyped_storage().nbytes() // x.element_size())
        return result


def test_a_fit_takes_memory_in_proportion_to_its_samples():
    """One matrix for all of them would have 69 numbers for each sample."""
    time = torch.linspace(0, 60, 4 * LONG, dtype=torch.float64)
    position = torch.sin(time[:, None] * torch.arange(1, 8))
    JointDMP.fit(time[::100], position[::100], 20)
    with LargestTensor() as largest:
        JointDMP.fit(time, position, 20, smooth=True)
    # Blocks of time have twenty functions and seven columns next to the samples.
    assert largest.size < 40 * len(time)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("spring", SPRINGS, ids=str)
def test_a_spring_alone_moves_by_the_exponential_of_its_matrix(spring, order):
    response = response_of(spring, GaussianBasis(count=12), 0.0)
    A = np.array([[0, 1], [-spring.alpha * spring.beta, -spring.alpha]])
    s = np.array([[0.0, 0.1], [0.5, 1.3]])
    found = spring_rows(response, torch.from_numpy(s), order)
    for k in np.ndindex(2, 2):
        expected = (expm(A * s[k]) @ np.linalg.matrix_power(A, order))[0]
        np.testing.assert_allclose(found[k], expected, atol=1e-9 * abs(A).max() ** order)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-7, 1e-11])
def test_polynomials_have_the_lowest_degree_within_the_tolerance(tolerance):
    """Sums of the last Chebyshev coefficients bound the error, relative to those of all."""
    rng = np.random.default_rng(0)
    decay = np.array([1.0, 0.3, 100.0]) * np.array([0.02, 0.1, 0.04]) ** np.arange(13)[:, None]
    cheb = rng.uniform(0.5, 1, (4, 13, 3)) * rng.choice([-1, 1], (4, 13, 3)) * decay
    powers = np.zeros_like(cheb)
    for piece, column in np.ndindex(4, 3):
        powers[piece, :, column] = cheb2poly(cheb[piece, :, column])
    found = _lowest_degree(torch.from_numpy(powers), tolerance).numpy()
    tail = np.abs(cheb)[:, ::-1].cumsum(1)[:, ::-1].max(0)
    needed = int((tail > tolerance * tail[0]).any(1).sum())
    assert found.shape == (4, needed, 3)
    assert 3 < needed < 13
    for piece, column in np.ndindex(4, 3):
        kept = poly2cheb(found[piece, :, column])
        size = np.abs(cheb[:, 0, column]).max()
        np.testing.assert_allclose(kept, cheb[piece, :needed, column], atol=1e-12 * size)


def test_a_straight_line_keeps_three_coefficients():
    line = torch.zeros(2, 13, 1).double()
    line[:, 1] = 1.0
    assert _lowest_degree(line, 1e-12).shape == (2, 3, 1)


@pytest.mark.parametrize("most", [1, 7, 8, 16, 20, 100])
def test_blocks_cover_all_samples_once(most):
    s = torch.zeros(5, 8)
    seen = torch.zeros(5, 8)
    for part, steps in blocks(s, most):
        assert 0 < seen[part, steps].numel() <= most
        seen[part, steps] += 1
    assert (seen == 1).all()
    sizes = [len(s[part]) for part in chunks(s, most)]
    size = max(1, most // 8)
    assert sizes == [size] * (5 // size) + [5 % size] * (5 % size > 0)


def test_a_batch_is_one_chunk_unless_it_is_long(monkeypatch):
    assert list(chunks(torch.zeros(5, 8))) == [slice(0, 2**16 // 8)]
    assert list(chunks(torch.zeros(5, 0))) == []
    monkeypatch.setitem(CHUNK, "cpu", 16)
    assert list(chunks(torch.zeros(5, 8))) == [slice(0, 2), slice(2, 4), slice(4, 6)]
    assert list(chunks(torch.zeros(5, 8, device="meta"))) == list(chunks(torch.zeros(5, 8)))


@pytest.mark.parametrize("rising", [False, True])
@pytest.mark.parametrize(("basis", "approach"), BASES.values(), ids=BASES)
def test_chunks_of_a_batch_are_what_it_is_at_once(basis, approach, rising, monkeypatch):
    response = response_of(SpringDamper(), basis, approach)
    s, x = random_motions(basis, batch=5)
    s = s.sort(-1).values if rising else s
    results = []
    for most in (1000, 60, 1):
        monkeypatch.setitem(CHUNK, "cpu", most)
        values = x.clone().requires_grad_()
        y = motion(response, s, values, 0)
        (gradient,) = torch.autograd.grad((y * y.detach().sin()).sum(), values)
        results.append((y, gradient))
    # Gradients as of the product with the dense matrix.
    dense = torch.einsum("btd,btm->bdm", y.detach().sin(), response.evaluate(s)[..., 0, :])
    size = dense.abs().max()
    torch.testing.assert_close(results[0][1] / size, dense / size, rtol=0, atol=1e-9)
    for found in results[1:]:
        torch.testing.assert_close(found, results[0], rtol=1e-10, atol=1e-10 * size.item())


@pytest.mark.parametrize("order", [0, 1, 3])
@pytest.mark.parametrize(("basis", "approach"), BASES.values(), ids=BASES)
def test_pieces_meet_at_their_knots(basis, approach, order):
    """Exactly at the ends of pieces, around them, and where one period follows another."""
    response = response_of(SpringDamper(), basis, approach)
    interval, end = response.forced.interval, response.forced.end
    knots = interval * torch.arange(len(response.forced.coefficients) + 2).double()
    s = torch.cat([knots, torch.tensor([end, 2 * end, 7 * end]).double()])[None]
    _, x = random_motions(basis, batch=1)
    y, before, after = (
        motion(response, (s + h).clamp(min=0), x, order) for h in (0.0, -1e-9, 1e-9)
    )
    size = y.abs().max().item()
    for near in (before, after) if order < 2 else ():
        torch.testing.assert_close(near, y, rtol=0, atol=1e-4 * size)
    rates = (motion(response, s + h, x, order - 1) for h in (1e-5, 2e-5)) if order else ()
    if order:
        one, two = rates
        middle = motion(response, s + 1.5e-5, x, order)
        slope = (two - one) / 1e-5
        torch.testing.assert_close(slope, middle, rtol=0, atol=1e-4 * middle.abs().max().item())


def test_a_time_that_rounds_up_to_a_period_is_its_beginning():
    response = response_of(SpringDamper(), PeriodicBasis(count=9), 0.0)
    _, x = random_motions(PeriodicBasis(count=9), batch=1)
    # The remainder of a negative number this small is the divisor.
    found = motion(response, torch.tensor([[-1e-20, 0.0]]).double(), x, 0)
    torch.testing.assert_close(found[:, 0], found[:, 1])


def test_tables_are_kept_and_shorter_in_single_precision():
    response = response_of(SpringDamper(), GaussianBasis(count=12), 1.0)
    double, single = (torch.zeros(1, dtype=dtype) for dtype in (torch.float64, torch.float32))
    table = _table(response, 0, double)
    assert _table(response, 0, double) is table
    assert _table(response, 0, single).size < table.size <= 13
    assert _table(response, 1, double) is not table
    assert _table(response, 1, double).order == 1
    # One more piece is after the forcing, unless it is periodic.
    pieces = len(response.forced.coefficients)
    assert table.pieces == pieces + 1
    assert (table.others, table.matrix.shape) == (0, (15, (pieces + 1) * table.size))
    # An approach is no polynomial on the piece in which it ends.
    between = response_of(SpringDamper(), *BASES["approach between knots"])
    assert _table(between, 0, double).others == 1
    periodic = response_of(SpringDamper(), PeriodicBasis(count=9), 0.0)
    assert _table(periodic, 0, double).pieces == len(periodic.forced.coefficients)
    assert _table(periodic, 0, double).others == 2


def test_the_gradient_of_one_motion_does_not_depend_on_the_order_of_its_times():
    response = response_of(SpringDamper(), GaussianBasis(count=12))
    _, x = random_motions(GaussianBasis(count=12), batch=1)
    # One time in each piece, so that the pieces fall strictly.
    falling = torch.linspace(0.98, 0.02, 12, dtype=torch.float64)[None]
    weights = torch.randn(
        1, 12, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    gradients = []
    for times, weight in ((falling, weights), (falling.flip(1), weights.flip(1))):
        values = x.clone().requires_grad_()
        y = motion(response, times, values, 0)
        gradients += torch.autograd.grad((y * weight).sum(), values)
    dense = torch.einsum("btd,btm->bdm", weights, response.evaluate(falling)[..., 0, :])
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=1e-12)
    torch.testing.assert_close(gradients[0], dense, rtol=0, atol=1e-9)
