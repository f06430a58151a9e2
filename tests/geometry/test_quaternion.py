import math

import numpy as np
import pytest
import torch
from sampling import directions, generator, quaternions, rotation_vectors
from scipy.spatial.transform import Rotation
from torch.testing import assert_close
from unchecked import shapes_unchecked

from hrc_learn.geometry import quaternion

BATCHES = [(), (1,), (3, 1, 2)]


def scipy_rotation(q):
    return Rotation.from_quat(q.reshape(-1, 4).numpy(), scalar_first=True)


def same_rotation(p, q, atol=1e-14):
    assert_close(quaternion.canonical(p), quaternion.canonical(q), rtol=0, atol=atol)


@pytest.mark.parametrize("batch", BATCHES)
def test_agrees_with_scipy(batch):
    rng = generator(1)
    p, q = quaternions(*batch, rng=rng), quaternions(*batch, rng=rng)
    v = torch.randn(*batch, 3, generator=rng, dtype=torch.float64)
    P, Q = scipy_rotation(p), scipy_rotation(q)

    def expect(actual, oracle):
        assert_close(actual, torch.from_numpy(oracle).reshape(actual.shape), rtol=0, atol=1e-13)

    same_rotation(
        quaternion.multiply(p, q),
        torch.from_numpy((P * Q).as_quat(scalar_first=True)).reshape(*batch, 4),
    )
    expect(quaternion.to_matrix(q), Q.as_matrix())
    expect(quaternion.rotate(q, v), Q.apply(v.reshape(-1, 3).numpy()))
    expect(quaternion.log(q), Q.as_rotvec())
    expect(quaternion.angle(p, q), (P.inv() * Q).magnitude())
    same_rotation(quaternion.conjugate(q), quaternion.from_matrix(quaternion.to_matrix(q).mT))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("max_angle", [3 * math.pi, 1.0, 1e-6])
def test_exp_agrees_with_scipy_at_any_angle(batch, max_angle):
    v = rotation_vectors(*batch, rng=generator(2), max_angle=max_angle)
    oracle = Rotation.from_rotvec(v.reshape(-1, 3).numpy()).as_quat(scalar_first=True)
    same_rotation(quaternion.exp(v), torch.from_numpy(oracle).reshape(*batch, 4))


def test_exp_inverts_log_from_tiny_angles_to_half_turns():
    axis = directions(400, rng=generator(3))
    length = torch.logspace(-12, math.log10(math.pi - 1e-9), 400, dtype=torch.float64)
    v = length[:, None] * axis
    assert_close(quaternion.log(quaternion.exp(v)), v, rtol=1e-9, atol=0)
    assert_close(quaternion.log(quaternion.exp(v[:300])), v[:300], rtol=1e-14, atol=0)


def test_small_angles_agree_with_their_neighbours_across_the_series_threshold():
    """Both forms of `where` meet: no step as the argument passes the threshold."""
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    angles = torch.linspace(0.02, 0.8, 2001, dtype=torch.float64)
    w, s = torch.cos(angles / 2), torch.sin(angles / 2)
    q = torch.cat([w[:, None], s[:, None] * axis], dim=-1)
    assert_close(quaternion.exp(angles[:, None] * axis), q, rtol=0, atol=3e-16)
    assert_close(quaternion.log(q), angles[:, None] * axis, rtol=2e-15, atol=0)


@pytest.mark.parametrize("sample", ["uniform", "tiny", "half turn", "exact half turn"])
def test_both_signs_give_the_same_answer(sample):
    rng = generator(4)
    q = {
        "uniform": quaternions(50, rng=rng),
        "tiny": quaternion.exp(rotation_vectors(50, rng=rng, max_angle=1e-8)),
        "half turn": quaternion.exp((math.pi - 1e-12) * directions(50, rng=rng)),
        "exact half turn": torch.cat(
            [torch.zeros(50, 1, dtype=torch.float64), directions(50, rng=rng)], dim=-1
        ),
    }[sample]
    p, v = quaternions(50, rng=rng), directions(50, rng=rng)
    exactly = {"rtol": 0, "atol": 0}
    assert_close(quaternion.log(-q), quaternion.log(q), **exactly)
    assert_close(quaternion.to_matrix(-q), quaternion.to_matrix(q), **exactly)
    assert_close(quaternion.rotate(-q, v), quaternion.rotate(q, v), **exactly)
    assert_close(quaternion.angle(-q, p), quaternion.angle(q, p), **exactly)
    assert_close(quaternion.slerp(p, -q, 0.3), quaternion.slerp(p, q, 0.3), **exactly)
    assert bool((quaternion.log(q).norm(dim=-1) <= math.pi + 1e-15).all())


@pytest.mark.parametrize("turn", ["any", "half"])
def test_from_matrix_inverts_to_matrix(turn):
    rng = generator(5)
    q = quaternions(200, rng=rng)
    if turn == "half":
        q = torch.cat([torch.zeros(200, 1, dtype=q.dtype), directions(200, rng=rng)], dim=-1)
    same_rotation(quaternion.from_matrix(quaternion.to_matrix(q)), q, atol=1e-15)


def test_what_is_compiled_is_the_same(monkeypatch):
    """Also where several components are largest, as in a third of a turn about (1, 1, 1)."""
    ties = 0.5 * torch.tensor([[1, 1, 1, 1], [2**0.5, 2**0.5, 0, 0]], dtype=torch.float64)
    p = torch.cat([quaternions(200, rng=generator(12)), ties])
    q, R = quaternions(3, 1, rng=generator(13)), quaternion.to_matrix(p)
    row, product = quaternion.from_matrix(R), quaternion.multiply(p, q)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert_close(quaternion.from_matrix(R), row, rtol=0, atol=1e-15)
    assert_close(quaternion.multiply(p, q), product, rtol=0, atol=1e-15)


def test_slerp_turns_at_constant_rate_the_short_way():
    rng = generator(6)
    p, q = quaternions(30, rng=rng), quaternions(30, rng=rng)
    total = quaternion.angle(p, q)
    same_rotation(quaternion.slerp(p, q, 0.0), p)
    same_rotation(quaternion.slerp(p, q, 1.0), q)
    for t in (0.1, 0.5, 0.9):
        assert_close(quaternion.angle(p, quaternion.slerp(p, q, t)), t * total)
    t = torch.linspace(0, 1, 30, dtype=p.dtype)
    assert_close(quaternion.angle(p, quaternion.slerp(p, q, t)), t * total)


def test_continuous_repairs_random_signs():
    rng = generator(7)
    rate = rotation_vectors(4, 1, rng=rng, max_angle=0.1)
    step = torch.arange(100, dtype=torch.float64)[:, None]
    smooth = quaternion.multiply(quaternions(4, 1, rng=rng), quaternion.exp(step * rate))
    sign = torch.randint(2, (4, 100, 1), generator=rng) * 2.0 - 1
    repaired = quaternion.continuous(smooth * sign)
    assert_close(repaired, smooth * sign[:, :1])


@pytest.mark.parametrize("degrees", [10, 170, 190, 350, 370, 720, 1100])
def test_unwrap_log_follows_a_turn_of_any_angle(degrees):
    axis = directions(5, 1, rng=generator(8))
    angles = torch.linspace(0, math.radians(degrees), 237, dtype=torch.float64)
    path = angles[:, None] * axis
    wrapped = quaternion.log(quaternion.exp(path))
    # log loses digits like eps / distance at half turns and whole turns.
    assert_close(quaternion.unwrap_log(wrapped), path, rtol=0, atol=1e-11)


def test_unwrap_log_passes_through_the_identity_and_back_past_a_turn():
    axis = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    angles = torch.tensor([-4.0, -2, 0, 2, 4, 6, 2 * math.pi, 7, 6, 4, 1, -1])
    path = angles.double()[:, None] * axis
    unwrapped = quaternion.unwrap_log(quaternion.log(quaternion.exp(path)))
    # The first sample is kept in its shortest form: the whole path is a turn further on.
    assert_close(unwrapped, path + 2 * math.pi * axis, rtol=0, atol=1e-11)


def test_unwrap_log_keeps_the_rotation():
    rng = generator(9)
    steps = rotation_vectors(3, 200, rng=rng, max_angle=0.5)
    q = [quaternion.exp(steps[:, 0])]
    for step in steps[:, 1:].unbind(1):
        q.append(quaternion.multiply(quaternion.exp(step), q[-1]))
    q = torch.stack(q, dim=1)
    same_rotation(quaternion.exp(quaternion.unwrap_log(quaternion.log(q))), q, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(dtype):
    q = quaternions(3, 4, rng=generator(), dtype=dtype)
    R = quaternion.to_matrix(q)
    results = [
        quaternion.multiply(q, q),
        quaternion.conjugate(q),
        quaternion.log(q),
        quaternion.exp(q[..., 1:]),
        quaternion.rotate(q, q[..., 1:]),
        R,
        quaternion.from_matrix(R),
        quaternion.angle(q, q),
        quaternion.slerp(q, q, 0.5),
        quaternion.continuous(q),
        quaternion.unwrap_log(quaternion.log(q)),
    ]
    assert {result.dtype for result in results} == {dtype}
    assert_close(quaternion.exp(quaternion.log(q)), quaternion.canonical(q))


def test_broadcasts():
    rng = generator(10)
    q, many = quaternions(4, 1, rng=rng), quaternions(5, rng=rng)
    assert quaternion.multiply(q, many).shape == (4, 5, 4)
    assert quaternion.rotate(q, directions(5, rng=rng)).shape == (4, 5, 3)
    assert quaternion.rotate(many[0], directions(5, rng=rng)).shape == (5, 3)


@pytest.mark.gradients
def test_the_mean_has_a_derivative_even_of_equal_quaternions():
    one = quaternion.exp(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    jacobian = torch.func.jacrev(quaternion.mean)(one.repeat(4, 1))
    tangent = torch.eye(4, dtype=torch.float64) - torch.outer(one, one)
    sign = torch.sign(quaternion.mean(one.repeat(4, 1)) @ one)
    assert_close(jacobian, (sign * tangent / 4).unsqueeze(1).expand(4, 4, 4))
    spread = quaternion.exp(
        0.4 * torch.randn(5, 3, generator=generator(2), dtype=torch.float64)
    )
    assert torch.autograd.gradcheck(quaternion.mean, spread.requires_grad_())


def test_the_mean_of_whole_numbers_is_no_whole_number():
    with shapes_unchecked():
        q = torch.tensor([[1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 1, 0]])
        assert_close(quaternion.mean(q), quaternion.mean(q.double()))


def test_the_mean_is_nearest_to_all_matrices_whatever_the_signs():
    spread = 0.4 * torch.randn(7, 3, generator=generator(3), dtype=torch.float64)
    centre = quaternion.exp(torch.tensor([3.0, 0.5, 0.0], dtype=torch.float64))
    q = quaternion.multiply(centre, quaternion.exp(spread))
    sign = torch.tensor([1, -1, 1, 1, -1, -1, 1], dtype=torch.float64)
    mean = quaternion.mean(sign[:, None] * q)

    def distance(m):
        difference = quaternion.to_matrix(q) - quaternion.to_matrix(m)
        return difference.square().sum()

    assert mean.norm().item() == pytest.approx(1, abs=1e-12)
    for step in 1e-3 * torch.cat([torch.eye(3), -torch.eye(3)]).double():
        assert distance(quaternion.multiply(quaternion.exp(step), mean)) > distance(mean)


def test_what_compilers_get_are_the_same_products_and_rotations():
    """Written out for compilers, every branch by the largest component, against SciPy."""
    rng = np.random.default_rng(0)
    # Turns near each of the four components that can be the largest.
    q = np.eye(4)[rng.integers(4, size=40)] + rng.normal(0, 0.4, (40, 4))
    one, other = (Rotation.from_quat(x, scalar_first=True) for x in (q, np.roll(q, 7, axis=0)))
    p, r = (torch.from_numpy(x.as_quat(scalar_first=True)) for x in (one, other))
    product = torch.stack(quaternion.product_of_components(p.unbind(-1), r.unbind(-1)), -1)
    expected = (one * other).as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((product.numpy() * expected).sum(-1)), 1, atol=1e-12)
    # Linear in both, and so independent of their length.
    longer = quaternion.product_of_components((2 * p).unbind(-1), (3 * r).unbind(-1))
    torch.testing.assert_close(torch.stack(longer, -1), 6 * product)
    back = quaternion._written_out_from_matrix(torch.from_numpy(one.as_matrix())).numpy()
    np.testing.assert_allclose(np.abs((back * p.numpy()).sum(-1)), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(back, axis=-1), 1, atol=1e-12)
    # The largest component is positive.
    assert (np.take_along_axis(back, np.abs(back).argmax(-1)[:, None], 1) > 0).all()
