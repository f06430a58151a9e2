"""The parts of the policy that learn, against loops."""

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torchvision.models import ResNet18_Weights, resnet18, resnet34

from hrc_learn.dmp import GaussianBasis, SpringDamper, response_of
from hrc_learn.lerobot.policy.contextual_motion import HARMONICS, ContextualMotion
from hrc_learn.lerobot.policy.observation_encoder import (
    KeypointEncoder,
    ObservationEncoder,
    load_backbone,
    make_backbone,
)

SPRING = SpringDamper()
COUNT, WIDTH, CONTEXT = 5, 2, 3


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_the_small_backbone_halves_an_image_three_times():
    backbone, channels = make_backbone("small", 4)
    maps = backbone(normal(2, 4, 48, 64))
    assert maps.shape == (2, channels, 6, 8)
    assert sum(p.numel() for p in backbone.parameters()) == sum(
        9 * a * b + 3 * b for a, b in ((4, 32), (32, 48), (48, 64), (64, 64))
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_a_resnet_takes_images_of_any_channels(channels):
    backbone, width = make_backbone("resnet18", channels)
    assert backbone.eval()(normal(1, channels, 64, 96)).shape == (1, width, 2, 3)
    first = next(backbone.children())
    assert isinstance(first, nn.Conv2d)
    assert first.weight.shape == (64, channels, 7, 7)
    assert first.stride == (2, 2)
    assert first.bias is None


def test_torchvisions_weights_make_torchvisions_features(tmp_path):
    """Those of a ResNet in evaluation, whose images torchvision has prepared."""
    torch.manual_seed(0)
    theirs = resnet18(weights=None).eval()
    for layer in theirs.modules():
        if isinstance(layer, nn.BatchNorm2d):  # as after a training
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.5, 2)
            nn.init.normal_(layer.bias)
    file = tmp_path / "weights.safetensors"
    save_file(theirs.state_dict(), file)
    encoder = ObservationEncoder(
        {}, {"front": 3}, backbone="resnet18", n_keypoints=4, pretrained=True
    )
    encoder.load_vision(file)
    (camera,) = encoder.cameras.values()
    image = torch.rand(2, 3, 64, 96)
    prepare = ResNet18_Weights.IMAGENET1K_V1.transforms()
    x = (image - torch.tensor(prepare.mean)[:, None, None]) / torch.tensor(prepare.std)[
        :, None, None
    ]
    for name, part in theirs.named_children():
        if name == "avgpool":
            break
        x = part(x)
    camera.maps, seen = nn.Identity(), []
    camera.maps.register_forward_hook(lambda _, __, maps: seen.append(maps))
    camera(image)
    torch.testing.assert_close(seen[0], x, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (None, "there is no file"),
        (lambda file: file.write_bytes(b"no weights"), "is no safetensors file"),
        (lambda file: save_file({"conv1.weight": torch.ones(64, 3, 7, 7)}, file), ": bn1"),
        (lambda file: save_file(resnet34().state_dict(), file), "holds no weights"),
    ],
)
def test_files_that_hold_no_weights_of_a_resnet_are_named(tmp_path, write, message):
    file = tmp_path / "weights.safetensors"
    if write is not None:
        write(file)
    backbone, _ = make_backbone("resnet50", 3, pretrained=True)
    with pytest.raises(ValueError, match=f"vision_weights: .*{message}") as error:
        load_backbone(backbone, file)
    assert str(file) in str(error.value)


def test_weights_that_fit_no_network_are_refused():
    with pytest.raises(ValueError, match="give vision_backbone as well"):
        make_backbone("small", 3, pretrained=True)
    with pytest.raises(ValueError, match="3 channels, these have 1"):
        make_backbone("resnet18", 1, pretrained=True)


def test_numbers_that_hardly_vary_are_not_blown_up():
    """A joint that is held trembles; one that never moved is left as it is."""
    widths = {"joints": 4, "goal": 2}
    encoder = ObservationEncoder(widths, {}, backbone="small", n_keypoints=1)
    std = {"joints": [0.5, 1e-4, 0.3, 0.0], "goal": [0.0, 0.0]}
    encoder.whiten(
        {
            key: {"mean": torch.ones(n), "std": torch.tensor(std[key])}
            for key, n in widths.items()
        }
    )
    off = {"joints": 1 + torch.tensor([1.0, 3e-3, 0.3, 0.2]), "goal": 1 + torch.ones(2)}
    numbers = encoder.numbers(off)
    torch.testing.assert_close(numbers, torch.tensor([2.0, 1.0, 1.0, 0.2, 1.0, 1.0]))


def test_places_are_the_centres_of_a_softmax_over_the_maps():
    encoder = KeypointEncoder("small", 3, n_keypoints=2)
    encoder.backbone = nn.Identity()
    encoder.maps = nn.Conv2d(3, 2, kernel_size=1)
    image = normal(2, 3, 4, 6).sigmoid()
    weight, bias = encoder.maps.weight[..., 0, 0].tolist(), encoder.maps.bias.tolist()
    for b, k in np.ndindex(2, 2):
        total = u = v = 0.0
        for row, column in np.ndindex(4, 6):
            seen = [2 * x - 1 for x in image[b, :, row, column].tolist()]
            share = math.exp(bias[k] + sum(w * x for w, x in zip(weight[k], seen, strict=True)))
            total += share
            u += share * (-1 + 2 * column / 5)
            v += share * (-1 + 2 * row / 3)
        found = encoder(image)[b]
        assert found[[k, 2 + k]].tolist() == pytest.approx([u / total, v / total], abs=1e-6)


def test_numbers_are_whitened_and_what_never_changed_only_centred():
    encoder = ObservationEncoder({"a": 2, "b": 1}, {}, backbone="small", n_keypoints=4)
    stats = {
        "a": {"mean": torch.tensor([1.0, 2.0]), "std": torch.tensor([0.5, 1e-7])},
        "b": {"mean": torch.tensor([-1.0]), "std": torch.tensor([4.0])},
    }
    encoder.whiten(stats)
    seen = {"b": torch.tensor([[3.0]]), "a": torch.tensor([[2.0, 2.5]])}
    assert encoder(seen).tolist() == [[2.0, 0.5, 1.0]]
    assert encoder.size == 3


def test_features_are_numbers_and_places_of_all_cameras():
    images = {"one.left": 3, "two": 1}
    encoder = ObservationEncoder({"a": 2}, images, backbone="small", n_keypoints=4)
    seen = {key: normal(5, channels, 16, 24) for key, channels in images.items()}
    assert encoder(seen | {"a": normal(5, 2)}).shape == (5, encoder.size)
    assert encoder.size == 2 + 2 * 4 * 2
    blind = ObservationEncoder({}, images, backbone="small", n_keypoints=4)
    blind.whiten({})
    assert blind.numbers(seen).shape == (5, 0)
    assert blind.numbers({}).shape == (0,)
    assert blind(seen).shape == (5, blind.size)


@pytest.fixture
def motion():
    response = response_of(SPRING, GaussianBasis(count=COUNT))
    motion = ContextualMotion(response, WIDTH, CONTEXT, features=4, hidden=8)
    with torch.no_grad():
        motion.base.copy_(normal(len(motion.base), seed=1))
        motion.slopes.copy_(0.1 * normal(*motion.slopes.shape, seed=2))
        motion.centre.copy_(torch.tensor([0.5, 0.0, -0.5]))
        motion.low.copy_(torch.tensor([-1.0, -math.inf, -2.0]))
        motion.high.copy_(torch.tensor([1.0, math.inf, 0.0]))
    return motion


@pytest.mark.parametrize("slower", [0.3, 5.0, -0.3, -5.0])
def test_coordinates_stand_for_weights_velocity_start_goal_and_duration(motion, slower):
    x = normal(3, WIDTH * (COUNT + 3) + 1)
    x[:, -1] = motion.base[-1].item() + slower
    found = motion.primitives(x)
    # Three times as long or short as fitted, at most.
    duration = math.exp(motion.base[-1].item()) * min(max(math.exp(slower), 1 / 3), 3)
    for b in range(3):
        assert found.duration[b].item() == pytest.approx(duration, rel=1e-5)
        rest = iter(x[b].tolist())
        for a in range(WIDTH):
            weights = [next(rest) * SPRING.stiffness for _ in range(COUNT)]
            assert found.weights[b, a].tolist() == pytest.approx(weights, rel=1e-5)
            velocity = next(rest) / duration
            assert found.start_velocity[b, a].item() == pytest.approx(velocity, rel=1e-5)
            assert found.start[b, a].item() == pytest.approx(next(rest))
            assert found.goal[b, a].item() == pytest.approx(next(rest))


class Overheard(nn.Module):
    """Keeps what a network is shown, and answers with a given correction."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def forward(self, shown):
        self.shown = shown
        return self.answer.expand(len(shown), -1)


def test_the_network_sees_features_and_the_phase_and_corrects_a_straight_line(motion):
    motion.network = Overheard(0.1 * normal(len(motion.base), seed=3))
    context = torch.tensor([[0.2, 3.0, -1.0], [9.0, 0.0, -1.0], [-9.0, 0.0, 4.0]])
    clamped = torch.tensor([[0.2, 3.0, -1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    features, fitted = normal(3, 4), motion.base[-1].item()
    line = motion.base + (clamped - motion.centre) @ motion.slopes
    duration = line[:, -1].clamp(fitted - math.log(3), fitted + math.log(3)).exp()
    elapsed = duration.detach() * torch.tensor([0.0, 0.3, 7.0])
    found = motion(context, features, elapsed)
    expected = motion.primitives(line + motion.network.answer)
    for name in ("weights", "start", "start_velocity", "goal", "duration"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))
    for shown, seen, phase in zip(motion.network.shown, features, (0.0, 0.3, 1.0), strict=True):
        angles = [math.pi * phase * k for k in range(1, HARMONICS + 1)]
        waves = [math.sin(a) for a in angles] + [math.cos(a) for a in angles]
        assert shown.tolist() == pytest.approx(seen.tolist() + waves, abs=1e-5)


def test_an_untrained_network_changes_nothing():
    response = response_of(SPRING, GaussianBasis(count=COUNT))
    motion = ContextualMotion(response, WIDTH, CONTEXT, features=4, hidden=8)
    found = motion(100 * normal(2, CONTEXT), normal(2, 4), torch.tensor([0.0, 2.0]))
    assert not found.weights.any()
    assert not found.goal.any()
    assert found.duration.tolist() == [1.0, 1.0]
    last = motion.network[-1]
    assert isinstance(last, nn.Linear)
    assert last.weight.shape == (WIDTH * (COUNT + 3) + 1, 8)
