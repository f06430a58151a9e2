"""Random samples for tests: every function takes the generator it draws from."""

import torch
from torch import Tensor


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def quaternions(*batch: int, rng: torch.Generator, dtype=torch.float64) -> Tensor:
    """Unit quaternions, uniform over rotations, either sign."""
    q = torch.randn(*batch, 4, generator=rng, dtype=dtype)
    return q / q.norm(dim=-1, keepdim=True)


def directions(*batch: int, rng: torch.Generator, dtype=torch.float64) -> Tensor:
    """Unit vectors, uniform over the sphere."""
    v = torch.randn(*batch, 3, generator=rng, dtype=dtype)
    return v / v.norm(dim=-1, keepdim=True)


def rotation_vectors(
    *batch: int, rng: torch.Generator, max_angle: float = torch.pi, dtype=torch.float64
) -> Tensor:
    """Rotation vectors with angles uniform between zero and `max_angle` [rad]."""
    length = max_angle * torch.rand(*batch, 1, generator=rng, dtype=dtype)
    return length * directions(*batch, rng=rng, dtype=dtype)


def within(
    lower: Tensor, upper: Tensor, *batch: int, rng: torch.Generator, margin: float = 0.0
) -> Tensor:
    """Points uniform in a box, at least `margin` inside its walls."""
    fraction = torch.rand(*batch, len(lower), generator=rng, dtype=lower.dtype)
    return lower + margin + fraction * (upper - lower - 2 * margin)
