"""LeRobot's ACT and Diffusion Policy with their chunks decoded as motions."""

import json

import pytest
import torch
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.rtc import ActionQueue, RTCConfig
from lerobot.rollout.inference.rtc import supports_rtc_inference
from lerobot_samples import FPS, GOAL, STATE, features_of, reaching, stats_of, windows

from hrc_learn.lerobot import ActDmpConfig, DiffusionDmpConfig
from hrc_learn.lerobot.policy.modeling_backbones import ChunkMotion

SHOWN = reaching(8)
CONFIGS = {"act_dmp": ActDmpConfig, "diffusion_dmp": DiffusionDmpConfig}
SMALL = {
    "act": {
        "chunk_size": 12,
        "n_action_steps": 5,
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 64,
        "n_encoder_layers": 1,
        "use_vae": False,
    },
    "diffusion": {
        "horizon": 16,
        "n_action_steps": 5,
        "down_dims": (32, 64),
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 4,
    },
}
both = pytest.mark.parametrize("name", CONFIGS)


def small(name, episodes=SHOWN, **changes):
    """A policy that was not trained, which plans wildly."""
    settings = {"fps": FPS, "n_basis": 6, "device": "cpu", "push_to_hub": False}
    settings |= SMALL[name.removesuffix("_dmp")] | changes
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = CONFIGS[name](**features_of(episodes[0]), **settings)
        return get_policy_class(name)(config, dataset_stats=stats_of(episodes))


def drawn(policy, seed):
    """What such a policy sees: random numbers, as it stacks them itself."""
    rng = torch.Generator().manual_seed(seed)
    return {STATE: torch.randn(1, 3, generator=rng), GOAL: torch.randn(1, 2, generator=rng)}


def chunk_of(policy, seed, **settings):
    """A chunk for what is seen, asked for as LeRobot's engines do."""
    seen = drawn(policy, seed)
    steps = policy.config.n_obs_steps
    if steps > 1:
        seen = {key: x[:, None].expand(-1, steps, -1) for key, x in seen.items()}
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return policy.predict_action_chunk(seen, **settings)


def executed(policy, steps):
    policy.reset()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = [policy.select_action(drawn(policy, 100 + k)) for k in range(steps)]
    return torch.cat(made)


@both
def test_actions_join_where_those_of_lerobots_own_jump(name):
    """The second difference at a seam, of chunks for what has nothing to do with each other."""
    policy = small(name)
    plain_name = name.removesuffix("_dmp")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = type(policy.config).__bases__[1](
            **features_of(SHOWN[0]), device="cpu", push_to_hub=False, **SMALL[plain_name]
        )
        plain = get_policy_class(plain_name)(config)
    seams = slice(3, None, 5)  # differences k, k + 1, k + 2 with a new chunk at k + 2 or k + 1
    changes = {}
    for key, each in (("motion", policy), ("plain", plain)):
        change = executed(each, 60).diff(n=2, dim=0).abs().amax(-1)
        changes[key] = torch.stack([change[3::5], change[4::5][: len(change[seams])]]).amax()
    assert changes["motion"] < 0.35 * changes["plain"]


@both
def test_a_seam_keeps_position_velocity_and_acceleration(name):
    policy = small(name)
    executed(policy, 5)
    before = policy.motion.chunk
    policy.select_action(drawn(policy, 7))
    now = policy.motion.chunk
    assert now is not before
    torch.testing.assert_close(now.states[:, 0], before.states[:, 5], rtol=0, atol=1e-5)


@both
def test_the_first_chunk_is_the_motion_nearest_to_what_is_predicted(name):
    policy = small(name)
    rng = torch.Generator().manual_seed(0)
    predicted = torch.randn(3, policy.motion.decoder.samples, 2, generator=rng)
    begun = policy.motion.begin(predicted, None, 0)
    nearest = policy.motion.decode(predicted)[:, :-1]
    assert policy.motion.decoder.step == 1 / FPS
    torch.testing.assert_close(begun, nearest, rtol=0, atol=1e-4)


@both
def test_real_time_chunks_begin_with_what_will_be_carried_out_meanwhile(name):
    policy = small(name)
    assert supports_rtc_inference(policy)
    first = chunk_of(policy, 0)[0]
    before = policy.motion.chunk
    chunk = chunk_of(policy, 1, inference_delay=3, prev_chunk_left_over=first[4:])[0]
    torch.testing.assert_close(chunk[:3], first[4:7], rtol=0, atol=0)
    now, then = policy.motion.chunk.states[0, 3], before.states[0, 7]
    torch.testing.assert_close(now, then, rtol=0, atol=1e-5)


@both
def test_lerobots_action_queue_runs_without_a_jump(name):
    """Its queue cuts left-overs off and replaces chunks late, by more than was expected."""
    long = {"chunk_size": 40} if name == "act_dmp" else {"horizon": 48}
    policy = small(name, **long, fps=100.0)
    queue, made = ActionQueue(RTCConfig(execution_horizon=10)), []
    for k, (expected, real) in enumerate(((0, 0), (5, 5), (5, 7), (5, 6), (3, 3))):
        left, index = queue.get_left_over(), queue.get_action_index()
        if left is not None:
            left = left[:10]
        chunk = chunk_of(policy, k, inference_delay=expected, prev_chunk_left_over=left)[0]
        made += [queue.get() for _ in range(real)]
        queue.merge(chunk, chunk, real, index)
        made += [queue.get() for _ in range(9)]
    change = torch.stack(made).diff(n=2, dim=0).abs().amax()
    cut = []
    for k in range(5):
        policy.reset()
        cut.append(chunk_of(policy, k)[0, :9])
    jump = torch.cat(cut).diff(n=2, dim=0).abs().amax()
    assert change < 0.3 * jump


@both
def test_who_does_not_say_what_was_carried_out_is_found_on_the_chunk(name):
    """The same plan again, asked for without a word: the motion is where the plan is."""
    policy = small(name)
    plan = torch.linspace(0, 1, policy.motion.decoder.samples)[None, :, None].expand(-1, -1, 2)
    policy.motion.begin(plan, None, 0)
    moved = plan + 4 * (plan[0, 1, 0] - plan[0, 0, 0])
    actions = policy.go_on(moved, 0, None)
    torch.testing.assert_close(actions[0, 0], plan[0, 4], rtol=0, atol=0.01)


@both
def test_asking_for_chunks_after_single_actions_goes_by_where_the_plan_is(name):
    policy = small(name)
    executed(policy, 6)
    last = policy.motion.chunk
    plan = last.actions + (last.actions[:, 3] - last.actions[:, 0])[:, None]
    begun = policy.go_on(plan.float(), 0, None)
    torch.testing.assert_close(begun[0, 0], last.actions[0, 3].float(), rtol=0, atol=1e-4)


def test_actions_that_all_know_two_levels_are_motions_all_the_same():
    shown = [e | {"action": (e["action"] > 0.5).float()} for e in SHOWN]
    shown[0]["action"][0] = 1.0  # both are up somewhere
    assert small("act_dmp", shown).config.two_level_actions == []


@both
def test_what_decodes_goes_where_the_policy_goes(name):
    policy = small(name).to("meta")
    assert policy.motion.decoder.maps.device.type == "meta"


@both
def test_reset_forgets_the_motion(name):
    policy = small(name)
    first = chunk_of(policy, 0)
    policy.reset()
    torch.testing.assert_close(chunk_of(policy, 0), first, rtol=0, atol=1e-6)
    assert (chunk_of(policy, 1) - first)[:, 0].abs().max() < 1  # goes on
    policy.reset()
    assert policy.motion.chunk is None


@both
def test_a_gripper_of_two_levels_is_left_as_it_is_predicted(name):
    shown = []
    for episode in SHOWN:
        first, second = episode["action"].split(1, dim=-1)
        shut = 40 * (first > 0.5).float()
        shown.append(episode | {"action": torch.cat([first, shut, second], dim=-1)})
    policy = small(name, shown)
    assert policy.config.two_level_actions == [1]
    rng = torch.Generator().manual_seed(0)
    chunk = torch.randn(2, policy.motion.decoder.samples, 3, generator=rng)
    decoded = policy.motion.decode(chunk)
    torch.testing.assert_close(decoded[..., 1], chunk[..., 1], rtol=0, atol=0)
    assert (decoded[..., 0] - chunk[..., 0]).abs().max() > 0.1  # noise is no motion
    # Other components are not exchanged on the way.
    line = torch.linspace(0, 1, policy.motion.decoder.samples)[:, None] * torch.tensor(
        [1.0, 5.0, -2.0]
    )
    torch.testing.assert_close(policy.motion.decode(line[None])[0], line, rtol=0, atol=0.05)
    # A gripper that shuts now shuts now, on the way of a motion that goes on.
    policy.motion.begin(torch.zeros_like(chunk), None, 0)
    after = policy.motion.begin(chunk, policy.motion.after(5), 0)
    torch.testing.assert_close(after[..., 1], chunk[:, :-1, 1], rtol=0, atol=0)


@both
def test_what_will_be_carried_out_meanwhile_keeps_its_gripper(name):
    motion = small(name, two_level_actions=[1]).motion
    samples = motion.decoder.samples
    motion.begin(torch.zeros(1, samples, 2), None, 0)
    plan = torch.ones(1, samples, 2)
    actions = motion.begin(plan, motion.after(2), 3)
    assert actions[0, :, 1].tolist() == [0.0] * 3 + [1.0] * (samples - 4)
    assert (plan == 1).all()  # what was predicted is not written to


@both
def test_a_delay_longer_than_a_chunk_carries_out_the_last_one(name):
    policy = small(name)
    first = chunk_of(policy, 0)
    later = chunk_of(policy, 1, inference_delay=500, prev_chunk_left_over=first[0])
    torch.testing.assert_close(later, first, rtol=0, atol=1e-6)


@both
def test_losses_fall_and_a_checkpoint_brings_everything(name, tmp_path):
    policy = small(name)
    stats, samples = stats_of(SHOWN), windows(policy, SHOWN)
    before, after = make_pre_post_processors(policy.config, dataset_stats=stats)
    rng = torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3)
    losses = []
    policy.train()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for _ in range(60):
            loss, _ = policy.forward(before(samples.draw(32, rng)))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])
    policy.eval()
    for saved in (policy, before, after):
        saved.save_pretrained(tmp_path)
    loaded = get_policy_class(name).from_pretrained(tmp_path)
    assert loaded.config.fps == FPS
    assert json.loads((tmp_path / "config.json").read_text())["two_level_actions"] == []
    torch.testing.assert_close(executed(loaded, 12), executed(policy, 12))


def test_act_learns_what_is_carried_out():
    """Its loss is that of the motion, so that nothing is learned that decoding takes away."""
    policy = small("act_dmp").eval()
    stats = stats_of(SHOWN)
    before, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    batch = before(windows(policy, SHOWN).draw(8, torch.Generator().manual_seed(0)))
    actions, _ = policy.model(batch)
    assert actions.shape[1] == policy.config.chunk_size + 1
    torch.testing.assert_close(policy.motion.decode(actions), actions, rtol=0, atol=0.05)
    wanted = (actions - batch["action"]).abs()[~batch["action_is_pad"]].mean()
    torch.testing.assert_close(policy.forward(batch)[0], wanted)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("act_dmp", {"n_action_steps": 12}, "less than the 12 actions predicted"),
        ("diffusion_dmp", {"n_action_steps": 15}, "less than the 15 actions predicted"),
        ("act_dmp", {"n_basis": 0}, "n_basis must be at least 1"),
        ("act_dmp", {"fps": None}, "how many actions a second"),
        ("diffusion_dmp", {"two_level_actions": [2]}, "components 0 to 1"),
        (
            "act_dmp",
            {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1},
            "no temporal_ensemble_coeff",
        ),
    ],
)
def test_settings_that_make_no_policy(name, changes, message):
    with pytest.raises(ValueError, match=message):
        small(name, **changes)


def test_a_negative_delay_is_refused():
    with pytest.raises(ValueError, match="inference_delay must not be negative, got -1"):
        chunk_of(small("act_dmp"), 0, inference_delay=-1)


def test_columns_that_jump_are_put_back_in_their_place():
    config = ActDmpConfig(n_basis=4, fps=10.0, two_level_actions=[0, 2])
    motion = ChunkMotion(config, 9, 4)
    chunk = torch.arange(9.0)[None, :, None] * torch.tensor([1.0, 2.0, 3.0, 4.0]) / 9
    torch.testing.assert_close(motion.decode(chunk), chunk, rtol=0, atol=0.05)
