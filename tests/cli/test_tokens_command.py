"""`hrc tokens`: what it fits, measures and refuses."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from clean_sets import FPS, write_set
from commands import done

from hrc_learn.dmp.tokens import MotionTokenizer

SMALL = ("--config", "vocabulary_size=64", "tolerance=0.02", "seconds=0.5")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("tokens") / "set", "v3.0")


@pytest.fixture(scope="module")
def fitted(dataset):
    figures = dataset.parent / "fit.json"
    done("tokens", "fit", "--dataset", dataset, "--json", figures, *SMALL)
    return dataset.with_name("set_tokens"), json.loads(figures.read_text())


def test_a_fit_measures_episodes_that_it_left_out(dataset, fitted):
    folder, figures = fitted
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    action = np.array(table["action"].to_pylist())[np.array(table["episode_index"]) == 4]
    # The fifth episode alone; half a second, and two frames for the state before it.
    assert figures["chunks"] == len(action) - 15 - 1
    tokenizer = MotionTokenizer.load(folder / "tokens")
    assert tokenizer.vocabulary_size == 64
    assert tokenizer.steps == [6]
    time = np.arange(16) / FPS
    starts = range(1, len(action) - 15)
    motions = np.stack([action[t : t + 16] for t in starts])
    velocity = np.stack([(action[t] - action[t - 1]) * FPS for t in starts])
    ids = tokenizer.encode(time, motions, velocity)
    error = tokenizer.decode(ids, time, motions[:, 0], velocity).numpy() - motions
    assert figures["rmse"] == pytest.approx(np.sqrt(np.mean(error[:, 1:] ** 2)), rel=1e-6)
    assert figures["tokens_mean"] < 8
    assert figures["bits_per_s"] == pytest.approx(figures["tokens_mean"] * 6 / 0.5, rel=1e-3)


def test_a_report_repeats_the_figures_of_the_fit(dataset, fitted, tmp_path):
    folder, figures = fitted
    file = tmp_path / "report.json"
    outcome = done("tokens", "report", "--dataset", dataset, "--model", folder, "--json", file)
    assert "tokens per chunk" in outcome.output
    assert json.loads(file.read_text()) == pytest.approx(figures)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("report",), "needs --model"),
        (("report", "--config", "seconds=1"), "--config belongs to hrc tokens fit"),
        (("fit", "--model", "x"), "--model belongs to hrc tokens report"),
        (
            ("fit", "--config", "feature=velocity"),
            "has no feature 'velocity'; it has observation.state, action",
        ),
        (("fit", "--config", "seconds=100"), "shorten seconds"),
        (("fit", "--config", "tolerance=-1"), "tolerance must lie between 0 and 1"),
        (("report", "--model", "nowhere"), "nowhere"),
        (("report", "--model", "."), "tokens/config.json does not exist"),
    ],
)
def test_wrong_words_are_named(dataset, tmp_path, words, message):
    out = ("--out", tmp_path / "out") if words[0] == "fit" else ()
    outcome = done("tokens", *words, "--dataset", dataset, *out, status=2)
    assert message in " ".join(outcome.error.split())
    assert not (tmp_path / "out").exists()
