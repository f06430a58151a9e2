"""Processor steps that keep any policy's actions within limits."""

import gc
import json

import numpy as np
import pytest
import torch
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.processor.converters import (
    batch_to_transition,
    policy_action_to_transition,
    transition_to_batch,
    transition_to_policy_action,
)

from hrc_learn.lerobot.action_limits import ActionLimits
from hrc_learn.lerobot.processor import (
    POSTPROCESSOR,
    PREPROCESSOR,
    WatchStateStep,
    add_smoothing,
    remove_smoothing,
)

LIMITS = ActionLimits(
    names=["a.pos", "b.pos"],
    fps=50.0,
    velocity=[1.0, 2.0],
    acceleration=[4.0, 8.0],
    jerk=[40.0, 80.0],
    lower=[-1.0, None],
    upper=[1.0, None],
    state_columns=[1, -1],
)


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint's processors, smoothing added."""
    normalise = {"registry_name": "normalizer_processor", "config": {}}
    for name, steps in (
        (PREPROCESSOR, [{"registry_name": "to_batch_processor", "config": {}}, normalise]),
        (POSTPROCESSOR, [{"registry_name": "to_batch_processor", "config": {}}]),
    ):
        (tmp_path / name).write_text(json.dumps({"name": "policy", "steps": steps}))
    add_smoothing(tmp_path, LIMITS)
    return tmp_path


def loaded(checkpoint):
    """The steps that were added, as LeRobot makes them of the files."""
    step = {}
    for name in (PREPROCESSOR, POSTPROCESSOR):
        for entry in json.loads((checkpoint / name).read_text())["steps"]:
            if entry["registry_name"].startswith("hrc_learn"):
                kind = ProcessorStepRegistry.get(entry["registry_name"])
                step[entry["registry_name"]] = kind(**entry["config"])
                assert step[entry["registry_name"]].get_config() == entry["config"]
    watch, smooth = step["hrc_learn_watch_state"], step["hrc_learn_smooth_actions"]
    before = PolicyProcessorPipeline(
        [watch], to_transition=batch_to_transition, to_output=transition_to_batch
    )
    after = PolicyProcessorPipeline(
        [smooth],
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    before.reset()
    return before, after, smooth


def observe(before, a):
    before({"observation.state": torch.tensor([[9.0, a, 9.0]])})


def test_steps_are_put_at_both_ends_and_taken_out_again(checkpoint):
    add_smoothing(checkpoint, LIMITS)  # twice is once

    def names(file):
        steps = json.loads((checkpoint / file).read_text())["steps"]
        return [step["registry_name"] for step in steps]

    own = "hrc_learn_watch_state", "hrc_learn_smooth_actions"
    assert names(PREPROCESSOR) == [own[0], "to_batch_processor", "normalizer_processor"]
    assert names(POSTPROCESSOR) == ["to_batch_processor", own[1]]
    remove_smoothing(checkpoint)
    assert names(PREPROCESSOR) == ["to_batch_processor", "normalizer_processor"]
    assert names(POSTPROCESSOR) == ["to_batch_processor"]


def test_adding_to_no_checkpoint_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="pretrained_model"):
        add_smoothing(tmp_path, LIMITS)


def test_single_actions_start_where_the_robot_is_and_keep_the_limits(checkpoint):
    before, after, smooth = loaded(checkpoint)
    a = [0.3]
    for k in range(120):
        observe(before, a[-1])
        asked = torch.tensor([[0.5 + 0.3 * (k > 60), 0.0]])
        action = after(asked)
        assert action.shape == (1, 2)
        a.append(float(action[0, 0]))
    path = np.concatenate([[a[0]] * 3, a])
    for order, limit in ((1, 1.0), (2, 4.0), (3, 40.0)):
        # Single precision: 1e-7 rad, times fps^3.
        assert np.abs(np.diff(path, n=order)).max() * 50**order <= limit + 0.05
    assert a[60] == pytest.approx(0.5, abs=5e-3)
    assert a[-1] == pytest.approx(0.8, abs=5e-3)
    changes = smooth.changes
    assert changes.steps == 120
    assert changes.broken["jerk"] > 0
    assert changes.largest["a.pos"] == pytest.approx(0.3, abs=0.02)
    assert "120 actions changed" in str(changes)


def test_a_robot_that_was_put_somewhere_begins_an_episode(checkpoint):
    """lerobot-eval resets no processor between its episodes."""
    before, after, _ = loaded(checkpoint)
    for _ in range(20):
        observe(before, 0.0)
        after(torch.tensor([[0.0, 0.0]]))
    observe(before, 0.7)
    assert float(after(torch.tensor([[0.7, 0.0]]))[0, 0]) == pytest.approx(0.7, abs=1e-3)


def test_a_chunk_goes_on_where_the_robot_is_on_the_one_before(checkpoint):
    before, after, _ = loaded(checkpoint)
    t = torch.arange(1, 41, dtype=torch.float64) / 50
    wave = torch.stack([0.2 * (1 - torch.cos(2 * t)), 0 * t], dim=-1)[None]
    observe(before, 0.0)
    first = after(wave[:, :20])
    observe(before, float(first[0, 9, 0]))  # ten actions were carried out
    second = after(wave[:, 10:30])
    torch.testing.assert_close(second, wave[:, 10:30], atol=1e-6, rtol=0)


def test_actions_of_another_width_are_refused(checkpoint):
    _, after, _ = loaded(checkpoint)
    with pytest.raises(ValueError, match="3 values"):
        after(torch.zeros(1, 3))


def test_a_step_that_is_gone_is_no_longer_asked():
    """Two policies in one process: what the first one saw is not taken for the second's."""
    watch = WatchStateStep(pair="of a policy")
    watch(batch_to_transition({"observation.state": torch.tensor([[0.25, 0.5]])}))
    seen = WatchStateStep.newest_state("of a policy")
    assert seen is not None
    assert seen.tolist() == [[0.25, 0.5]]
    del watch
    gc.collect()
    assert WatchStateStep.newest_state("of a policy") is None
