import numpy as np
import pytest
import torch
from demo_motions import PERIOD, rhythm
from dmp_contract import DMPContract
from scipy.integrate import solve_ivp

from hrc_learn.dmp import PeriodicBasis, Response, SpringDamper, Stepper, fit_rhythmic
from hrc_learn.dmp.rhythmic_dmp import _mean_of_whole_cycles


class TestRhythmic(DMPContract):
    reproduction = 5e-5

    def test_reversed_goes_the_same_way_back(self, dmp):
        with pytest.raises(ValueError, match="a rhythm cannot be reversed"):
            dmp.reversed()

    def demonstrate(self, seed, n_samples=300):
        return rhythm(seed, n_samples)

    def fit(self, *demonstration, n_basis=25, **kwargs):
        return fit_rhythmic(*demonstration, n_basis=n_basis, period=PERIOD, **kwargs)

    def outputs(self, trajectory):
        return {"position": trajectory.position, "rate of position": trajectory.velocity}

    state_outputs = outputs

    def ends(self, seed):
        rng = torch.Generator().manual_seed(seed)
        return torch.rand(2, 3, generator=rng, dtype=torch.float64).unbind()

    def distance(self, outputs, demonstration):
        return (outputs["position"] - demonstration[1]).abs().max()

    def test_masked_samples_do_not_matter(self):
        """Cut short, a rhythm has another centre; so compare with one as long."""
        time, y = rhythm(n_samples=300)
        mask = torch.arange(310) < 300
        padded = (torch.cat([c, torch.full_like(c[:10], torch.nan)]) for c in (time, y))
        dmp = self.fit(*padded, mask=mask)
        torch.testing.assert_close(dmp.weights, self.fit(time, y).weights)

    def test_motion_settles_at_the_goal_from_anywhere(self, dmp):
        """It settles on the limit cycle, about the goal."""
        start, goal = self.ends(3)
        t = torch.linspace(4, 6, 201, dtype=torch.float64) * dmp.duration
        one = dmp.rollout(time=t, start=start, goal=goal).position
        other = dmp.rollout(time=t, start=-start, goal=goal).position
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9)
        torch.testing.assert_close(one[:100], one[100:200], rtol=0, atol=1e-9)
        # Cycles of the demonstration are cut at samples, so the centre is not exact.
        torch.testing.assert_close(one[:200].mean(0), goal, rtol=0, atol=5e-3)


def test_periods_are_found():
    for seed in range(5):
        time, y = rhythm(seed)
        assert fit_rhythmic(time, y).duration.item() == pytest.approx(PERIOD, rel=1e-3)


@pytest.mark.long
def test_periods_are_found_in_noise():
    """Of 0.3 of the amplitude, over five periods."""
    rng, time = torch.Generator().manual_seed(0), torch.linspace(0, 8.3, 400).double()
    found = []
    for _ in range(10):
        phase = 6 * torch.rand((), generator=rng).double()
        noise = 0.3 * torch.randn(400, generator=rng).double()
        wave = torch.sin(2 * torch.pi * time / 1.7 + phase) + noise
        found.append(float(fit_rhythmic(time, wave[:, None], n_basis=10).duration))
    assert np.sum(np.abs(np.array(found) - 1.7) < 0.03) >= 9


@pytest.mark.parametrize("lag", [7, 20, 33])
def test_the_period_is_where_the_motion_resembles_itself_first(lag):
    """Spikes at one distance: the means over what overlaps, of a plain loop."""
    y = torch.zeros(160, 1, dtype=torch.float64)
    y[::lag] = 1.0
    y[1::lag] = 0.5
    elapsed = torch.arange(160.0, dtype=torch.float64) / 50
    centred = (y - y.mean(0))[:, 0].numpy()
    means = [centred[k:] @ centred[: 160 - k] / (160 - k) for k in range(120)]
    first = next(
        k
        for k in range(1, 119)
        if means[k] >= max(means[k - 1], means[k + 1])
        and min(means[:k]) < 0
        and means[k] > 0.5 * max(means[lag - 2 :])
    )
    assert first == lag
    assert fit_rhythmic(elapsed, y).duration.item() == pytest.approx(lag / 50, rel=0.02)


def test_a_run_in_goes_over_to_the_rhythm():
    """Swelling from rest, the demonstration is met once it swings in full."""
    time, y = rhythm(duration=8.0, n_samples=900)
    centre = y.mean(0)
    swelling = centre + (y - centre) * (1 - torch.exp(-6 * time[:, None]))
    dmp = fit_rhythmic(time, swelling)
    error = (dmp.rollout().position - swelling)[200:]
    assert error.abs().max() < 0.03


def test_frequency_and_amplitude_are_modulated():
    time, y = rhythm()
    dmp = fit_rhythmic(time, y, period=PERIOD)
    t = torch.linspace(0, 4 * PERIOD, 400, dtype=torch.float64)
    plain = dmp.rollout(time=t).position
    torch.testing.assert_close(dmp.rollout(time=t / 2, speed=2.0).position, plain)
    late = 4 * PERIOD + t
    wide = dmp.rollout(time=late, forcing_gain=2.0).position - dmp.goal
    torch.testing.assert_close(wide, 2 * (dmp.rollout(time=late).position - dmp.goal))


def test_steps_change_amplitude_without_a_jump():
    time, y = rhythm()
    dmp = fit_rhythmic(time, y, period=PERIOD)
    state = dmp.step(dmp.initial_state(), 3.0)
    louder = dmp.step(state, 0.0, forcing_gain=2.0)
    torch.testing.assert_close(louder.position, state.position)
    torch.testing.assert_close(louder.velocity, state.velocity)
    louder = dmp.step(louder, 20 * PERIOD, forcing_gain=2.0)
    cycle = dmp.rollout(time=louder.s[None] * PERIOD, forcing_gain=2.0)
    torch.testing.assert_close(louder.position, cycle.position[0], rtol=0, atol=1e-9)


def test_the_stepper_goes_round():
    time, y = rhythm()
    dmp = fit_rhythmic(time, y, period=PERIOD)
    stepper, state = Stepper(dmp), Stepper(dmp).initial_state()
    for _ in range(77):
        state = stepper.step(state, 0.05)
    there = dmp.rollout(time=[77 * 0.05])
    np.testing.assert_allclose(state.position, there.position[0].detach(), atol=1e-9)
    np.testing.assert_allclose(state.velocity, there.velocity[0].detach(), atol=1e-8)


def test_the_response_solves_the_differential_equation():
    spring, basis = SpringDamper(alpha=20.0, beta=3.0), PeriodicBasis(count=7)
    weights = 100 * np.random.default_rng(0).standard_normal(7)
    sharpness = (7 / (2 * np.pi * 0.6)) ** 2

    def rhs(s, x):
        psi = np.exp(sharpness * (np.cos(2 * np.pi * (s - np.arange(7) / 7)) - 1))
        force = psi @ weights / psi.sum()
        return [x[1], 20 * (3 * (0.5 - x[0]) - x[1]) + force]

    times = np.linspace(0, 3, 50)
    tight = {"rtol": 1e-12, "atol": 1e-12, "max_step": 0.01}
    expected = solve_ivp(rhs, (0, 3), [0.2, -1.0], "DOP853", times, **tight).y
    H = Response(spring, basis).evaluate(torch.tensor(times)).numpy()
    rows = H @ np.concatenate([weights, [-1.0, 0.2, 0.5]])
    np.testing.assert_allclose(rows[:, :2].T, expected, atol=1e-8)


def test_what_cannot_be_a_rhythm_is_refused():
    time, y = rhythm()
    with pytest.raises(ValueError, match=r"a whole period of 9\.000 s, got 4\.200 s"):
        fit_rhythmic(time, y, period=9.0)
    with pytest.raises(ValueError, match=r"a whole period of 0\.000 s"):
        fit_rhythmic(time, y, period=0.0)
    with pytest.raises(ValueError, match="no period found"):
        fit_rhythmic(time, torch.zeros(500, 2, dtype=torch.float64))


@pytest.mark.parametrize(("last", "first"), [(2.7, 0.7), (3.0, 0.0), (1.2, 0.2), (0.8, 0.0)])
def test_the_centre_is_the_mean_of_whole_cycles_counted_from_the_end(last, first):
    """Of few samples at any times, by the rule of trapezoids."""
    s = np.linspace(0, last, 28)
    s[1:-1] += 0.02 * np.random.default_rng(0).uniform(-1, 1, 26)
    y = np.stack([np.sin(2 * np.pi * s), s**2], -1)
    inside = s >= first - 1e-12
    expected = np.trapezoid(y[inside], s[inside], axis=0) / (last - s[inside][0])
    found = _mean_of_whole_cycles(torch.from_numpy(s), torch.from_numpy(y))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
