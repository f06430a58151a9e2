"""What a policy makes of an observation: whitened numbers, and places in images."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .backbone import make_backbone

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
