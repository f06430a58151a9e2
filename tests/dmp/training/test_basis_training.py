"""Learned bases: gradients, agreement with the ordinary response, and what they gain."""

import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import ExponentialPhase, JointDMP, Response, SigmoidPhase, SpringDamper
from hrc_learn.dmp.training import DescentConfig, learn_basis
from hrc_learn.dmp.training.basis_training import Demo, Placement, projection_error

STAMPS = torch.linspace(0, 1, 120, dtype=torch.float64) ** 1.2


def moved_placement(count, spring, phase, seed=0):
    placement = Placement(count, spring, phase)
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in placement.parameters():
            parameter += torch.randn(parameter.shape, generator=rng, dtype=torch.float64)
    return placement


def knock(n_samples=120):
    """A slow reach with a knock of some hundredths of its duration, in one coordinate."""
    s = torch.linspace(0, 1, n_samples, dtype=torch.float64)
    reach = s**3 * (10 - 15 * s + 6 * s**2)
    return 2 * s, torch.stack([reach + 0.15 * torch.exp(-(((s - 0.6) / 0.02) ** 2)), reach], -1)


@pytest.mark.parametrize("approach", [0.0, 0.7])
@pytest.mark.parametrize("phase", [ExponentialPhase(), SigmoidPhase()])
@pytest.mark.parametrize("spring", [SpringDamper(), SpringDamper(alpha=14.0, beta=9.0)])
def test_the_differentiable_response_is_the_response(spring, phase, approach):
    placement = moved_placement(7, spring, phase)
    H = Response(placement.spring(), placement.basis(), approach).evaluate(STAMPS)[:, 0]
    design = placement.design(STAMPS, approach)
    torch.testing.assert_close(design, H, rtol=0, atol=1e-10)


@pytest.mark.parametrize("ratio", [0.1, 0.25, 0.9])
def test_gradients_of_the_response_are_exact(ratio):
    """By centres, widths and gain, whether or not the damping is critical."""
    placement = moved_placement(3, SpringDamper(beta=25.0 * ratio), ExponentialPhase())
    s = torch.linspace(0, 1, 6, dtype=torch.float64)

    def design(*parameters):
        named = dict(zip(("centres", "widths", "gain"), parameters, strict=True))
        return torch.func.functional_call(Design(placement), rename(named), (s,))

    assert torch.autograd.gradcheck(design, tuple(placement.parameters()))


class Design(torch.nn.Module):
    def __init__(self, placement):
        super().__init__()
        self.placement = placement

    def forward(self, s):
        return self.placement.design(s, 0.0)


def rename(named):
    return {f"placement.{name}": value for name, value in named.items()}


def test_the_projected_error_is_that_of_the_fit():
    time, position = arm_motion(n_samples=150, moving_start=True)
    placement = moved_placement(8, SpringDamper(), ExponentialPhase())
    s = time / time[-1]
    everything = torch.ones_like(s, dtype=torch.bool)
    H = placement.design(s, 0.0)
    mean, held = projection_error(H, Demo(s, position, everything), 1e-7)
    fit = JointDMP.fit(time, position, basis=placement.basis(), spring=placement.spring())
    torch.testing.assert_close(mean, fit.fit_report.rmse.square().sum(), rtol=1e-4, atol=0)
    assert held == mean


def test_learned_centres_follow_a_sharp_event():
    """At equal N less than a fifth of the error, with the functions where the event is."""
    time, position = knock()
    uniform = JointDMP.fit(time, position, 14).fit_report.nrmse
    learned = learn_basis(
        time, position, 14, config=DescentConfig(steps=60, learning_rate=0.06)
    ).dmp
    assert learned.fit_report.nrmse < uniform / 5
    gaps = torch.tensor(learned.basis.centres).diff()
    assert 0.5 < learned.basis.centres[int(gaps.argmin())] < 0.7


def test_held_out_samples_decide():
    """With more functions than a noisy motion supports, what is kept is the best held out."""
    time, position = arm_motion(n_samples=60)
    rng = torch.Generator().manual_seed(0)
    noisy = position + 1e-2 * torch.randn(position.shape, generator=rng, dtype=torch.float64)
    config = DescentConfig(steps=30, learning_rate=0.1)
    history = learn_basis(time, noisy, 25, held_out=4, config=config).history
    assert history.best == min(history.criterion)
    assert history.loss[-1] < history.loss[history.best_step]


def test_a_learned_gain_keeps_its_damping_and_its_bounds():
    time, position = knock(100)
    spring = SpringDamper(alpha=25.0, beta=4.0)
    config = DescentConfig(steps=15, learning_rate=1.0)
    dmp = learn_basis(
        time, position, 8, learn=["gain"], spring=spring, held_out=0, config=config
    ).dmp
    assert dmp.spring.alpha != 25.0
    assert 25.0 / 4 <= dmp.spring.alpha <= 25.0 * 4
    assert dmp.spring.beta / dmp.spring.alpha == pytest.approx(4.0 / 25.0)
    late = dmp.rollout(time=[20.0], goal=[3.0, 4.0]).position[0]
    torch.testing.assert_close(late, torch.tensor([3.0, 4.0], dtype=torch.float64))


def test_demonstrations_share_a_basis():
    """Of a padded batch; what is padded does not count."""
    time, position = knock(100)
    mask = torch.ones(2, 100, dtype=torch.bool)
    mask[1, 80:] = False
    both = torch.stack([position, 0.5 * position.flip(-1)])
    both[1, 80:] = torch.nan
    config = DescentConfig(steps=4)
    dmp = learn_basis(time, both, 10, mask=mask, config=config).dmp
    assert dmp.weights.shape == (2, 2, 10)
    assert dmp.fit_report.nrmse.isfinite().all()


@pytest.mark.parametrize("learn", [[], ["weights"]])
def test_unknown_names_are_refused(learn):
    with pytest.raises(ValueError, match="learn must name some of centres, widths, gain"):
        learn_basis(*knock(20), 5, learn=learn)
