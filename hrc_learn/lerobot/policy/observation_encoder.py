"""Encode observations as vectors of features: whitened numbers, and keypoints of images."""

from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

# Convolutional backbones are chosen by name; none of them downloads weights.

GROUPS = 8
"""Number of groups in group normalisation. Batch normalisation is not used, because batches
from few demonstrations are too small for batch statistics.
"""
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and spread of red, green and blue in the images that trained torchvision's weights."""


def make_backbone(
    name: str, channels: int, *, pretrained: bool = False
) -> tuple[nn.Module, int]:
    """Backbone from images to feature maps.

    Args:
        name: "small", or a ResNet of torchvision.
        channels: Number of channels of the images.
        pretrained: True if torchvision's weights will be loaded; the backbone then uses frozen
            batch normalisation.

    Returns:
        The backbone, and the number of channels of its maps.

    Raises:
        ValueError: There is no such backbone, or no weights can be loaded into it.
    """
    if name == "small":
        if pretrained:
            raise ValueError("vision_weights are for a ResNet: give vision_backbone as well")
        return _small(channels)
    if name.startswith("resnet"):
        return _resnet(name, channels, pretrained)
    raise ValueError(f"vision_backbone must be 'small' or a 'resnet...', got {name!r}")


def _small(channels: int) -> tuple[nn.Module, int]:
    widths = (channels, 32, 48, 64, 64)
    layers: list[nn.Module] = []
    for k, (before, after) in enumerate(pairwise(widths)):
        stride = 2 if k < 3 else 1
        layers.append(nn.Conv2d(before, after, kernel_size=3, stride=stride, padding=1))
        layers += [nn.GroupNorm(GROUPS, after), nn.ReLU()]
    return nn.Sequential(*layers), widths[-1]


def _resnet(name: str, channels: int, pretrained: bool) -> tuple[nn.Module, int]:
    from torchvision.models import ResNet, get_model, list_models
    from torchvision.ops import FrozenBatchNorm2d

    known = [model for model in list_models() if model.startswith("resnet")]
    if name not in known:
        raise ValueError(f"vision_backbone {name!r} is unknown; there are {', '.join(known)}")
    norm = FrozenBatchNorm2d if pretrained else partial(nn.GroupNorm, GROUPS)
    resnet = get_model(name, weights=None, norm_layer=norm)
    assert isinstance(resnet, ResNet)
    if pretrained and channels != 3:
        raise ValueError(f"vision_weights are for images of 3 channels, these have {channels}")
    if channels != 3:
        resnet.conv1 = nn.Conv2d(channels, 64, kernel_size=7, stride=2, padding=3, bias=False)
    # All layers before pooling and classification, with torchvision's names; the last stage
    # halves the resolution once more.
    parts = OrderedDict(list(resnet.named_children())[:-2])
    return nn.Sequential(parts), resnet.fc.in_features


def load_backbone(backbone: nn.Module, path: Path) -> None:
    """Load weights of a ResNet, with torchvision's names, from a file.

    Args:
        backbone: Backbone that `make_backbone` returned with pretrained=True.
        path: State dict in a safetensors file.

    Raises:
        ValueError: There is no such file, or it holds no weights of this ResNet.
    """
    if not path.is_file():
        raise ValueError(f"vision_weights: there is no file {path}")
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(
            f"vision_weights: {path} is no safetensors file ({error}); convert a file of "
            "torchvision by safetensors.torch.save_file(torch.load(PTH), FILE)"
        ) from error
    try:
        missing = backbone.load_state_dict(weights, strict=False).missing_keys
    except RuntimeError as error:
        missing = [" ".join(str(error).split())]
    if missing:
        raise ValueError(
            f"vision_weights: {path} holds no weights of this ResNet: {missing[0][:200]} is "
            "missing, or of another shape"
        )


# Features of an observation: whitened numbers, and keypoints of images.

SMALLEST_SPREAD = 1e-6
"""A component with at most this spread counts as constant."""
SMALLEST_SCALE = 0.01
"""Smallest scale of a feature's values, relative to their median spread. A joint held at rest
still varies by a thousandth of the motion of other joints, and varies differently in states
that were not demonstrated. When this variation was amplified, it moved an ALOHA arm away from
its cube.
"""
type Observation = Mapping[str, Any]
"""Tensors by key; LeRobot's evaluation adds other entries."""


class ObservationEncoder(nn.Module):
    """Encodes the numbers and images of one moment as one vector of features."""

    def __init__(
        self,
        widths: Mapping[str, int],
        images: Mapping[str, int],
        *,
        backbone: str,
        n_keypoints: int,
        pretrained: bool = False,
    ):
        """Build the encoder, with a spread of one for all numbers.

        Args:
            widths: Number of components of each feature of numbers, by key.
            images: Number of channels of each image feature, by key.
            backbone: See `make_backbone`.
            n_keypoints: Number of keypoints in each image.
            pretrained: See `make_backbone`.

        Raises:
            ValueError: There is no such backbone.
        """
        super().__init__()
        self.widths = dict(widths)
        self.mean = nn.Buffer(torch.zeros(sum(widths.values())))
        """Mean of each number."""
        self.std = nn.Buffer(torch.ones(sum(widths.values())))
        """Scale by which each number is divided."""
        # Names of modules must not contain dots, but keys of features do.
        self.cameras = nn.ModuleDict(
            {
                _module_name(key): KeypointEncoder(backbone, channels, n_keypoints, pretrained)
                for key, channels in images.items()
            }
        )
        self.images = tuple(images)
        self.size = len(self.mean) + 2 * n_keypoints * len(images)
        """Number of features."""

    def whiten(self, stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Set mean and scale of the numbers from a dataset's statistics."""
        if not self.widths:
            return
        mean = torch.cat([torch.as_tensor(stats[key]["mean"]) for key in self.widths])
        self.mean.copy_(mean)
        spreads = [divisors(torch.as_tensor(stats[key]["std"])) for key in self.widths]
        self.std.copy_(torch.cat(spreads))

    def load_vision(self, path: Path) -> None:
        """Load the weights of a file into the backbones of all cameras.

        Raises:
            ValueError: Same as `load_backbone`.
        """
        for camera in self.cameras.values():
            assert isinstance(camera, KeypointEncoder)
            load_backbone(camera.backbone, path)

    def numbers(self, observation: Observation) -> Float[Tensor, "*batch C"]:
        """Whitened numbers of an observation, without its images."""
        if not self.widths:
            batch = observation[self.images[0]].shape[:-3] if observation else ()
            return self.mean.new_zeros(*batch, 0)
        values = torch.cat([observation[key] for key in self.widths], dim=-1)
        return (values.to(self.mean) - self.mean) / self.std

    def forward(self, observation: Observation) -> Float[Tensor, "B F"]:
        """All features of a batch of observations."""
        seen = [self.cameras[_module_name(key)](observation[key]) for key in self.images]
        return torch.cat([self.numbers(observation), *seen], dim=-1)


def divisors(std: Float[Tensor, "n"], fraction: float = SMALLEST_SCALE) -> Float[Tensor, "n"]:
    """Scales of a feature's values: spreads, bounded below by a fraction of the median."""
    varies = std > SMALLEST_SPREAD
    if not varies.any():
        return torch.ones_like(std)
    least = fraction * std[varies].median()
    return torch.where(varies, std.clamp_min(least), 1.0)


class KeypointEncoder(nn.Module):
    """Keypoints of an image: each is the mean position under the softmax of a feature map.

    (Levine et al. 2016, "End-to-end training of deep visuomotor policies", section 5)
    """

    def __init__(
        self, backbone: str, channels: int, n_keypoints: int, pretrained: bool = False
    ):
        super().__init__()
        self.pretrained = pretrained
        self.backbone, width = make_backbone(backbone, channels, pretrained=pretrained)
        self.maps = nn.Conv2d(width, n_keypoints, kernel_size=1)

    def forward(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B two_K"]:
        """Coordinates of the keypoints, -1 to 1: u (right) of each, then v (down) of each."""
        if self.pretrained:
            mean, std = (image.new_tensor(x)[:, None, None] for x in IMAGENET)
            image = (image - mean) / std
        else:
            image = 2 * image - 1
        maps = self.maps(self.backbone(image))
        height, width = maps.shape[-2:]
        weight = maps.flatten(-2).softmax(-1).unflatten(-1, (height, width))
        u = torch.linspace(-1, 1, width).to(maps)
        v = torch.linspace(-1, 1, height).to(maps)
        return torch.cat([weight.sum(-2) @ u, weight.sum(-1) @ v], dim=-1)


def _module_name(key: str) -> str:
    return key.replace(".", "_")
