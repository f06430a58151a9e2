"""What a policy makes of an observation: whitened numbers, and places in images."""

from collections.abc import Mapping
from functools import partial
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

# Convolutions that policies see with, by name; none brings or downloads weights.

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


# What a policy makes of an observation: whitened numbers, and places in images.

SMALLEST_SPREAD = 1e-6
"""Components that vary by less have never changed."""
type Observation = Mapping[str, Tensor]


class ObservationEncoder(nn.Module):
    """Numbers and images of one moment as one vector of features."""

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        widths: Mapping[str, int],
        images: Mapping[str, int],
        *,
        backbone: str,
        n_keypoints: int,
    ):
        """Put it together, with a spread of one for all numbers.

        Args:
            widths: Features of numbers: key, and number of components.
            images: Features of images: key, and number of channels.
            backbone: See `make_backbone`.
            n_keypoints: Places looked for in each image.

        Raises:
            ValueError: There is no such backbone.
        """
        super().__init__()
        self.widths = dict(widths)
        self.register_buffer("mean", torch.zeros(sum(widths.values())))
        self.register_buffer("std", torch.ones(sum(widths.values())))
        # Names of modules may hold no dots, keys of features do.
        self.cameras = nn.ModuleDict(
            {
                _module_name(key): KeypointEncoder(backbone, channels, n_keypoints)
                for key, channels in images.items()
            }
        )
        self.images = tuple(images)
        self.size = len(self.mean) + 2 * n_keypoints * len(images)
        """Number of features."""

    def whiten(self, stats: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Take mean and spread of the numbers from a dataset's statistics."""
        if not self.widths:
            return

        def all_of(statistic: str) -> Tensor:
            return torch.cat([torch.as_tensor(stats[key][statistic]) for key in self.widths])

        self.mean.copy_(all_of("mean"))
        std = all_of("std")
        self.std.copy_(torch.where(std > SMALLEST_SPREAD, std, 1.0))

    def numbers(self, observation: Observation) -> Float[Tensor, "*batch C"]:
        """The numbers alone, whitened."""
        if not self.widths:
            batch = observation[self.images[0]].shape[:-3] if observation else ()
            return self.mean.new_zeros(*batch, 0)
        values = torch.cat([observation[key] for key in self.widths], dim=-1)
        return (values.to(self.mean) - self.mean) / self.std

    def forward(self, observation: Observation) -> Float[Tensor, "B F"]:
        """All features of a batch of observations."""
        seen = [self.cameras[_module_name(key)](observation[key]) for key in self.images]
        return torch.cat([self.numbers(observation), *seen], dim=-1)


class KeypointEncoder(nn.Module):
    """Places in an image, each the centre of a softmax over a feature map.

    (Levine et al. 2016, "End-to-end training of deep visuomotor policies", section 5)
    """

    def __init__(self, backbone: str, channels: int, n_keypoints: int):
        super().__init__()
        self.backbone, width = make_backbone(backbone, channels)
        self.maps = nn.Conv2d(width, n_keypoints, kernel_size=1)

    def forward(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B two_K"]:
        """Coordinates (u right, v down) of each place, -1 to 1."""
        maps = self.maps(self.backbone(2 * image - 1))
        height, width = maps.shape[-2:]
        share = maps.flatten(-2).softmax(-1).unflatten(-1, (height, width))
        u = torch.linspace(-1, 1, width).to(maps)
        v = torch.linspace(-1, 1, height).to(maps)
        return torch.cat([share.sum(-2) @ u, share.sum(-1) @ v], dim=-1)


def _module_name(key: str) -> str:
    return key.replace(".", "_")
