"""`motion_chunk` knows several ways: averaged where their error explains them, else chosen."""

import math

import pytest
import torch
from lerobot_samples import (
    STATE,
    UNNAMED,
    chunk_policy,
    decaying,
    executed,
    played,
    reaching,
    train,
)

from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkPolicy
from hrc_learn.lerobot.policy.motion_chunks import (
    ChunkDecoder,
    ContinuedMotion,
    MotionChunk,
    Plans,
)

SHOWN = reaching(10)


def two_plans(policy, apart, score):
    """The first stands still, the second is so far off everywhere and has another score."""
    coefficients = torch.zeros(1, 2, 2, policy.decoder.size)
    unit = policy.decoder.project(torch.ones(11, 2))  # one everywhere, as near as may be
    size = policy.decoder.positions(unit).square().mean().sqrt()
    coefficients[0, 1] = apart * unit / size
    return Plans(
        coefficients=coefficients,
        scores=torch.tensor([[0.0, score]]),
        levels=torch.zeros(1, 11, 0),
    )


@pytest.mark.parametrize(("apart", "expected"), [(2.9, "mean"), (3.1, "likeliest")])
def test_plans_are_averaged_where_their_error_explains_how_far_apart_they_are(apart, expected):
    policy = chunk_policy(SHOWN, n_plans=2)
    policy.error.fill_(0.2)
    plans = two_plans(policy, 0.2 * apart, 0.1)
    share = torch.tensor(0.1).sigmoid() if expected == "mean" else 1.0
    second = plans.coefficients[:, 1]
    chosen = policy._chosen(plans, None)
    torch.testing.assert_close(chosen, share * second, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("score", "stays"), [(1.2, True), (1.6, False)])
def test_a_motion_stays_with_its_way_unless_another_is_far_likelier(score, stays):
    """Five errors off: by 5^2 / (2 3^2) = 1.39 in the logarithm."""
    policy = chunk_policy(SHOWN, n_plans=2)
    policy.error.fill_(0.2)
    plans = two_plans(policy, 1.0, score)
    still = torch.zeros(1, 11, 3, 2)
    before = MotionChunk(states=still, stepped=still[:, :, 0, :0], actions=still[:, :, 0])
    assert (policy._chosen(plans, None) != 0).any()
    assert (policy._chosen(plans, before) == 0).all() == stays


@pytest.mark.parametrize("error", [0.0, 1e-12])
def test_plans_without_an_error_are_plans_all_the_same(error):
    """Of demonstrations that stand still."""
    still = [{STATE: torch.ones(40, 2), "action": torch.ones(40, 2)} for _ in range(3)]
    policy = chunk_policy(still, **UNNAMED)
    policy.error.fill_(error)
    made = played(policy, still[0])
    torch.testing.assert_close(made, still[0]["action"], rtol=0, atol=1e-3)


@pytest.mark.gradients
@pytest.mark.simulation
@pytest.mark.long
def test_the_error_of_the_nearest_plan_is_learned_and_kept(tmp_path):
    shown = passing()
    policy = chunk_policy(shown, chunk_size=20, n_basis=8, **UNNAMED)
    at_first = float(policy.error)  # of the linear function, which goes between
    assert at_first > 0.3
    assert chunk_policy(decaying(), **UNNAMED).error < 0.05  # whose future is linear
    train(policy, shown, 200)
    assert policy.error < 0.5 * at_first
    policy.save_pretrained(tmp_path)
    assert MotionChunkPolicy.from_pretrained(tmp_path).error == policy.error


def passing(count=24, frames=40):
    """Past an obstacle at (1, 0), half of the times on either side, from the same place."""
    rng = torch.Generator().manual_seed(0)
    x = torch.linspace(0, 2, frames)
    episodes = []
    for k in range(count):
        side = 1 if k % 2 else -1
        y = side * 0.6 * torch.sin(math.pi * x / 2) ** 2
        path = torch.stack([x, y + 0.02 * torch.randn((), generator=rng)], dim=-1)
        episodes.append({STATE: path, "action": path})
    return episodes


def sides(policy, count):
    """Where each of so many motions passes the obstacle."""
    passes = []
    for _ in range(count):
        path = executed(policy, torch.zeros(2), 32)
        passes.append(path[(path[:, 0] - 1).abs().argmin(), 1])
    return torch.stack(passes)


@pytest.mark.slow
def test_both_ways_round_an_obstacle_are_kept_and_none_between():
    shown = passing()
    settings = dict(chunk_size=20, n_action_steps=5, n_basis=8, hidden_dim=64, **UNNAMED)
    policy = train(chunk_policy(shown, sample_plans=True, **settings), shown, 1000)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        y = sides(policy, 60)
    in_a_mode = (y.abs() - 0.6).abs() < 0.2
    assert in_a_mode.float().mean() >= 0.95
    assert 0.25 < (y > 0).float().mean() < 0.75
    # The likeliest is one of them, always the same.
    policy.config.sample_plans = False
    assert sides(policy, 2).diff().abs() == 0


def under_way():
    """A motion of ten samples of which two are wide: sample k is at (k, -k), at rate 1."""
    motion = ContinuedMotion(ChunkDecoder(9, 0.05, 4), compose=lambda smooth, _: smooth)
    assert motion.decoder.samples == 10
    k = torch.arange(10.0)
    states = torch.zeros(1, 10, 3, 2)
    states[0, :, 0], states[0, :, 1] = torch.stack([k, -k], 1), torch.tensor([1.0, -1.0])
    stepped = (k > 4)[None, :, None].float()
    motion.chunk = MotionChunk(states=states, stepped=stepped, actions=states[:, :, 0])
    return motion


@pytest.mark.parametrize(("steps", "first"), [(0, 0), (3, 3), (9, 9), (12, 9)])
def test_what_is_left_of_a_chunk_stands_still_beyond_its_end(steps, first):
    rest = under_way().after(steps)
    expected = torch.arange(first, first + 10).clamp(max=9).float()
    assert torch.equal(rest.states[0, :, 0, 0], expected)
    assert torch.equal(rest.actions[0, :, 1], -expected)
    assert torch.equal(rest.stepped[0, :, 0], (expected > 4).float())
    moving = torch.arange(10) + steps <= 9
    assert torch.equal(rest.states[0, :, 1, 0], moving.float())


@pytest.mark.parametrize(
    ("at", "first"), [((6.2, -5.9), 6), ((-5.0, 5.0), 1), ((50.0, 0.0), 9)]
)
def test_a_motion_goes_on_from_its_nearest_action_but_the_first(at, first):
    rest = under_way().nearest(torch.tensor([at]))
    assert rest.states[0, 0, 0, 0] == first


@pytest.mark.parametrize(
    ("left", "first"),
    [
        ([[4.0, -4.0], [5.0, -5.0]], 4),
        ([[4.0, -4.0], [5.0, -5.0], [0.0, 0.0]], 4),  # filled up with zeros
        ([[0.0, 0.0], [1.0, -1.0]], 0),
        ([[0.0, 0.0]], 9),  # none is left over
        ([[4.0, -4.0], [6.0, -6.0]], None),  # of another source
    ],
)
def test_actions_left_over_are_found_in_the_last_chunk(left, first):
    rest = under_way().left_over(torch.tensor(left))
    assert (None if rest is None else rest.states[0, 0, 0, 0]) == first


def test_nothing_under_way_has_no_rest():
    motion = under_way()
    motion.reset()
    assert motion.after(1) is None
    assert motion.nearest(torch.zeros(1, 2)) is None
    assert motion.left_over(torch.ones(1, 2)) is None


def planned(seed, batch=2):
    """Coefficients of two smooth columns, and a column that jumps."""
    rng = torch.Generator().manual_seed(seed)
    motion = ContinuedMotion(
        ChunkDecoder(9, 0.05, 4), compose=lambda smooth, levels: torch.cat([smooth, levels], -1)
    )
    shape = (batch, 2, motion.decoder.size)
    coefficients = 0.1 * torch.randn(shape, generator=rng, dtype=torch.float64)
    levels = (torch.rand(batch, 10, 1, generator=rng) > 0.5).double()
    return motion, coefficients, levels


@pytest.mark.parametrize("delay", [0, 4])
def test_a_motion_begins_where_its_plan_does_or_where_the_arm_is(delay):
    """Nothing is carried out yet, so there is nothing to wait for."""
    motion, coefficients, levels = planned(0)
    own = motion.decoder.states(coefficients)[:, 0]
    moving = own + torch.tensor([[0.02, -0.01], [0.1, 0.2], [-0.3, 0.5]]).double()
    for beginning in (None, moving):
        actions = motion.go_on(coefficients, levels, None, beginning=beginning, delay=delay)
        chunk, start = motion.chunk, own if beginning is None else beginning
        torch.testing.assert_close(chunk.states[:, 0], start, atol=1e-9, rtol=0)
        assert torch.equal(chunk.stepped, levels)
        assert torch.equal(chunk.actions, actions)
        assert torch.equal(actions, torch.cat([chunk.states[:, :, 0], levels], -1))
    plan = motion.decoder.positions(coefficients)
    motion.go_on(coefficients, levels, None, delay=delay)
    torch.testing.assert_close(motion.chunk.states[:, :, 0], plan, atol=1e-9, rtol=0)


@pytest.mark.parametrize("delay", [0, 1, 4, 9, 30])
def test_actions_that_are_carried_out_meanwhile_stay_and_the_motion_goes_on(delay):
    motion, coefficients, levels = planned(1)
    _, others, switched = planned(2)
    motion.go_on(others, switched, None)
    before, given = motion.chunk, levels.clone()
    motion.go_on(
        coefficients, levels, before, beginning=torch.ones(2, 3, 2).double(), delay=delay
    )
    assert torch.equal(levels, given)
    after, kept = motion.chunk, min(delay, 9)
    assert torch.equal(after.states[:, :kept], before.states[:, :kept])
    assert torch.equal(after.stepped[:, :kept], switched[:, :kept])
    assert torch.equal(after.stepped[:, kept:], levels[:, kept:])
    # Position, velocity and acceleration are continuous where the plan takes over.
    torch.testing.assert_close(
        after.states[:, kept], before.states[:, kept], atol=1e-7, rtol=1e-7
    )
    if kept < 9:
        assert (after.states[:, -1, 0] - before.states[:, -1, 0]).abs().max() > 0.01
