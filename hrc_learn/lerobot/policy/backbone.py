"""Convolutions that policies see with, by name; none brings or downloads weights."""

from functools import partial
from itertools import pairwise

from torch import nn

GROUPS = 8
"""Of channels normalised together; batches of few demonstrations say too little."""


def make_backbone(name: str, channels: int) -> tuple[nn.Module, int]:
    """From images to feature maps.

    Args:
        name: "small", or a ResNet of torchvision.
        channels: Of the images.

    Returns:
        The backbone, and the channels of its maps.

    Raises:
        ValueError: There is no such backbone.
    """
    if name == "small":
        return _small(channels)
    if name.startswith("resnet"):
        return _resnet(name, channels)
    raise ValueError(f"vision_backbone must be 'small' or a 'resnet...', got {name!r}")


def _small(channels: int) -> tuple[nn.Module, int]:
    widths = (channels, 32, 48, 64, 64)
    layers: list[nn.Module] = []
    for k, (before, after) in enumerate(pairwise(widths)):
        stride = 2 if k < 3 else 1
        layers.append(nn.Conv2d(before, after, kernel_size=3, stride=stride, padding=1))
        layers += [nn.GroupNorm(GROUPS, after), nn.ReLU()]
    return nn.Sequential(*layers), widths[-1]


def _resnet(name: str, channels: int) -> tuple[nn.Module, int]:
    from torchvision.models import ResNet, get_model, list_models

    known = [model for model in list_models() if model.startswith("resnet")]
    if name not in known:
        raise ValueError(f"vision_backbone {name!r} is unknown; there are {', '.join(known)}")
    resnet = get_model(name, weights=None, norm_layer=partial(nn.GroupNorm, GROUPS))
    assert isinstance(resnet, ResNet)
    if channels != 3:
        resnet.conv1 = nn.Conv2d(channels, 64, kernel_size=7, stride=2, padding=3, bias=False)
    # All but pooling and classes; the last stage halves the resolution once more.
    return nn.Sequential(*list(resnet.children())[:-2]), resnet.fc.in_features
