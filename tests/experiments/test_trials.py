"""Trials over seeds: resumed, in several processes, failed."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from power_cuts import cut_off
from trial_runs import Breaks

from hrc_learn.experiments.trials import Trial, TrialFile, repeat


class TaskFailedError(Exception):
    """Tells that a trial failed."""


MADE_BY = {"speed": 1.5, "model": Path("models/placing")}


def square(seed):
    return {"square": seed**2, "place": "shelf"}


def stumbles(seed):
    if seed == 3:
        raise TaskFailedError("dropped it")
    return {"square": seed**2, "failure": "too slow" if seed == 5 else ""}


def lines(file):
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_each_seed_is_run_once_and_written(tmp_path):
    file = tmp_path / "new" / "of today" / "trials.jsonl"
    trials = repeat(square, [4, 2, 4], file, made_by=MADE_BY)
    assert [trial.seed for trial in trials] == [4, 2]
    assert trials[0].values == {"square": 16, "place": "shelf"}
    head, *rows = lines(file)
    assert head == {"made_by": {"speed": 1.5, "model": "models/placing"}}
    assert rows[1] == {"seed": 2, "failure": "", "square": 4, "place": "shelf"}


def test_a_failed_trial_is_a_row_with_its_reason(tmp_path):
    trials = repeat(
        stumbles,
        range(6),
        tmp_path / "t.jsonl",
        made_by=MADE_BY,
        failures=(TaskFailedError,),
    )
    assert {t.seed: t.failure for t in trials if t.failure} == {3: "dropped it", 5: "too slow"}
    assert trials[5].values == {"square": 25}


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.long)])
def test_an_unexpected_error_stops_all_names_its_seed_and_loses_nothing(tmp_path, processes):
    file = tmp_path / "t.jsonl"
    with pytest.raises(ZeroDivisionError) as caught:
        repeat(Breaks(2), [0, 1, 2], file, made_by=MADE_BY, processes=processes)
    assert "seed 2" in caught.value.__notes__[0]
    kept = lines(file)[1:]
    assert 1 <= len(kept) <= 2
    # Several processes are others than this one, and one is this one.
    assert {row["process"] == os.getpid() for row in kept} == {processes == 1}
    trials = repeat(Breaks(9), range(3), file, made_by=MADE_BY)
    assert [trial.seed for trial in trials] == [0, 1, 2]
    assert trials[kept[0]["seed"]].values["process"] == kept[0]["process"]


def test_what_is_in_the_file_is_not_run_again(tmp_path):
    file = tmp_path / "t.jsonl"
    repeat(square, range(3), file, made_by=MADE_BY)
    asked = []
    repeat(lambda seed: asked.append(seed) or {}, range(5), file, made_by=MADE_BY)
    assert asked == [3, 4]


def test_a_line_that_was_cut_short_is_tried_again(tmp_path):
    file = tmp_path / "t.jsonl"
    repeat(square, range(3), file, made_by=MADE_BY)
    whole = file.read_text()
    file.write_text(whole[:-9])
    repeat(square, range(3), file, made_by=MADE_BY)
    assert file.read_text() == whole


def test_trials_of_something_else_are_refused(tmp_path):
    file = tmp_path / "t.jsonl"
    repeat(square, [0], file, made_by=MADE_BY)
    with pytest.raises(ValueError, match=r"t\.jsonl .*speed is 1\.5 in the file, but 2\.0 now"):
        repeat(square, [0], file, made_by=MADE_BY | {"speed": 2.0})
    other = tmp_path / "notes.txt"
    for text in ("a shopping list\n", "", "[]\n"):
        other.write_text(text)
        with pytest.raises(ValueError, match="holds no trials"):
            repeat(square, [0], other, made_by=MADE_BY)
        assert other.read_text() == text


@pytest.mark.parametrize(("seeds", "processes"), [([], 1), ([0], 0)])
def test_nothing_to_do_is_refused(tmp_path, seeds, processes):
    with pytest.raises(ValueError, match="at least one seed and one process"):
        repeat(square, seeds, tmp_path / "t.jsonl", made_by=MADE_BY, processes=processes)
    assert not list(tmp_path.iterdir())


def test_what_is_no_number_or_text_is_refused(tmp_path):
    with pytest.raises(ValueError, match="path must be a number or text, but is a list"):
        repeat(lambda seed: {"path": [1]}, [0], tmp_path / "t.jsonl", made_by={})


def test_lines_keep_what_was_measured():
    trial = Trial.of(
        7, {"error": np.float64(0.1), "steps": np.int64(3), "ok": True, "t": math.inf}
    )
    again = Trial.from_line(trial.line())
    assert again.seed == 7
    assert again.values["error"] == 0.1
    assert again.values["steps"] == 3
    assert again.values["ok"] is True
    assert again.values["t"] != again.values["t"]  # NaN


def test_two_runs_do_not_write_one_file(tmp_path):
    """They would both try the same seeds, and each end with half of the trials."""
    file = tmp_path / "t.jsonl"

    def again(seed):
        repeat(square, [seed], file, made_by=MADE_BY)
        return {}

    with pytest.raises(FileExistsError, match="is being written by process"):
        repeat(again, [0], file, made_by=MADE_BY)
    assert list(tmp_path.iterdir()) == [file]


def test_trials_cut_off_at_any_step_go_on_where_they_ended(tmp_path):
    file = tmp_path / "t.jsonl"

    def add_missing(seeds):
        # As `repeat` does, without a process for the trials.
        with TrialFile(file, MADE_BY) as done:
            for seed in seeds:
                if seed not in done.trials:
                    done.append(Trial.of(seed, square(seed)))
            return sorted(done.trials)

    for _ in cut_off(lambda: add_missing([0, 1])):
        assert add_missing([0, 1, 2]) == [0, 1, 2]
        assert list(tmp_path.iterdir()) == [file]
        file.unlink()
