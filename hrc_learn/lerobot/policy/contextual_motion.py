"""Movement primitives as a function of the observation, and their fit in closed form."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hrc_learn.dmp import JointDMP, Response, fit_ridge

HARMONICS = 4
"""Number of sines, and of cosines, of the phase among the inputs of the network."""
DURATIONS = math.log(3)
"""Largest difference between the logarithms of a predicted duration and of the fitted one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitives:
    """One primitive of A coordinates for each element of a batch."""

    weights: Float[Tensor, "*batch A N"]
    start: Float[Tensor, "*batch A"]
    start_velocity: Float[Tensor, "*batch A"]
    """Velocity at the start [1/s]."""
    goal: Float[Tensor, "*batch A"]
    duration: Float[Tensor, "*batch"]
    """Duration of the motion [s]."""

    def from_rest(self) -> Float[Tensor, "*batch A M"]:
        """Coordinates of the same primitive if it begins at rest and at its goal."""
        ends = torch.stack([torch.zeros_like(self.goal), self.goal, self.goal], dim=-1)
        return torch.cat([self.weights, ends], dim=-1)


class ContextualMotion(nn.Module):
    """Primitives as a function of the observation.

    x = a + B c + r(features, phase),   x = (weights, y_0', y_0, g) of each coordinate, log tau

    y_0' is the start velocity times the duration tau, y_0 the start and g the goal. The context
    c holds the numbers measured at the start of the episode. The parameters a (`base`) and B
    (`slopes`) come from a fit in closed form (`fit_closed_form`), and the network r starts at
    zero. Therefore the policy works before any training, and training learns the residual. In
    x, weights are divided by the spring's stiffness, which makes them about as large as the
    motion.
    """

    def __init__(
        self, response: Response, width: int, context: int, features: int, hidden: int
    ):
        """Start with a motion that stands still.

        Args:
            response: Response of the primitives.
            width: Number A of coordinates.
            context: Length C of the context.
            features: Number of features of the first and the current observation together.
            hidden: Width of the network.
        """
        super().__init__()
        self.response = response
        self.width = width
        count = response.basis.count + 3
        self.base = nn.Parameter(torch.zeros(width * count + 1))
        self.slopes = nn.Parameter(torch.zeros(context, width * count + 1))
        self.centre = nn.Buffer(torch.zeros(context))
        """Context at which the primitives are `base`."""
        self.low = nn.Buffer(torch.full((context,), -torch.inf))
        """Lowest context; lower values are clamped."""
        self.high = nn.Buffer(torch.full((context,), torch.inf))
        """Highest context; higher values are clamped."""
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
        """Primitives for an observation.

        Args:
            context: Numbers of the first observation.
            features: Features of the first and the current observation.
            elapsed: Time since the start of the episode [s].
        """
        # Clamp the context: linear extrapolation outside the demonstrations is unbounded.
        c = torch.minimum(torch.maximum(context, self.low), self.high) - self.centre
        x = self.base + c @ self.slopes
        phase = elapsed / self._duration(x)
        angle = torch.pi * phase[:, None].clamp(0, 1) * torch.arange(1, HARMONICS + 1).to(x)
        return self.primitives(
            x + self.network(torch.cat([features, angle.sin(), angle.cos()], dim=-1))
        )

    def primitives(self, x: Float[Tensor, "*batch K"]) -> Primitives:
        """Primitives from the vector x (see the class)."""
        per_coordinate = x[..., :-1].unflatten(-1, (self.width, -1))
        duration = self._duration(x)
        return Primitives(
            weights=per_coordinate[..., :-3] * self.response.spring.stiffness,
            start_velocity=per_coordinate[..., -3] / duration[..., None],
            start=per_coordinate[..., -2],
            goal=per_coordinate[..., -1],
            duration=duration,
        )

    def _duration(self, x: Tensor) -> Tensor:
        """Duration [s] from the vector x, within `DURATIONS` of the fitted duration."""
        fitted = self.base[-1].detach()
        return (fitted + (x[..., -1] - fitted).clamp(-DURATIONS, DURATIONS)).exp()


REGULARIZATIONS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge strengths of the regression, chosen by cross-validation."""
FEWEST = 4
"""Fewest demonstrations for which a regression can be distinguished from chance."""
SMALLEST_VARIATION = 0.05
"""A context value is used only if its whitened standard deviation between demonstrations is
larger than this."""
MARGIN = 0.5
"""Contexts may lie outside the demonstrated range by this fraction of the range."""


@torch.no_grad()
def fit_closed_form(
    motion: ContextualMotion,
    demonstrations: Sequence[Float[Tensor, "_frames A"]],
    contexts: Float[Tensor, "n C"],
    fps: float,
) -> float:
    """Set base and slopes of `motion` from demonstrations.

    One primitive is fitted to each demonstration. The result is the mean of these primitives,
    or a ridge regression on the context if it predicts left-out demonstrations better.

    Args:
        motion: Motion whose base, slopes and range of contexts are set in place.
        demonstrations: Whitened actions of each demonstration.
        contexts: Whitened context of each demonstration.
        fps: Frames a second.

    Returns:
        Root mean square error of motions predicted for left-out demonstrations, relative to the
        spread of the coordinates; NaN for a single demonstration.
    """
    x, c, n = _fit_each(motion.response, demonstrations, fps), contexts.double(), len(contexts)
    left_out = (x - x.mean(0)) * n / (n - 1) if n > 1 else x * torch.nan
    best = _error(motion, left_out)
    slopes = c.new_zeros(c.shape[1], x.shape[1])
    varies = (c - c.mean(0)).square().mean(0).sqrt() > SMALLEST_VARIATION
    for regularization in REGULARIZATIONS if n >= FEWEST and varies.any() else ():
        fit = fit_ridge(c[:, varies], x, regularization)
        error = _error(motion, fit.held_out)
        if error < best:
            best, slopes[varies] = error, fit.coefficients[1:] / fit.scale[:, None]
    motion.base.copy_(x.mean(0))
    motion.slopes.copy_(slopes)
    motion.centre.copy_(c.mean(0))
    low, high = torch.aminmax(c, dim=0)
    motion.low.copy_(low - MARGIN * (high - low))
    motion.high.copy_(high + MARGIN * (high - low))
    return best


def _fit_each(
    response: Response, demonstrations: Sequence[Tensor], fps: float
) -> Float[Tensor, "n K"]:
    """Vector x (see `ContextualMotion`) of a primitive fitted to each demonstration."""
    position = pad_sequence([d.double() for d in demonstrations], batch_first=True)
    lengths = torch.tensor([len(d) for d in demonstrations])
    frame = torch.arange(position.shape[1])
    dmp = JointDMP.fit(
        frame.double() / fps,
        position,
        mask=frame < lengths[:, None],
        basis=response.basis,
        spring=response.spring,
        approach=response.approach,
    )
    each = dmp.coordinates()
    each[..., :-3] /= response.spring.stiffness
    return torch.cat([each.flatten(1), dmp.duration.log()[:, None]], dim=-1)


def _error(motion: ContextualMotion, difference: Float[Tensor, "n K"]) -> float:
    """Root mean square difference of motions whose vectors x differ by `difference`."""
    # The motion is linear in all of x but the duration, which shifts the motion in time.
    per_coordinate = difference[:, :-1].unflatten(-1, (motion.width, -1)).clone()
    per_coordinate[..., :-3] *= motion.response.spring.stiffness
    s = torch.linspace(0, 1, 100, dtype=torch.float64)
    position, _, _ = motion.response.matrices(s, torch.float64)
    square = (per_coordinate @ position).square().mean() + difference[:, -1].square().mean()
    return float(square.sqrt())
