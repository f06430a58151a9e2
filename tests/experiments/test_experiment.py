"""The frame, on a fourth experiment: a throw of a ball that lands somewhere."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from sample_runs import sample_run

from hrc_learn.experiments.experiment import (
    RepeatedRun,
    RunOptions,
    Study,
    evaluate_all,
    run_experiment,
)
from hrc_learn.experiments.metric_table import Metric, evaluate, p95
from hrc_learn.experiments.simulated_cell import UNOBSERVED, Observer
from hrc_learn.experiments.trials import Trial
from hrc_learn.log import LoggedSteps, RunRecording, StepLog
from hrc_learn.sim import PhysicsError
from hrc_learn.viz.report import Picture, Section, read_report


@dataclass(frozen=True)
class Throw:
    landed: float
    """[m]"""
    failure: str = ""

    @property
    def log(self) -> LoggedSteps:
        log = StepLog()
        log.append(landed=self.landed)
        return log


@dataclass(frozen=True, kw_only=True)
class ThrowExperiment:
    """How far from its target a ball lands."""

    title: ClassVar[str] = "Throwing"
    summary: ClassVar[str] = "A ball is thrown."

    target: float = 1.0
    spread: float = 0.01
    bound: float = 50.0
    """[mm]"""
    gives_up: bool = False

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> Throw:
        observer.tell("throwing")
        error = self.spread * np.random.default_rng(seed).standard_normal()
        return Throw(self.target + error, "the ball was dropped" if self.gives_up else "")

    def metrics(self) -> Sequence[Metric[Throw]]:
        return [
            Metric(
                "error",
                lambda run: 1e3 * abs(run.landed - self.target),
                "mm",
                at_most=self.bound,
                essential=True,
                detail=lambda run: f"it landed at {run.landed:.2f} m",
            ),
            Metric("throws", lambda run: 1),
            Metric("height", lambda run: None, "m", at_most=2.0),
        ]

    def recordings(self, run: Throw) -> Mapping[str, RunRecording]:
        return {"run": sample_run()}

    def sections(self, run: Throw, recordings: Mapping[str, RunRecording]) -> Sequence[Section]:
        grey = np.full((4, 4, 3), 128, np.uint8)
        return [Section(heading="The throw", figures=[Picture("throw", grey, "Grey.")])]

    def study(self) -> Study:
        return Study(
            title="Other throws",
            trial=RepeatedRun(replace(self, gives_up=False)),
            metrics=[Metric("throws, error (95 %)", p95("error_mm"), "mm", at_most=1e3)],
        )


def errors(count, spread=0.01):
    drawn = [np.random.default_rng(seed).standard_normal() for seed in range(count)]
    return [1e3 * spread * abs(z) for z in drawn]


@pytest.fixture
def work(tmp_path, capsys):
    def run(experiment, folder="run", **options):
        options = {"film": False} | options
        chosen = RunOptions(out=tmp_path / folder, json=tmp_path / "values.json", **options)
        status = run_experiment(experiment, chosen, command="throw")
        values = json.loads((tmp_path / "values.json").read_text())
        return status, values, chosen.out, capsys.readouterr()

    return run


@pytest.mark.long
def test_a_new_experiment_is_run_repeated_and_reported(work):
    status, values, folder, shown = work(ThrowExperiment(), trials=4, film=True)
    assert status == 0
    assert "throwing" in shown.out
    assert values["trials"] == values["throws"] == 4
    assert values["error_max_mm"] == pytest.approx(max(errors(4)))
    assert values["error_mm"] == pytest.approx(errors(1)[0])
    assert {path.name for path in folder.iterdir()} == {
        ".manifest.json",
        "figures",
        "film.mp4",
        "log.npz",
        "made_by.json",
        "measured.json",
        "report.html",
        "report.json",
        "run.rrd",
        "trials.jsonl",
    }
    assert not list(folder.parent.glob("*.jsonl"))
    report = read_report(folder)
    assert [section.heading for section in report.sections] == ["The throw", "Other throws"]
    assert "4 of 4 succeeded" in report.sections[1].text
    assert [m.name for m in report.table] == ["error", "throws", "throws, error (95 %)"]
    assert report.command == "throw"
    assert report.configuration["target"] == 1.0


def test_without_trials_the_statistics_are_those_of_the_run(work):
    _, values, *_ = work(ThrowExperiment())
    assert values["trials"] == values["success_rate"] == 1
    assert values["error_p95_mm"] == values["error_median_mm"] == values["error_mm"]


def test_a_missed_bound_and_a_task_given_up_are_failures_with_reasons(work):
    status, values, _, shown = work(ThrowExperiment(bound=1e-6))
    assert status == 1
    assert values["success_rate"] == 0
    assert "error: 1.3 mm, but the bound is ≤ 1e-06 mm (it landed at 1.00 m)" in shown.err
    status, values, _, shown = work(ThrowExperiment(gives_up=True), "other")
    assert (status, values["success_rate"]) == (1, 0)
    assert shown.err == "failed: the ball was dropped\n"


def test_physics_that_fails_ends_the_run_and_counts_as_a_failed_trial(
    tmp_path, work, monkeypatch, capsys
):
    run = ThrowExperiment.run

    def diverging(self, seed, observer=UNOBSERVED):
        if seed == 1:
            raise PhysicsError("a velocity is nan", 2.5, "ball")
        return run(self, seed, observer)

    monkeypatch.setattr(ThrowExperiment, "run", diverging)
    reason = "physics failed at ball at 2.500 s: a velocity is nan"
    _, values, folder, _ = work(ThrowExperiment(), trials=3)
    assert (values["trials"], values["successes"]) == (3, 2)
    assert f"Seed 1: {reason}." in read_report(folder).sections[1].text
    assert run_experiment(ThrowExperiment(), RunOptions(out=tmp_path / "single", seed=1)) == 1
    assert capsys.readouterr().err == f"failed: {reason}\n"
    assert not (tmp_path / "single").exists()


def test_failed_trials_do_not_fail_the_run_unless_a_metric_bounds_them(work):
    status, values, folder, _ = work(ThrowExperiment(bound=5.0), trials=4)
    failed = [error > 5.0 for error in errors(4)]
    assert 0 < sum(failed) < 4
    assert not failed[0]
    assert values["successes"] == 4 - sum(failed)
    assert status == 0
    assert f"Seed {failed.index(True)}: error: " in read_report(folder).sections[1].text


def test_a_stopped_repetition_goes_on(tmp_path, work, monkeypatch):
    options = RunOptions(out=tmp_path / "run", trials=3, film=False)
    run, seeds = ThrowExperiment.run, []

    def stopped(self, seed, observer=UNOBSERVED):
        seeds.append(seed)
        if len(seeds) == 3:
            raise KeyboardInterrupt
        return run(self, seed, observer)

    monkeypatch.setattr(ThrowExperiment, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(ThrowExperiment(), options)
    assert seeds == [0, 0, 1]  # the run itself, then the trials
    assert not options.out.exists()
    run_experiment(ThrowExperiment(), options)
    assert seeds == [0, 0, 1, 0, 1, 2]
    assert len((options.out / "trials.jsonl").read_text().splitlines()) == 4


@pytest.mark.parametrize("given", [{"trials": -1}, {"seed": -1}, {"processes": 0}])
def test_wrong_numbers_of_a_run_are_refused(tmp_path, given):
    with pytest.raises(ValueError, match=f"{next(iter(given))} must"):
        RunOptions(out=tmp_path, **given)


def test_trials_with_other_settings_are_refused_before_anything_runs(tmp_path, monkeypatch):
    options, seeds = RunOptions(out=tmp_path / "run", trials=2, film=False), []

    def run(self, seed, observer=UNOBSERVED):
        seeds.append(seed)
        if len(seeds) == 2:
            raise KeyboardInterrupt
        return Throw(self.target)

    monkeypatch.setattr(ThrowExperiment, "run", run)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(ThrowExperiment(), options)
    with pytest.raises(
        ValueError, match=r"run\.trials\.jsonl holds trials with other settings"
    ):
        run_experiment(ThrowExperiment(target=2.0), options)
    assert seeds == [0, 0]


def test_an_older_run_is_replaced_only_on_request(tmp_path, work):
    work(ThrowExperiment())
    with pytest.raises(FileExistsError):
        work(ThrowExperiment())
    assert work(ThrowExperiment(target=2.0), overwrite=True)[0] == 0
    made_by = json.loads((tmp_path / "run" / "made_by.json").read_text())
    assert made_by["target"] == 2.0


def test_a_study_is_not_evaluated_without_trials():
    run = Throw(1.0)
    results = evaluate_all(ThrowExperiment(), run, 0, [])
    assert [m.name for m in results.table] == ["error", "throws"]
    assert results.ok
    trials = [Trial(seed=k, values={"error_mm": 2e3}) for k in range(3)]
    results = evaluate_all(ThrowExperiment(), run, 0, trials)
    assert [m.ok for m in results.table] == [True, None, False]
    assert not results.ok


def test_a_metric_of_a_part_keeps_its_bound_unless_it_is_only_compared():
    metric = Metric("error", lambda x: x, "mm", at_most=1.0, claim="small", essential=True)
    whole = {"a": 2.0, "b": 3.0}
    bounded = metric.of_part(lambda w: w["a"])
    compared = metric.of_part(lambda w: w["b"], "theirs, ", bounded=False)
    evaluation = evaluate([bounded, compared], whole)
    assert evaluation.values == {"error_mm": 2.0, "theirs_error_mm": 3.0}
    assert [m.ok for m in evaluation.table] == [False, None]
    assert len(evaluation.faults) == 1


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (0.0283, "mm", "< 0.1 mm"),
        (-0.0283, "mm", "< 0.1 mm"),
        (6.564, "mm", "6.6 mm"),
        (116.2, "mm", "116 mm"),
        (0.00052, "deg", "< 0.02 deg"),
        (0.5712, "deg", "0.57 deg"),
        (0.0259, "px", "< 0.1 px"),
        (math.nan, "mm", "nan mm"),
        (0.000459, "", "0.000459"),
    ],
)
def test_no_digits_below_the_resolution_are_shown_but_all_are_kept(value, unit, shown):
    metric = Metric("error", lambda x: x, unit).of_part(lambda x: x)
    evaluation = evaluate([metric], value)
    assert [m.shown for m in evaluation.table] == [shown]
    assert list(evaluation.values.values()) == pytest.approx([value], abs=0, nan_ok=True)


def test_a_bound_missed_by_less_than_the_resolution_does_not_look_kept():
    metric = Metric("error", lambda x: x, "mm", at_most=2.0)
    assert [m.shown for m in evaluate([metric], 2.04).table] == ["2.04 mm"]


def test_rows_that_are_not_listed_are_measured_and_nan_keeps_no_bound():
    hidden = Metric("hidden", lambda x: x, at_least=1.0, listed=False, essential=True)
    evaluation = evaluate([hidden], math.nan)
    assert evaluation.table == ()
    assert list(evaluation.values) == ["hidden"]
    assert evaluation.faults[0].startswith("hidden: nan")
    with pytest.raises(ValueError, match="two bounds"):
        Metric("both", lambda x: x, at_most=1.0, at_least=0.0)
