"""The page of requirements: what it names exists, and what was measured stands on it."""

from dataclasses import asdict
from pathlib import Path

import pytest

from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.collaboration_metrics import collaboration_metrics
from hrc_learn.viz.evidence import Clause, _ending, _filled, clauses, evidence_page
from hrc_learn.viz.report import Measurement, Report, flatten

ROOT = Path(__file__).parents[2]


def test_the_style_is_not_escaped():
    """An escaped quote in a style ends it."""
    assert '"Segoe UI"' in evidence_page([run()])


def run(**changes):
    values = {
        "title": "A worker & an arm",
        "summary": "",
        "table": [
            Measurement(name="separation violations", value=0, target=0),
            Measurement(name="contact force relative to its limit", value=0.41, target=1.0),
            Measurement(name="trials, cycle time (median)", value=38.2, unit="s"),
        ],
        "configuration": {"cell": {"safety": {"separation": {"mode": "ssm+pfl"}}}},
        "command": "hrc run collaboration --worker",
    }
    return Report(**values | changes)


def test_settings_and_metrics_exist():
    settings = flatten(asdict(CollaborationExperiment(aiming=ROOT, placing=ROOT)))
    measured = {metric.name for metric in collaboration_metrics(1, 0.0)}
    for clause in clauses():
        for name in clause.parameters:
            assert any(f".{key}".endswith(f".{name}") for key in settings), name
        assert set(clause.measured) <= measured
        assert "2025" in clause.standard
        assert clause.outside


def test_the_page_shows_values_settings_and_what_is_outside():
    page = evidence_page([run(), run(title="Second", table=run().table[:1])])
    assert "This is no certificate" in page
    assert "<code>safety.separation.mode</code> = ssm+pfl" in page
    assert "contact force relative to its limit 0.41" in page
    assert "Run 2" in page
    assert "A worker &amp; an arm" in page
    assert "emergency stop" in page
    assert "http" not in page.replace("http-equiv", "")
    table = [Measurement(name="separation violations", value=3, target=0)]
    missed = evidence_page([run(table=table)])
    assert "separation violations 3 (target ≤ 0: missed)" in missed


def test_a_run_without_people_is_no_evidence():
    alone = run(table=[Measurement(name="cycle time", value=3.0)])
    with pytest.raises(ValueError, match="hrc run collaboration --worker"):
        evidence_page([alone])


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ({"cell.safety.delay": 0.1, "page.safety.delay": 0.2}, [0.1]),
        ({"config.safety.delay": 0.1, "page.safety.delay": 0.2}, [0.1, 0.2]),
        ({"experiment.cell.safety.delay": 0.3, "safety.delay": 0.2}, [0.3]),
        ({"safety.delay": 0.2}, [0.2]),
        ({"unsafety.delay": 0.2, "safety.delayed": 0.1}, []),
    ],
)
def test_settings_of_the_work_cell_come_before_those_of_other_parts(settings, values):
    assert _ending(settings, "safety.delay") == values


def test_a_requirement_has_each_value_once_and_the_measurements_of_each_run():
    clause = Clause(
        standard="s",
        requirement="r",
        kept="k",
        parameters=["safety.mode", "delay"],
        test="t",
        measured=["force", "wait"],
        outside="o",
    )
    made = [
        run(
            configuration={"cell": {"safety": {"mode": mode}, "delay": 0.5}},
            table=[Measurement(name=name, value=k) for k, name in enumerate(names)],
        )
        for mode, names in (("a", ("wait", "other", "force")), ("b", ()), ("a", ("force",)))
    ]
    found = _filled(clause, made)
    assert found.parameters == [("safety.mode", ["a", "b"]), ("delay", ["0.5"])]
    assert [(number, [m.name for m in rows]) for number, rows in found.measured] == [
        (1, ["wait", "force"]),
        (2, []),
        (3, ["force"]),
    ]
    assert (found.standard, found.test) == ("s", "t")


def test_one_run_near_a_person_is_enough():
    alone = run(table=[Measurement(name="cycle time", value=3.0)])
    assert "Run 2" in evidence_page([alone, run()])
