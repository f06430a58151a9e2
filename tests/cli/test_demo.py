"""The demo as a chain of commands, and the models that other commands take from it."""

from pathlib import Path

import pytest
from commands import done, hrc

from hrc_learn.cli.commands import (
    _demo_models,
    fit_image_jacobian,
    fit_primitives,
    record_placing,
    record_servoing,
    run_collaboration,
)

STEPS = (record_placing, record_servoing, fit_primitives, fit_image_jacobian, run_collaboration)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What each command is asked to do, in turn; none of them does it."""
    asked = []

    def pretend(args):
        asked.append(args)
        args.out.mkdir(parents=True)
        return 0

    for step in STEPS:
        monkeypatch.setattr(step, "run", pretend)
    monkeypatch.chdir(tmp_path)
    return asked


def test_each_step_works_on_what_the_one_before_it_left(asked):
    outcome = done("demo", "--out", "new", "--shelf", "upper", "--json", "figures.json")
    placing, servoing, primitives, jacobian, job = asked
    assert primitives.dataset == placing.out
    assert jacobian.dataset == servoing.out
    assert (job.placing, job.aiming) == (primitives.out, jacobian.out)
    assert (job.shelf, job.json) == ("upper", Path("figures.json"))
    assert all(args.out.parent == Path("new") and args.overwrite for args in asked)
    assert [f"[{i}/5]" in outcome.output for i in range(7)] == [False, *[True] * 5, False]
    assert '"shelf": "upper"' in Path("new/configuration.json").read_text()


def test_a_demo_that_fails_fails_as_its_job(asked, monkeypatch):
    monkeypatch.setattr(run_collaboration, "run", lambda _: 1)
    assert hrc("demo").status == 1


def test_models_that_are_not_given_are_those_of_the_demo(asked):
    from rich.console import Console

    console = Console(quiet=True)
    assert _demo_models.model(Path("mine"), "placing", console) == Path("mine")
    assert not asked
    # They are learned once, both together.
    assert _demo_models.model(None, "placing", console) == Path("outputs/demo/placing")
    assert len(asked) == 4
    assert _demo_models.model(None, "aiming", console) == Path("outputs/demo/aiming")
    assert len(asked) == 4


def test_nothing_is_learned_for_a_run_that_finds_its_place_taken(asked, monkeypatch, tmp_path):
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    Path("outputs/placing").mkdir(parents=True)
    outcome = done("run", "placing", status=2)
    assert "outputs/placing exists" in outcome.error
    assert not Path("outputs/demo").exists()
