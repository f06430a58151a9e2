"""Derivatives of the quaternion functions, above all where a naive form has none."""

import math

import pytest
import torch
from sampling import directions, generator, quaternions, rotation_vectors
from torch.autograd import gradcheck, gradgradcheck
from torch.testing import assert_close

from hrc_learn.geometry import quaternion

IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
HALF_TURN = torch.tensor([0.0, 0.6, 0, -0.8], dtype=torch.float64)
TINY = quaternion.exp(torch.tensor([1e-9, -2e-9, 0], dtype=torch.float64))
SPECIAL = {"identity": IDENTITY, "minus one": -IDENTITY, "half turn": HALF_TURN, "tiny": TINY}
P = quaternions(rng=generator(1))
V = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)

OF_QUATERNION = {
    "log": quaternion.log,
    "to_matrix": quaternion.to_matrix,
    "from_matrix": lambda q: quaternion.from_matrix(quaternion.to_matrix(q)),
    "rotate": lambda q: quaternion.rotate(q, V),
    "multiply": lambda q: quaternion.multiply(q, P),
    "angle to another": lambda q: quaternion.angle(q, P),
    "angle to itself": lambda q: quaternion.angle(q, q.detach()),
    "slerp": lambda q: quaternion.slerp(q, P, 0.3),
    "slerp to itself": lambda q: quaternion.slerp(q, q.detach(), 0.3),
    "normalize": quaternion.normalize,
}


def derivatives(function, x):
    """Value, all first and all second derivatives."""
    jacobian = torch.func.jacrev(function)
    return function(x), jacobian(x), torch.func.jacfwd(jacobian)(x)


@pytest.mark.parametrize("at", SPECIAL)
@pytest.mark.parametrize("name", OF_QUATERNION)
def test_first_and_second_derivatives_are_finite(name, at):
    for result in derivatives(OF_QUATERNION[name], SPECIAL[at]):
        assert bool(result.isfinite().all())


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-4, 0.63, 0.64, math.pi, 2 * math.pi])
def test_exp_has_two_true_derivatives_at_any_angle(length):
    v = length * directions(rng=generator(2))
    assert gradcheck(quaternion.exp, v.clone().requires_grad_(), atol=1e-8)
    assert gradgradcheck(quaternion.exp, v.clone().requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("length", [0.0, 1e-10, 1e-3, 0.06, 0.0635, 1.0, 3.1])
def test_log_has_two_true_derivatives_along_rotations(length):
    q = quaternion.exp(length * directions(rng=generator(3)))

    def of_turn(turn):
        return quaternion.log(quaternion.multiply(q, quaternion.exp(turn)))

    turn = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(of_turn, turn, atol=1e-8)
    assert gradgradcheck(of_turn, turn, atol=1e-6)


def test_log_is_half_the_identity_map_at_the_identity():
    jacobian = torch.func.jacrev(quaternion.log)(IDENTITY)
    assert_close(jacobian[:, 1:], 2 * torch.eye(3, dtype=torch.float64), rtol=0, atol=0)
    assert_close(jacobian[:, 0], torch.zeros(3, dtype=torch.float64), rtol=0, atol=0)


def test_gradient_of_log_at_a_half_turn_is_the_limit_from_below():
    near = torch.cat([torch.tensor([1e-9], dtype=torch.float64), HALF_TURN[1:]])
    at = torch.func.jacrev(quaternion.log)(HALF_TURN)
    assert_close(at, torch.func.jacrev(quaternion.log)(near), rtol=0, atol=1e-8)


def test_from_matrix_gradients():
    rng = generator(4)
    for v in (rotation_vectors(rng=rng), torch.zeros(3).double(), 3.14 * directions(rng=rng)):

        def of_turn(turn, v=v):
            return quaternion.from_matrix(quaternion.to_matrix(quaternion.exp(v + turn)))

        turn = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        assert gradcheck(of_turn, turn, atol=1e-8)
        assert gradgradcheck(of_turn, turn, atol=1e-6)


def test_unwrap_log_gradient_is_true_past_half_a_turn():
    steps = torch.full((12, 3), 0.4, dtype=torch.float64)

    def unwrapped(steps):
        return quaternion.unwrap_log(quaternion.log(quaternion.exp(steps.cumsum(-2))))

    assert_close(unwrapped(steps), steps.cumsum(-2))
    assert gradcheck(unwrapped, steps.clone().requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("name", [*OF_QUATERNION, "exp"])
def test_vmaps(name):
    function = OF_QUATERNION.get(name, lambda q: quaternion.exp(q[..., 1:]))
    q = quaternions(7, rng=generator(5))
    assert_close(torch.vmap(function)(q), torch.stack([function(qi) for qi in q]))
