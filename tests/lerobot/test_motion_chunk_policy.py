"""What LeRobot, and whoever trusts a policy with an arm, may expect of `motion_chunk`."""

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.policies import get_policy_class
from lerobot.policies.rtc import ActionQueue, RTCConfig
from lerobot.rollout.inference.rtc import supports_rtc_inference
from lerobot_samples import (
    DECAY,
    FPS,
    GOAL,
    IMAGE,
    STATE,
    UNNAMED,
    chunk_policy,
    decaying,
    executed,
    features_of,
    played,
    reaching,
    stats_of,
    train,
    wild,
    windows,
)
from safetensors.torch import save_file
from torchvision.models import resnet18

from hrc_learn.lerobot import MotionChunkConfig
from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkPolicy
from hrc_learn.lerobot.policy.motion_chunks import ChunkDecoder, ChunkNetwork

SHOWN = reaching(10)


@pytest.mark.parametrize("index", [0, 3, 9])
def test_a_chunk_begins_in_the_state_it_is_given_and_soon_is_as_planned(index):
    decoder = ChunkDecoder(20, 0.05, 8, blend_time=0.05)
    rng = torch.Generator().manual_seed(0)
    planned, state = torch.randn(3, 2, decoder.size, generator=rng), torch.zeros(3, 3, 2)
    state[:, 0] = decoder.states(planned)[:, index, 0] + 1
    motion = decoder.begin_in(planned, state, index)
    reached = decoder.states(motion)[:, index]
    torch.testing.assert_close(reached, state.double(), rtol=0, atol=1e-8)
    off = (decoder.states(motion) - decoder.states(planned))[:, :, 0].abs()
    torch.testing.assert_close(off[:, index], torch.ones_like(off[:, 0]), rtol=0, atol=1e-6)
    assert off[:, index + 8 :].max() < 0.25
    # In the state that was planned there is nothing to change.
    same = decoder.begin_in(planned, decoder.states(planned)[:, index], index)
    torch.testing.assert_close(same, planned.double(), rtol=0, atol=1e-8)


@pytest.mark.parametrize(("fps", "chunk_size"), [(80.0, 24), (30.0, 50), (15.0, 8)])
def test_uneven_plans_do_not_lead_a_motion_astray(fps, chunk_size):
    """Each chunk goes on with the acceleration of the one before, and so with its noise."""
    settings = dict(n_action_steps=5, n_basis=10, **UNNAMED)
    decoder = chunk_policy(decaying(), fps=fps, chunk_size=chunk_size, **settings).decoder
    rng, noise = torch.Generator().manual_seed(0), 0.03
    state, farthest = torch.zeros(200, 3, 1), 0.0
    for _ in range(12):
        plan = decoder.project(noise * torch.randn(200, chunk_size + 1, 1, generator=rng))
        states = decoder.states(decoder.begin_in(plan, state))
        farthest = max(farthest, states[:, :6, 0].square().mean().sqrt().item())
        state = states[:, 5]
    assert farthest < 2 * noise


def test_states_are_derivatives_of_positions():
    decoder = ChunkDecoder(400, 0.005, 8, blend_time=0.05)
    planned = torch.randn(1, decoder.size, generator=torch.Generator().manual_seed(0))
    y, yd, ydd = decoder.states(planned.double())[..., 0].unbind(-1)
    inner = slice(2, -2)
    for value, rate in ((y, yd), (yd, ydd)):
        (difference,) = torch.gradient(value, spacing=0.005)
        error = (difference - rate)[inner].abs().max()
        assert error < 2e-3 * rate.abs().max()


def test_projection_finds_what_the_decoder_made():
    decoder = ChunkDecoder(30, 0.05, 8, blend_time=0.05)
    made = torch.randn(5, 3, decoder.size, generator=torch.Generator().manual_seed(0))
    chunks = decoder.positions(made.double())
    again = decoder.positions(decoder.project(chunks))
    assert (again - chunks).square().mean().sqrt() < 0.02 * chunks.std()


@pytest.mark.parametrize("steps", [1, 4, 10])
def test_a_seam_keeps_position_velocity_and_acceleration_whatever_is_predicted(steps):
    policy = wild(chunk_policy(SHOWN))
    rng = torch.Generator().manual_seed(1)
    chunk = None
    for _ in range(4):
        seen = {STATE: torch.randn(1, 3, generator=rng), GOAL: torch.randn(1, 2, generator=rng)}
        left = None if chunk is None else chunk[0, steps:]
        before = policy.motion.chunk
        chunk = policy.predict_action_chunk(seen, prev_chunk_left_over=left)
        if before is None or steps == 10:
            continue
        # From one action to the next, of an arm that is sent from chunk to chunk.
        torch.testing.assert_close(chunk[0, 0], left[0], rtol=0, atol=1e-5)
        seam, end = policy.motion.chunk.states[0, 0], before.states[0, steps]
        torch.testing.assert_close(seam, end, rtol=0, atol=1e-5)


def test_selected_actions_are_one_smooth_motion():
    """At 2000 actions a second even jumps of the acceleration show."""
    policy = chunk_policy(SHOWN, fps=2000.0, chunk_size=200, n_action_steps=50, blend_time=0.02)
    policy = wild(policy.double())
    rng = torch.Generator().manual_seed(0)
    seen = {STATE: torch.zeros(1, 3), GOAL: torch.zeros(1, 2)}
    made = []
    for _ in range(8):
        seen = {key: x + torch.randn(x.shape, generator=rng) for key, x in seen.items()}
        made += [policy.select_action(seen) for _ in range(50)]
    acceleration = torch.cat(made).diff(n=2, dim=0) * 2000**2
    jump = acceleration.diff(dim=0).abs().amax(-1)
    seams = torch.arange(48, len(jump), 50)
    at_seams = torch.stack([jump[k - 1 : k + 3].max() for k in seams])
    # A jump would be as large as accelerations are, not as they change in half a millisecond.
    assert at_seams.max() < 0.4 * acceleration.abs().max()


@pytest.mark.parametrize("steps", [5, 10, 25, 50])
def test_the_motion_is_the_same_however_often_it_is_planned(steps):
    shown = decaying()
    policy = chunk_policy(shown, chunk_size=50, n_action_steps=steps, n_basis=10, **UNNAMED)
    start = torch.tensor([0.8, -0.5])
    made = executed(policy, start, 60)
    truth = start * torch.exp(-DECAY * torch.arange(60)[:, None] / FPS)
    # Every plan sees the arm one step late, where the last action sent it.
    torch.testing.assert_close(made, truth, rtol=0, atol=0.05)


def test_reset_in_mid_motion_goes_on_from_there():
    policy = chunk_policy(decaying(), chunk_size=50, n_action_steps=25, n_basis=10, **UNNAMED)
    where = torch.tensor([0.5, 0.2])
    whole = executed(policy, where, 60)
    first = executed(policy, where, 13)
    rest = executed(policy, first[-1], 40)
    torch.testing.assert_close(rest, whole[12:52], rtol=0, atol=0.02)


def test_the_first_action_is_where_the_arm_is_measured():
    policy = chunk_policy(SHOWN)
    played(policy, SHOWN[0], 13)
    policy.reset()
    # State is b, gripper, a.
    elsewhere = {STATE: torch.tensor([[0.2, 0.0, -0.3]]), GOAL: SHOWN[0][GOAL][:1]}
    torch.testing.assert_close(policy.select_action(elsewhere), torch.tensor([[-0.3, 0.2]]))


def test_states_that_are_not_what_actions_set_are_no_beginning():
    """As of velocities that are commanded under the names of positions."""
    shown = [{STATE: 5 - 3 * e["action"].flip(-1), "action": e["action"]} for e in SHOWN]
    policy = chunk_policy(shown, **UNNAMED)
    assert (policy.measured == -1).all()
    assert chunk_policy(SHOWN).measured.tolist() == [2, 0]


def test_real_time_chunks_begin_with_what_will_be_carried_out_meanwhile():
    policy = wild(chunk_policy(SHOWN))
    assert supports_rtc_inference(policy)
    seen = {STATE: torch.zeros(1, 3), GOAL: torch.ones(1, 2)}
    first = policy.predict_action_chunk(seen)[0]
    before = policy.motion.chunk
    other = {STATE: torch.ones(1, 3), GOAL: -torch.ones(1, 2)}
    chunk = policy.predict_action_chunk(
        other, inference_delay=4, prev_chunk_left_over=first[3:]
    )[0]
    torch.testing.assert_close(chunk[:4], first[3:7], rtol=0, atol=0)
    now, then = policy.motion.chunk.states[0, 4], before.states[0, 7]
    torch.testing.assert_close(now, then, rtol=0, atol=1e-5)
    assert (chunk[8] - first[7]).abs().max() > 0.1


def test_lerobots_action_queue_runs_without_a_jump():
    """Its queue cuts left-overs off and replaces chunks late, by more than was expected."""
    policy = wild(chunk_policy(SHOWN, chunk_size=40, n_action_steps=20, fps=100.0))
    queue, rng = ActionQueue(RTCConfig(execution_horizon=10)), torch.Generator().manual_seed(0)
    made = []
    for expected, real in ((0, 0), (5, 5), (5, 7), (5, 6), (3, 3)):
        seen = {STATE: torch.randn(1, 3, generator=rng), GOAL: torch.randn(1, 2, generator=rng)}
        left = queue.get_left_over()
        if left is not None:
            left = left[:10]
        index = queue.get_action_index()
        chunk = policy.predict_action_chunk(
            seen, inference_delay=expected, prev_chunk_left_over=left
        )[0]
        made += [queue.get() for _ in range(real)]
        queue.merge(chunk, chunk, real, index)
        made += [queue.get() for _ in range(9)]
    made = torch.stack(made)
    change = made.diff(n=2, dim=0).abs().amax()
    # Chunks by themselves, each from where the arm is measured, jump.
    cut = []
    for _ in range(5):
        policy.reset()
        seen = {STATE: torch.randn(1, 3, generator=rng), GOAL: torch.randn(1, 2, generator=rng)}
        cut.append(policy.predict_action_chunk(seen)[0, :9])
    jump = torch.cat(cut).diff(n=2, dim=0).abs().amax()
    assert change < 0.2 * jump


def test_a_chunk_without_left_over_actions_begins_at_the_end_of_the_last():
    policy = wild(chunk_policy(SHOWN))
    seen = {STATE: torch.zeros(1, 3), GOAL: torch.ones(1, 2)}
    end = policy.predict_action_chunk(seen)[0, -1]
    for left in (torch.zeros(0, 2), torch.zeros(4, 2)):  # LeRobot fills up with zeros
        chunk = policy.predict_action_chunk(seen, prev_chunk_left_over=left)[0]
        torch.testing.assert_close(chunk[0], end, rtol=0, atol=0.3)
        end = chunk[-1]


def test_who_does_not_say_what_was_carried_out_is_found_on_the_chunk():
    """As LeRobot's asynchronous server: the step is told by what is seen."""
    policy = chunk_policy(decaying(), chunk_size=50, n_basis=10, **UNNAMED)
    first = policy.predict_action_chunk({STATE: torch.tensor([[0.9, -0.6]])})[0]
    for steps in (4, 11):
        second = policy.predict_action_chunk({STATE: first[steps][None]})[0]
        torch.testing.assert_close(second[0], first[steps], rtol=0, atol=0.02)
        first = second


@pytest.mark.parametrize(("chunk", "count"), [(50, 10), (24, 9), (16, 6), (4, 2)])
def test_short_chunks_have_no_more_basis_functions_than_they_can_tell(chunk, count):
    assert ChunkDecoder(chunk, 0.1).size == count + 3


@pytest.mark.parametrize(("step", "expected"), [(0.1, 0.08), (0.05, 0.04), (0.01, 0.008)])
def test_motions_blend_within_an_action_or_what_basis_functions_resolve(step, expected):
    assert ChunkDecoder(16, step).blend_time == pytest.approx(expected)
    assert ChunkDecoder(200, step).blend_time == pytest.approx(max(0.05, step))


# Columns that jump.


def gripping(count=10):
    """A gripper that shuts where the arm passes half its way, up to 1, in one step."""
    episodes = []
    for episode in reaching(count):
        path = episode["action"]
        share = path[:, :1] / path[-1, 0]
        shut = (share > 0.5).float() * 40
        action = torch.cat([path, shut], dim=-1)
        episodes.append({STATE: action, "action": action})
    return episodes


def test_a_gripper_of_two_levels_jumps_and_never_stands_between():
    shown = gripping()
    policy = train(chunk_policy(shown, **UNNAMED), shown, 150)
    assert policy.config.two_level_actions == [2]
    right = []
    for episode in shown[:4]:
        made = played(policy, episode)
        assert set(made[:, 2].tolist()) == {0.0, 40.0}
        right.append(made[:, 2] == episode["action"][:, 2])
    assert torch.cat(right).float().mean() > 0.93


def test_a_gripper_that_opens_slowly_is_a_motion():
    shown = [
        {STATE: e[STATE], "action": torch.cat([e["action"], u[:, None]], dim=-1)}
        for e in SHOWN
        for u in [torch.linspace(0, 1, len(e["action"]))]
    ]
    assert chunk_policy(shown, **UNNAMED).config.two_level_actions == []


def with_images(episodes, keep):
    rng = torch.Generator().manual_seed(0)
    return [
        {key: e[key] for key in keep}
        | {IMAGE: torch.rand(len(e["action"]), 3, 16, 24, generator=rng)}
        for e in episodes
    ]


SEEN = {
    "state": [{k: e[k] for k in (STATE, "action")} for e in SHOWN],
    "state and environment": SHOWN,
    "environment": [{k: e[k] for k in (GOAL, "action")} for e in SHOWN],
    "state and image": with_images(SHOWN, (STATE, "action")),
    "image": with_images(SHOWN, ("action",)),
    "gripper": gripping(),
}


@pytest.mark.parametrize(("name", "episodes"), SEEN.items(), ids=SEEN)
def test_losses_chunks_and_gradients_whatever_it_sees(name, episodes):
    names = UNNAMED if name == "gripper" else {}
    policy = wild(chunk_policy(episodes, **names))
    width = episodes[0]["action"].shape[1]
    batch = windows(policy, episodes).draw(6, torch.Generator().manual_seed(0))
    policy.eval()
    loss, values = policy.forward(batch)
    each, _ = policy.forward(batch, reduction="none")
    assert loss.shape == ()
    torch.testing.assert_close(each.mean(), loss)
    assert values["rmse"] > 0
    policy.train()
    policy.forward(batch)[0].backward()
    for parameter_name, parameter in policy.named_parameters():
        if parameter.numel():
            assert parameter.grad is not None, parameter_name
            assert parameter.grad.isfinite().all(), parameter_name
            assert parameter.grad.any(), parameter_name
    now = {key: episodes[0][key][:2] for key in episodes[0] if key != "action"}
    assert policy.predict_action_chunk(now).shape == (2, 10, width)
    assert policy.predict_action_chunk(now).shape == (2, 10, width)
    policy.reset()
    assert policy.select_action(now).shape == (2, width)


@pytest.mark.parametrize("noise", [0.15, 0.0])
def test_training_blurs_the_arms_own_state_alone(noise):
    """So that plans lead back from beside the path; goals and images are seen as they are."""
    rng = torch.Generator().manual_seed(0)
    episodes = [
        e | {IMAGE: torch.rand(len(e[STATE]), 3, 32, 48, generator=rng)} for e in SHOWN[:3]
    ]
    policy, seen = chunk_policy(episodes, dropout=0.0, state_noise=noise), []
    policy.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    batch = windows(policy, episodes).draw(256, rng)
    for training in (True, False):
        policy.train(training)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            policy.forward(batch)
    off = seen[0] - seen[1]
    assert (off[:, 3:] == 0).all()
    torch.testing.assert_close(off[:, :3].std(), torch.tensor(noise), rtol=0.1, atol=0)


def test_padding_is_not_learned():
    policy = chunk_policy(SHOWN).eval()
    samples = windows(policy, SHOWN)
    # The last frames of an episode, the middle of it, the last of another.
    batch = samples.batch(torch.tensor([len(SHOWN[0]["action"]) - 2, 5, len(samples) - 1]))
    loss, _ = policy.forward(batch)
    absent = batch["action_is_pad"].clone()
    batch["action"] = torch.where(absent[..., None], 100.0, batch["action"])
    torch.testing.assert_close(policy.forward(batch)[0], loss, rtol=0, atol=1e-5)


@pytest.mark.parametrize("most", [50_000, 150])
def test_the_closed_form_counts_each_frame_or_evenly_spaced_ones(monkeypatch, most):
    """Against a loop over frames; a chunk longer than its episode repeats the last action."""
    module = "hrc_learn.lerobot.policy.motion_chunk_policy"
    monkeypatch.setattr(f"{module}.MOST_CHUNKS", most)
    policy, chunks = chunk_policy(SHOWN), []
    for episode in SHOWN:
        coordinates = policy.encoding.to_coordinates(episode["action"])
        last = len(coordinates) - 1
        for k in range(len(coordinates)):
            ahead = [min(k + j, last) for j in range(policy.decoder.samples)]
            chunks.append(coordinates[ahead])
    counted = torch.stack(chunks[:: math.ceil(len(chunks) / most)])
    assert len(counted) <= most
    coefficients = policy.decoder.project(counted)
    torch.testing.assert_close(policy.network.mean, coefficients.mean(0))
    torch.testing.assert_close(policy.network.spread, coefficients.std(0))


def test_a_network_begins_as_the_ridge_regression_of_numpy():
    """Numbers have a mean, as those of some episodes of a dataset do."""
    rng = np.random.default_rng(0)
    numbers = rng.normal([1.0, -0.5, 2.0], 0.3, (40, 3))
    settings = {"numbers": 3, "features": 3, "moving": 0, "columns": 2, "two_level": 0}
    decoder = ChunkDecoder(10, 0.05, n_basis=4)
    network = ChunkNetwork(decoder=decoder, n_plans=1, hidden=8, dropout=0.0, **settings)
    targets = numbers @ rng.normal(size=(3, 2 * decoder.size)) + 5.0
    targets += rng.normal(size=targets.shape)
    tensor = torch.from_numpy(numbers).float()
    network.fit(tensor, torch.from_numpy(targets).float().unflatten(-1, (2, -1)))
    plans = network.eval()(tensor, torch.zeros(40, 0), torch.zeros(40))
    white = (targets - targets.mean(0)) / targets.std(0, ddof=1)
    # Observations of zeros are the penalty; they have no constant.
    design = np.c_[np.r_[np.ones(40), np.zeros(3)], np.r_[numbers, np.sqrt(0.4) * np.eye(3)]]
    best = np.linalg.lstsq(design, np.r_[white, np.zeros((3, white.shape[1]))])[0]
    expected = (design[:40] @ best) * targets.std(0, ddof=1) + targets.mean(0)
    np.testing.assert_allclose(
        plans.coefficients[:, 0].flatten(1).detach().numpy(), expected, atol=1e-4
    )


def test_training_takes_up_what_the_closed_form_leaves():
    """Goals in the cube root of what is seen: no straight line fits, the network does."""
    bent = [e | {GOAL: e[GOAL].sign() * e[GOAL].abs() ** 3} for e in SHOWN]
    policy = chunk_policy(bent)
    samples = windows(policy, bent)
    some = samples.batch(torch.arange(0, len(samples), 10))
    before, _ = policy.eval().forward(some)
    after, _ = train(policy, bent, 100).forward(some)
    assert after < 0.7 * before


def test_a_hand_that_points_down_turns_without_a_jump():
    """Half a turn from the base frame, where a rotation vector changes its sign."""
    names = ["ee.wx", "ee.wy", "ee.wz"]
    tilt = torch.linspace(-0.3, 0.3, 40)
    turn = torch.pi + tilt
    turn = torch.where(turn > torch.pi, turn - 2 * torch.pi, turn)
    vectors = torch.stack([turn, torch.zeros(40), torch.zeros(40)], dim=-1)
    episode = {STATE: vectors, "action": vectors}
    policy = chunk_policy([episode], state_names=names, action_feature_names=names)
    assert policy.config.two_level_actions == []
    assert played(policy, episode).diff(dim=0).abs().max() < 0.06


def test_a_checkpoint_brings_everything(tmp_path):
    shown = gripping()
    policy = wild(chunk_policy(shown, **UNNAMED))
    policy.save_pretrained(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"config.json", "model.safetensors"}
    assert json.loads((tmp_path / "config.json").read_text())["two_level_actions"] == [2]
    loaded = get_policy_class("motion_chunk").from_pretrained(tmp_path)
    assert isinstance(loaded, MotionChunkPolicy)
    torch.testing.assert_close(played(loaded, shown[1]), played(policy, shown[1]))
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged"):
        MotionChunkPolicy.from_pretrained(tmp_path)


@pytest.mark.long
def test_a_policy_begins_with_given_weights_and_a_checkpoint_brings_them(tmp_path):
    """The file is not asked for again."""
    torch.manual_seed(0)
    weights = resnet18(weights=None).state_dict()
    file = tmp_path / "weights.safetensors"
    save_file(weights, file)
    episodes = [
        {STATE: e[STATE], IMAGE: torch.rand(len(e[STATE]), 3, 64, 64), "action": e["action"]}
        for e in SHOWN[:2]
    ]
    settings = {
        "vision_backbone": "resnet18",
        "vision_weights": str(tmp_path / "weights.safetensors"),
    }
    policy = chunk_policy(episodes, **settings)
    (camera,) = policy.encoder.cameras.values()
    torch.testing.assert_close(camera.backbone.conv1.weight, weights["conv1.weight"])
    policy.save_pretrained(tmp_path / "policy")
    file.unlink()
    loaded = MotionChunkPolicy.from_pretrained(tmp_path / "policy")
    (again,) = loaded.encoder.cameras.values()
    torch.testing.assert_close(again.backbone.state_dict(), camera.backbone.state_dict())
    with pytest.raises(ValueError, match="vision_weights: there is no file"):
        chunk_policy(episodes, **settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": None}, "how many actions a second"),
        ({"n_action_steps": 11}, "1 to chunk_size"),
        ({"n_obs_steps": 2}, "sees one step"),
        ({"n_plans": 0}, "n_plans must be positive"),
        ({"blend_time": 0.0}, "blend_time must be positive"),
        ({"state_noise": -0.1}, "state_noise must not be negative"),
        ({"history": -1}, "history must not be negative"),
        ({"chunk_size": 3, "n_action_steps": 1}, "chunk_size must be at least 4"),
        ({"two_level_actions": [2]}, "two_level_actions"),
    ],
)
def test_settings_that_make_no_policy(changes, message):
    with pytest.raises(ValueError, match=message):
        chunk_policy(SHOWN, **changes)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "'motion_chunk' needs observation.state"),
        ({STATE: torch.zeros(1, 4)}, "3 values in observation.state.* has 4"),
        ({STATE: torch.tensor([[0.0, 0.0, torch.nan]])}, r"not finite in a\.pos"),
    ],
)
def test_states_that_cannot_be_used_are_named(state, message):
    policy, seen = chunk_policy(SHOWN), {GOAL: SHOWN[0][GOAL][:1]} | state
    with pytest.raises(ValueError, match=message):
        policy.select_action(seen)
    with pytest.raises(ValueError, match=message):
        policy.predict_action_chunk(seen)


def test_a_negative_delay_is_refused():
    seen = {STATE: torch.zeros(1, 3), GOAL: torch.zeros(1, 2)}
    with pytest.raises(ValueError, match="inference_delay must not be negative, got -1"):
        chunk_policy(SHOWN).predict_action_chunk(seen, inference_delay=-1)


def test_statistics_that_cannot_be_used_are_named():
    stats = stats_of(SHOWN)
    del stats["action"]["max"]
    config = MotionChunkConfig(**features_of(SHOWN[0]), fps=FPS, device="cpu")
    with pytest.raises(ValueError, match="lack max of action"):
        MotionChunkPolicy(config, dataset_stats=stats)


@pytest.mark.parametrize("n_plans", [1, 3])
def test_the_loss_is_that_of_a_loop_over_samples_plans_and_actions(n_plans):
    """Of the plans that the network makes; the numbers are those that the module documents."""
    shown, plans = gripping(), []
    policy = wild(chunk_policy(shown, n_plans=n_plans, **UNNAMED)).eval()
    policy.network.register_forward_hook(lambda _, inputs, made: plans.append(made))
    samples = windows(policy, shown)
    batch = samples.batch(torch.tensor([0, 17, len(shown[0]["action"]) - 3, len(samples) - 1]))
    each, values = policy.forward(batch, reduction="none")
    made = plans[0]
    spread, low, high = policy.encoding.std, *policy.levels
    losses, squares, count = [], 0.0, 0
    for i in range(4):
        whitened = (batch["action"][i] - policy.encoding.mean) / spread
        present = (~batch["action_is_pad"][i]).tolist()
        errors, squared = [], []
        for coefficients in made.coefficients[i]:
            off = (policy.decoder.positions(coefficients) - whitened[:, :2]).tolist()
            here = [sum(map(abs, row)) / 2 for row in off]
            rate = [
                sum(abs(b - a) * FPS for a, b in zip(before, after, strict=True)) / 2
                for before, after in pairwise(off)
            ]
            error = sum(e for e, there in zip(here, present, strict=True) if there) / 11
            rates = [r for r, there in zip(rate, present[1:], strict=True) if there]
            errors.append(error + 0.005 * sum(rates) / 10)
            squared.append([sum(x * x for x in row) / 2 for row in off])
        best = min(range(n_plans), key=errors.__getitem__)
        loss = 0.95 * errors[best] + 0.05 * sum(errors) / n_plans
        scores = made.scores[i].tolist()
        loss += 0.1 * (math.log(sum(math.exp(s) for s in scores)) - scores[best])
        for k, there in enumerate(present):
            up = float(whitened[k, 2] > (low[2] + high[2]) / 2)
            chance = 1 / (1 + math.exp(-made.levels[i, k, 0].item()))
            loss -= there * math.log(chance if up else 1 - chance) / 11
            squares += there * squared[best][k]
            count += there
        losses.append(loss)
    assert each.tolist() == pytest.approx(losses, rel=1e-4)
    assert values["rmse"] == pytest.approx(math.sqrt(squares / count), rel=1e-4)
    mean, _ = policy.forward(batch)
    assert mean.item() == pytest.approx(sum(losses) / 4, rel=1e-4)


def test_the_error_of_plans_is_a_running_mean_over_trainings_only():
    policy = chunk_policy(SHOWN, dropout=0.0, history=0)
    batch = windows(policy, SHOWN).batch(torch.arange(6))
    before = float(policy.error)
    rmse = policy.eval().forward(batch)[1]["rmse"]
    assert policy.error == before
    policy.train().forward(batch)
    assert float(policy.error) == pytest.approx(0.99 * before + 0.01 * rmse, rel=1e-5)


def test_without_a_delay_a_chunk_begins_at_once():
    seen = {STATE: torch.zeros(1, 3), GOAL: torch.ones(1, 2)}
    chunks = []
    for delay in ({}, {"inference_delay": 0}, {"inference_delay": 2}):
        policy = wild(chunk_policy(SHOWN))
        policy.predict_action_chunk(seen)
        seen_later = {**seen, STATE: torch.ones(1, 3)}
        chunks.append(policy.predict_action_chunk(seen_later, **delay))
    assert torch.equal(chunks[0], chunks[1])
    assert not torch.equal(chunks[0], chunks[2])


@pytest.mark.parametrize(("steps", "warm_up"), [(60, 60), (100, 100), (5000, 100)])
def test_the_learning_rate_rises_and_then_falls_to_nothing(steps, warm_up):
    config = MotionChunkConfig(
        scheduler_decay_steps=steps, chunk_size=7, n_action_steps=3, device="cpu"
    )
    preset = config.get_scheduler_preset()
    assert (preset.num_warmup_steps, preset.num_decay_steps) == (warm_up, steps)
    assert (preset.peak_lr, preset.decay_lr) == (config.optimizer_lr, 0.0)
    assert config.action_delta_indices == list(range(8))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        *(({name: 1}, "") for name in ("n_basis", "hidden_dim", "n_plans")),
        *(({name: 0}, f"{name} must be positive, but is 0") for name in ("n_basis", "n_plans")),
        ({"chunk_size": 4, "n_action_steps": 2}, ""),
        ({"chunk_size": 3, "n_action_steps": 2}, "chunk_size must be at least 4, got 3"),
        ({"history": 0, "state_noise": 0.0, "blend_time": 1e-9}, ""),
        ({"history": -1}, "history must not be negative, but is -1"),
        ({"state_noise": float("nan")}, "state_noise must not be negative, but is nan"),
        ({"blend_time": 0.0}, "blend_time must be positive, but is 0.0"),
        ({"blend_time": float("nan")}, "blend_time must be positive, but is nan"),
    ],
)
def test_settings_have_their_least_values(settings, complaint):
    if complaint:
        with pytest.raises(ValueError, match=complaint):
            MotionChunkConfig(device="cpu", **settings)
    else:
        MotionChunkConfig(device="cpu", **settings)


@pytest.mark.parametrize("path", [None, Path("weights")])
def test_only_a_policy_without_weights_is_fitted_to_the_dataset(monkeypatch, path):
    fitted = []
    monkeypatch.setattr(
        MotionChunkPolicy, "_fit_dataset", lambda self, meta: fitted.append(meta)
    )
    config = chunk_policy(reaching(4)).config
    config.pretrained_path = path
    fitted.clear()
    MotionChunkPolicy(config, dataset_stats=stats_of(reaching(4)))
    assert fitted == ([None] if path is None else [])
