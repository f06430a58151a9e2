"""From features of observations to movement primitives."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import Response, continue_motion

HARMONICS = 4
"""Sines and cosines of the phase that the network sees."""
DURATIONS = math.log(3)
"""How far, as a logarithm, a duration may get from the one fitted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitives:
    """One primitive of A coordinates for each element of a batch."""

    weights: Float[Tensor, "*batch A N"]
    start: Float[Tensor, "*batch A"]
    start_velocity: Float[Tensor, "*batch A"]
    """Per second."""
    goal: Float[Tensor, "*batch A"]
    duration: Float[Tensor, "*batch"]
    """[s]"""


class ContextualMotion(nn.Module):
    """Primitives as a function of what is seen.

    x = a + B c + r(features, phase),   x = (weights, y_0', y_0, g) of each coordinate, log tau

    The context c is what was measured at the start of the episode. a and B come from a fit in
    closed form (see `closed_form.py`), and the network r starts at zero: so the policy works
    before the first gradient, and learns what is left. Weights count in units of the spring's
    stiffness, where they are as large as the motion.
    """

    centre: Tensor
    """Context of base."""
    low: Tensor
    high: Tensor

    def __init__(
        self, response: Response, width: int, context: int, features: int, hidden: int
    ):
        """Make one that stands still.

        Args:
            response: Of the primitives.
            width: A, their coordinates.
            context: C, length of the context.
            features: Of the first and the current observation together.
            hidden: Width of the network.
        """
        super().__init__()
        self.response = response
        self.width = width
        count = response.basis.count + 3
        self.base = nn.Parameter(torch.zeros(width * count + 1))
        self.slopes = nn.Parameter(torch.zeros(context, width * count + 1))
        self.register_buffer("centre", torch.zeros(context))
        self.register_buffer("low", torch.full((context,), -torch.inf))
        self.register_buffer("high", torch.full((context,), torch.inf))
        last = nn.Linear(hidden, width * count + 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.network = nn.Sequential(
            nn.Linear(features + 2 * HARMONICS, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            last,
        )

    def forward(
        self,
        context: Float[Tensor, "B C"],
        features: Float[Tensor, "B F"],
        elapsed: Float[Tensor, "B"],
    ) -> Primitives:
        """Primitives for what is seen.

        Args:
            context: Numbers of the first observation.
            features: Of the first observation and the current one.
            elapsed: Since the start of the episode [s].
        """
        # Outside of what was demonstrated a straight line leads anywhere.
        c = torch.minimum(torch.maximum(context, self.low), self.high) - self.centre
        x = self.base + c @ self.slopes
        phase = elapsed / self._duration(x)
        angle = torch.pi * phase[:, None].clamp(0, 1) * torch.arange(1, HARMONICS + 1).to(x)
        return self.primitives(
            x + self.network(torch.cat([features, angle.sin(), angle.cos()], dim=-1))
        )

    def primitives(self, x: Float[Tensor, "*batch K"]) -> Primitives:
        """What the coordinates stand for."""
        per_coordinate = x[..., :-1].unflatten(-1, (self.width, -1))
        duration = self._duration(x)
        return Primitives(
            weights=per_coordinate[..., :-3] * self.response.spring.stiffness,
            start_velocity=per_coordinate[..., -3] / duration[..., None],
            start=per_coordinate[..., -2],
            goal=per_coordinate[..., -1],
            duration=duration,
        )

    def continued(
        self,
        primitives: Primitives,
        position: Float[Tensor, "B A"],
        velocity: Float[Tensor, "B A"],
        *,
        elapsed: Float[Tensor, "B"],
        time: Float[Tensor, "B T"],
    ) -> tuple[Float[Tensor, "B T A"], Float[Tensor, "B T A"]]:
        """Motion of the primitives from here on; see `continue_motion`."""
        return continue_motion(
            self.response,
            primitives.weights,
            primitives.goal,
            position,
            velocity,
            duration=primitives.duration,
            elapsed=elapsed,
            time=time,
        )

    def _duration(self, x: Tensor) -> Tensor:
        fitted = self.base[-1].detach()
        return (fitted + (x[..., -1] - fitted).clamp(-DURATIONS, DURATIONS)).exp()
