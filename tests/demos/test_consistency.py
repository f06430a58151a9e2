"""Thresholds of the comparison between episodes, with cases on both sides of each."""

import json
from dataclasses import replace

import numpy as np
import pytest
from lerobot_folders import FPS, joint_path, read_info, write_folder, write_info

from hrc_learn.demos import check_dataset
from hrc_learn.demos.issues import ValidationReport
from hrc_learn.demos.quality import structure_checks
from hrc_learn.demos.read.dataset_folder import open_folder

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

STATE = "observation.state"
JOINTS = ["shoulder.pos", "elbow.pos", "wrist.pos"]
ODD = 4
"""The episode that differs; the ones before it are alike."""


def found(root, episodes, text, names=JOINTS):
    """Findings of a dataset that hold a text."""
    columns = dict.fromkeys(episodes[0], names)
    write_folder(root, episodes, columns)
    report = check_dataset(root)
    return [issue for issue in (*report.errors, *report.warnings) if text in issue.message]


def ramp(frames=100):
    return np.linspace(0, 1, frames)


def loop(frames=100):
    """One period of a sine: start and goal are equal."""
    return np.sin(2 * np.pi * ramp(frames)) / 2


@pytest.mark.parametrize(
    ("held", "usual", "frames", "told"),
    [
        (20, 0, 100, True),
        (14, 0, 100, False),  # less than 0.3 s
        (20, 0, 300, False),  # less than a tenth of the episode
        (20, 5, 100, False),  # not five times the usual
        (35, 5, 100, True),
    ],
)
def test_an_encoder_froze_that_stays_long_and_longer_than_usual(
    tmp_path, held, usual, frames, told
):
    assert FPS == 50

    def episode(count):
        q = np.stack([ramp(frames) + 0.1 * k * loop(frames) for k in range(3)], axis=1)
        q[40 : 41 + count, 1] = q[40, 1]
        return {STATE: q}

    episodes = [*(episode(usual) for _ in range(ODD)), episode(held)]
    issues = found(tmp_path / "set", episodes, "the encoder froze?")
    assert [(i.episode, i.components) for i in issues] == (
        [(ODD, ("elbow.pos",))] if told else []
    )


def test_objects_may_rest_longer_than_usual_but_joints_may_not(tmp_path):
    def episode(frames):
        x = np.stack([ramp(), loop(), 1 - ramp()], axis=1)
        x[:frames] = x[frames - 1]
        return {STATE: x, "observation.environment_state": x}

    issues = found(tmp_path / "set", [*map(episode, [1, 1, 1, 1, 30])], "the encoder froze?")
    assert [issue.key for issue in issues] == [STATE] * 3


@pytest.mark.parametrize("names", [["cube.qx", "cube.qy", "cube.qz"], ["qx", "qy", "qz"]])
def test_quaternions_of_objects_have_no_sign(tmp_path, names):
    joints = [*(three(0.2 + ramp(), i) for i in range(ODD)), three(-0.2 - ramp(), ODD)]
    episodes = [{**q, "observation.environment_state": q[STATE]} for q in joints]
    columns = {STATE: JOINTS, "observation.environment_state": names}
    write_folder(tmp_path / "set", episodes, columns)
    signs = [i for i in check_dataset(tmp_path / "set").errors if "opposite" in i.message]
    assert [issue.key for issue in signs] == [STATE]


def three(second, noise=0):
    """Three joints, the second one given."""
    frames = len(second)
    jitter = 1e-3 * np.random.default_rng(noise).normal(size=3)
    others = (0.3 + ramp(frames), -0.4 - 0.7 * ramp(frames))
    return {STATE: np.stack([others[0], second, others[1]], axis=1) + jitter}


@pytest.mark.parametrize(
    ("usual", "odd", "told"),
    [
        (0.2 + ramp(), -0.2 - ramp(), True),
        # Negated it would be 1.2 spreads away, of the 4 that it is.
        (-0.07 + loop(), 0.13 + loop(), False),
        # Negated it would be 2 spreads away, of 10.
        (-0.2 + loop(), 0.3 + loop(), False),
    ],
)
def test_a_joint_has_the_other_sign_where_negated_it_is_like_the_others(
    tmp_path, usual, odd, told
):
    episodes = [*(three(usual, i) for i in range(ODD)), three(odd, ODD)]
    issues = found(tmp_path / "set", episodes, "has the opposite sign")
    assert [(i.episode, i.components) for i in issues] == (
        [(ODD, ("elbow.pos",))] if told else []
    )
    assert all(issue.message.endswith(": elbow.pos") for issue in issues)


@pytest.mark.parametrize(
    ("forwards", "backwards", "told"),
    [
        ((ramp(), 2 * ramp(), 3 - ramp()), (1 - ramp(), 2 - 2 * ramp(), 2 + ramp()), True),
        # One of three goes back.
        ((ramp(), 2 * ramp(), 3 - ramp()), (1 - ramp(), 2 * ramp(), 3 - ramp()), False),
        # One of six goes back, and the others would look alike both ways.
        ((ramp(), *5 * [loop()]), (1 - ramp(), *5 * [loop()]), False),
    ],
)
def test_an_episode_runs_backwards_if_all_of_it_does(tmp_path, forwards, backwards, told):
    def episode(columns, seed):
        jitter = 1e-3 * np.random.default_rng(seed).normal(size=len(columns))
        return {STATE: np.stack(columns, axis=1) + jitter}

    names = [f"joint{i}.pos" for i in range(len(forwards))]
    episodes = [*(episode(forwards, i) for i in range(ODD)), episode(backwards, ODD)]
    issues = found(tmp_path / "set", episodes, "runs in the reverse direction", names)
    assert [issue.episode for issue in issues] == ([ODD] if told else [])


@pytest.mark.parametrize(
    ("gain", "usual", "told"),
    [
        (2.0, 1.0, True),
        (0.5, 1.0, True),
        (1.4, 1.0, False),
        (0.7, 1.0, False),
        (2.0, 2.0, False),
    ],
)
def test_a_state_that_goes_further_or_less_far_than_its_command(tmp_path, gain, usual, told):
    def episode(seed, factor):
        t = np.linspace(0, 6, 140)[:, None] + np.random.default_rng(seed).uniform(0, 0.3, 3)
        q = 0.5 * np.sin(t * [1.0, 1.7, 2.3])
        state = q[:120] * [1.0, factor, 1.0]
        return {STATE: state, "action": q[6:126]}

    episodes = [*(episode(i, usual) for i in range(ODD)), episode(ODD, gain)]
    issues = found(tmp_path / "set", episodes, "times as far as its command")
    assert [issue.episode for issue in issues] == ([ODD] if told else [])
    assert all(issue.message.endswith(": elbow") for issue in issues)


def test_rows_between_episodes_are_passed_over(tmp_path):
    """The middle one of three episodes in a file is not listed."""
    values = [k + np.tile(ramp(frames), (3, 1)).T for k, frames in ((1, 13), (2, 40), (3, 11))]
    root = write_folder(tmp_path / "set", [{STATE: q} for q in values], {STATE: JOINTS})
    folder = open_folder(root)
    listed = tuple(entry for entry in folder.episodes if entry.index != 1)
    folder, report = replace(folder, episodes=listed), ValidationReport(path=root)
    pieces = structure_checks.read_sound_episodes(folder, report)
    read = {entry.index: frames[STATE] for entry, frames in pieces}
    assert [*read] == [0, 2]
    for index, frames in read.items():
        np.testing.assert_allclose(frames, values[index], rtol=1e-6)


def resting(seed: int, frames: int = 120) -> np.ndarray:
    """A joint path [rad] that rests for 40 frames at its end."""
    path = joint_path(frames - 40, seed=seed)
    return np.concatenate([path, np.repeat(path[-1:], 40, axis=0)])


@pytest.mark.parametrize("offset", [0.0, np.deg2rad(17)])
def test_a_leader_calibrated_differently_is_reported(tmp_path, offset):
    names, episodes = JOINTS, []
    for seed in range(4):
        state = resting(seed)
        command = state + np.array([0.0, offset, 0.0])
        episodes.append({"observation.state": state, "action": command})
    root = write_folder(
        tmp_path / "set", episodes, {"observation.state": names, "action": names}
    )
    texts = map(str, check_dataset(root).warnings)
    found = [text for text in texts if "from its command" in text]
    assert len(found) == (offset > 0)
    assert all("elbow rests 0.2967" in text for text in found)
    episodes[2]["action"] = episodes[2]["action"] + np.array([0.0, 0.0, 0.4])
    root = write_folder(
        tmp_path / "drifted", episodes, {"observation.state": names, "action": names}
    )
    found = [
        issue for issue in check_dataset(root).warnings if "calibration changed" in str(issue)
    ]
    assert [issue.episode for issue in found] == [2]


def test_a_joint_that_never_moves_shows_no_calibration(tmp_path):
    episodes = []
    for seed in range(6):
        state = resting(seed)
        state[:, 2] = 0.0
        command = state + np.array([0.0, 0.0, 1e-6 * seed])
        episodes.append({"observation.state": state, "action": command})
    root = write_folder(tmp_path / "set", episodes, dict.fromkeys(episodes[0], JOINTS))
    assert not [text for text in map(str, check_dataset(root).warnings) if "calibra" in text]


def test_a_loop_that_is_late_now_and_then_has_another_rate(tmp_path):
    rng = np.random.default_rng(0)
    steps = np.where(rng.uniform(size=119) < 0.3, 0.065, 0.05)
    time = np.concatenate([[0.0], np.cumsum(steps)])[:, None]
    episodes = [{"observation.state": resting(0), "time": time}]
    names = {"observation.state": ["a.pos", "b.pos", "c.pos"], "time": ["time"]}
    root = write_folder(tmp_path / "set", episodes, names, fps=20, dtype="float64")
    found = [issue for issue in check_dataset(root).warnings if "fps says 20" in str(issue)]
    assert [issue.key for issue in found] == ["time"]
    assert f"{119 / steps.sum():.4g} Hz" in str(found[0])


def test_version_2_with_the_folder_named_as_in_version_3(tmp_path):
    names = {"observation.state": ["a.pos", "b.pos", "c.pos"]}
    episodes = [{"observation.state": resting(0)}]
    root = write_folder(tmp_path / "set", episodes, names, version="v2.1")
    info = read_info(root)
    info["data_path"] = "data/chunk-{chunk_index:03d}/episode_{episode_index:06d}.parquet"
    write_info(root, info)
    assert not check_dataset(root).errors


@pytest.mark.parametrize(("frames", "frozen"), [(25, True), (23, False)])
def test_a_hold_counts_above_five_usual_ones_and_two_per_cent(tmp_path, frames, frozen):
    """Holds of 4 in 200 frames are usual here: more than 24 are none."""

    def episode(seed, held):
        way = np.linspace(0, 2, 200)[:, None] + 0.1 * seed
        q = np.sin(way * np.linspace(0.6, 1.1, len(JOINTS)))
        q[80 : 80 + held] = q[80]
        return {STATE: q}

    episodes = [episode(k, 4) for k in range(4)] + [episode(4, frames)]
    assert bool(found(tmp_path / "set", episodes, "encoder froze")) == frozen


@pytest.mark.parametrize(
    ("frames", "told"), [(21, False), (20, True), (499, False), (500, True)]
)
def test_an_episode_five_times_as_long_or_short_is_named(tmp_path, frames, told):
    lengths = [100, 100, 100, 100, frames]
    episodes = [{STATE: joint_path(n, seed=k)} for k, n in enumerate(lengths)]
    issues = found(tmp_path / "set", episodes, "frames where 100 are usual: broken off")
    assert [issue.episode for issue in issues] == ([ODD] if told else [])
    assert all(f"has {frames} frames" in issue.message for issue in issues)


def stated(root, **statistics):
    """Statistics of the state as they are, but for some that are given."""
    values = np.concatenate([joint_path(60, seed=k) for k in range(3)])
    known = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    known |= {name: change(known) for name, change in statistics.items()}
    lists = {name: value.tolist() for name, value in known.items() if value is not None}
    (root / "meta/stats.json").write_text(json.dumps({STATE: lists}))


@pytest.mark.parametrize(
    ("statistics", "text"),
    [
        ({}, ""),
        # A part of a dataset keeps the statistics of the whole, up to 20 times as wide.
        ({"max": lambda s: s["max"] + 15 * (s["max"] - s["min"])}, ""),
        ({"max": lambda s: s["max"] + 25 * (s["max"] - s["min"]) + 1}, "in 3 components"),
        ({"max": lambda s: s["max"] - 0.01 * (s["max"] - s["min"])}, ""),
        ({"max": lambda s: s["max"] - 0.04 * (s["max"] - s["min"])}, "in 3 components"),
        ({"min": lambda s: s["min"] + 0.04 * (s["max"] - s["min"])}, "in 3 components"),
        ({"mean": lambda s: s["max"] + 0.04 * (s["max"] - s["min"])}, "in 3 components"),
        ({"mean": lambda s: s["min"] - 0.04 * (s["max"] - s["min"])}, "in 3 components"),
        ({"std": lambda s: s["std"] * [1, -1, 1]}, "in 1 components"),
        ({"std": lambda _: None}, "statistics are incomplete"),
    ],
)
def test_statistics_enclose_the_data_and_are_not_far_wider(tmp_path, statistics, text):
    episodes = [{STATE: joint_path(60, seed=k)} for k in range(3)]
    root = write_folder(tmp_path / "set", episodes, {STATE: JOINTS})
    stated(root, **statistics)
    said = [issue.message for issue in check_dataset(root).warnings]
    said = [message for message in said if "statistics" in message]
    assert len(said) == bool(text)
    assert all(text in message for message in said)


@pytest.mark.parametrize(
    ("tasks", "text"),
    [(("  ",), "task 0 has no text"), (("pour", "stir"), "a task is listed twice")],
)
def test_tasks_have_texts_of_their_own(tmp_path, tasks, text):
    episodes = [{STATE: joint_path(60, seed=k)} for k in range(2)]
    root = write_folder(
        tmp_path / "set", episodes, {STATE: JOINTS}, tasks=tasks, version="v2.1"
    )
    if len(tasks) > 1:
        lines = [{"task_index": k, "task": "pour"} for k in range(2)]
        texts = "".join(json.dumps(line) + "\n" for line in lines)
        (root / "meta/tasks.jsonl").write_text(texts)
    assert [i.message for i in check_dataset(root).warnings].count(text) == 1
