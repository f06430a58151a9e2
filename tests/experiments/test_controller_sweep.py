import math

import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import AdaptiveController, SafetyFilter
from hrc_learn.experiments.controller.disturbance_trials import StressConfig, run_stress_trials
from hrc_learn.experiments.controller.hostile_trials import (
    PlantConfig,
    PoisonConfig,
    run_plant_trials,
    run_poison_trials,
)
from hrc_learn.experiments.controller.sweep import (
    CRITERIA,
    EXPERIMENTS,
    chunks,
    compared,
    join,
)


def test_every_bound_is_on_a_figure_that_its_experiment_reports():
    """Experiments of one or two steps, and what is made of two of them."""
    assert {c.experiment for c in CRITERIA} <= EXPERIMENTS.keys()
    figures = dict.fromkeys(
        ("near_vision_phase_roll_0_30", "fixed_vision_phase_roll_0_30"), 1.0
    )
    assert compared(figures) == {"near_speed_up_roll_0_30": 1.0}
    for name in ("noise", "stress"):
        summary = run_chunk_of_two_steps(name).summary()
        assert_measured(name, summary)


def assert_measured(name: str, summary: dict[str, float]) -> None:
    figures = {f"{name}_{key}": value for key, value in summary.items()}
    wanted = [c.metric for c in CRITERIA if c.experiment == name]
    assert wanted
    assert all(metric.measure(figures) is not None for metric in wanted)
    assert all(metric.measure({}) is None for metric in wanted)


def run_chunk_of_two_steps(name: str):
    experiment = EXPERIMENTS[name]
    config = type(experiment.config)(count=5, duration=2 * experiment.config.dt)
    return experiment.run(config)


def test_a_bound_is_met_on_its_own_side():
    def measured(figure, value):
        near = [c.metric for c in CRITERIA if c.experiment == "near"]
        (metric,) = [m for m in near if m.name == figure]
        return metric.measure({f"near_{figure}": value})

    success = [measured("success", x).ok for x in (1.0, 0.99, 0.98, math.nan)]
    assert success == [True, True, False, False]
    assert measured("success", 1.0).bound == "≥ 0.99"
    assert [measured("t95", x).ok for x in (7.0, 8.0, math.inf)] == [True, True, False]
    assert measured("t95", 7.0).bound == "≤ 8"


def test_never_arriving_without_adaptation_is_infinitely_slower():
    gains = compared(
        {"near_vision_phase_roll_60_90": 1.0, "fixed_vision_phase_roll_60_90": math.inf}
    )
    assert gains == {"near_speed_up_roll_60_90": math.inf}


def test_chunks_make_up_the_trials_with_a_seed_each():
    jobs = chunks("near", 600, 2, 250)
    assert [count for _, count, _ in jobs] == [250, 250, 100]
    assert len({seed for *_, seed in jobs}) == 3
    assert not {seed for *_, seed in jobs} & {seed for *_, seed in chunks("near", 600, 0, 250)}
    assert chunks("effort", 600, 2, 250) == [("effort", 600, 2)]


def test_joined_results_are_those_of_the_chunks():
    parts = [run_chunk_of_two_steps("stress"), run_chunk_of_two_steps("stress")]
    joined = join(parts)
    assert joined.summary()["rollouts"] == 10
    assert torch.equal(joined.interventions[:5], parts[0].interventions)


@pytest.mark.parametrize("fault", ["none", "nan", "late", "lost"])
def test_no_limit_is_broken_under_stress(fault: str):
    config = StressConfig(count=40, seed=3, duration=2.5, fault=fault)
    with shapes_unchecked():  # for speed
        result = run_stress_trials(config)
    assert not result.beyond.any()
    assert not result.unknown.any()
    acted = result.interventions.sum(0)
    assert acted[1] > 0  # position limits were in the way
    assert (acted[6] > 0) == (fault in ("nan", "late"))


def poison_trials(**changes):
    with shapes_unchecked():  # for speed
        return run_poison_trials(PoisonConfig(dt=0.02, estimators=("composite",), **changes))


def test_poisoned_arms_keep_their_limits_and_move_again():
    result = poison_trials(count=50, duration=2.0, seed=8)
    assert result.summary()["ticks"] == 5000
    # A third by itself, and a tenth of all steps.
    assert 0.35 < result.poisoned.sum() / 5000 < 0.45
    assert not result.beyond.any()
    assert not result.unknown.any()
    assert not result.stuck.any()
    assert_measured("stress_poison", result.summary())


def test_poison_that_is_remembered_is_noticed(monkeypatch):
    monkeypatch.setattr(SafetyFilter, "restored", lambda self, state: state)
    monkeypatch.setattr(AdaptiveController, "_restored", lambda self, state: state)
    result = poison_trials(count=10, duration=0.4)
    assert result.unknown.any()
    assert result.stuck.any()


@pytest.mark.parametrize(("worse", "kept"), [(1.0, True), (4.0, False)])
def test_plants_as_declared_keep_their_limits_and_move_again(worse, kept):
    with shapes_unchecked():  # for speed
        result = run_plant_trials(PlantConfig(count=40, duration=2.0, worse=worse))
    assert not result.unknown.any()
    assert not result.beyond[:, 1].any()
    assert (not result.beyond[:, 0].any()) == kept
    assert (not result.stuck.any()) or not kept
    if kept:
        # All of the margin but what the encoders err by: up to 2 mrad, and noise.
        assert -0.025 < result.furthest.max() < -0.0175
        assert_measured("stress_plant", result.summary())
        assert_measured("stress_plant_worse", result.summary())
