"""Tables made in inference mode or while a program is traced serve every later call."""

import copy

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from unchecked import shapes_unchecked

from hrc_learn.dmp import GaussianBasis, JointDMP, SpringDamper, response
from hrc_learn.geometry.numerics import Constant

TIME = torch.linspace(0, 1, 83, dtype=torch.float64)
"""A grid that no other test uses: its tables are made here."""
MOTION = torch.stack([torch.sin(TIME), TIME**2], dim=-1)

FITS = {
    "trajectory": lambda y: JointDMP.fit(TIME, y, 9),
    "ridge": lambda y: JointDMP.fit(TIME, y, 9, method="ridge"),
    "lwr": lambda y: JointDMP.fit(TIME, y, 9, method="lwr"),
    "smooth": lambda y: JointDMP.fit(TIME, y, 9, smooth=True),
    "several": lambda y: JointDMP.fit(TIME.expand(2, -1) * torch.tensor([[1.0], [2.0]]), y, 9),
    "via points": lambda y: JointDMP.fit(TIME, y, 9).condition(
        TIME[20:21], y[..., 20:21, :] + 0.1
    ),
}


@pytest.mark.parametrize("name", FITS)
def test_a_fit_in_inference_mode_leaves_later_ones_differentiable(name):
    response.response_of.cache_clear()
    motion = MOTION.expand(2, -1, -1) if name == "several" else MOTION
    with torch.inference_mode():
        first = FITS[name](motion).weights.clone()
    asked = motion.clone().requires_grad_()
    weights = FITS[name](asked).weights
    torch.testing.assert_close(weights.detach(), first.clone())
    (gradient,) = torch.autograd.grad(weights.square().sum(), asked)
    assert gradient.isfinite().all()
    assert gradient.abs().sum() > 0


def test_a_response_made_while_a_program_is_traced_has_numbers():
    spring, basis = SpringDamper(), GaussianBasis(count=11)
    shared = response.response_of(spring, basis, 0.25)
    response.response_of.cache_clear()
    with FakeTensorMode():
        copy.deepcopy(shared)
    later = response.response_of(spring, basis, 0.25)
    assert later is not shared
    torch.testing.assert_close(later.forced.coefficients, shared.forced.coefficients)


def test_a_propagator_of_a_number_has_numbers_wherever_it_was_made():
    spring = SpringDamper(alpha=23.0)
    with FakeTensorMode(), torch.inference_mode():
        spring.propagator(0.375)
    found = spring.propagator(0.375)
    expected = torch.linalg.matrix_exp(
        0.375 * torch.tensor([[0.0, 1.0], [-spring.stiffness, -23.0]], dtype=torch.float64)
    )
    torch.testing.assert_close(found, expected)
    assert not found.is_inference()


def test_a_constant_has_numbers_wherever_it_was_converted():
    constant = Constant(torch.tensor([1.0, 2.0], dtype=torch.float64))
    like = torch.zeros(1, dtype=torch.float32)
    with FakeTensorMode():
        constant.like(like)
    torch.testing.assert_close(constant.like(like), torch.tensor([1.0, 2.0]))


@pytest.mark.parametrize("strict", [False, True])
def test_steps_of_a_fixed_length_are_exported_and_run_afterwards(strict):
    spring = SpringDamper(alpha=21.0)

    class Step(torch.nn.Module):
        def forward(self, offset):
            return spring.propagator(0.125) @ offset

    offset = torch.tensor([1.0, 0.5], dtype=torch.float64)
    with shapes_unchecked():
        program = torch.export.export(Step(), (offset,), strict=strict).module()
    torch.testing.assert_close(program(offset), Step()(offset))
