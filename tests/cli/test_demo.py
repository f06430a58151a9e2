"""The demo as a chain of commands, and the models that other commands take from it."""

import math
from pathlib import Path

import pytest
from commands import done, hrc

from hrc_learn.cli.commands import fit, record, run
from hrc_learn.protocols import DrawnRegion

STEPS = (
    (record, "record_placing"),
    (record, "record_servoing"),
    (fit, "fit_primitives"),
    (fit, "fit_image_jacobian"),
)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """What each command is asked to do, in turn; none of them does it."""
    asked = []

    def pretend(args):
        asked.append(args)
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "made").write_text(type(args).__name__)
        return 0

    for module, step in STEPS:
        monkeypatch.setattr(module, step, pretend)
    monkeypatch.chdir(tmp_path)
    return asked


@pytest.fixture
def conducted(monkeypatch):
    """Each experiment and its options, in turn; none of them is carried out."""
    conducted = []

    def pretend(experiment, options, **_):
        conducted.append((experiment, options))
        return 0

    monkeypatch.setattr(run, "conduct", pretend)
    return conducted


def test_each_step_works_on_what_the_one_before_it_left(asked, conducted):
    outcome = done("demo", "--out", "new", "--shelf", "upper", "--json", "figures.json")
    placing, servoing, primitives, jacobian = asked
    ((job, options),) = conducted
    assert primitives.dataset == placing.out
    assert jacobian.dataset == servoing.out
    assert (job.placing, job.aiming) == (primitives.out.resolve(), jacobian.out.resolve())
    assert (job.shelves, options.json) == (("upper",), Path("figures.json"))
    for step in (*asked, options):
        assert step.out.parent == Path("new")
        assert step.overwrite
    assert [f"[{i}/5]" in outcome.output for i in range(7)] == [False, *[True] * 5, False]
    assert '"shelf": "upper"' in Path("new/configuration.json").read_text()


def test_a_second_demo_does_only_what_is_not_there_unchanged(asked, conducted):
    def done_again(*options):
        asked.clear()
        done("demo", "--out", "new", *options)
        return [args.out.name for args in asked]

    every = ["placing_demos", "aiming_demos", "placing", "aiming"]
    assert done_again() == every
    assert done_again("--shelf", "upper", "--seed", 3) == []
    assert len(conducted) == 2
    # Somebody records more: what was learned from that is learned again, and nothing else.
    Path("new/placing_demos/more").write_text("a demonstration")
    assert done_again() == ["placing_demos", "placing"]
    assert done_again() == []
    Path("new/aiming/made").unlink()
    assert done_again() == ["aiming"]
    assert done_again("--robot", "fr3") == every
    assert done_again("--robot", "fr3", "--again") == every
    Path("new/steps.json").write_text("no JSON")
    assert done_again("--robot", "fr3") == every


def test_other_code_does_all_again(asked, conducted, monkeypatch):
    done("demo", "--out", "new")
    monkeypatch.setattr("hrc_learn.cli._ledger.software_versions", lambda: {"torch": "other"})
    done("demo", "--out", "new")
    assert len(asked) == 8


def test_a_demo_that_fails_fails_as_its_job(asked, monkeypatch):
    monkeypatch.setattr(run, "conduct", lambda *_, **__: 1)
    assert hrc("demo").status == 1


def test_models_that_are_not_given_are_those_of_the_demo(asked, conducted, tmp_path):
    models = tmp_path / "outputs" / "demo"
    done("run", "placing", "--placing", "mine", "--demonstrations", "shown")
    assert conducted[-1][0].placing == tmp_path / "mine"
    assert not asked
    # They are learned once, both together.
    done("run", "placing", "--demonstrations", "shown")
    assert conducted[-1][0].placing == models / "placing"
    assert len(asked) == 4
    done("run", "grasping")
    assert conducted[-1][0].aiming == models / "aiming"
    done("run", "collaboration", "--aiming", "mine")
    assert conducted[-1][0].placing == models / "placing"
    assert conducted[-1][0].aiming == tmp_path / "mine"
    assert len(asked) == 4


def test_a_scripted_person_draws_as_the_command_says(asked, conducted):
    drawn = (
        *("--draw-region", 3, 7, 0.35, 0.3, 0.3, 0.06, 0.07, 0.05),
        *("--mark-target", 4, 5, 0.37, 0.33, 0.32, "--turn-tool", 4, 5, 0, 0, 90),
    )
    for command in ("grasping", "collaboration"):
        models = ("--aiming", "mine", "--placing", "mine")[: 2 if command == "grasping" else 4]
        done("run", command, *drawn, *models, "--page")
        experiment = conducted[-1][0]
        region, target, turn = experiment.drawings
        assert (region.start, region.duration) == (3, 7)
        assert region.region == DrawnRegion(
            centre=(0.35, 0.3, 0.3), half_size=(0.06, 0.07, 0.05)
        )
        assert (target.target, target.region) == ((0.37, 0.33, 0.32), None)
        assert turn.turn == (0.0, 0.0, math.pi / 2)
        assert experiment.page is not None


def test_nothing_is_learned_for_a_run_that_finds_its_place_taken(asked, tmp_path):
    Path("outputs/placing").mkdir(parents=True)
    outcome = done("run", "placing", status=2)
    assert "outputs/placing exists" in outcome.error
    assert not asked
    assert not Path("outputs/demo").exists()
