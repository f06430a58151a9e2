"""Motions made up for the pictures; nothing here is a movement primitive."""

import torch
from torch import Tensor

from hrc_learn.geometry import quaternion


def rise(s: Tensor) -> Tensor:
    """Minimum-jerk curve from 0 to 1."""
    s = s.clamp(0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def stamps(duration: float, n_samples: int = 200) -> tuple[Tensor, Tensor]:
    """Times [s], and the same from 0 to 1."""
    s = torch.linspace(0, 1, n_samples, dtype=torch.float64)
    return duration * s, s


def joints() -> tuple[Tensor, Tensor]:
    """Two joints over 2 s [rad]."""
    time, s = stamps(2.0)
    first = 0.9 * rise(s) + 0.25 * torch.sin(2 * torch.pi * s) * torch.sin(torch.pi * s)
    second = 0.6 - 0.8 * rise(s) + 0.35 * torch.sin(torch.pi * s) ** 2
    return time, torch.stack([first, second], -1)


def stroke() -> tuple[Tensor, Tensor]:
    """A stroke in the plane over 2 s [m]."""
    time, s = stamps(2.0)
    x = 0.4 * rise(s) + 0.05 * torch.sin(2 * torch.pi * s) * torch.sin(torch.pi * s)
    y = 0.16 * torch.sin(torch.pi * rise(s)) + 0.1 * rise(s)
    return time, torch.stack([x, y], -1)


def swing() -> tuple[Tensor, Tensor]:
    """A path in space over 3 s [m], and orientations that turn along it."""
    time, s = stamps(3.0)
    m = rise(s)
    bow = torch.sin(torch.pi * m) ** 2
    position = torch.stack([0.3 + 0.25 * m, -0.25 + 0.5 * m, 0.3 + 0.2 * bow + 0.05 * m], -1)
    vector = torch.stack([0.9 * bow, -0.4 * m, 1.4 * m], -1)
    return time, torch.cat([position, quaternion.exp(vector)], -1)
