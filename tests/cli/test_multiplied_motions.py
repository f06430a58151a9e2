"""Random choices, planned motions, judges and figures of `hrc multiply`."""

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.cli import image_jacobian_commands, multiply_command
from hrc_learn.cli.arguments import Evaluate, FitImageJacobian, Multiply, columns
from hrc_learn.cli.multiply_command import (
    Multiplication,
    MultiplyConfig,
    ObjectConfig,
    Settings,
    _between_cells,
    _judge,
)
from hrc_learn.experiments.motion_judge import JudgeConfig, Trial
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import ArmChoice, arm
from hrc_learn.sim.workplace import Workplace


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


@pytest.mark.parametrize(
    ("given", "refused"),
    [
        ({"style": 0.0}, False),
        ({"style": 1.0}, False),
        ({"style": -0.01}, True),
        ({"style": 1.01}, True),
        ({"speed": (1.0, 1.0)}, False),
        ({"speed": (0.001, 2.0)}, False),
        ({"speed": (0.0, 1.0)}, True),
        ({"speed": (1.1, 1.0)}, True),
    ],
)
def test_style_is_a_fraction_and_speed_a_range_above_zero(given, refused):
    if refused:
        with pytest.raises(ValueError, match=r"must be"):
            MultiplyConfig(**given)
    else:
        MultiplyConfig(**given)


def job(objects=None, **config):
    """What random choices depend on: three demonstrations of two objects."""
    positions = torch.tensor([[0.1, 0.2, 0.3], [0.3, 0.2, 0.4], [0.2, 0.6, 0.35]]).double()
    turns = quaternion.exp(torch.tensor([[0.0, 0, 0.1], [0, 0, 0.2], [0, 0, 0.3]]).double())
    settings = Settings(multiply=MultiplyConfig(**config), objects=objects or {})
    made: Any = SimpleNamespace(
        config=settings.multiply,
        settings=settings,
        demos=["a", "b", "c"],
        objects={"box": Pose(positions, turns), "lid": Pose(positions + 1.0, turns)},
    )
    made.draw = lambda attempts: Multiplication.draw(made, attempts)
    return made


def yaws(pose):
    rotation = Rotation.from_quat(pose.orientation.numpy(), scalar_first=True)
    return rotation.as_rotvec()[:, 2]


def test_choices_fill_the_ranges_of_the_demonstrations():
    draws = job(style=0.3, speed=(0.8, 1.25), start=0.02).draw(range(400))
    for name, shift in (("box", 0.0), ("lid", 1.0)):
        place = draws.scene[name].position.numpy() - shift
        low, high = np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.6, 0.4])
        assert (place >= low).all()
        assert (place <= high).all()
        np.testing.assert_allclose(place.min(axis=0), low, atol=0.02)
        np.testing.assert_allclose(place.max(axis=0), high, atol=0.02)
        # Without a range of turns an object is turned as in one of the demonstrations.
        np.testing.assert_allclose(np.unique(yaws(draws.scene[name]).round(6)), (0.1, 0.2, 0.3))
    # Objects are placed independently.
    a, b = (draws.scene[name].position.numpy() for name in ("box", "lid"))
    assert np.abs(np.corrcoef(a[:, 0], b[:, 0])[0, 1]) < 0.2
    weights = draws.weights.numpy()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert (weights >= 0).all()
    main = weights.max(axis=1)
    assert (main >= 0.7).all()
    assert main.min() < 0.75
    assert np.bincount(weights.argmax(axis=1), minlength=3).min() > 80
    speed = draws.speed.numpy()
    assert 0.8 <= speed.min() < 0.82
    assert 1.23 < speed.max() <= 1.25
    start = draws.start.numpy()
    np.testing.assert_allclose(np.abs(start).max(axis=0), 0.02, atol=5e-4)
    np.testing.assert_allclose(start.min(axis=0), -0.02, atol=5e-4)


def test_ranges_that_are_given_replace_those_of_the_demonstrations():
    given = ObjectConfig(x=(0.5, 0.6), z=(-0.1, 0.0), yaw=(-0.4, 0.8))
    draws = job({"box": given}, style=0.0).draw(range(300))
    place = draws.scene["box"].position.numpy()
    for axis, (low, high) in enumerate(((0.5, 0.6), (0.2, 0.6), (-0.1, 0.0))):
        assert low <= place[:, axis].min() < low + 0.02
        assert high - 0.02 < place[:, axis].max() <= high
    other = draws.scene["lid"].position.numpy()
    assert other[:, 0].max() < 1.31
    weights = draws.weights.numpy()
    np.testing.assert_array_equal(np.sort(weights, axis=1), [[0.0, 0.0, 1.0]] * 300)
    # The turn is added to the one of the demonstration that is followed.
    turn = yaws(draws.scene["box"]) - np.array([0.1, 0.2, 0.3])[weights.argmax(axis=1)]
    assert -0.4 <= turn.min() < -0.35
    assert 0.75 < turn.max() <= 0.8


def test_an_attempt_is_the_same_in_any_chunk_and_differs_by_the_seed():
    whole, part = job().draw(range(10)), job().draw(range(7, 9))
    np.testing.assert_array_equal(whole.speed[7:9], part.speed)
    np.testing.assert_array_equal(whole.scene["box"].position[7:9], part.scene["box"].position)
    assert len(np.unique(whole.speed)) == 10
    assert not np.array_equal(job(seed=1).draw(range(10)).speed, whole.speed)


def test_a_plan_has_the_moving_objects_of_the_demonstration():
    q = panda.ready + 0.1 * torch.arange(3).double()[:, None]
    motion, objects = SimpleNamespace(joints=q), {"box": np.ones(7)}
    columns = SimpleNamespace(object_paths=lambda *given: given)
    made: Any = SimpleNamespace(columns=columns)
    trial = Trial(joints=q.numpy(), gripper=np.zeros(3), objects=objects)
    replay = Multiplication._planned(made, motion, trial)  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(replay.joints, q)
    np.testing.assert_array_equal(replay.sent, q[[1, 2, 2]])
    assert replay.objects == (motion, objects)
    assert (replay.gripper, replay.failure) == (None, "")


@pytest.mark.parametrize(
    ("scene", "task", "judged"),
    [
        ("", "place the box on the upper shelf", ("placing", "upper")),
        ("", "place the box on the lower shelf", ("placing", "lower")),
        ("", "grasp the box and lift it", ("grasping", "middle")),
        ("", "pour the tea", ("", "middle")),
        ("none", "grasp the box and lift it", ("", "middle")),
        ("mine.xml", "grasp the box and lift it", ("mine.xml", "middle")),
    ],
)
def test_the_judge_is_the_scenario_that_the_task_names(scene, task, judged):
    found = _judge(JudgeConfig(scene=scene), task)
    assert (found.scene, found.shelf) == judged
    words = Multiplication.judged_by.fget(SimpleNamespace(judge=found))
    assert (f"physics: {judged[0]}" == words) == bool(judged[0])
    assert ("without physics" in words) == (not judged[0])


@pytest.mark.parametrize("scene", ["placing", "grasping"])
@pytest.mark.parametrize("hand", [1.0, 0.5])
def test_a_task_moves_with_the_shelf_or_the_table_of_the_work_cell(scene, hand):
    """Its ends do; distances from them are scaled with the hand."""
    old, new = Workplace.of(arm("panda")), Workplace.of(arm("fr3"))
    other: Any = SimpleNamespace(
        robot=SimpleNamespace(hand_size=hand * old.robot.hand_size),
        shelf=lambda name: Pose(new.shelf(name).position + 0.25, new.home().orientation),
        hover=lambda: Pose(new.hover().position + 0.5, new.home().orientation),
    )
    with pytest.MonkeyPatch.context() as patch:
        cells = {"old": old, "new": other}
        patch.setattr(multiply_command, "Workplace", SimpleNamespace(of=cells.__getitem__))
        judge = JudgeConfig(scene=scene, shelf="upper")
        job: Any = SimpleNamespace(robot="new", judge=judge, config=MultiplyConfig())
        moved = _between_cells("old", job)
    if scene == "placing":
        there, expected = old.shelf("upper"), new.shelf("upper").position + 0.25
    else:
        there, expected = old.hover(), new.hover().position + 0.5
        # The table is as high as before.
        there = Pose(there.position * torch.tensor([1, 1, 0]), there.orientation)
        expected = expected * torch.tensor([1, 1, 0])
    assert moved(there).position.tolist() == pytest.approx(expected.tolist())
    beside = moved(Pose(there.position + 0.1, there.orientation)).position
    assert (beside - expected).tolist() == pytest.approx(3 * [0.1 * hand])
    assert torch.equal(moved(there).orientation, there.orientation)


class Writer:
    """Keeps what is written; what was written before is known."""

    def __init__(self, before=()):
        self.provenance = list(before)

    def __call__(self, *given):
        return self

    def claimed(self):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def write(self, values, task, origin):
        self.provenance.append(origin)


def work(monkeypatch, outcomes, wanted, before=()):
    """Reasons of failures by the outcome of each attempt: "" is a success."""
    asked, writer = [], Writer(before)

    def attempts(chunk, judge):
        asked.append(chunk)
        for k in chunk:
            reason = outcomes(k)
            yield k, reason or (("values",), "task", {"attempt": k})

    monkeypatch.setattr(multiply_command, "MultipliedWriter", writer)
    job: Any = SimpleNamespace(
        args=SimpleNamespace(episodes=wanted, folder=Path("out"), dataset=Path("set")),
        settings=Settings(),
        config=MultiplyConfig(),
        choice=ArmChoice("panda"),
        robot=SimpleNamespace(name="panda"),
        kind="panda",
        columns=None,
        source=SimpleNamespace(fps=20.0),
        demos=[],
        judge=JudgeConfig(),
        _attempts=attempts,
    )
    return Multiplication.run(job), writer, asked


def test_failures_are_counted_by_reason_and_work_goes_on_after_the_last_attempt(monkeypatch):
    before = [{"attempt": 4, "failed": {0: "reach", 3: "reach"}}]
    reasons = {5: "reach", 7: "contact", 8: "contact"}
    failed, writer, asked = work(monkeypatch, lambda k: reasons.get(k, ""), 4, before)
    assert failed == Counter(reach=3, contact=2)
    assert [origin["attempt"] for origin in writer.provenance] == [4, 6, 9, 10]
    assert [origin["failed"] for origin in writer.provenance[1:]] == [
        {5: "reach"},
        {7: "contact", 8: "contact"},
        {},
    ]
    assert asked[0] == range(5, 55)


@pytest.mark.parametrize("every", [50, 51])
def test_work_ends_if_fewer_than_two_in_a_hundred_succeed(monkeypatch, every):
    """One in 50 is enough; one in 51 is not, from attempt 100 on."""

    def outcome(k):
        return "" if k % every == 0 else f"reason {k % 5}"

    if every == 50:
        _, writer, _ = work(monkeypatch, outcome, 4)
        assert len(writer.provenance) == 4
    else:
        with pytest.raises(RuntimeError, match=r"hardly any motion .*: reason \d \(\d+\)"):
            work(monkeypatch, outcome, 4)


@pytest.mark.parametrize("episodes", [0, 3])
def test_a_summary_names_attempts_and_rate(monkeypatch, tmp_path, capsys, episodes):
    made: Any = SimpleNamespace(
        segmentation=SimpleNamespace(rows=lambda demos: [("a", "b")]),
        demos=["x"] * 5,
        objects={},
        config=MultiplyConfig(segments=str(tmp_path / "segments.json")),
        judged_by="a judge",
        run=lambda: Counter({"reach": 1, "contact": 2}),
    )
    monkeypatch.setattr(multiply_command, "Multiplication", lambda *given: made)
    monkeypatch.setattr(multiply_command, "write_json", lambda path, value: path.touch())
    args = Multiply(
        dataset=tmp_path / "set", episodes=episodes, out=tmp_path / "out", json=tmp_path / "j"
    )
    assert multiply_command.multiply(args) == 0
    said = capsys.readouterr().out
    assert "no object poses" in said
    assert (tmp_path / "segments.json").exists() == (not episodes)
    if not episodes:
        assert "judged by" not in said
        return
    assert "judged by a judge" in said
    assert "     2 motions left out: contact\n     1 motions left out: reach\n" in said
    assert f"3 of 6 motions succeeded (50%): {tmp_path / 'out'}" in said
    assert json.loads((tmp_path / "j").read_text()) == {
        "episodes": 3,
        "attempts": 6,
        "success_rate": 0.5,
    }
    with pytest.raises(ValueError, match="not be negative, but is -1"):
        multiply_command.multiply(Multiply(dataset=tmp_path, episodes=-1))


def test_columns_are_a_range_a_list_or_none():
    given = {"a": "none", "b": "x[0:7]", "c": "u,v", "d": "nonesuch"}
    assert columns(given) == {"a": None, "b": "x[0:7]", "c": ["u", "v"], "d": "nonesuch"}


@pytest.mark.parametrize(
    ("upright", "tilted", "status"), [(0.05, 9.0, 0), (0.051, 0.0, 1), (float("nan"), 0.0, 1)]
)
def test_an_image_jacobian_is_good_up_to_5_percent_upright(
    monkeypatch, tmp_path, upright, tilted, status
):
    figures = {"upright_relative_error_median": upright, "tilted_relative_error_median": tilted}
    monkeypatch.setattr(
        image_jacobian_commands, "_image_jacobian_figures", lambda args, network: figures
    )
    monkeypatch.setattr(
        image_jacobian_commands,
        "VisualServoSkill",
        SimpleNamespace(load=lambda model: SimpleNamespace(jacobian=None)),
    )
    threads = torch.get_num_threads()
    try:
        args = Evaluate(dataset=tmp_path)
        found = image_jacobian_commands.evaluate_image_jacobian(args, tmp_path)
    finally:
        torch.set_num_threads(threads)
    assert found == status


@pytest.mark.parametrize(("marker", "refused"), [(-1, 1), (0, 0), (49, 0), (50, 1)])
def test_markers_are_those_of_the_dictionary_of_fifty(monkeypatch, tmp_path, marker, refused):
    monkeypatch.setattr(
        image_jacobian_commands,
        "extract_features",
        lambda dataset, name, detector, **more: SimpleNamespace(
            name=name, episodes=3, known=1, seen=7, frames=9, without_image=2, left_out={0: "x"}
        ),
    )
    from rich.console import Console

    console = Console(width=200)
    args = FitImageJacobian(dataset=tmp_path)
    with console.capture() as said:
        if refused:
            with pytest.raises(ValueError, match=f"0 to 49, got {marker}"):
                image_jacobian_commands._find_marker(args, marker, console)
            return
        found = image_jacobian_commands._find_marker(args, marker, console)
    assert found.name == f"marker_{marker}"
    assert "3 episodes searched, 1 known before; marker in 7 of 9 frames, 2" in said.get()
    assert "left out: x" in said.get()
