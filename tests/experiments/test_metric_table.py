"""Statistics of many trials: success rate, quantiles, totals, and their keys."""

import math

import numpy as np
import pytest
from scipy.stats import binomtest

from hrc_learn.experiments.metric_table import (
    Metric,
    Summary,
    column,
    median,
    p95,
    success_rate,
    wilson_interval,
)
from hrc_learn.experiments.trials import Trial


@pytest.mark.parametrize(
    ("successes", "trials"), [(0, 1), (50, 50), (49, 50), (3, 7), (0, 200)]
)
def test_the_interval_is_that_of_wilson(successes, trials):
    oracle = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, trials) == pytest.approx(
        (oracle.low, oracle.high), abs=1e-6
    )


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (2, 1), (-1, 3)])
def test_no_share_without_trials(successes, trials):
    with pytest.raises(ValueError, match="do not give a rate"):
        wilson_interval(successes, trials)


def test_a_summary_counts_and_sorts():
    trials = [Trial(seed=k, values={"error": float(k), "shelf": "upper"}) for k in range(20)]
    trials[3] = Trial(seed=3, values={}, failure="dropped it")
    trials[4] = Trial(seed=4, values={"error": math.nan}, failure="lost [sight]")
    summary = Summary.of(trials)
    errors = [k for k in range(20) if k not in (3, 4)]
    spread = summary.spread["error"]
    assert (spread["min"], spread["max"]) == (0, 19)
    assert spread["median"] == errors[9]
    assert sum(e <= spread["p95"] for e in errors) >= 0.95 * len(errors)
    assert summary.failed == {3: "dropped it", 4: "lost [sight]"}
    figures = summary.figures()
    assert figures["successes"] == 18
    assert figures["error_p95"] == spread["p95"]
    assert all(isinstance(value, (int, float)) for value in figures.values())
    with pytest.raises(ValueError, match="no trials"):
        Summary.of([])


def test_a_summary_names_the_rate_and_the_reasons_of_failures():
    trials = [
        Trial(seed=0, values={"goal_error_mm": 0.5}),
        Trial(seed=8, values={}, failure="a [b]"),
    ]
    text = str(Summary.of(trials))
    assert "1 of 2 succeeded" in text
    assert "seed 8: a [b]" in text


def test_statistics_are_named_before_the_unit_and_counts_are_summed_up():
    rows = [(0.5, 2, "a"), (1.5, 0, "b"), (2.5, 3, "c")]
    trials = [
        Trial(seed=k, values={"place_error_mm": error, "contacts": n, "shelf": shelf})
        for k, (error, n, shelf) in enumerate(rows)
    ]
    figures = Summary.of(trials).figures()
    assert figures["place_error_median_mm"] == 1.5
    assert figures["place_error_p95_mm"] == figures["place_error_max_mm"] == 2.5
    assert figures["contacts"] == 5
    assert (figures["trials"], figures["success_rate"]) == (3, 1.0)
    assert "place_error_mm" not in figures
    assert not [key for key in figures if key.startswith(("shelf", "contacts_"))]


def test_a_trial_that_was_given_up_spoils_no_quantile():
    trials = [Trial(seed=k, values={"error": float(k)}) for k in range(4)]
    assert median("error")(trials) == 2  # one that was measured, not the mean of two
    assert p95("error")(trials) == 3
    given_up = [*trials, Trial(seed=9, values={}, failure="no free start")]
    assert np.isnan(column(given_up, "error")).tolist() == [False] * 4 + [True]
    assert p95("error")(given_up) == 3
    assert success_rate(given_up) == 0.8
    assert median("nothing")(trials) is None


@pytest.mark.parametrize("bound", [{"at_most": 1.0}, {"at_least": 1.0}])
def test_a_metric_has_one_bound(bound):
    measured = Metric("error", lambda run: run, **bound).measure(2.0)
    assert measured is not None
    assert measured.ok == ("at_least" in bound)
    with pytest.raises(ValueError, match="'error' has two bounds"):
        Metric("error", lambda run: run, at_most=1.0, at_least=0.0)
