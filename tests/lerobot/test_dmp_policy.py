"""What LeRobot, and whoever trusts a policy with an arm, may expect of `dmp`."""

from dataclasses import fields
from types import SimpleNamespace

import pytest
import torch
from lerobot.policies import get_policy_class
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot_samples import (
    FPS,
    GOAL,
    STATE,
    config_for,
    fitted_policy,
    played,
    reaching,
    shaken,
    stats_of,
    windows,
    write_dataset,
)

from hrc_learn.lerobot import DMPConfig
from hrc_learn.lerobot.policy.dmp_policy import (
    DMPPolicy,
    make_dmp_pre_post_processors,
    write_closed_form_policy,
)

SHOWN = reaching(10)
HELD_OUT = reaching(5, seed=1)
IMAGE = "observation.images.front"


def with_images(episodes, keep=(STATE, GOAL, "action")):
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
}


@pytest.mark.parametrize("episodes", SEEN.values(), ids=SEEN)
def test_losses_chunks_and_gradients_whatever_it_sees(episodes):
    policy = shaken(fitted_policy(episodes))
    batch = windows(policy, episodes).draw(6, torch.Generator().manual_seed(0))
    loss, values = policy.forward(batch)
    each, _ = policy.forward(batch, reduction="none")
    assert loss.shape == ()
    assert each.shape == (6,)
    square = each.sum() * batch["action_is_pad"].shape[1] / (~batch["action_is_pad"]).sum()
    assert values == {"rmse": pytest.approx(square.item() ** 0.5)}
    loss.backward()
    for name, parameter in policy.named_parameters():
        if parameter.numel():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name
    now = {key: episodes[0][key][:2] for key in episodes[0] if key != "action"}
    assert policy.predict_action_chunk(now).shape == (2, 10, 2)
    policy.reset()
    assert policy.select_action(now).shape == (2, 2)


def test_training_sees_the_first_and_the_present_observation():
    samples = windows(fitted_policy(SHOWN), SHOWN)
    seen = samples.batch(torch.arange(len(samples)))
    for key in (STATE, GOAL):
        present = torch.cat([e[key] for e in SHOWN])
        first = torch.cat([e[key][:1].expand_as(e[key]) for e in SHOWN])
        torch.testing.assert_close(seen[key], torch.stack([first, present], dim=1))


def test_padding_is_not_learned():
    policy = fitted_policy(SHOWN)
    samples = windows(policy, SHOWN)
    # The last frames of an episode, the middle of it, the last of another.
    batch = samples.batch(torch.tensor([len(SHOWN[0]["action"]) - 2, 5, len(samples) - 1]))
    absent = batch["action_is_pad"]
    assert absent.sum(-1).tolist() == [8, 0, 9]
    loss, _ = policy.forward(batch)
    each, _ = policy.forward(batch, reduction="none")
    batch["action"] = torch.where(absent[..., None], 100.0, batch["action"])
    torch.testing.assert_close(policy.forward(batch)[0], loss, rtol=0, atol=0)
    torch.testing.assert_close(policy.forward(batch, reduction="none")[0], each, rtol=0, atol=0)
    # Two halves of a batch, each in a process of its own, average to the whole.
    halves = [{key: x[part] for key, x in batch.items()} for part in (slice(1), slice(1, 3))]
    one, two = (policy.forward(half)[0] for half in halves)
    torch.testing.assert_close((one + 2 * two) / 3, loss)


def test_one_demonstration_is_repeated_without_training():
    policy = fitted_policy(SHOWN[:1])
    error = played(policy, SHOWN[0]) - SHOWN[0]["action"]
    # Of a path two long; twelve basis functions leave a thousandth.
    assert error.abs().max() < 5e-3


def test_ten_demonstrations_lead_to_goals_between_them():
    policy = fitted_policy(SHOWN)
    mean = fitted_policy([{k: e[k] for k in (STATE, "action")} for e in SHOWN])
    for episode in HELD_OUT:
        reached = played(policy, episode, 60)[-1]
        assert (reached - episode[GOAL][0]).norm() < 0.02
    # One that does not see the goal cannot.
    assert (played(mean, HELD_OUT[0], 60)[-1] - HELD_OUT[0][GOAL][0]).norm() > 0.1


def test_what_explains_nothing_is_not_followed():
    """Goals that are somebody else's: demonstrations left out say that the mean is better."""
    others = [
        e | {GOAL: o[GOAL][:1].expand(len(e["action"]), -1)}
        for e, o in zip(SHOWN, HELD_OUT * 2, strict=True)
    ]
    one, other = ({GOAL: torch.full((1, 2), x), STATE: torch.zeros(1, 3)} for x in (-1.0, 1.0))
    policy, misled = fitted_policy(SHOWN), fitted_policy(others)

    def difference(policy):
        ends = [policy.begin(seen).context for seen in (one, other)]
        slopes = policy.motion.slopes
        return float(((ends[0] - ends[1]) @ slopes).norm())

    assert difference(misled) < 0.1 * difference(policy)


def test_beyond_what_was_shown_it_goes_no_farther():
    """By half of the range shown, however far away the goal is seen."""
    policy = fitted_policy(SHOWN)
    far = SHOWN[0] | {GOAL: SHOWN[0][GOAL] + 100}
    goals = torch.stack([e[GOAL][0] for e in SHOWN])
    farthest = goals.amax(0) + 0.5 * (goals.amax(0) - goals.amin(0))
    reached = played(policy, far, 60)[-1]
    torch.testing.assert_close(reached, farthest, rtol=0, atol=0.1)


@pytest.mark.slow
def test_training_takes_up_what_the_closed_form_leaves():
    """Goals in the cube root of what is seen: no straight line fits, the network does."""
    bent = [e | {GOAL: e[GOAL].sign() * e[GOAL].abs() ** 3} for e in SHOWN]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = fitted_policy(bent)
    samples, rng = windows(policy, bent), torch.Generator().manual_seed(0)
    some = samples.batch(torch.arange(0, len(samples), 10))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=5e-3)
    before, _ = policy.forward(some)
    for _ in range(40):
        optimizer.zero_grad()
        policy.forward(samples.draw(16, rng))[0].backward()
        optimizer.step()
    assert policy.forward(some)[0] < 0.8 * before


def test_position_and_velocity_go_on_over_seams_whatever_is_predicted():
    """At a thousand actions a second velocity jumps show, were there any."""
    policy = shaken(fitted_policy(SHOWN, chunk_size=40, n_action_steps=20))
    policy.config.fps = 1000.0
    noise = torch.Generator().manual_seed(0)
    episode = {
        key: x[:1] + torch.randn(400, x.shape[-1], generator=noise) if key != "action" else x
        for key, x in SHOWN[0].items()
    }
    episode["action"] = torch.zeros(400, 2)
    velocity = played(policy, episode).double().diff(dim=0) * 1000
    jump = velocity.diff(dim=0).abs().amax(-1)
    speed = velocity.norm(dim=-1).max()
    seams = torch.arange(19, len(jump), 20)
    # Float32 actions, of the size of one, resolve a thousandth of one per second.
    assert jump.max() < 0.05 * speed
    # A policy that forgets its motion jumps there.
    forgetful = []
    for k in range(0, 400, 20):
        policy.reset()
        forgetful.append(
            policy.predict_action_chunk({x: episode[x][k][None] for x in (STATE, GOAL)})
        )
    cut = torch.cat([chunk[0, :20] for chunk in forgetful]).double().diff(dim=0) * 1000
    assert cut.diff(dim=0).abs().amax(-1)[seams[:-1]].min() > 0.05 * speed


def test_reset_begins_where_the_arm_is_measured():
    policy = fitted_policy(SHOWN)
    played(policy, SHOWN[0], 13)
    policy.reset()
    elsewhere = {STATE: torch.tensor([[0.2, 0.0, -0.3]]), GOAL: SHOWN[0][GOAL][:1]}
    # State is b, gripper, a.
    torch.testing.assert_close(policy.select_action(elsewhere), torch.tensor([[-0.3, 0.2]]))


def test_actions_that_are_changes_per_step_do_not_begin_at_the_measured_position():
    """Their names are those of the state, which would be commanded as one huge change."""
    changes = [e | {"action": e["action"].diff(dim=0, append=e["action"][-1:])} for e in SHOWN]
    policy = fitted_policy(changes)
    assert (policy.measured == -1).all()
    largest = torch.cat([e["action"] for e in changes]).abs().max()
    for shown in changes:
        assert played(policy, shown, 5).abs().max() <= 1.5 * largest
    assert fitted_policy(SHOWN).measured.tolist() == [2, 0]


def test_columns_are_told_by_name_alone():
    permuted = [e | {STATE: e[STATE].flip(-1)} for e in SHOWN]
    one, other = (
        fitted_policy(SHOWN),
        fitted_policy(permuted, state_names=["a.pos", "gripper.pos", "b.pos"]),
    )
    torch.testing.assert_close(played(one, SHOWN[0]), played(other, permuted[0]))


def test_chunks_by_themselves_go_on_as_selected_actions_do():
    policy = shaken(fitted_policy(SHOWN))
    now = {key: SHOWN[0][key][:1] for key in (STATE, GOAL)}
    selected = torch.cat([policy.select_action(now) for _ in range(18)])
    policy.reset()
    chunks = [policy.predict_action_chunk(now)[0, :6] for _ in range(3)]
    torch.testing.assert_close(torch.cat(chunks), selected)


def test_a_hand_that_points_down_turns_without_a_jump():
    """Half a turn from the base frame, where a rotation vector changes its sign."""
    names = ["ee.wx", "ee.wy", "ee.wz"]
    tilt = torch.linspace(-0.3, 0.3, 40)
    # About x by pi + tilt: beyond pi the shortest rotation vector points the other way.
    turn = torch.pi + tilt
    turn = torch.where(turn > torch.pi, turn - 2 * torch.pi, turn)
    vectors = torch.stack([turn, torch.zeros(40), torch.zeros(40)], dim=-1)
    episode = {STATE: vectors, "action": vectors}
    policy = fitted_policy([episode], state_names=names, action_feature_names=names)
    actions = played(policy, episode)
    assert actions.diff(dim=0).abs().max() < 0.03
    turned = torch.remainder(actions[:, 0], 2 * torch.pi) - torch.pi
    torch.testing.assert_close(turned, tilt, rtol=0, atol=3e-3)
    policy.train()
    loss, _ = policy.forward(windows(policy, [episode]).batch(torch.arange(40)))
    assert loss < 1e-3


def test_a_checkpoint_brings_everything(tmp_path):
    policy = shaken(fitted_policy(SHOWN))
    policy.save_pretrained(tmp_path)
    loaded = get_policy_class("dmp").from_pretrained(tmp_path)
    assert isinstance(loaded, DMPPolicy)
    assert isinstance(loaded, PreTrainedPolicy)
    torch.testing.assert_close(played(loaded, HELD_OUT[0]), played(policy, HELD_OUT[0]))


def test_processors_leave_numbers_as_they_are():
    policy = fitted_policy(SHOWN)
    before, after = make_dmp_pre_post_processors(policy.config, stats_of(SHOWN))
    seen = before({STATE: SHOWN[0][STATE][0], GOAL: SHOWN[0][GOAL][0]})
    torch.testing.assert_close(seen[STATE], SHOWN[0][STATE][:1])
    torch.testing.assert_close(after(SHOWN[0]["action"][:1]), SHOWN[0]["action"][:1])


def test_a_dataset_on_disk_is_fitted_by_its_episodes(tmp_path, caplog):
    folder = write_dataset(tmp_path / "set", SHOWN[:3])
    shown = [e | {STATE: e["action"]} for e in SHOWN[:3]]
    stats, meta = stats_of(shown), SimpleNamespace(root=folder, fps=FPS)
    config = config_for(shown[0], fps=None, fit_episodes=[2, 0], state_names=["a.pos", "b.pos"])
    policy = DMPPolicy(config, dataset_stats=stats, dataset_meta=meta)
    assert config.fps == FPS
    like = DMPPolicy(config, dataset_stats=stats)
    like.fit([shown[0], shown[2]])
    torch.testing.assert_close(played(policy, shown[1]), played(like, shown[1]))
    # Of a dataset that is streamed nothing lies on disk.
    DMPPolicy(config, dataset_stats=stats, dataset_meta=SimpleNamespace(root=tmp_path, fps=FPS))
    assert "training starts from a resting arm" in caplog.text


def test_tuning_for_other_actions_or_rates_is_refused(tmp_path):
    fitted_policy(SHOWN).save_pretrained(tmp_path)
    config = DMPConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    with pytest.raises(ValueError, match=r"trained for the actions a\.pos, b\.pos; .* c\.pos"):
        config.set_dataset_feature_metadata({"action": {"names": ["c.pos", "b.pos"]}})
    meta = SimpleNamespace(root=tmp_path, fps=2 * FPS)
    with pytest.raises(ValueError, match="for 20 actions a second, the dataset has 40"):
        DMPPolicy(config, dataset_meta=meta)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": None}, "how many actions a second"),
        ({"input_features": {}}, "needs an input"),
        ({"output_features": {}}, "'action' among its outputs"),
        ({"n_action_steps": 11}, "1 to chunk_size"),
        ({"n_obs_steps": 2}, "sees one step"),
    ],
)
def test_settings_that_make_no_policy(changes, message):
    settings = vars(config_for(SHOWN[0])) | changes
    settings = {field.name: settings[field.name] for field in fields(DMPConfig)}
    with pytest.raises(ValueError, match=message):
        DMPPolicy(DMPConfig(**settings))


def test_backbones_are_told_by_name():
    image = with_images(SHOWN[:1])
    with pytest.raises(ValueError, match="'small' or a 'resnet"):
        DMPPolicy(config_for(image[0], vision_backbone="vit"))
    with pytest.raises(ValueError, match="resnet19"):
        DMPPolicy(config_for(image[0], vision_backbone="resnet19"))
    policy = fitted_policy(image, vision_backbone="resnet18")
    loss, _ = policy.forward(windows(policy, image).batch(torch.arange(2)))
    assert loss.isfinite()


@pytest.mark.parametrize("episodes", [None, [0, 2]])
def test_a_closed_form_policy_is_a_checkpoint_of_numbers_alone(tmp_path, episodes):
    dataset = write_dataset(tmp_path / "set", SHOWN[:4], images=True)
    (tmp_path / "policy").mkdir()
    figures = write_closed_form_policy(
        dataset, tmp_path / "policy", n_basis=12, episodes=episodes
    )
    chosen = range(4) if episodes is None else episodes
    assert figures["demonstrations"] == len(chosen)
    policy = DMPPolicy.from_pretrained(tmp_path / "policy")
    config = policy.config
    assert config.fit_episodes == episodes
    assert config.input_features.keys() == {STATE, GOAL}
    assert config.output_features.keys() == {"action"}
    assert (config.fps, config.n_basis, config.push_to_hub) == (FPS, 12, False)
    shown = [e | {STATE: e["action"]} for e in (SHOWN[k] for k in chosen)]
    like = DMPPolicy(config_for(shown[0], state_names=["a.pos", "b.pos"]))
    like.encoder.load_state_dict(policy.encoder.state_dict())
    like.fit(shown)
    assert figures["left_out_error"] == pytest.approx(like.left_out_error, rel=1e-5)
    torch.testing.assert_close(policy.motion.base, like.motion.base)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        assert (tmp_path / "policy" / name).is_file()


def test_a_closed_form_policy_takes_a_dataset(tmp_path):
    with pytest.raises(FileNotFoundError, match="no LeRobot dataset"):
        write_closed_form_policy(tmp_path, tmp_path, n_basis=12)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "needs observation.state"),
        ({STATE: torch.zeros(1, 4)}, "3 values in observation.state.* has 4"),
        ({STATE: torch.tensor([[0.0, 0.0, torch.nan]])}, r"not finite in a\.pos"),
    ],
)
def test_states_that_cannot_be_used_are_named(state, message):
    policy = fitted_policy(SHOWN)
    with pytest.raises(ValueError, match=message):
        policy.select_action({GOAL: SHOWN[0][GOAL][:1]} | state)


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        (STATE, {"mean": torch.zeros(3)}, "lack std of observation.state"),
        (GOAL, {}, "lack mean of observation.environment_state"),
        ("action", {"mean": torch.zeros(3), "std": torch.ones(2)}, "2 finite.* mean of action"),
        (STATE, {"mean": torch.zeros(3), "std": torch.full((3,), torch.nan)}, "3 finite.* std"),
    ],
)
def test_statistics_that_cannot_be_used_are_named(key, values, message):
    with pytest.raises(ValueError, match=message):
        DMPPolicy(config_for(SHOWN[0]), dataset_stats=stats_of(SHOWN) | {key: values})


def test_tuning_on_states_in_another_order_is_refused():
    config = config_for(SHOWN[0])
    names = {"action": {"names": ["a.pos", "b.pos"]}}
    same = {"observation.state": {"names": ["b.pos", "gripper.pos", "a.pos"]}}
    config.set_dataset_feature_metadata(names | same)
    other = {"observation.state": {"names": ["a.pos", "gripper.pos", "b.pos"]}}
    with pytest.raises(
        ValueError, match=r"in the order b\.pos, gripper\.pos, a\.pos; .*a\.pos"
    ):
        config.set_dataset_feature_metadata(names | other)


def test_a_truncated_checkpoint_is_named(tmp_path):
    fitted_policy(SHOWN).save_pretrained(tmp_path)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged"):
        DMPPolicy.from_pretrained(tmp_path)
