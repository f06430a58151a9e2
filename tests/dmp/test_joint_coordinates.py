"""A primitive's coordinates, and primitives that differ from it in these alone."""

import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import GaussianBasis, JointDMP, SpringDamper

NAMES = ("a", "b", "c")


@pytest.fixture
def dmp():
    time, position = arm_motion(n_samples=60, n_joints=3, moving_start=True)
    return JointDMP.fit(
        time,
        position,
        approach=0.5,
        scaling="amplitude",
        joint_names=NAMES,
        units="deg",
        basis=GaussianBasis(count=7, width=0.8),
        spring=SpringDamper(alpha=20.0),
    )


def test_the_same_coordinates_give_the_same_primitive(dmp):
    twin = dmp.with_coordinates(dmp.coordinates())
    assert twin.config() == dmp.config()
    assert twin.fit_report is None
    for name, tensor in dmp.state_dict().items():
        torch.testing.assert_close(twin.state_dict()[name], tensor, msg=name)


def test_coordinates_are_what_the_response_maps_to_the_motion(dmp):
    plain = JointDMP.fit(*arm_motion(n_samples=60, n_joints=3, moving_start=True), n_basis=7)
    H = plain.response.evaluate(plain.timestamps)[:, 0]
    torch.testing.assert_close(H @ plain.coordinates().mT, plain.rollout().position)


def test_nothing_is_shared_with_the_original(dmp):
    before = {name: tensor.clone() for name, tensor in dmp.state_dict().items()}
    twin = dmp.with_coordinates(dmp.coordinates())
    for tensor in twin.state_dict().values():
        tensor.zero_()
    for name, tensor in dmp.state_dict().items():
        torch.testing.assert_close(tensor, before[name], msg=name)


@pytest.mark.parametrize("batch", [(), (2,), (4, 1, 2)])
def test_the_batch_is_that_of_the_coordinates(dmp, batch):
    factor = 1 + torch.rand(*batch, 1, 1, generator=torch.Generator().manual_seed(0))
    x = factor * dmp.coordinates().detach()
    many = dmp.with_coordinates(x, duration=2.0 * dmp.duration)
    assert many.rollout().position.shape == (*batch, 60, 3)
    alone = dmp.with_coordinates(x.reshape(-1, *x.shape[-2:])[-1], 2.0 * dmp.duration)
    one = many.rollout().position.reshape(-1, 60, 3)[-1]
    torch.testing.assert_close(one, alone.rollout().position)
    torch.testing.assert_close(many.duration, (2 * dmp.duration).expand(batch))


def test_gradients_reach_coordinates_and_duration(dmp):
    x = dmp.coordinates().detach().requires_grad_()
    duration = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)

    def motion(x, duration):
        made = dmp.with_coordinates(x, duration)
        return made.rollout(time=[0.3, 1.7]).velocity

    assert torch.autograd.gradcheck(motion, (x, duration), atol=1e-6)
    assert not list(dmp.with_coordinates(x).parameters())


def test_weights_can_be_trained_where_nothing_is_to_be_passed_on(dmp):
    twin = dmp.with_coordinates(dmp.coordinates().detach())
    assert [name for name, _ in twin.named_parameters()] == ["weights"]
