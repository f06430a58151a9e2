import pytest
import torch
from lerobot_samples import reaching

from hrc_learn.lerobot.policy.closed_form import SampleWindows

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
