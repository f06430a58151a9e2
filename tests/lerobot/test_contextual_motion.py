"""Policies by regression, against loops over the demonstrations, and samples of these."""

import math

import pytest
import torch
from lerobot_samples import SampleWindows, reaching, write_dataset

from hrc_learn.dmp import GaussianBasis, SpringDamper, response_of
from hrc_learn.dmp.trajectory import Trajectory
from hrc_learn.lerobot.policy import policy_base
from hrc_learn.lerobot.policy.contextual_motion import (
    DURATIONS,
    HARMONICS,
    ContextualMotion,
    fit_closed_form,
)

EPISODES = reaching(3)
DELTAS = {"observation.state": [-1000, 0], "action": [-2, 0, 5], "observation.goal": None}


def test_samples_are_what_a_loop_over_frames_gives():
    episodes = [e | {"observation.goal": e["observation.environment_state"]} for e in EPISODES]
    samples = SampleWindows(episodes, DELTAS, fps=20)
    batch = samples.batch(torch.arange(len(samples)))
    k = 0
    for episode in episodes:
        frames = len(episode["action"])
        for frame in range(frames):
            assert batch["timestamp"][k].item() == pytest.approx(frame / 20)
            assert batch["observation.goal"][k].equal(episode["observation.goal"][frame])
            for key, deltas in list(DELTAS.items())[:2]:
                for i, delta in enumerate(deltas):
                    there = min(max(frame + delta, 0), frames - 1)
                    assert batch[key][k, i].equal(episode[key][there])
                    assert batch[f"{key}_is_pad"][k, i] == (there != frame + delta)
            k += 1
    assert len(samples) == k


def test_samples_are_drawn_from_all_frames():
    samples = SampleWindows(EPISODES, {"action": None}, fps=20)
    drawn = samples.draw(500, torch.Generator().manual_seed(0))
    again = samples.draw(500, torch.Generator().manual_seed(0))
    assert drawn["action"].equal(again["action"])
    assert len(drawn["timestamp"].unique()) > 30


def motion_of(*, context: int = 2) -> ContextualMotion:
    response = response_of(SpringDamper(), GaussianBasis(count=12))
    motion = ContextualMotion(response, 2, context, features=4, hidden=8)
    return motion.double()


def fitted(demonstrations, contexts):
    motion = motion_of(context=contexts.shape[1])
    return motion, fit_closed_form(motion, demonstrations, contexts, fps=20.0)


ACTIONS = [episode["action"].double() for episode in EPISODES]
GOALS = torch.stack([episode["observation.environment_state"][0] for episode in EPISODES])
GOALS = GOALS.double() - GOALS.double().mean(0)


def traced(motion, x):
    """A primitive's path at a hundred moments of its own duration, and that."""
    motion.base.data.copy_(x)  # durations count from it
    p = motion.primitives(x[None])
    rate = p.start_velocity * p.duration[:, None]
    path = Trajectory(
        coordinates=torch.cat([p.weights, torch.stack([rate, p.start, p.goal], -1)], -1),
        s=torch.linspace(0, 1, 100, dtype=torch.float64),
        duration=p.duration,
        response=motion.response,
    ).position
    return path[0].detach(), p.duration.log().detach()


def test_the_error_of_the_mean_is_that_of_demonstrations_left_out():
    """Each by itself, against the mean of the others, moment by moment."""
    nothing = torch.zeros(len(ACTIONS), 2, dtype=torch.float64)
    motion, error = fitted(ACTIONS, nothing)
    each = [fitted([action], nothing[:1])[0].base.detach() for action in ACTIONS]
    torch.testing.assert_close(motion.base.detach(), torch.stack(each).mean(0))
    assert not motion.slopes.any()
    squares, durations = [], []
    for k, x in enumerate(each):
        others = torch.stack([y for i, y in enumerate(each) if i != k]).mean(0)
        (path, log_duration), (mean, mean_log) = traced(motion, x), traced(motion, others)
        squares.append((path - mean).square().mean())
        durations.append((log_duration - mean_log).square())
    expected = torch.stack(squares).mean() + torch.stack(durations).mean()
    assert error == pytest.approx(expected.sqrt().item(), rel=1e-6)


def test_one_demonstration_tells_no_error():
    assert math.isnan(fitted(ACTIONS[:1], GOALS[:1])[1])


def test_contexts_count_as_far_as_half_of_their_range_beyond_it():
    motion, _ = fitted(ACTIONS, GOALS)
    low, high = GOALS.amin(0), GOALS.amax(0)
    torch.testing.assert_close(motion.low, low - (high - low) / 2)
    torch.testing.assert_close(motion.high, high + (high - low) / 2)
    torch.testing.assert_close(motion.centre, GOALS.mean(0))


@pytest.mark.parametrize(("count", "follows"), [(3, False), (4, True)])
def test_a_regression_takes_four_demonstrations(count, follows):
    episodes = reaching(count, seed=2)
    actions = [episode["action"].double() for episode in episodes]
    goals = torch.stack([action[-1] for action in actions])
    assert bool(fitted(actions, goals)[0].slopes.any()) == follows


def test_what_hardly_differs_between_demonstrations_is_left_out():
    """Numbers that vary by less than a twentieth of their spread, which is one."""
    episodes = reaching(12, seed=2)
    actions = [episode["action"].double() for episode in episodes]
    goals = torch.stack([action[-1] for action in actions])
    goals = (goals - goals.mean(0)) / goals.std(0, correction=0)
    contexts = torch.cat([goals, 0.049 * goals[:, :1] + 7, 0.051 * goals[:, 1:]], dim=-1)
    motion, error = fitted(actions, contexts)
    assert motion.slopes.abs().sum(-1).gt(0).tolist() == [True, True, False, True]
    _, of_the_mean = fitted(actions, torch.zeros_like(goals))
    assert error < 0.5 * of_the_mean
    # The goal is the last coordinate before the next one's, and follows the context.
    reached = motion.primitives(motion.base + (contexts - motion.centre) @ motion.slopes).goal
    ends = torch.stack([action[-1] for action in actions])
    assert (reached - ends).norm(dim=-1).max() < 0.1 * ends.std(0).norm()


def test_of_many_demonstrations_some_are_read_spread_evenly(tmp_path, monkeypatch):
    episodes = reaching(5)
    folder = write_dataset(tmp_path / "set", episodes)
    monkeypatch.setattr(policy_base, "MOST", 3)
    read = policy_base.read_episodes(folder, ["action"])
    assert len(read) == 3
    for found, k in zip(read, (0, 2, 4), strict=True):
        torch.testing.assert_close(found["action"], episodes[k]["action"])
    assert len(policy_base.read_episodes(folder, ["action"], [1, 3])) == 2


def test_primitives_are_those_of_a_loop_over_contexts():
    """Linear in the clipped context, corrected by a network that sees the phase."""
    rng = torch.Generator().manual_seed(3)
    motion, told = motion_of(), []
    motion.network.register_forward_hook(lambda _, given, made: told.append((given[0], made)))
    with torch.no_grad():
        for parameter in motion.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=rng))
        motion.centre.copy_(torch.tensor([0.5, -0.5]))
        motion.low.copy_(torch.tensor([-1.0, -2.0]))
        motion.high.copy_(torch.tensor([1.0, 2.0]))
    contexts = torch.tensor([[0.2, 0.7], [-3.0, 1.0], [4.0, 9.0], [0.0, -9.0]]).double()
    features = torch.randn(4, 4, generator=rng).double()
    elapsed = torch.tensor([0.0, 0.4, 0.9, 50.0]).double()
    with torch.no_grad():
        found = motion(contexts, features, elapsed)
    (inputs, corrections), base = told[0], motion.base.detach()
    for i in range(4):
        clipped = [sorted((-(k + 1.0), float(contexts[i, k]), k + 1.0))[1] for k in range(2)]
        slopes = motion.slopes.detach()
        x = base + (clipped[0] - 0.5) * slopes[0] + (clipped[1] + 0.5) * slopes[1]

        def duration(x):
            off = float(x[-1] - base[-1])
            return math.exp(base[-1] + max(-DURATIONS, min(off, DURATIONS)))

        phase = min(elapsed[i].item() / duration(x), 1.0)
        waves = [
            wave(math.pi * k * phase)
            for wave in (math.sin, math.cos)
            for k in range(1, HARMONICS + 1)
        ]
        assert inputs[i].tolist() == pytest.approx([*features[i].tolist(), *waves])
        x = x + corrections[i]
        count = motion.response.basis.count + 3
        assert found.duration[i].item() == pytest.approx(duration(x))
        for a in range(2):
            *weights, rate, start, goal = x[a * count : (a + 1) * count].tolist()
            stiffness = motion.response.spring.stiffness
            assert found.weights[i, a].tolist() == pytest.approx(
                [stiffness * w for w in weights]
            )
            assert found.start_velocity[i, a].item() == pytest.approx(rate / duration(x))
            assert (found.start[i, a].item(), found.goal[i, a].item()) == (start, goal)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_durations_stay_near_the_fitted_one(sign):
    motion = motion_of()
    x = motion.base.detach().clone()
    x[-1] += 10 * sign
    assert motion.primitives(x).duration.item() == pytest.approx(math.exp(DURATIONS * sign))


def test_coordinates_from_rest_begin_at_their_goal():
    x = torch.randn(2 * 15 + 1, generator=torch.Generator().manual_seed(0)).double()
    primitives = motion_of().primitives(x)
    ends = primitives.from_rest()[:, -3:].tolist()
    assert ends == [[0.0, goal, goal] for goal in primitives.goal.tolist()]
    assert primitives.from_rest()[:, :-3].equal(primitives.weights)
