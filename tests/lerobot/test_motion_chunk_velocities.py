"""`motion_chunk` sees how fast the state changes, and what hardly varies leads it nowhere."""

import math

import pytest
import torch
from lerobot_samples import (
    FPS,
    GOAL,
    IMAGE,
    STATE,
    UNNAMED,
    chunk_policy,
    played,
    reaching,
    stats_of,
    train,
    wild,
    windows,
)

SHOWN = reaching(10)


def heard(policy):
    """What the network is told of velocities: their values, and whether they are known."""
    told = []
    policy.network.register_forward_pre_hook(lambda _, inputs: told.append(inputs[1:]))
    return told


def turning_about(frames=30):
    """A hand that points down and turns past half a turn, where vectors jump, and a slide."""
    turn = torch.pi + torch.linspace(-0.4, 0.6, frames) ** 2
    turn = torch.where(turn > torch.pi, turn - 2 * torch.pi, turn)
    slide = torch.linspace(0, 1, frames) ** 3
    state = torch.stack([turn, 0 * turn, 0 * turn, slide], dim=-1)
    return {STATE: state, "action": state}


HAND = ["ee.wx", "ee.wy", "ee.wz", "slide.pos"]


@pytest.mark.parametrize("history", [1, 2, 5])
@pytest.mark.parametrize(
    ("episode", "names"),
    [
        (SHOWN[0], {}),
        (turning_about(), {"state_names": HAND, "action_feature_names": HAND}),
    ],
    ids=["joints", "hand"],
)
def test_velocities_are_the_same_in_training_and_in_use(history, episode, names):
    """Of frames as they are loaded, and of those that went by; at first neither knows it."""
    policy = chunk_policy([episode], history=history, n_action_steps=1, **names).eval()
    told = heard(policy)
    batch = windows(policy, [episode]).batch(torch.arange(20))
    assert batch[STATE].shape[1] == 2
    policy.forward(batch)
    played(policy, {key: x[:20] for key, x in episode.items()})
    velocity, known = (torch.cat(x) for x in zip(*told[1:], strict=True))
    assert known.tolist() == [0.0] * history + [1.0] * (20 - history)
    torch.testing.assert_close(told[0][1], known, rtol=0, atol=0)
    sure = known > 0
    torch.testing.assert_close(told[0][0][sure], velocity[sure], rtol=0, atol=1e-5)


def test_of_two_frames_the_later_one_is_what_is_seen():
    episodes, rng = SHOWN[:2], torch.Generator().manual_seed(0)
    episodes = [
        e | {IMAGE: torch.rand(len(e[STATE]), 3, 16, 24, generator=rng)} for e in episodes
    ]
    policy, seen = chunk_policy(episodes).eval(), []
    policy.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    policy.forward(windows(policy, episodes).batch(torch.arange(12)))
    now = {key: episodes[0][key][:12] for key in (STATE, GOAL, IMAGE)}
    torch.testing.assert_close(seen[0], policy.encoder(now))


def test_observations_may_be_written_over_one_another():
    """As of a loop that fills one array again and again."""
    policy = chunk_policy(SHOWN, n_action_steps=1)
    told = heard(policy)
    seen = {key: SHOWN[0][key][:1].clone() for key in (STATE, GOAL)}
    for k in range(10):
        seen[STATE].copy_(SHOWN[0][STATE][k])
        policy.select_action(seen)
    played(policy, SHOWN[0], 10)
    torch.testing.assert_close(told[9][0], told[19][0])
    assert told[9][0].any()


def test_velocities_are_differences_in_their_own_spread():
    policy = chunk_policy(SHOWN, history=3, n_action_steps=1)
    told = heard(policy)
    played(policy, SHOWN[0])
    rates = torch.cat([e[STATE].diff(dim=0) * FPS for e in SHOWN])
    spread = rates.square().mean(0).sqrt()
    moves = spread > 0
    off = (SHOWN[0][STATE][13] - SHOWN[0][STATE][10]) * FPS / 3
    expected = off[moves] / spread[moves]
    torch.testing.assert_close(told[13][0][0, moves], expected, rtol=1e-4, atol=0)


def test_after_a_reset_and_for_chunks_alone_no_velocity_is_known():
    policy = chunk_policy(SHOWN, n_action_steps=1)
    told = heard(policy)
    played(policy, {key: x[:5] for key, x in SHOWN[0].items()})
    policy.predict_action_chunk({key: SHOWN[0][key][5:6] for key in (STATE, GOAL)})
    policy.select_action({key: SHOWN[0][key][6:7] for key in (STATE, GOAL)})
    policy.reset()
    played(policy, {key: x[:3] for key, x in SHOWN[1].items()})
    assert [float(known) for _, known in told] == [0, 0, 1, 1, 1, 0, 0, 0, 0, 1]


def test_a_frame_that_was_not_measured_leaves_the_velocity_unknown():
    """Between two chunks; what a chunk is planned from must be measured."""
    policy = chunk_policy(SHOWN, n_action_steps=3)
    told = heard(policy)
    seen = [{key: SHOWN[0][key][k : k + 1] for key in (STATE, GOAL)} for k in range(7)]
    seen[1][STATE] = torch.full((1, 3), torch.nan)
    made = [policy.select_action(x) for x in seen]
    assert torch.cat(made).isfinite().all()
    assert [float(known) for _, known in told] == [0, 0, 1]
    assert not told[1][0].any()


def test_three_samples_in_ten_are_trained_without_their_velocity():
    policy = chunk_policy(SHOWN)
    told = heard(policy)
    batch = windows(policy, SHOWN).draw(4000, torch.Generator().manual_seed(0))
    moving = ~batch[f"{STATE}_is_pad"][:, 0]
    for training in (True, False):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            policy.train(training).forward(batch)
    (_, known), (_, all_known) = told
    torch.testing.assert_close(all_known, moving.float(), rtol=0, atol=0)
    assert not known[~moving].any()
    assert 0.67 < known[moving].mean() < 0.73
    # What is unknown has no effect, whatever it would be.
    policy = wild(policy.eval())
    features, velocity = policy.encoder({k: SHOWN[0][k][:5] for k in (STATE, GOAL)}), told[0][0]
    for share, same in ((0.0, True), (1.0, False)):
        plans = [
            policy.network(features, v, torch.full((5,), share)).coefficients
            for v in (velocity[:5], velocity[5:10] + 1)
        ]
        assert torch.equal(*plans) == same


def test_without_a_history_one_frame_is_loaded_and_seen():
    policy = chunk_policy(SHOWN, history=0)
    assert policy.config.observation_delta_indices is None
    batch = windows(policy, SHOWN).batch(torch.arange(6))
    assert batch[STATE].ndim == 2
    told = heard(policy)
    assert policy.forward(batch)[0].isfinite()
    played(policy, SHOWN[0])
    assert told[-1][0].shape == (1, 0)


def there_and_back(count=12, frames=60):
    """Along a line and back through the same places: where to depends on the way one comes."""
    rng = torch.Generator().manual_seed(0)
    time = torch.linspace(0, math.pi, frames)[:, None]
    paths = [(1 + 0.05 * torch.randn(1, generator=rng)) * torch.sin(time) for _ in range(count)]
    return [{STATE: x, "action": x} for x in (p.expand(-1, 2).clone() for p in paths)]


@pytest.mark.gradients
@pytest.mark.simulation
@pytest.mark.long
def test_velocities_tell_the_way_there_from_the_way_back():
    shown = there_and_back()
    errors = []
    for history in (2, 0):
        settings = dict(n_action_steps=5, n_plans=1, history=history, **UNNAMED)
        policy = train(chunk_policy(shown, **settings), shown, 150)
        made = played(policy, shown[0])
        errors.append((made - shown[0]["action"])[10:].square().mean().sqrt())
    assert errors[0] < 0.4 * errors[1]


# Numbers that hardly vary.


def trembling(names=None, size=1e-5):
    """Demonstrations in which a column, or a hand that points down, follows by a tremble."""
    episodes = []
    for e in SHOWN:
        way = e["action"][:, :1]
        small = size * torch.cat([way, way.sin(), way.square()], dim=-1)
        if names:
            small = small + torch.tensor([math.pi, 0.0, 0.0])
        state = torch.cat([e[STATE], small if names else small[:, :1]], dim=-1)
        episodes.append({STATE: state, GOAL: e[GOAL], "action": e["action"]})
    return episodes


@pytest.mark.parametrize(
    ("names", "off"), [(None, 1e-3), (["ee.wx", "ee.wy", "ee.wz"], 0.01)], ids=["joint", "hand"]
)
def test_what_only_trembles_leads_no_motion_astray(names, off):
    """Off by a hundred times what was shown, or more, it changes next to nothing."""
    shown = trembling(names)
    named = ["b.pos", "gripper.pos", "a.pos", *(names or ["held.pos"])]
    policy = chunk_policy(shown, state_names=named)
    seen = {key: shown[0][key][10:11].clone() for key in (STATE, GOAL)}
    usual = policy.predict_action_chunk(seen)
    policy.reset()
    seen[STATE][:, 3:] += off
    moved = policy.predict_action_chunk(seen) - usual
    assert moved.abs().max() < 0.05 * stats_of(shown)["action"]["std"].max()


def test_slow_columns_are_not_blown_up_as_velocities():
    """A held joint that is shaken: slow beside what moves, fast beside what it did."""
    policy = chunk_policy(trembling(), n_action_steps=1, state_names=[*"bga", "held"])
    told = heard(policy)
    seen = {key: x[:3].clone() for key, x in trembling()[0].items()}
    seen[STATE][2, 3] += 2e-4
    played(policy, seen, 3)
    assert told[2][1] == 1
    assert told[2][0][0, 3].abs() < 1
