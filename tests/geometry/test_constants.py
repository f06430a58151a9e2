import torch

from hrc_learn.geometry.constants import Constant


def test_a_value_first_met_in_a_control_loop_serves_autograd_later():
    constant = Constant(torch.tensor([2.0, 3.0], dtype=torch.float64))
    x = torch.ones(2)
    with torch.inference_mode():
        constant.like(x)
    x.requires_grad_()
    (constant.like(x) * x * x).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [4.0, 6.0]


def test_it_is_converted_once():
    constant = Constant(torch.ones(3, dtype=torch.float64))
    x = torch.zeros(1)
    assert constant.like(x) is constant.like(x)
    assert constant.like(x).dtype == torch.float32
    assert Constant(torch.arange(2)).like(x).dtype == torch.int64
