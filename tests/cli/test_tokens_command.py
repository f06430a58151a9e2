"""`hrc tokens`: what it fits, measures and refuses."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from clean_sets import FPS, write_set
from commands import done

from hrc_learn.cli.tokens_command import held_out, read_chunks
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
    ranges = np.ptp(motions.reshape(-1, motions.shape[-1]), axis=0)
    relative = np.sqrt(np.mean((error[:, 1:] / ranges) ** 2))
    assert figures["rmse_of_range"] == pytest.approx(relative, rel=1e-6)
    counts = sorted(tokenizer.length(row) for row in ids.tolist())
    assert figures["tokens_mean"] == pytest.approx(sum(counts) / len(counts))
    assert figures["tokens_p95"] == pytest.approx(np.quantile(counts, 0.95))
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


@pytest.mark.parametrize("number", range(7))
@pytest.mark.parametrize("count", range(14))
def test_every_nth_episode_is_held_out_but_never_the_only_one(count, number):
    episodes = [7 * k + 3 for k in range(count)]
    kept = held_out(episodes, number)
    if number == 0 or count == 0 or (count == 1 and number > 1):
        assert kept == []
    elif count < number:
        assert kept == episodes[-1:]
    else:
        assert kept == [episodes[k] for k in range(count) if (k + 1) % number == 0]


@pytest.mark.parametrize(
    ("seconds", "frames", "most"),
    [(0.5, 15, 10_000), (0.5, 15, 40), (0.01, 2, 10_000), (2 / FPS, 2, 7), (5.5, 165, 100)],
)
def test_chunks_are_spread_evenly_over_the_episodes(dataset, seconds, frames, most):
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    action, episode = (np.array(table[key].to_pylist()) for key in ("action", "episode_index"))
    chosen = [action[episode == k] for k in (1, 3, 4)]
    # A chunk, the known frame and the frame before it must fit.
    counts = [max(len(x) - frames - 1, 0) for x in chosen]
    stride = -(-sum(counts) // most)
    expected, speeds = [], []
    for values, count in zip(chosen, counts, strict=True):
        for first in range(0, count, stride):
            speeds.append((values[first + 1] - values[first]) * FPS)
            expected.append(values[first + 1 : first + 2 + frames])
    found = read_chunks(dataset, "action", seconds, [1, 3, 4], most)
    np.testing.assert_allclose(found.time, np.arange(frames + 1) / FPS)
    np.testing.assert_array_equal(found.motions, expected)
    np.testing.assert_allclose(found.start_velocity, speeds)
    assert len(expected) <= most + len(chosen)


def test_a_chunk_may_be_as_long_as_the_longest_episode_allows(dataset):
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    longest = max(np.bincount(np.array(table["episode_index"])))
    every = [*range(5)]
    found = read_chunks(dataset, "action", (longest - 2) / FPS, every, 100)
    assert found.motions.shape[:2] == (1, longest - 1)
    with pytest.raises(ValueError, match=f"has {longest + 1} frames: shorten seconds"):
        read_chunks(dataset, "action", (longest - 1) / FPS, every, 100)
