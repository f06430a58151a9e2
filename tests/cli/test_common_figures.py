"""Figures over trials, against numbers that can be told by hand."""

import pytest

from hrc_learn.cli.commands._common_figures import Figure, common_figures, median, p95, total
from hrc_learn.experiments.monte_carlo import Trial


def trial(seed: int, failure: str = "", **values: float) -> Trial:
    return Trial(seed=seed, values=values, failure=failure)


def test_figures_of_trials():
    trials = [trial(i, "" if i else "fell", contacts=2, time_s=i, miss=i) for i in range(101)]
    figures = {
        "contacts": Figure("contacts", total),
        "time": Figure("time_s", median),
        "miss_mm": Figure("miss", p95, 1e3),
    }
    assert common_figures(trials, figures) == {
        "trials": 101,
        "success_rate": pytest.approx(100 / 101),
        "contacts": 202,
        "time": 50,
        "miss_mm": pytest.approx(95e3),
    }


def test_what_was_not_measured_is_left_out():
    trials = [trial(0, aim_time_s=3.0), trial(1, time_s=float("nan"))]
    figures = {"time": Figure("time_s", median), "joints": Figure("joints", total)}
    assert common_figures(trials, figures) == {"trials": 2, "success_rate": 1.0}


def test_an_ending_stands_for_every_shelf():
    trials = [trial(0, lower_contacts=1, upper_contacts=3, contacts=100)]
    assert common_figures(trials, {"n": Figure("_contacts", total)})["n"] == 4
