"""`hrc run` and `hrc demo`: experiments that options make, models learned when needed."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from unchecked import shapes_unchecked

from hrc_learn.cli import (
    experiment_commands,
    fit_command,
    image_jacobian_commands,
    record_command,
)
from hrc_learn.cli.arguments import Demo, FitPrimitives, Record, Run, WithRobot
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.placing_experiment import PlacingExperiment, dataset_of
from hrc_learn.kinematics import ArmChoice
from hrc_learn.sim import CameraChange, Imperfections
from hrc_learn.sim.scene import UnmarkedLook

FOLDERS = {name: Path("/models") / name for name in ("placing", "aiming")}


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


@pytest.fixture
def ran(monkeypatch):
    """Experiments that were run, with their options, in place of running them."""
    found = []

    def run_experiment(experiment, options, *, command):
        found.append((experiment, options))
        return 5

    monkeypatch.setattr(experiment_commands, "run_experiment", run_experiment)
    monkeypatch.setattr(experiment_commands, "dataset_of", lambda folder: folder / "shown")
    monkeypatch.setattr(experiment_commands, "_models", models)
    return found


def models(args):
    needed = {"placing": ["placing"], "grasping": ["aiming"]}
    return {k: FOLDERS[k] for k in needed.get(args.experiment, FOLDERS)}


def experiment_of(ran, **given):
    assert experiment_commands.run(Run(**given)) == 5
    return ran.pop()


def test_plain_experiments_are_the_defaults_of_the_paper(ran, tmp_path):
    placing, options = experiment_of(ran, experiment="placing", out=tmp_path / "new")
    nominal = Imperfections.nominal()
    common = {"imperfections": nominal, "arm": "sim", "robot": ArmChoice("panda")}
    shown = FOLDERS["placing"] / "shown"
    assert placing == PlacingExperiment(
        placing=FOLDERS["placing"], demonstrations=shown, **common
    )
    assert (options.out, options.seed, options.trials) == (tmp_path / "new", 0, 0)
    assert (options.processes, options.film, options.serve) == (1, True, False)
    assert (options.overwrite, options.json) == (False, None)
    grasping, options = experiment_of(ran, experiment="grasping")
    assert options.out == Path("outputs/grasping")
    assert isinstance(grasping, GraspingExperiment)
    assert (grasping.aiming, grasping.camera) == (FOLDERS["aiming"], "auto")
    assert grasping.page is grasping.look is None
    assert grasping.imperfections == nominal
    job, _ = experiment_of(ran, experiment="collaboration")
    assert isinstance(job, CollaborationExperiment)
    assert (job.shelves, job.pulls) == (("middle",), "scripted")
    assert (job.worker, job.handover, job.page) == (False, False, None)
    assert job.disturbances.camera_change is None


def test_options_change_the_experiment_they_belong_to(ran, tmp_path):
    job, options = experiment_of(
        ran,
        experiment="collaboration",
        out=tmp_path,
        overwrite=True,
        seed=7,
        trials=4,
        camera="synthetic",
        shelf=("upper", "lower"),
        pulls="random",
        camera_moved=True,
        worker=True,
        page=True,
        serve=True,
        markerless=True,
        imperfections=2.0,
        json=tmp_path / "j",
        config=("processes=3", "film=false"),
    )
    assert (job.shelves, job.pulls, job.camera) == (("upper", "lower"), "random", "synthetic")
    assert job.worker
    assert not job.handover
    assert job.page is not None
    assert job.look == UnmarkedLook()
    assert job.disturbances.camera_change == CameraChange()
    assert job.imperfections == Imperfections.nominal().scaled(2.0)
    assert (options.seed, options.trials, options.processes) == (7, 4, 3)
    assert (options.film, options.serve, options.overwrite) == (False, True, True)
    assert options.json == tmp_path / "j"
    job, _ = experiment_of(ran, experiment="collaboration", handover=True, ideal=True)
    assert job.handover
    assert job.imperfections == Imperfections.nominal().scaled(0.0)


def test_an_arm_without_null_space_is_not_pulled(ran, capsys):
    job, _ = experiment_of(ran, experiment="collaboration", robot="ur5e")
    assert job.pulls == "none"
    said = capsys.readouterr().out
    assert "ur5e needs all its 6 joints" in said
    job, _ = experiment_of(ran, experiment="collaboration", robot="ur5e", pulls="none")
    assert job.pulls == "none"
    job, _ = experiment_of(ran, experiment="collaboration", pulls="random")
    assert job.pulls == "random"
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"experiment": "placing", "worker": True}, "hrc run collaboration"),
        ({"experiment": "placing", "camera": "egl"}, "hrc run grasping, collaboration"),
        ({"experiment": "grasping", "pulls": "none"}, "hrc run collaboration"),
        ({"experiment": "grasping", "imperfections": -0.1}, "not be negative, but is -0.1"),
        (
            {"experiment": "grasping", "camera": "film.mp4"},
            "the cameras",
        ),
        ({"experiment": "placing", "arm": "lerobot"}, "does not support --arm lerobot"),
        ({"experiment": "placing", "arm": "franky", "ip": "1.2.3.4", "trials": 2}, "simulated"),
    ],
)
def test_options_of_other_experiments_and_bad_values_are_refused(ran, given, message):
    with pytest.raises(ValueError, match=message):
        experiment_commands.run(Run(**given))
    assert ran == []


def test_wrong_numbers_are_refused_before_models_are_learned(ran, monkeypatch):
    learned = []
    monkeypatch.setattr(experiment_commands, "_models", learned.append)
    with pytest.raises(ValueError, match="--trials must not be negative, but is -1"):
        experiment_commands.run(Run(experiment="placing", trials=-1))
    assert learned == []


def test_existing_results_are_not_overwritten_unasked(ran, tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError):
        experiment_commands.run(Run(experiment="placing", out=tmp_path / "there"))


@pytest.mark.parametrize("failure", ["", "the arm stopped"])
@pytest.mark.parametrize("experiment", ["placing", "grasping"])
@pytest.mark.parametrize("camera", ["auto", "/dev/video7"])
def test_a_real_arm_gets_task_camera_and_address(
    ran, monkeypatch, tmp_path, capsys, failure, experiment, camera
):
    calls: dict[str, Any] = {"closed": 0}

    class Camera:
        def __init__(self, source, *, delay):
            calls["camera"] = source, delay

        def close(self):
            calls["closed"] += 1

    def run_on_arm(site, workplace, task, *, camera, on_phase):
        calls["site"], calls["given"] = site, (workplace, task)
        assert calls["closed"] == 0
        on_phase("approach", 12.345)
        save = lambda *given: calls.update(saved=given)  # noqa: E731
        return SimpleNamespace(failure=failure, save=save, duration=4.5)

    def task_of(experiment, shelf):
        calls["shelf"] = shelf
        return "workplace", "task"

    monkeypatch.setattr(experiment_commands, "CaptureCamera", Camera)
    monkeypatch.setattr(experiment_commands, "run_on_arm", run_on_arm)
    monkeypatch.setattr(experiment_commands, "task_of", task_of)
    args = Run(
        experiment=experiment,
        out=tmp_path / "run",
        arm="franky",
        ip="1.2.3.4",
        config=("site.camera_delay=0.03",),
        json=tmp_path / "values.json",
    )
    if experiment == "grasping":
        args = replace(args, camera=camera)
    else:
        args = replace(args, shelf=("upper",))
    assert experiment_commands.run(args) == (1 if failure else 0)
    assert ran == []
    assert calls["given"] == ("workplace", "task")
    assert calls["shelf"] == ("middle" if experiment == "grasping" else "upper")
    values = json.loads((tmp_path / "values.json").read_text())
    assert values == {"duration_s": 4.5, "failed": int(bool(failure))}
    assert (calls["site"].driver, calls["site"].ip) == ("franky", "1.2.3.4")
    if experiment == "grasping":
        assert calls["camera"] == ("0" if camera == "auto" else camera, 0.03)
    assert calls["closed"] == (experiment == "grasping")
    folder, title, configuration = calls["saved"]
    assert (folder, title) == (tmp_path / "run", "franky at 1.2.3.4")
    assert configuration["experiment"] == experiment
    said = capsys.readouterr().out
    assert " 12.35 s  approach" in said or " 12.34 s  approach" in said
    assert (failure or "done") in said
    assert f"hrc show {tmp_path / 'run'}\n" in said.split("Dashboard: ")[1]


@pytest.fixture
def learned(monkeypatch, tmp_path):
    """Steps of learning, each of which writes a file into its folder."""
    steps: list[tuple[str, Any]] = []

    def write(folder, text):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "file").write_text(text)

    def record(args):
        steps.append((args.demonstration, args))
        write(args.out, f"{args.demonstration} {args.robot}")
        return 0

    def fit(kind):
        def fitted(args):
            steps.append((kind, args))
            write(args.out, kind)

        return fitted

    # Learning depends on the code of a package, here of one file.
    package = tmp_path / "package"
    write(package / "cli", "")
    (package / "code.py").write_text("1")
    monkeypatch.setattr(experiment_commands, "__file__", str(package / "cli/commands.py"))
    monkeypatch.setattr(record_command, "record", record)
    monkeypatch.setattr(fit_command, "fit_primitives", fit("primitives"))
    monkeypatch.setattr(image_jacobian_commands, "fit_image_jacobian", fit("jacobian"))
    return steps


ALL = ["placing", "servoing", "primitives", "jacobian"]


def names(steps):
    found = [name for name, _ in steps]
    steps.clear()
    return found


@pytest.mark.parametrize("markerless", [False, True])
def test_learning_records_then_fits_and_repeats_what_has_changed(learned, tmp_path, markerless):
    out, console = tmp_path / "demo", Console(width=200)

    def learn(**more):
        with console.capture() as said:
            experiment_commands.learn(out, console, markerless=markerless, **more)
        return names(learned), said.get()

    given, said = dict(learned), ""
    experiment_commands.learn(out, console, markerless=markerless)
    given = dict(learned)
    assert names(learned) == ALL
    watched = out / ("aiming_films" if markerless else "aiming_demos")
    aiming = out / ("aiming_markerless" if markerless else "aiming")
    assert given["placing"] == Record(
        demonstration="placing", out=out / "placing_demos", overwrite=True
    )
    film = ("demonstration.markerless=true",) if markerless else ()
    assert given["servoing"].out == watched
    assert given["servoing"].config == film
    assert given["primitives"] == FitPrimitives(
        dataset=out / "placing_demos", out=out / "placing", overwrite=True
    )
    assert (given["jacobian"].dataset, given["jacobian"].out) == (watched, aiming)
    assert given["jacobian"].markerless is markerless
    done, said = learn()
    assert done == []
    assert [line.split(":")[0] for line in said.splitlines()] == [
        "[1/4] Demonstrations of placing",
        "[2/4] Demonstrations of servoing with an uncalibrated camera",
        "[3/4] Movement primitives of placing",
        "[4/4] Image Jacobian of servoing",
    ]
    assert said.count("up to date in") == 4
    assert learn(again=True)[0] == ALL
    # What is changed by hand is made anew; what reads it sees the same again.
    (out / "placing_demos/file").write_text("other")
    assert learn()[0] == ["placing"]
    (out / "placing/file").unlink()
    assert learn()[0] == ["primitives"]
    (aiming / "more").write_text("")
    assert learn()[0] == ["jacobian"]
    assert learn(robot=WithRobot(robot="fr3"))[0] == ALL
    learn()
    (tmp_path / "package/page.html").write_text("")
    (tmp_path / "mine.py").write_text("")
    assert learn()[0] == []
    (tmp_path / "package/limits.toml").write_text("")
    assert learn()[0] == ALL
    mine = WithRobot(robot=f"{tmp_path / 'arm.urdf'}:tip")
    for text in ("<robot/>", "<robot></robot>"):
        (tmp_path / "arm.urdf").write_text(text)
        assert learn(robot=mine)[0] == ALL
    assert learn(robot=mine)[0] == []
    learn()
    (tmp_path / "package/code.py").write_text("2")
    assert learn()[0] == ALL
    (out / "steps.json").write_text("{")
    done, said = learn(steps=5)
    assert done == ALL
    assert said.startswith("[1/5] Demonstrations of placing\n")


def test_a_lost_dataset_of_a_placing_skill_can_be_named_anew(ran, monkeypatch, tmp_path):
    (tmp_path / "made_by.json").write_text(json.dumps({"dataset": str(tmp_path / "lost")}))
    monkeypatch.setattr(experiment_commands, "dataset_of", dataset_of)
    monkeypatch.setattr(experiment_commands, "_models", lambda args: {"placing": tmp_path})
    config = (f"experiment.demonstrations={tmp_path / 'found'}",)
    placing, _ = experiment_of(ran, experiment="placing", out=tmp_path / "a", config=config)
    assert placing.demonstrations == tmp_path / "found"


def test_an_expert_that_fails_ends_learning(learned, monkeypatch, tmp_path):
    monkeypatch.setattr(record_command, "record", lambda args: 1)
    with pytest.raises(RuntimeError, match="failed to demonstrate placing"):
        experiment_commands.learn(tmp_path, Console())


def test_a_checksum_is_of_names_and_contents_in_folders_below(tmp_path):
    def digest(pattern="*"):
        return experiment_commands._digest(tmp_path / "a", pattern)

    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/x.py").write_text("1")
    first = digest()
    assert digest() == first
    (tmp_path / "a/b/y").write_text("2")
    second = digest()
    assert second != first
    assert digest("*.py") == first
    (tmp_path / "a/b/y").rename(tmp_path / "a/b/z")
    assert digest() not in (first, second)
    (tmp_path / "a/b/z").unlink()
    assert digest() == first
    (tmp_path / "a/b/x.py").write_text("2")
    assert digest() != first


@pytest.mark.parametrize("experiment", ["placing", "grasping", "collaboration"])
def test_models_that_are_missing_are_those_of_the_demo(
    monkeypatch, tmp_path, capsys, experiment
):
    monkeypatch.chdir(tmp_path)
    made = []

    def learn(out, console, *, markerless):
        made.append((out, markerless))

    monkeypatch.setattr(experiment_commands, "learn", learn)
    home = Path("outputs/demo").resolve()
    needed = {
        "placing": {"placing"},
        "grasping": {"aiming"},
        "collaboration": {"placing", "aiming"},
    }[experiment]

    def find(**given):
        found = experiment_commands._models(Run(experiment=experiment, **given))
        assert set(found) == needed
        return found

    assert find() == {k: home / k for k in needed}
    assert made == [(Path("outputs/demo"), False)]
    assert "models are learned first" in capsys.readouterr().out
    # Not learned if there are models, or if they are named.
    given = {k: tmp_path / f"my {k}" for k in needed}
    assert find(**given) == given
    for name in needed:
        (home / name).mkdir(parents=True)
    assert find() == {k: home / k for k in needed}
    assert len(made) == 1
    assert capsys.readouterr().out == ""
    if experiment != "placing":
        assert find(markerless=True)["aiming"] == home / "aiming_markerless"
        assert made[1:] == [(Path("outputs/demo"), True)]


def test_models_of_another_arm_are_not_learned_unasked(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="hrc demo --robot ur5e --out FOLDER"):
        experiment_commands._models(Run(experiment="grasping", robot="ur5e"))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("markerless", [False, True])
def test_the_demo_learns_and_runs_the_whole_job(ran, learned, tmp_path, markerless):
    out = tmp_path / "demo"
    args = Demo(out=out, seed=3, shelf="upper", markerless=markerless, ideal=True)
    assert experiment_commands.demo(args) == 5
    assert names(learned) == ALL
    ((job, options),) = ran
    assert (job.shelves, options.seed, options.out) == (("upper",), 3, out / "run")
    assert options.overwrite
    assert (job.look is not None) == markerless
    assert job.imperfections == Imperfections.nominal().scaled(0.0)
    assert json.loads((out / "configuration.json").read_text())["seed"] == 3
    experiment_commands.demo(args)
    assert names(learned) == []
    experiment_commands.demo(replace(args, overwrite=True, robot="fr3"))
    assert names(learned) == ALL
