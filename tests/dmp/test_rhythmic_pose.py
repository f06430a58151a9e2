import pytest
import torch
from demo_motions import PERIOD, rhythm, turning_motion
from dmp_contract import DMPContract

from hrc_learn.dmp import (
    OrientationDMP,
    PoseDMP,
    fit_rhythmic_orientation,
    fit_rhythmic_pose,
)
from hrc_learn.dmp.orientation_error import intrinsic_mean, to_error
from hrc_learn.geometry import quaternion

CENTRE = quaternion.exp(torch.tensor([1.5, -2.0, 0.4], dtype=torch.float64))
LATE = torch.linspace(4, 6, 201, dtype=torch.float64) * PERIOD


def waving(seed=0, n_samples=500):
    """Time and orientations that swing about all axes of a centre."""
    time, vector = rhythm(seed, n_samples)
    return time, quaternion.multiply(quaternion.exp(vector - vector.mean(0)), CENTRE)


def orientations(seed):
    rng = torch.Generator().manual_seed(seed)
    vectors = torch.rand(2, 3, generator=rng, dtype=torch.float64) - 0.5
    return quaternion.multiply(quaternion.exp(vectors), CENTRE).unbind()


class TestRhythmicOrientation(DMPContract):
    reproduction = 1e-4

    def test_reversed_goes_the_same_way_back(self, dmp):
        with pytest.raises(ValueError, match="a rhythm cannot be reversed"):
            dmp.reversed()

    def demonstrate(self, seed, n_samples=300):
        return waving(seed, n_samples)

    def fit(self, *demonstration, n_basis=25, **kwargs):
        return fit_rhythmic_orientation(
            *demonstration, n_basis=n_basis, period=PERIOD, **kwargs
        )

    def outputs(self, trajectory):
        return {
            "orientation": trajectory.orientation,
            "rate of orientation": trajectory.angular_velocity,
        }

    state_outputs = outputs

    def ends(self, seed):
        return orientations(seed)

    def rate(self, name, outputs):
        pure = torch.nn.functional.pad(outputs[f"rate of {name}"], (1, 0))
        return quaternion.multiply(pure, outputs[name]) / 2

    def distance(self, outputs, demonstration):
        return quaternion.angle(outputs["orientation"], demonstration[1]).max()

    def test_masked_samples_do_not_matter(self):
        """Cut short, a rhythm has another centre; so compare with one as long."""
        time, q = waving(n_samples=300)
        mask = torch.arange(310) < 300
        padded = (torch.cat([c, torch.full_like(c[:10], torch.nan)]) for c in (time, q))
        dmp = self.fit(*padded, mask=mask)
        torch.testing.assert_close(dmp.motion.weights, self.fit(time, q).motion.weights)

    def test_motion_settles_at_the_goal_from_anywhere(self, dmp):
        """It settles on the limit cycle, about the goal."""
        start, goal = self.ends(3)
        one, other = (
            dmp.rollout(time=LATE, start=q, goal=goal).orientation for q in (start, CENTRE)
        )
        assert quaternion.angle(one, other).max() < 1e-7
        assert quaternion.angle(one[:100], one[100:200]).max() < 1e-7
        # Cycles of the demonstration are cut at samples, so the centre is not exact.
        assert to_error(one[:200], goal).mean(0).norm() < 5e-3


def test_signs_of_quaternions_mean_nothing():
    time, q = waving()
    rng = torch.Generator().manual_seed(0)
    sign = torch.where(torch.rand(500, 1, generator=rng) < 0.5, -1.0, 1.0)
    plain, flipped = (fit_rhythmic_orientation(time, x, period=PERIOD) for x in (q, sign * q))
    one, other = (dmp.rollout(time=LATE).orientation for dmp in (plain, flipped))
    assert quaternion.angle(one, other).max() < 1e-7


def test_frequency_and_amplitude_are_modulated():
    dmp = fit_rhythmic_orientation(*waving(), period=PERIOD)
    plain = dmp.rollout(time=LATE)
    fast = dmp.rollout(time=LATE / 2, speed=2.0)
    torch.testing.assert_close(fast.orientation, plain.orientation)
    torch.testing.assert_close(fast.angular_velocity, 2 * plain.angular_velocity)
    wide = dmp.rollout(time=LATE, forcing_gain=0.5)
    errors = (to_error(x.orientation, dmp.reference) for x in (plain, wide))
    one, other = (error - dmp.motion.goal for error in errors)
    torch.testing.assert_close(other, one / 2, rtol=0, atol=1e-6)


def test_a_step_changes_the_amplitude_without_a_jump():
    dmp = fit_rhythmic_orientation(*waving(), period=PERIOD)
    state = dmp.step(dmp.initial_state(), 3.0)
    louder = dmp.step(state, 0.0, forcing_gain=1.5)
    torch.testing.assert_close(louder.orientation, state.orientation)
    torch.testing.assert_close(louder.angular_velocity, state.angular_velocity)
    louder = dmp.step(louder, 20 * PERIOD, forcing_gain=1.5)
    cycle = dmp.rollout(time=louder.motion.s[None] * PERIOD, forcing_gain=1.5)
    assert quaternion.angle(louder.orientation, cycle.orientation[0]) < 1e-7


def test_a_rhythm_past_half_a_turn_from_its_mean_is_refused():
    time = torch.linspace(0, 4, 400, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    swing = 3.3 * torch.sin(2 * torch.pi * time)[:, None] * axis
    with pytest.raises(ValueError, match="half a turn from its mean at sample"):
        fit_rhythmic_orientation(time, quaternion.exp(swing), period=1.0)
    nearly = quaternion.multiply(quaternion.exp(swing * (3.0 / 3.3)), CENTRE)
    dmp = fit_rhythmic_orientation(time, nearly, period=1.0)
    assert torch.rad2deg(quaternion.angle(dmp.rollout().orientation, nearly).max()) < 0.1
    both = torch.stack([nearly, quaternion.exp(swing)])
    with pytest.raises(ValueError, match="demonstration 1: orientation passes half a turn"):
        fit_rhythmic_orientation(time, both, period=1.0)


def test_a_rhythm_of_a_pose_shares_its_period_and_is_saved(tmp_path):
    time, q = waving(seed=2)
    _, position = rhythm(seed=3)
    body = torch.sin(2 * torch.pi * time / PERIOD)
    dmp = fit_rhythmic_pose(time, position, q, body=body)
    assert dmp.duration.item() == pytest.approx(PERIOD, rel=1e-3)
    motion = dmp.rollout()
    # The period is found to a thousandth, which five cycles add up.
    torch.testing.assert_close(motion.position, position, rtol=0, atol=0.01)
    assert quaternion.angle(motion.orientation, q).max() < 0.01
    dmp.save(tmp_path / "pose")
    loaded = PoseDMP.load(tmp_path / "pose").rollout(time=LATE, forcing_gain=1.2)
    expected = dmp.rollout(time=LATE, forcing_gain=1.2)
    torch.testing.assert_close(loaded.pose.vector(), expected.pose.vector())


def test_the_intrinsic_mean_is_as_far_from_one_side_as_from_the_other():
    _, q = turning_motion(50)
    sign = torch.where(torch.arange(50)[:, None] % 3 == 0, -1.0, 1.0)
    mean = intrinsic_mean(sign * q)
    away = quaternion.log(quaternion.multiply(q, quaternion.conjugate(mean)))
    torch.testing.assert_close(
        away.mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-9, rtol=0
    )


def test_an_orientation_rhythm_is_an_orientation_primitive():
    assert isinstance(fit_rhythmic_orientation(*waving(), period=PERIOD), OrientationDMP)
