"""Options, figures and exit status of the commands that mend datasets."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from unchecked import shapes_unchecked

from hrc_learn.cli import dataset_commands
from hrc_learn.cli.arguments import Check, Curate, Import, Merge, Push, Repair
from hrc_learn.demos import RepairOptions
from hrc_learn.demos.quality.ranking import Decision


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


@pytest.fixture
def repaired(monkeypatch, tmp_path):
    """Options with which datasets were repaired, and what a killed process left."""
    calls: Any = SimpleNamespace(made=[], mended=[])
    report = SimpleNamespace(
        changes=[1, 2, 3], changed=2, left_out=[9], frames_before=100, frames=90
    )

    def repair_dataset(dataset, folder, options, *, mapping, units, progress):
        calls.made.append((dataset, folder, options, mapping, units))
        return report

    monkeypatch.setattr(dataset_commands, "repair_dataset", repair_dataset)
    monkeypatch.setattr(dataset_commands, "recover_all", lambda dataset: calls.mended)

    def run(**given):
        dataset_commands.repair(Repair(dataset=Path("set"), json=tmp_path / "j", **given))
        return json.loads((tmp_path / "j").read_text())

    calls.run = run
    return calls


DEFAULT = RepairOptions()


@pytest.mark.parametrize(
    ("given", "options"),
    [
        ({}, DEFAULT),
        ({"skip": ("trim",)}, RepairOptions(trim=False)),
        ({"skip": ("unwrap",)}, RepairOptions(unwrap=False)),
        ({"skip": ("signs",)}, RepairOptions(fix_signs=False)),
        ({"skip": ("late",)}, RepairOptions(drop_late=False)),
        ({"drop": ("repeats",)}, RepairOptions(drop_repeats=True)),
        ({"drop": ("bad-frames",)}, RepairOptions(drop_bad_frames=True)),
        ({"drop": ("bad-episodes",)}, RepairOptions(drop_bad_episodes=True)),
        (
            {"offsets": {"a": 2.0}, "fps": 20.0, "videos": False, "dry_run": True},
            RepairOptions(offsets={"a": 2.0}, fps=20.0, videos=False, dry_run=True),
        ),
    ],
)
def test_each_option_of_a_repair_changes_one_thing(repaired, given, options):
    values = repaired.run(**given, mapping={"gripper": "none"}, units={"position": "mm"})
    ((dataset, folder, found, mapping, units),) = repaired.made
    assert found == options
    assert (dataset, folder) == (Path("set"), Path("set_repaired"))
    assert (mapping, units) == ({"gripper": None}, {"position": "mm"})
    assert values == {
        "mended": 0,
        "episodes": 3,
        "episodes_changed": 2,
        "episodes_left_out": 1,
        "frames_before": 100,
        "frames": 90,
    }


@pytest.mark.parametrize(
    ("given", "copied", "mended"),
    [({}, False, 2), ({"out": Path("copy")}, True, 2), ({"dry_run": True}, True, 0)],
)
def test_what_a_killed_process_left_is_copied_only_if_a_folder_is_named(
    repaired, capsys, given, copied, mended
):
    repaired.mended = ["first mended", "second mended"]
    values = repaired.run(**given)
    assert bool(repaired.made) == copied
    assert values["mended"] == mended
    said = capsys.readouterr().out
    assert ("first mended\nsecond mended\n" in said) == bool(mended)


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    ("errors", "warnings", "moved", "status"),
    [(0, 0, False, 0), (2, 0, False, 1), (0, 3, False, "strict"), (0, 0, True, "strict")],
)
def test_a_check_fails_on_errors_and_if_strict_on_warnings_and_motion(
    monkeypatch, tmp_path, strict, errors, warnings, moved, status
):
    report = SimpleNamespace(
        errors=["e"] * errors,
        warnings=["w"] * warnings,
        episodes=4,
        frames=50,
        contract=None,
        lines=lambda full: ["all" if full else "some"],
        records=list,
    )
    monkeypatch.setattr(dataset_commands, "check_dataset", lambda *given, **more: report)
    monkeypatch.setattr(dataset_commands, "_camera_moved", lambda args: moved)
    (tmp_path / "meta").mkdir()
    args = Check(
        dataset=tmp_path,
        strict=strict,
        camera=True,
        json=tmp_path / "j",
        out=tmp_path / "out",
    )
    assert dataset_commands.check(args) == (int(strict) if status == "strict" else status)
    counts = {"errors": errors, "warnings": warnings, "episodes": 4, "frames": 50}
    counts["camera_moved"] = int(moved)
    assert json.loads((tmp_path / "j").read_text()) == counts
    assert json.loads((tmp_path / "out/metrics.json").read_text()) == counts
    assert not (tmp_path / "out/contract.json").exists()
    with pytest.raises(ValueError, match="no columns could be read"):
        dataset_commands.check(Check(dataset=tmp_path, keep_contract=True))


@pytest.mark.parametrize(
    ("groups", "moved", "said"),
    [
        ([], False, "visible in fewer than two episodes"),
        ([(0, 2)], False, "camera stood still in episodes 5, 7"),
        ([(0,), (1, 2)], True, "moved by 3 cm in episodes 6, 7"),
    ],
)
def test_placements_of_a_camera_name_their_episodes(monkeypatch, capsys, groups, moved, said):
    monkeypatch.setattr(
        dataset_commands,
        "load_demos",
        lambda *given, **more: [SimpleNamespace(episode=5 + k) for k in range(3)],
    )
    monkeypatch.setattr(dataset_commands, "feature_trajectories", list)
    placements = [SimpleNamespace(episodes=g, motion="moved by 3 cm") for g in groups]
    monkeypatch.setattr(dataset_commands, "camera_placements", lambda *given: placements)
    assert dataset_commands._camera_moved(Check(dataset=Path("set"))) is moved
    assert said in capsys.readouterr().out


@pytest.fixture
def curated(monkeypatch, tmp_path):
    """A ranking of five episodes of 100 frames, and decisions that were stored or written."""
    ranking = SimpleNamespace(
        episodes=[
            SimpleNamespace(episode=k, length=100, score=score, broken=score > 5)
            for k, score in enumerate((0.0, 0.1, 9.0, -1.0, 2.0))
        ],
        lines=lambda count: [f"{count} lines"],
    )
    calls: Any = SimpleNamespace(kept=[], written=[], stored={})
    monkeypatch.setattr(dataset_commands, "rank_episodes", lambda dataset, progress: ranking)
    monkeypatch.setattr(dataset_commands, "read_decisions", lambda dataset: dict(calls.stored))
    monkeypatch.setattr(
        dataset_commands, "keep_decisions", lambda dataset, made: calls.kept.append(made)
    )

    def write(dataset, folder, decisions, progress):
        calls.written.append((folder, decisions))
        return SimpleNamespace(frames=77)

    monkeypatch.setattr(dataset_commands, "write_curated", write)

    def run(**given):
        args = Curate(dataset=tmp_path / "set", json=tmp_path / "j", browser=False, **given)
        dataset_commands.curate(args)
        return json.loads((tmp_path / "j").read_text())

    calls.run = run
    return calls


def test_typed_decisions_are_stored_and_counted(curated, capsys):
    curated.stored = {4: Decision(verdict="reject", length=100)}
    values = curated.run(accept=(0,), reject=(1, 3), cut={2: "30:80"})
    (kept,) = curated.kept
    assert kept == {
        0: Decision(verdict="accept", length=100),
        1: Decision(verdict="reject", length=100),
        2: Decision(verdict="cut", length=100, start=30, stop=80),
        3: Decision(verdict="reject", length=100),
        4: Decision(verdict="reject", length=100),
    }
    assert values == {
        "episodes": 5,
        "episodes_in_doubt": 3,
        "episodes_broken": 1,
        "episodes_rejected": 3,
        "episodes_cut": 1,
    }
    said = capsys.readouterr().out
    assert "20 lines" in said
    assert "--write makes the cleaned dataset" in said
    assert curated.written == []


def test_without_decisions_nothing_is_stored_and_a_copy_has_all(curated, capsys):
    curated.run()
    assert curated.kept == []
    assert "decisions stored" not in capsys.readouterr().out
    values = curated.run(write=True)
    ((folder, decisions),) = curated.written
    assert (folder.name, decisions) == ("set_curated", {})
    assert values["frames"] == 77


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"accept": (1,), "reject": (1,)}, "name episode 1 twice"),
        ({"reject": (3, 2, 3, 2)}, "name episode 2 twice"),
        ({"reject": (5,)}, "there is no episode 5; the dataset has 0 to 4"),
        ({"cut": {2: "30"}}, "--cut 2 30: give the first frame to keep"),
        ({"cut": {2: "a:b"}}, "the episode has 100"),
        ({"cut": {2: "30:31"}}, "must keep two frames"),
        ({"cut": {2: "30:101"}}, "must keep two frames"),
    ],
)
def test_decisions_that_cannot_be_are_refused(curated, given, message):
    with pytest.raises(ValueError, match=message):
        curated.run(**given)
    assert curated.kept == []


@pytest.mark.parametrize("screen", [True, False])
def test_a_page_returns_the_decisions_made_there(curated, monkeypatch, tmp_path, screen):
    from hrc_learn.teleoperation import curation_page

    opened = []

    class Page:
        url = "http://page"
        decisions: ClassVar = {1: Decision(verdict="reject", length=100)}

        def __init__(self, ranking, folder, address):
            self.port = address.port

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def wait(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(curation_page, "CurationPage", Page)
    monkeypatch.setattr(dataset_commands, "has_screen", lambda: screen)
    browser = SimpleNamespace(open=opened.append)
    monkeypatch.setattr(dataset_commands, "webbrowser", browser)
    dataset_commands.curate(Curate(dataset=tmp_path / "set", json=tmp_path / "j"))
    assert json.loads((tmp_path / "j").read_text())["episodes_rejected"] == 1
    assert opened == ["http://page"] * screen


def test_a_merge_counts_what_it_wrote(monkeypatch, tmp_path, capsys):
    report = SimpleNamespace(episodes=7, frames=70, tasks=2, notes=["n"])
    calls = []

    def merge(datasets, out, **more):
        calls.append((datasets, out, more))
        return report

    monkeypatch.setattr(dataset_commands, "merge_datasets", merge)
    args = Merge(datasets=(Path("a"), Path("b")), out=Path("c"), json=tmp_path / "j")
    dataset_commands.merge(args)
    assert json.loads((tmp_path / "j").read_text()) == {
        "episodes": 7,
        "frames": 70,
        "tasks": 2,
        "notes": 1,
    }
    ((datasets, out, _),) = calls
    assert (datasets, out) == ((Path("a"), Path("b")), Path("c"))


@pytest.mark.parametrize("unsound", [True, False])
@pytest.mark.parametrize("errors", [0, 2])
def test_a_dataset_with_errors_is_uploaded_only_if_asked(
    monkeypatch, tmp_path, capsys, unsound, errors
):
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/meta/info").write_bytes(b"x" * 1_500_000)
    (tmp_path / "set/data").write_bytes(b"y" * 100_000)
    report = SimpleNamespace(errors=["first", "second"][:errors], warnings=["w"])
    monkeypatch.setattr(dataset_commands, "check_dataset", lambda dataset: report)
    args = Push(
        dataset=tmp_path / "set",
        repo="a/b",
        dry_run=True,
        unsound=unsound,
        json=tmp_path / "j",
    )
    if errors and not unsound:
        with pytest.raises(ValueError, match=r"has errors: repair it.*first$"):
            dataset_commands.push(args)
        return
    monkeypatch.setitem(sys.modules, "lerobot.datasets", None)  # nothing is uploaded
    assert dataset_commands.push(args) == 0
    assert "2 files, 1.6 MB" in capsys.readouterr().out
    assert json.loads((tmp_path / "j").read_text()) == {
        "files": 2,
        "bytes": 1_600_000,
        "errors": errors,
        "warnings": 1,
    }


def test_options_of_an_import_come_before_those_of_the_mapping_file(tmp_path):
    mapping = tmp_path / "map.json"
    mapping.write_text(
        json.dumps(
            {
                "columns": {"joint_position": ["q"], "gripper": ["g"]},
                "units": {"joint_position": "deg", "position": "mm"},
                "time": "t",
                "fps": 10.0,
                "task": "pour",
            }
        )
    )
    plain = dataset_commands._import_options(Import(files=()), mapping)
    assert plain.columns == {"joint_position": ["q"], "gripper": ["g"]}
    assert (plain.time, plain.fps, plain.task) == ("t", 10.0, "pour")
    args = Import(
        files=(),
        joints=("a,b", "c"),
        orientation=("o",),
        quaternion_order="xyzw",
        units={"position": "cm"},
        time="stamp",
        fps=20.0,
        task="",
        joint_names=("x,y",),
        duration=3.0,
    )
    said = dataset_commands._import_options(args, mapping)
    assert said.columns == {
        "joint_position": ["a", "b", "c"],
        "gripper": ["g"],
        "quaternion_xyzw": ["o"],
    }
    assert said.units == {"joint_position": "deg", "position": "cm"}
    assert (said.time, said.fps, said.task, said.duration) == ("stamp", 20.0, "", 3.0)
    assert said.joint_names == ("x", "y")
    for name in ("fps", "duration"):
        with pytest.raises(ValueError, match=f"{name} must be positive, but is 0"):
            dataset_commands._import_options(Import(files=(), **{name: 0.0}), mapping)
