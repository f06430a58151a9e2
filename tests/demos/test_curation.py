"""What speaks against an episode, what is decided, and the cleaned copy."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from clean_sets import CAMERA, FPS, demonstration, write_set
from commands import done
from lerobot_folders import write_folder

from hrc_learn.cli import dataset_commands
from hrc_learn.demos import DatasetError, check_dataset, load_demos
from hrc_learn.demos.images import load_images
from hrc_learn.demos.quality.ranking import (
    Decision,
    decisions_path,
    gripper_moves,
    keep_decisions,
    log_dimensionless_jerk,
    rank_episodes,
    read_decisions,
    write_curated,
)
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.teleoperation.curation_page import CurationPage

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

NAMES = [*(f"joint{i}.pos" for i in range(1, 7)), "gripper.pos"]


def decide(verdict, length, start=0, stop=0):
    return Decision(verdict=verdict, length=length, start=start, stop=stop)


def odd_set(root: Path) -> Path:
    """Fourteen demonstrations of which six are odd, each in its own way."""
    rng = np.random.default_rng(0)
    made = [demonstration(seed) for seed in range(14)]
    made[3] = {key: values.copy() for key, values in made[1].items()}
    waits = {key: np.repeat(values[:1], 90, axis=0) for key, values in made[5].items()}
    waits["observation.state"][:, :6] += 2e-4 * rng.standard_normal((90, 6))
    made[5] = {key: np.concatenate([waits[key], made[5][key]]) for key in made[5]}
    shaken = made[7]["observation.state"]
    shaken[:, :6] += 0.01 * rng.standard_normal((len(shaken), 6))
    state = made[9]["observation.state"]
    state[:, [1, 2]] = state[:, [2, 1]]
    action = made[11]["action"]
    made[11]["action"] = np.concatenate([np.repeat(action[:1], 20, axis=0), action[:-20]])
    bend = 0.8 * np.sin(np.linspace(0, 3, len(made[2]["action"])))[:, None]
    for values in made[2].values():
        values[:, :6] += bend
    return write_folder(root, made, dict.fromkeys(made[0], NAMES), fps=FPS)


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    return odd_set(tmp_path_factory.mktemp("curation") / "odd")


@pytest.fixture(scope="module")
def ranking(odd):
    return rank_episodes(odd)


def test_every_odd_episode_comes_before_every_sound_one(ranking):
    assert {q.episode for q in ranking.episodes[:6]} == {2, 3, 5, 7, 9, 11}
    assert all(q.score == 0 and not q.reasons for q in ranking.episodes[6:])


@pytest.mark.parametrize(
    ("episode", "reason"),
    [
        (2, "unlike the other"),
        (3, "shows the same motion as episode 1"),
        (5, "standing still"),
        (7, "jerkily"),
        (9, "exchanged"),
        (11, "shifted against states"),
    ],
)
def test_the_reason_is_the_one_that_was_made(ranking, episode, reason):
    (quality,) = (q for q in ranking.episodes if q.episode == episode)
    assert any(reason in said for said in quality.reasons)


def test_the_motion_of_a_late_beginner_is_found(ranking):
    (late,) = (q for q in ranking.episodes if q.episode == 5)
    assert 80 <= late.start <= 95
    assert late.stop == late.length
    assert late.measures["idle"] == pytest.approx(90 / late.length, abs=0.05)


def test_two_ways_to_do_it_are_no_outliers(tmp_path):
    made = [demonstration(seed) for seed in range(16)]
    for episode in made[::2]:
        for values in episode.values():
            values[:, 0] *= -1
    write_folder(tmp_path / "two", made, dict.fromkeys(made[0], NAMES), fps=FPS)
    ranking = rank_episodes(tmp_path / "two")
    assert not any("unlike" in said for q in ranking.episodes for said in q.reasons)


def test_what_all_episodes_share_speaks_against_none(tmp_path):
    root = write_set(tmp_path / "set", "v2.1")
    for file in (root / "data").rglob("*.parquet"):
        table = pq.read_table(file)
        place = table.column_names.index("timestamp")
        column = np.asarray(table.column("timestamp")) + np.float32(0.05)
        pq.write_table(table.set_column(place, "timestamp", [column]), file)
    assert any("begins at" in str(w) for w in check_dataset(root).warnings)
    assert all(not q.reasons for q in rank_episodes(root).episodes)


def test_an_episode_that_cannot_be_read_comes_first_and_hides_no_other(tmp_path):
    root = write_set(tmp_path / "set", "v2.1")
    file = root / "data/chunk-000/episode_000002.parquet"
    file.write_bytes(file.read_bytes()[:200])
    first, *rest = rank_episodes(root).episodes
    assert first.episode == 2
    assert first.broken
    assert all(q.measures for q in rest)


def test_the_table_shows_the_worst_and_counts_the_rest(ranking):
    lines = [*ranking.lines(most=3)]
    assert lines[0].split()[:3] == ["episode", "doubt", "frames"]
    assert lines[1].split()[0] == str(ranking.episodes[0].episode)
    assert "and 11 less doubtful episodes" in lines[4]


def test_jerk_knows_neither_units_nor_pace():
    s = np.linspace(0, 1, 400)
    # Minimum jerk: the integral of the squared jerk is 720, its path as long as it is wide.
    path = (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None]
    exact = np.log(720.0)
    assert log_dimensionless_jerk(s, path) == pytest.approx(exact, abs=0.05)
    assert log_dimensionless_jerk(3 * s, 57.3 * path) == pytest.approx(exact, abs=0.05)
    assert np.isnan(log_dimensionless_jerk(s, np.zeros((400, 2))))


# What is decided.


def test_decisions_are_kept_beside_the_dataset(odd, tmp_path):
    root = shutil.copytree(odd, tmp_path / "set")
    before = sorted(root.rglob("*"))
    lengths = [entry.length for entry in open_folder(root).episodes]
    decided = {3: decide("reject", lengths[3]), 5: decide("cut", lengths[5], 85, 200)}
    keep_decisions(root, decided)
    assert read_decisions(root) == decided
    assert sorted(root.rglob("*")) == before
    content = json.loads(decisions_path(root).read_text())
    content["decisions"]["3"]["length"] += 1
    decisions_path(root).write_text(json.dumps(content))
    with pytest.raises(DatasetError, match="belongs to another dataset"):
        read_decisions(root)
    decisions_path(root).write_text("[1]")
    with pytest.raises(DatasetError, match=r"curation.json: expected object, got array"):
        read_decisions(root)


def test_the_name_of_an_episode_is_its_number(tmp_path):
    root = write_set(tmp_path / "set", "v3.0")
    keep_decisions(root, {1: decide("reject", 100)})
    text = decisions_path(root).read_text()
    decisions_path(root).write_text(text.replace('"1"', '"True"'))
    with pytest.raises(DatasetError, match="delete it to begin anew"):
        read_decisions(root)


@pytest.mark.parametrize("cut", [(-1, 10), (5, 6), (5, 5), (9, 3), (0, 101)])
def test_cuts_that_leave_nothing_or_do_not_exist_are_refused(cut):
    with pytest.raises(ValueError, match="must keep two frames"):
        decide("cut", 100, *cut)
    assert decide("cut", 100, 98, 100).stop == 100


def test_no_decision_begins_before_its_episode():
    with pytest.raises(ValueError, match="frames -1 to 0"):
        decide("accept", 100, -1)


def test_the_cleaned_set_is_what_was_decided_and_the_source_as_it_was(tmp_path):
    root = write_set(tmp_path / "set", "v2.1", camera=True)
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    decided = {1: decide("reject", 100), 2: decide("cut", 100, 20, 90)}
    report = write_curated(root, tmp_path / "out", decided)
    old, new = load_demos(root), load_demos(tmp_path / "out")
    assert [*report.changes] == [0, 2, 3, 4]
    np.testing.assert_array_equal(new[0].joint_position, old[0].joint_position)
    np.testing.assert_array_equal(new[1].joint_position, old[2].joint_position[20:90])
    np.testing.assert_array_equal(new[1].command_position, old[2].command_position[20:90])
    shown = load_images(tmp_path / "out", 1)[CAMERA]
    assert (shown == load_images(root, 2, frames=range(20, 90))[CAMERA]).all()
    assert not check_dataset(tmp_path / "out").errors
    assert {path: path.read_bytes() for path in before} == before


def test_what_is_typed_is_decided_before_the_page_opens(tmp_path, monkeypatch):
    root = write_set(tmp_path / "set", "v3.0")
    opened = []
    monkeypatch.setattr(CurationPage, "wait", lambda page: opened.append(dict(page.decisions)))
    monkeypatch.setattr(dataset_commands, "has_screen", lambda: False)
    command = ("curate", root, "--port", 0)
    done(*command, "--reject", 3, "--accept", 1, "--cut", 2, "5:20")
    (decisions,) = opened
    assert {k: d.verdict for k, d in decisions.items()} == {1: "accept", 2: "cut", 3: "reject"}
    assert read_decisions(root) == decisions


@pytest.mark.parametrize(
    ("one", "other"), [("accept", "reject"), ("accept", "cut"), ("cut", "reject")]
)
def test_an_episode_is_not_decided_on_twice(odd, one, other):
    words = {
        name: (f"--{name}", 3, *(("5:20",) if name == "cut" else ())) for name in (one, other)
    }
    error = done("curate", odd, *words[one], *words[other], status=2).error
    assert "--accept, --cut and --reject name episode 3 twice" in error
    assert not decisions_path(odd).exists()


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("--reject", 99), "there is no episode 99; the dataset has 0 to 13"),
        (("--cut", 3, "30"), "--cut 3 30: give the first frame to keep and the one after"),
        (("--cut", 3, "30:9999"), "--cut 3 30:9999: give the first frame to keep"),
    ],
)
def test_a_decision_on_what_does_not_exist_is_refused(odd, words, fault):
    assert fault in done("curate", odd, "--no-browser", *words, status=2).error
    assert not decisions_path(odd).exists()


def test_a_cleaned_set_is_written_from_the_terminal(tmp_path):
    root, out, figures = write_set(tmp_path / "set", "v2.0"), tmp_path / "new", tmp_path / "n"
    lengths = [len(demo) for demo in load_demos(root)]
    options = ("--no-browser", "--reject", 3, "--cut", 1, "20:90", "--out", out)
    written = done("curate", root, *options, "--write", "--json", figures).output
    frames = sum(lengths) - lengths[3] - lengths[1] + 70
    assert f"{out}: 4 episodes, {frames} of {sum(lengths)} frames" in written
    values = json.loads(figures.read_text())
    assert (values["episodes"], values["frames"]) == (5, frames)
    assert (values["episodes_rejected"], values["episodes_cut"]) == (1, 1)
    assert [len(demo) for demo in load_demos(out)] == [lengths[0], 70, lengths[2], lengths[4]]


def test_all_rejected_and_unknown_episodes_are_refused(odd, tmp_path):
    everything = dict.fromkeys(range(14), decide("reject", 100))
    with pytest.raises(DatasetError, match="every episode"):
        write_curated(odd, tmp_path / "out", everything)
    with pytest.raises(DatasetError, match="no such episode"):
        write_curated(odd, tmp_path / "out", {14: decide("reject", 100)})
    assert not (tmp_path / "out").exists()


def test_moves_of_a_gripper_are_counted_without_its_trembling():
    held = np.r_[np.ones(20), np.linspace(1, 0.1, 10), 0.1 + 0.02 * np.sin(np.arange(30))]
    assert gripper_moves(held) == 1
    assert gripper_moves(np.r_[held, np.ones(5), held]) == 3
    assert gripper_moves(np.full(10, 0.3)) == gripper_moves(np.full(10, np.nan)) == 0
    assert gripper_moves(100 * held) == 1
