"""Processor steps that keep any policy's actions within limits."""

import functools
import gc
import json

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.processor.converters import (
    batch_to_transition,
    policy_action_to_transition,
    transition_to_batch,
    transition_to_policy_action,
)

from hrc_learn.lerobot.smoothing import (
    PREPROCESSOR,
    ActionLimits,
    SmoothActionsStep,
    add_smoothing,
    remove_smoothing,
)
from hrc_learn.lerobot.smoothing.processor import POSTPROCESSOR, Changes, WatchStateStep

SETTINGS = {
    "fps": 50.0,
    "names": ["a.pos", "b.pos"],
    "velocity": [1.0, 2.0],
    "acceleration": [4.0, 8.0],
    "jerk": [40.0, 80.0],
    "lower": [-1.0, None],
    "upper": [1.0, None],
    "state_columns": [0, -1],
}
LIMITS = ActionLimits(**SETTINGS | {"state_columns": [1, -1]})


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


def test_limits_of_another_width_are_refused(checkpoint):
    config = {"output_features": {"action": {"type": "ACTION", "shape": [7]}}}
    (checkpoint / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="has 7 values in an action, but the limits are"):
        add_smoothing(checkpoint, LIMITS)


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
    assert changes.largest[0] == pytest.approx(0.3, abs=0.02)
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


def test_two_robots_of_one_checkpoint_do_not_see_each_other(checkpoint):
    (first, move_first, _), (second, move_second, _) = loaded(checkpoint), loaded(checkpoint)
    observe(first, 0.5)
    observe(second, -0.5)
    here = torch.tensor([[0.5, 0.0]])
    torch.testing.assert_close(move_first(here), here)
    torch.testing.assert_close(move_second(-here), -here)


@pytest.mark.long
def test_a_step_takes_the_watch_built_before_it_if_it_still_exists():
    watch = WatchStateStep()
    assert SmoothActionsStep(**SETTINGS).watch is watch
    assert SmoothActionsStep(**SETTINGS).watch is None
    watch = WatchStateStep()
    del watch
    gc.collect()
    assert SmoothActionsStep(**SETTINGS).watch is None


def chunk_of(a, b=0.0, batch=1):
    """A chunk of given paths of both values, the same for all robots of a batch."""
    a = torch.as_tensor(a, dtype=torch.float64)
    return torch.stack([a, torch.as_tensor(b, dtype=a.dtype).expand_as(a)], -1).repeat(
        batch, 1, 1
    )


@pytest.mark.parametrize("reached", [0, 1, 2, 5, 19])
def test_a_chunk_goes_on_from_the_three_actions_up_to_where_the_robot_is(reached):
    """Or from the first three, where it has not come that far: an acceleration takes three."""
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS)
    wave = 0.2 * (1 - np.cos(2 * np.arange(1, 41) / 50))
    send = functools.partial(sent_by, watch, smooth)
    whole = chunk_of(wave, wave)
    torch.testing.assert_close(send(0.0, whole[:, :20]), whole[:, :20], atol=1e-9, rtol=0)
    # What is not measured is sent elsewhere, and says nothing about how far the robot is.
    start = max(reached, 2) + 1
    asked = chunk_of(wave[start : start + 20], 0.0)
    second = send(wave[reached], asked)
    torch.testing.assert_close(second[..., 0], asked[..., 0], atol=1e-9, rtol=0)


def sent_by(watch, smooth, a, chunk):
    """What becomes of a chunk when the robot's first value is measured."""
    state = torch.as_tensor(a, dtype=torch.float64).reshape(-1, 1)
    watch(batch_to_transition({"observation.state": state}))
    return smooth(policy_action_to_transition(chunk))[TransitionKey.ACTION]


@pytest.mark.parametrize(
    ("moved", "jumps"), [(0.09, False), (-0.09, False), (0.11, True), (-0.11, True)]
)
def test_only_what_no_motion_explains_begins_an_episode(moved, jumps):
    """Five times the limit of 1/s, at 50 actions a second, is 0.1."""
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS)
    send = functools.partial(sent_by, watch, smooth)
    still = [0.2, 0.2]  # of two robots
    for _ in range(5):
        send(still, torch.tensor([[0.2, 0.0]] * 2, dtype=torch.float64))
    asked = torch.tensor([[0.2 + moved, 0.0], [0.2, 0.0]], dtype=torch.float64)
    action = send([0.2 + moved, 0.2], asked)
    begun_anew = abs(action[0, 0] - (0.2 + moved)) < 1e-9
    assert bool(begun_anew) == (abs(moved) > 0.1)
    assert action[1, 0] == pytest.approx(0.2)  # the other robot goes on


def test_a_state_of_other_robots_is_not_taken_for_these():
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS)
    actions = torch.tensor([[0.5, 0.1], [0.6, 0.2]], dtype=torch.float64)
    torch.testing.assert_close(sent_by(watch, smooth, 0.0, actions), actions)


def test_a_reset_begins_where_the_robot_then_is():
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS)
    send = functools.partial(sent_by, watch, smooth)
    send(0.0, torch.tensor([[0.9, 0.0]], dtype=torch.float64))
    assert smooth.changes.steps == 1
    smooth.reset()
    assert smooth.changes.steps == 0
    here = torch.tensor([[0.05, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(send(0.05, here), here)


def test_what_is_no_action_or_no_observation_passes():
    smooth, watch = SmoothActionsStep(**SETTINGS), WatchStateStep()
    nothing = {TransitionKey.ACTION: None}
    assert smooth(nothing) is nothing
    watch({TransitionKey.OBSERVATION: {"observation.state": torch.zeros(3)}})
    for transition in (nothing, {TransitionKey.OBSERVATION: {"other": torch.ones(1)}}):
        assert watch(transition) is transition
    assert watch.state.shape == (1, 3)
    watch.reset()
    assert watch.state is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jerk": [0.0, 1.0]}, "jerk.*expected float > 0"),
        ({"velocity": [float("nan"), 1.0]}, "velocity.*expected float, got null"),
        ({"lower": [2.0, None]}, "lower of a.pos must be below upper"),
        ({"fps": 0.0}, "fps: expected float > 0"),
    ],
)
def test_limits_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SmoothActionsStep(**SETTINGS | change)


def test_settings_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="velocity must have one entry for each of"):
        SmoothActionsStep(**SETTINGS | {"velocity": [1.0]})
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS | {"state_columns": [-1, 1]})
    action = torch.zeros(1, 2, dtype=torch.float64)
    with pytest.raises(ValueError, match="state_columns reach 1, but the state has 1 values"):
        sent_by(watch, smooth, 0.0, action)


def test_changes_add_up():
    changes = Changes(["a", "b"])
    change = np.array([[[0.0, 2e-6], [-0.3, 0.0], [1e-7, 0.0]]])
    changes.add(change)
    assert (changes.steps, changes.changed) == (3, 2)
    np.testing.assert_allclose(changes.largest, [0.3, 2e-6])
    changes.add(change[..., ::-1] / 3)
    assert (changes.steps, changes.changed) == (6, 3)
    np.testing.assert_allclose(changes.largest, [0.3, 0.1])
    assert "3 of 6 actions changed, by at most 0.3 (a)" in str(changes)
    changes.clear()
    assert (changes.steps, changes.changed, changes.largest.any()) == (0, 0, False)


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("bad", [0, 3])
def test_a_value_that_is_not_finite_is_held_or_goes_on_and_recovers(whole, bad):
    """In the first state, and in the middle of a motion."""
    watch = WatchStateStep()
    smooth = SmoothActionsStep(**SETTINGS | {"state_columns": [0, 1]})
    asked = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    asked = asked.expand(1, 5, 2) if whole else asked
    path = [np.array([0.0, 0.1])]
    for k in range(8):
        a, b = path[-1] if k > (bad == 0) else path[0]
        state = torch.tensor([[a, np.nan if k == bad else b]], dtype=torch.float64)
        watch(batch_to_transition({"observation.state": state}))
        action = smooth(policy_action_to_transition(asked))[TransitionKey.ACTION]
        path.append(action.reshape(-1, 2)[0].numpy())
    if bad == 0:  # held where it was sent first; then it begins where it is
        assert path.pop(1)[1] == pytest.approx(0.4)
    assert np.isfinite(path).all()
    path = np.array([path[0]] * 2 + path)
    limits = SETTINGS["velocity"], SETTINGS["acceleration"], SETTINGS["jerk"]
    for order, limit in enumerate(() if whole else limits, 1):  # of a chunk more is executed
        change = np.abs(np.diff(path[:, 1], n=order)).max() * 50**order
        assert change <= limit[1] * (1 + 1e-6)


def test_a_motion_that_is_reset_goes_on_with_the_measured_velocity():
    watch, smooth = WatchStateStep(), SmoothActionsStep(**SETTINGS)
    send = functools.partial(sent_by, watch, smooth)
    action = torch.tensor([[0.5, 0.0]], dtype=torch.float64)
    send(0.0, action)
    watch.reset()
    smooth.reset()
    first = send(0.012, action)[0, 0]  # 0.6 rad/s
    # One step at the limit of acceleration changes the velocity by 0.08 rad/s.
    assert (first - 0.012) * 50 == pytest.approx(0.6, abs=0.08)
    watch.reset()
    smooth.reset()
    assert send(0.3, action)[0, 0] - 0.3 < 1e-3  # put there: faster than any motion


def test_without_a_state_a_jump_is_no_episode():
    smooth = SmoothActionsStep(**SETTINGS)
    for a, b in ((0.0, 0.0), (0.9, 1.5)):
        action = smooth(
            policy_action_to_transition(torch.tensor([[a, b]], dtype=torch.float64))
        )
    assert action[TransitionKey.ACTION].abs().max() < 0.01


def test_what_is_no_processor_is_refused(tmp_path):
    (tmp_path / PREPROCESSOR).write_text("{}")
    with pytest.raises(ValueError, match="is not a processor of LeRobot"):
        remove_smoothing(tmp_path)


def test_a_robot_with_one_value_that_was_put_elsewhere_begins_at_rest_the_other_goes_on():
    watch, smooth = WatchStateStep(), SmoothActionsStep(**SETTINGS | {"state_columns": [0, 1]})
    asked = torch.full((2, 2), 0.5, dtype=torch.float64)
    states = torch.zeros(2, 2, dtype=torch.float64), torch.full((2, 2), 0.012).double()
    states[1][0, 0] = 0.3  # 15 rad/s; the other values move at 0.6 rad/s
    for state in states:
        watch.reset()
        smooth.reset()
        watch(batch_to_transition({"observation.state": state}))
        action = smooth(policy_action_to_transition(asked))[TransitionKey.ACTION]
    velocity = (action - states[1]) * 50
    # One step at the limit of acceleration changes a velocity by 0.16 rad/s at most.
    expected = torch.tensor([[0.0, 0.0], [0.6, 0.6]], dtype=torch.float64)
    torch.testing.assert_close(velocity, expected, atol=0.16, rtol=0)
