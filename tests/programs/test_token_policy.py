"""The benchmark of policies that write tokens, without an environment."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import bench_token_policy as bench  # pyright: ignore[reportMissingImports]
import token_writer  # pyright: ignore[reportMissingImports]


@pytest.fixture
def episodes():
    """Reaches from 0 to a place that is seen, 40 frames of 20 a second."""
    s = torch.linspace(0, 1, 40)[1:, None]
    places = torch.tensor([[-1.0, 0.5], [-0.4, 0.1], [0.3, 0.9], [0.8, -0.7], [0.5, 0.2]])
    return [
        {bench.STATE: place.expand(39, 2), bench.ACTION: s * s * (3 - 2 * s) * place}
        for place in places
    ]


@pytest.fixture
def job(episodes):
    return bench.Job("reach", episodes, 20.0, 10)


@pytest.mark.parametrize(("code", "most"), [("ours", 0.05), ("bins", 0.005)])
def test_a_chunk_survives_its_tokens(job, code, most):
    made, ids, figures = job.encoded(code)
    assert len(ids) == len(job.learned.chunk) == 195
    assert all(0 <= i < made.size for row in ids for i in row)
    assert 0 < figures["code_rmse"] < most


def test_actions_before_an_episode_are_its_first(job, episodes):
    """They are predicted from what is seen; the first action here is linear in the place."""
    first = np.stack([e[bench.ACTION][0].numpy() for e in episodes])
    places = np.stack([e[bench.STATE][0].numpy() for e in episodes])
    assert job.restored(job.begun(places)) == pytest.approx(first, abs=0.01)
    assert (job.learned.velocity[::39] == 0).all()
    assert job.learned.start[2] == pytest.approx(job.learned.chunk[1, 0])


@pytest.mark.long  # the first optimiser of a process takes seconds to import
def test_a_trained_policy_follows_what_is_seen(job):
    made, ids, _ = job.encoded("bins")
    training = token_writer.Training(job.learned, made.size, ids, seed=0, width=32, layers=1)
    losses = training.run(20)
    assert losses[-1] < losses[0]
    policy = token_writer.Policy(training.writer, made)
    some = job.learned.some(8)
    chunks, failed = policy.act(some, relaxed=False)
    assert chunks.shape == some.chunk.shape
    assert not failed.any()


def test_writing_takes_the_most_probable_token_of_the_whole_sequence():
    """With the keys kept, as when the network reads all tokens anew for each."""
    torch.manual_seed(0)
    inputs = torch.randn(5, 3)
    writer = token_writer.Writer(inputs, 12, 6, 16, 2)
    for p in writer.parameters():
        torch.nn.init.normal_(p, std=0.5)
    ids = writer.write(inputs, None)
    with torch.no_grad():
        assert torch.equal(writer(inputs, ids[:, :-1]).argmax(-1), ids)
    end = int(ids[0, 2])
    ended = writer.write(inputs, end)
    k = ids[0].tolist().index(end)
    assert ended[0].tolist() == ids[0, : k + 1].tolist() + [end] * (ended.shape[1] - k - 1)


def test_intervals_are_those_of_student():
    values = [0.3, 0.5, 0.4]
    mean, half = bench.interval(values)
    low, high = stats.t.interval(0.95, 2, np.mean(values), stats.sem(values))
    assert (mean - half, mean + half) == pytest.approx((low, high))
