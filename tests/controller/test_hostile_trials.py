"""Limits under random goals, poisoned inputs and plants worse than declared."""

import pytest
from disturbance_trials import StressConfig, run_stress_trials
from hostile_trials import PlantConfig, PoisonConfig, run_plant_trials, run_poison_trials

from hrc_learn.controller import AdaptiveController, SafetyFilter

pytestmark = pytest.mark.simulation


@pytest.mark.long
@pytest.mark.parametrize(
    "fault",
    [
        "none",
        "nan",
        pytest.param("late", marks=pytest.mark.slow),
        pytest.param("lost", marks=pytest.mark.slow),
    ],
)
def test_no_limit_is_broken_under_stress(fault: str):
    config = StressConfig(count=40, seed=3, duration=1.8, fault=fault)
    result = run_stress_trials(config)
    assert not result.beyond.any()
    assert not result.unknown.any()
    acted = result.interventions.sum(0)
    assert acted[1] > 0  # position limits were in the way
    assert (acted[6] > 0) == (fault in ("nan", "late"))


def poison_trials(**changes):
    return run_poison_trials(PoisonConfig(dt=0.02, estimators=("composite",), **changes))


@pytest.mark.long
def test_poisoned_arms_keep_their_limits_and_move_again():
    result = poison_trials(count=50, duration=2.0, seed=8)
    assert result.summary()["ticks"] == 5000
    # A third by itself, and a tenth of all steps.
    assert 0.35 < result.poisoned.sum() / 5000 < 0.45
    assert not result.beyond.any()
    assert not result.unknown.any()
    assert not result.stuck.any()


@pytest.mark.long
def test_poison_that_is_remembered_is_noticed(monkeypatch):
    monkeypatch.setattr(SafetyFilter, "restored", lambda self, state: state)
    monkeypatch.setattr(AdaptiveController, "_restored", lambda self, state: state)
    result = poison_trials(count=10, duration=0.4)
    assert result.unknown.any()
    assert result.stuck.any()


@pytest.mark.long
@pytest.mark.parametrize(("worse", "kept"), [(1.0, True), (10.0, False)])
def test_plants_as_declared_keep_their_limits_and_move_again(worse, kept):
    result = run_plant_trials(PlantConfig(count=40, duration=2.0, worse=worse))
    assert not result.unknown.any()
    assert not result.beyond[:, 1].any()
    assert (not result.beyond[:, 0].any()) == kept
    assert (not result.stuck.any()) or not kept
    if kept:
        # All of the margin but what the encoders err by: up to 2 mrad, and noise.
        assert -0.025 < result.furthest.max() < -0.0175
