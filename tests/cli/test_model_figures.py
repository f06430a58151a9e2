"""Episodes, tables and figures of `hrc play`, `hrc evaluate`, `hrc smooth` and `hrc tokens`."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from clean_sets import FPS, write_set
from rich.console import Console
from unchecked import shapes_unchecked

from hrc_learn.cli import model_commands, play_command
from hrc_learn.cli.arguments import Evaluate, Play, Smooth
from hrc_learn.cli.tokens_command import TokenSettings, _measured, held_out, read_chunks
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.learning.motion_playing import PlayedMotion
from hrc_learn.learning.reproduction_error import ReproductionError
from hrc_learn.lerobot import smoothing
from hrc_learn.lerobot.smoothing import ActionLimits


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


# Playing.


@pytest.fixture
def episode(monkeypatch):
    """One demonstration of three joints, as `hrc play` opens it."""
    demo = SimpleNamespace(
        joint_position=np.arange(6.0).reshape(2, 3),
        joint_names=("b.pos", "c.pos", "a.pos"),
        position=np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
        orientation=np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]]),
    )
    opened = []

    def open_demos(dataset, **more):
        opened.append((dataset, more))
        return [demo]

    monkeypatch.setattr(play_command, "open_demos", open_demos)
    monkeypatch.setattr(play_command, "fitted_from", lambda folder: {"dataset": "shown"})
    demo.opened = opened
    return demo


def model(joints=True):
    return SimpleNamespace(
        folder=Path("model"),
        joint=SimpleNamespace(units="rad") if joints else None,
        joint_names=("a", "b", "c"),
        target=lambda words, option: (tuple(words), option),
    )


@pytest.mark.parametrize(("option", "row"), [("--start", 0), ("--goal", 1)])
def test_an_episode_gives_its_first_or_last_joints_in_the_models_order(episode, option, row):
    found = play_command._target(model(), ["episode", "3"], option)
    b, c, a = episode.joint_position[row]
    assert found.joints.tolist() == [a, b, c]
    assert found.position is found.orientation is None
    ((dataset, more),) = episode.opened
    assert (dataset, more["episodes"]) == ("shown", [3])


@pytest.mark.parametrize(("option", "row"), [("--start", 0), ("--goal", 1)])
def test_an_episode_gives_a_pose_to_a_model_without_joints(episode, option, row):
    found = play_command._target(model(joints=False), ["episode", "0"], option)
    assert found.joints is None
    assert found.position.tolist() == episode.position[row].tolist()
    assert found.orientation.tolist() == episode.orientation[row].tolist()
    # A copy: the demonstration may be a view of a file.
    found.position.add_(1)
    assert episode.position[row][0] in (0.1, 0.4)
    episode.orientation = None
    assert (
        play_command._target(model(joints=False), ["episode", "0"], option).orientation is None
    )


def test_an_episode_without_joints_gives_a_pose_or_nothing(episode):
    episode.joint_position = None
    assert play_command._target(model(), ["episode", "0"], "--goal").position is not None
    episode.position = None
    with pytest.raises(ValueError, match="--goal: episode 7 has neither joints nor positions"):
        play_command._target(model(), ["episode", "7"], "--goal")


def test_a_goal_needs_words():
    with pytest.raises(ValueError, match="--goal is empty: give numbers"):
        play_command._target(model(), (), "--goal")


@pytest.mark.parametrize("words", [["episode"], ["episode", "1", "2"], ["episode", "x"]])
def test_an_episode_is_one_number(episode, words):
    with pytest.raises(ValueError, match="--start episode needs one number"):
        play_command._target(model(), words, "--start")
    assert play_command._target(model(), ["1", "2"], "--goal") == (("1", "2"), "--goal")


def motion(**given):
    time = np.arange(5) * 0.02
    values = {
        "time": time,
        "joints": panda.ready.numpy() + np.outer(time**2, np.arange(1.0, 8)),
        "position": np.outer(time, (1.0, 2.0, 3.0)),
        "orientation": np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
        "planned_duration": 0.05,
        "goal_errors": {"goal_position_error_mm": 1.26, "goal_turn_error_deg": 0.04},
        "deviation": 0.007,
    }
    return PlayedMotion(**(values | given))


@pytest.mark.parametrize("robot", [None, "panda"])
@pytest.mark.parametrize("units", ["rad", "1"])
def test_a_table_names_joints_of_the_arm_or_model_with_their_unit(robot, units):
    made, fitted = motion(), model()
    fitted.joint.units = units
    fitted.joint_names = tuple("abcdefg")
    text = play_command._table(fitted, robot and arm(robot), made)
    header, *rows = text.splitlines()
    joints = panda.joint_names if robot else "abcdefg"
    unit = "rad" if robot else units
    assert header.split(",") == [
        "time [s]",
        *(f"{name} [{unit}]" for name in joints),
        *("x [m]", "y [m]", "z [m]", "qw", "qx", "qy", "qz"),
    ]
    values = np.array([row.split(",") for row in rows], dtype=float)
    whole = [made.time[:, None], made.joints, made.position, made.orientation]
    np.testing.assert_allclose(values, np.hstack(whole), rtol=1e-8)
    only = play_command._table(fitted, None, motion(joints=None, orientation=None))
    assert only.splitlines()[0] == "time [s],x [m],y [m],z [m]"


@pytest.mark.parametrize("slowed", ["", "velocity of panda_joint1"])
@pytest.mark.parametrize("robot", [None, "panda"])
def test_a_report_says_how_long_it_lasts_and_why(capsys, robot, slowed):
    args = Play(model=Path("m"), goal=("1",), out=Path("out"))
    play_command._report(args, robot and arm(robot), motion(slowed_by=slowed))
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == "0.08 s, 1.3 mm from the goal, 0.0 deg from the goal's orientation"
    notes = [line for line in rest if line.startswith("note: ")]
    if robot is None:
        assert "no limits are checked" in notes[0]
    elif slowed:
        assert notes == [
            f"note: 0.08 s instead of 0.05 s, because the {slowed} would be beyond its limit"
        ]
    else:
        assert notes == []
    assert "Motion in out" in rest
    assert any(line.startswith("Dashboard: ") for line in rest) == (robot is not None)


def test_figures_and_recording_hold_the_motion():
    made = motion()
    assert play_command._figures(made) == {
        "duration_s": pytest.approx(0.08),
        "planned_duration_s": 0.05,
        "samples": 5.0,
        "path_deviation_rad": 0.007,
        "goal_position_error_mm": 1.26,
        "goal_turn_error_deg": 0.04,
    }
    args = Play(model=Path("models/pour"), goal=("1",))
    run = play_command._recording(args, arm("panda"), made)
    assert run.title == "pour played by panda"
    # The joints accelerate evenly: central differences are exact inside.
    speed = np.outer(2 * made.time, np.arange(1.0, 8))
    scale = play_command.DT / 0.02
    np.testing.assert_allclose(scale * run.joint_velocity[1:-1], speed[1:-1], atol=1e-9)
    np.testing.assert_array_equal(run.plan_path, made.position)


# Evaluation.


@pytest.mark.parametrize(
    ("count", "named", "fitted"),
    [
        (1, (), (0,)),
        (1, (0,), ()),
        (2, (), (0,)),
        (4, (), (0, 1, 2)),
        (5, (), (0, 1, 2, 3)),
        (11, (), (0, 1, 2, 3, 5, 6, 7, 8, 10)),
        (4, (0, 2), (1, 3)),
        (2, (0, 1), None),
    ],
)
def test_every_fifth_demonstration_is_held_out(monkeypatch, tmp_path, count, named, fitted):
    wanted = []
    entries = [SimpleNamespace(index=i) for i in range(count)]
    opened = SimpleNamespace(entries=entries), []
    monkeypatch.setattr(model_commands, "open_moving", lambda dataset, episodes: opened)
    monkeypatch.setattr(model_commands, "fit_silently", wanted.append)
    args = Evaluate(dataset=tmp_path, episodes=named)
    if fitted is None:
        with pytest.raises(ValueError, match=f"names all {count} episodes"):
            model_commands._fit_most(args, tmp_path / "model")
        return
    model_commands._fit_most(args, tmp_path / "model")
    assert [(fit.episodes, fit.out) for fit in wanted] == [(fitted, tmp_path / "model")]


@pytest.mark.parametrize(
    ("learned", "named", "same", "read", "note"),
    [
        ((0, 1), (), True, [2, 3], "2 episodes that were not learned from"),
        ((0, 1, 2, 3), (), True, None, "all of these demonstrations were learned from"),
        ((), (), True, None, "some of these demonstrations were learned from"),
        ((0, 1), (1, 2), True, [1, 2], "some of these demonstrations were learned from"),
        ((0, 1), (2, 3), True, [2, 3], ""),
        ((0, 1), (), False, None, ""),
        ((0, 1), (0,), False, [0], ""),
    ],
)
def test_an_evaluation_prefers_what_was_not_learned(
    monkeypatch, tmp_path, learned, named, same, read, note
):
    opened = []

    def open_moving(dataset, episodes, **more):
        opened.append(more | {"episodes": episodes})
        return SimpleNamespace(entries=[SimpleNamespace(index=i) for i in range(4)]), []

    monkeypatch.setattr(model_commands, "open_moving", open_moving)
    monkeypatch.setattr(model_commands, "sampled", lambda demos: demos)
    dataset = tmp_path / "set"
    made_by = {
        "dataset": str(dataset if same else tmp_path / "other"),
        "episodes": learned,
        "joint_names": ["a"],
        "units": {"position": "mm"},
    }
    monkeypatch.setattr(model_commands, "fitted_from", lambda model: made_by)
    console = Console(width=200)
    with console.capture() as said:
        args = Evaluate(dataset=dataset, episodes=named)
        model_commands._demonstrations(args, Path("model"), console)
    assert opened[-1]["episodes"] == (read or [])
    assert opened[-1]["joint_names"] == ("a",)
    assert opened[-1]["units"] == {"position": "mm"}
    assert said.get().strip() == (f"note: {note}" if note else "")


def test_a_dataset_that_was_read_as_it_is_has_no_names():
    assert model_commands.as_fitted({}) == {"joint_names": None, "mapping": {}, "units": {}}


@pytest.mark.parametrize("count", [1, 8, 9, 20])
def test_a_table_lists_the_eight_worst_and_the_median(count):
    rng = np.random.default_rng(0)
    nrmse, turn = (torch.from_numpy(rng.uniform(0.1, 0.9, count)) for _ in range(2))
    error = ReproductionError(nrmse=nrmse, turn_rmse=turn)
    demos: Any = [SimpleNamespace(episode=100 + k) for k in range(count)]
    table = model_commands._table("joint", demos, error)
    columns = [[*column.cells] for column in table.columns]
    heads = [str(column.header) for column in table.columns]
    assert heads == ["episode", "nrmse", "turn rmse [deg]"]
    worst = np.argsort(-nrmse.numpy())[:8]
    assert columns[0] == [*(str(100 + k) for k in worst), "median"]
    assert columns[1][:-1] == [f"{nrmse[k]:.3g}" for k in worst]
    assert columns[2][:-1] == [f"{turn[k]:.3g}" for k in worst]
    assert columns[1][-1] == f"{np.median(nrmse.numpy()):.3g}"
    assert table.caption == (f"{count - 8} more, none worse" if count > 8 else None)
    assert table.title == "joint: predicted from start, goal and duration"


def test_a_figure_shows_each_measure_over_the_episodes_with_its_median(monkeypatch):
    drawn = []
    monkeypatch.setattr(
        model_commands, "plots_figure", lambda *given, **more: drawn.append((given, more))
    )
    error = ReproductionError(
        nrmse=torch.tensor([0.1, 0.4, 0.2]), largest=torch.tensor([1.0, 2.0, 6.0])
    )
    demos: Any = [SimpleNamespace(episode=k) for k in (7, 3, 5)]
    model_commands._figure(demos, error)
    (((episodes, plots), more),) = drawn
    assert episodes.tolist() == [7.0, 3.0, 5.0]
    assert [plot.title for plot in plots] == ["nrmse", "largest [rad or m]"]
    for plot, values, median in zip(plots, error.columns().values(), (0.2, 2.0), strict=True):
        curves = [np.ravel(curve.values) for curve in plot.curves]
        np.testing.assert_allclose(curves[0], values)
        np.testing.assert_allclose(curves[1], [median] * 3, rtol=1e-6)
    assert more["columns"] == 2


@pytest.mark.parametrize(
    ("medians", "most", "status"),
    [
        ({"joint": 0.2, "position": 0.1}, None, 0),
        ({"joint": 0.25, "position": 0.125}, 0.25, 0),
        ({"joint": 0.2, "position": 0.1}, 0.19, 1),
        ({"joint": 0.1, "position": 0.3}, 0.2, 1),
    ],
)
def test_every_channel_has_to_meet_the_limit(monkeypatch, tmp_path, medians, most, status):
    for channel in medians:
        (tmp_path / "model" / channel).mkdir(parents=True)

    class Demos(list):
        notes = ("a note",)

    demos = Demos([SimpleNamespace(episode=0)])
    monkeypatch.setattr(model_commands, "CHANNELS", ("position", "joint"))
    monkeypatch.setattr(model_commands, "_demonstrations", lambda *given: demos)
    monkeypatch.setattr(model_commands, "best_models", lambda model: {"joint": "wider"})
    monkeypatch.setattr(model_commands, "predict", lambda model, channel, *more: channel)
    motions = SimpleNamespace(
        require=lambda channel: None,
        error=lambda channel, made: ReproductionError(nrmse=torch.tensor([medians[made]])),
    )
    monkeypatch.setattr(model_commands, "Motions", SimpleNamespace(of=lambda demos: motions))
    args = Evaluate(dataset=tmp_path, most_nrmse=most, json=tmp_path / "j")
    assert model_commands._evaluate_primitives(args, tmp_path / "model") == status
    figures = json.loads((tmp_path / "j").read_text())
    assert figures["demonstrations"] == 1
    for channel, median in medians.items():
        assert figures[f"{channel}_nrmse_median"] == pytest.approx(median)


def test_a_folder_without_models_is_refused(tmp_path):
    args = Evaluate(dataset=tmp_path)
    with pytest.raises(FileNotFoundError, match="holds no model"):
        model_commands._evaluate_primitives(args, tmp_path)


# Limits of policies.


@pytest.fixture
def limits(monkeypatch):
    """Limits of three values in place of a dataset's, and what was done to checkpoints."""
    names = ["panda_joint1.pos", "panda_joint2.pos", "gripper.pos"]
    made = ActionLimits(
        names=names,
        fps=30.0,
        velocity=[1.0, 2.0, 3.0],
        acceleration=[10.0, 20.0, 30.0],
        jerk=[100.0, 200.0, 300.0],
        lower=[None, None, None],
        upper=[None, None, None],
        state_columns=[0, 1, 2],
    )
    done: list[Any] = []

    def gathered(dataset, **more):
        done.append(("gathered", dataset, more))
        return made

    monkeypatch.setattr(smoothing, "gathered_limits", gathered)
    monkeypatch.setattr(
        smoothing, "add_smoothing", lambda *given: done.append(("added", *given))
    )
    monkeypatch.setattr(
        smoothing, "remove_smoothing", lambda *given: done.append(("removed", *given))
    )
    return done


@pytest.mark.parametrize("source", ["demonstrations", "urdf", "calibration"])
@pytest.mark.parametrize("checkpoint", [True, False])
def test_limits_are_those_of_the_demonstrators_within_the_pandas_unless_named(
    limits, tmp_path, capsys, source, checkpoint
):
    (tmp_path / "checkpoint").mkdir()
    named = {} if source == "demonstrations" else {source: tmp_path / "robot"}
    args = Smooth(
        checkpoint=tmp_path / "checkpoint" if checkpoint else None,
        dataset=tmp_path / "set",
        limits=tmp_path / "limits.json",
        json=tmp_path / "j",
        scale=0.5,
        degrees=True,
        **named,
    )
    model_commands.smooth(args)
    _, dataset, more = limits[0]
    assert dataset == tmp_path / "set"
    assert (more["scale"], more["degrees"]) == (0.5, True)
    kept = ActionLimits.load(tmp_path / "limits.json")
    lower, upper = panda.limits.lower.tolist(), panda.limits.upper.tolist()
    if source == "demonstrations":
        assert kept.lower == pytest.approx([*lower[:2], None])
        assert kept.upper == pytest.approx([*upper[:2], None])
    else:
        assert kept.lower == kept.upper == [None] * 3
    assert limits[1:] == ([("added", tmp_path / "checkpoint", kept)] if checkpoint else [])
    figures = json.loads((tmp_path / "j").read_text())
    assert figures["velocity_panda_joint2.pos"] == 2.0
    assert figures["acceleration_panda_joint1.pos"] == 10.0
    assert figures["jerk_gripper.pos"] == 300.0
    assert len(figures) == 9
    said = capsys.readouterr().out
    assert ("keeps its actions within these limits" in said) == checkpoint
    rows = [line for line in said.splitlines() if "panda_joint2.pos" in line]
    assert [cell.strip() for cell in rows[0].strip("│ ").split("│")][1:] == ["2", "20", "200"]


def test_limits_are_removed_without_a_dataset(limits, tmp_path, capsys):
    model_commands.smooth(Smooth(checkpoint=tmp_path, remove=True))
    assert limits == [("removed", tmp_path)]
    assert "limits removed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "give --checkpoint, or --limits"),
        ({"remove": True, "limits": Path("x")}, "give --checkpoint, or --limits"),
        ({"limits": Path("x")}, "give --dataset"),
        ({"checkpoint": Path("nowhere")}, "there is no folder nowhere"),
        ({"checkpoint": Path(), "remove": True, "limits": Path("x")}, "--limits is not used"),
    ],
)
def test_smoothing_needs_a_checkpoint_or_a_file_and_a_dataset(limits, given, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        model_commands.smooth(Smooth(**given))
    assert limits == []


# Tokens.


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("figures") / "set", "v3.0")


def actions(dataset):
    """Actions of each episode, by pyarrow."""
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    action = np.array(table["action"].to_pylist())
    index = np.array(table["episode_index"])
    return [action[index == k] for k in np.unique(index)]


@pytest.mark.parametrize(("seconds", "frames"), [(0.5, round(0.5 * FPS)), (0.01, 2)])
@pytest.mark.parametrize("most", [1, 10, 100_000])
def test_chunks_are_spread_evenly_over_the_episodes(dataset, seconds, frames, most):
    episodes = [0, 2, 3]
    found = read_chunks(dataset, "action", seconds, episodes, most)
    np.testing.assert_allclose(found.time, np.arange(frames + 1) / FPS)
    every = [actions(dataset)[k] for k in episodes]
    # A chunk has the frame before its known one, and ends with the episode at the latest.
    counts = [len(x) - frames - 1 for x in every]
    stride = -(-sum(counts) // most)
    motions = [
        x[t + 1 : t + frames + 2]
        for x, count in zip(every, counts, strict=True)
        for t in range(0, count, stride)
    ]
    np.testing.assert_allclose(found.motions, motions, atol=1e-6)
    before = [
        x[t] for x, count in zip(every, counts, strict=True) for t in range(0, count, stride)
    ]
    np.testing.assert_allclose(
        found.start_velocity, (found.motions[:, 0] - before) * FPS, atol=1e-3
    )
    assert len(found.motions) <= most + len(episodes)


def test_the_longest_chunk_has_all_but_two_frames_of_an_episode(dataset):
    length = len(actions(dataset)[0])
    found = read_chunks(dataset, "action", (length - 2) / FPS, [0], 10)
    assert found.motions.shape[:2] == (1, length - 1)
    with pytest.raises(ValueError, match=f"no episode of .* has {length + 1} frames"):
        read_chunks(dataset, "action", (length - 1) / FPS, [0], 10)


@pytest.mark.parametrize(
    ("count", "number", "left_out"),
    [
        (10, 5, [4, 9]),
        (5, 5, [4]),
        (4, 5, [3]),
        (1, 5, []),
        (3, 1, [0, 1, 2]),
        (3, 0, []),
    ],
)
def test_every_episode_of_a_number_is_left_out(count, number, left_out):
    assert held_out([*range(count)], number) == left_out


class Tokenizer:
    """Decodes all but the first column exactly; the k-th chunk takes k tokens."""

    vocabulary_size, duration = 64, 0.5
    components = SimpleNamespace(known=True)

    def encode(self, time, motions, velocity):
        self.motions = motions
        return torch.arange(len(motions))[:, None]

    def length(self, row):
        return row[0]

    def decode(self, ids, time, *state):
        assert len(state) == 2
        made = self.motions.clone()
        made[:, 1:, 0] += 0.02
        return made


def test_figures_of_tokens_are_means_quantiles_and_errors_of_the_range(dataset):
    tokenizer: Any = Tokenizer()
    settings = TokenSettings(seconds=0.5)
    figures = _measured(tokenizer, dataset, settings, [0, 1, 2, 3, 4])
    count = int(figures["chunks"])
    motions = tokenizer.motions.numpy()
    assert count == len(motions)
    lengths = np.arange(count)
    assert figures["tokens_mean"] == pytest.approx(lengths.mean())
    assert figures["tokens_p95"] == pytest.approx(np.quantile(lengths, 0.95))
    assert figures["bits_per_s"] == pytest.approx(lengths.mean() * 6 / 0.5)
    columns = motions.shape[-1]
    assert figures["rmse"] == pytest.approx(0.02 / np.sqrt(columns))
    span = np.ptp(motions[..., 0])
    assert figures["rmse_of_range"] == pytest.approx(0.02 / span / np.sqrt(columns))
