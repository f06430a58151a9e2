"""Chunks of actions as smooth motions: their basis functions, the network that plans them, and
their continuation from chunk to chunk.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from hrc_learn.dmp import fit_ridge
from hrc_learn.dmp.motion_head import MotionHead

# A chunk is a motion, given by a linear map of a few coefficients.

NOISE = 1e-2
"""Noise of demonstrated actions relative to their spread; smaller motions are not learned."""
BASIS, ACTIONS_EACH = 10, 2.5
"""`BASIS`: largest default number of basis functions of a chunk. `ACTIONS_EACH`: fewest actions
per basis function by default."""
BLEND_TIME = 0.05
"""Default blend time [s], or one action period if that is longer; limited by `BLEND_SHARE`."""
BLEND_SHARE = 0.3
"""Largest default blend time, as a fraction of the spacing h of basis functions. A plan with
error e has an acceleration error of about 20 e / h^2, which displaces the motion by
20 e (blend_time / h)^2.
"""
TINY = 1e-9
"""Relative regularisation that keeps a matrix invertible."""


class ChunkDecoder(nn.Module):
    """Map from coefficients of movement primitives, one for each column, to a chunk of actions.

    A column has M = N + 3 coefficients: start, start velocity, and the N weights and the goal
    of a `MotionHead`. Actions and their derivatives are linear in the coefficients. Therefore
    closed forms give the coefficients of a demonstrated chunk, and the change of a chunk that
    lets it begin in a given state.
    """

    def __init__(
        self,
        chunk_size: int,
        step: float,
        n_basis: int | None = None,
        blend_time: float | None = None,
    ):
        """Compute the maps.

        Args:
            chunk_size: Actions of a chunk.
            step: Time between actions [s].
            n_basis: Number N of weights per column; None: 10, or two per five actions if that
                is fewer.
            blend_time: Approximate time in which a chunk changes from the executed motion to
                the plan [s]; None: the longer of 0.05 s and one action period, but at most
                `BLEND_SHARE` of the spacing of basis functions.
        """
        super().__init__()
        n_basis = n_basis or min(BASIS, max(2, int(chunk_size / ACTIONS_EACH)))
        between = chunk_size * step / n_basis
        self.step = step
        self.blend_time = blend_time or min(max(BLEND_TIME, step), BLEND_SHARE * between)
        head = MotionHead(1, n_basis, duration=chunk_size * step).double()
        unit = torch.eye(n_basis + 3, dtype=torch.float64)
        time = step * torch.arange(chunk_size + 1, dtype=torch.float64)
        motion = head(unit[:, 2:], time, unit[:, :1], unit[:, 1:2])
        acceleration = motion.acceleration[..., 0].T
        (jerk,) = torch.gradient(acceleration, spacing=step, dim=0)
        position, velocity = motion.position[..., 0].T, motion.velocity[..., 0].T
        maps = torch.stack([position, velocity, acceleration, jerk])
        # The maps follow from the settings, so they are not saved. They are in double
        # precision, as jerk spans many orders of magnitude.
        self.maps = nn.Buffer(maps, persistent=False)
        """Linear map from coefficients to position, velocity, acceleration and jerk at each
        action, (4, samples, M). The last sample lies one action period after the last action;
        it is the chunk's final state."""
        normal = position.T @ position + NOISE**2 * unit
        projection = torch.linalg.solve(normal, position.T)
        self.projection = nn.Buffer(projection, persistent=False)
        """Linear map from a demonstrated chunk to its coefficients, (M, samples)."""

    @property
    def size(self) -> int:
        """Number M of coefficients of a column."""
        return self.maps.shape[-1]

    @property
    def samples(self) -> int:
        """Number of samples: the actions of a chunk, and the action after them."""
        return self.maps.shape[1]

    def project(self, chunks: Float[Tensor, "*batch samples D"]) -> Float[Tensor, "*batch D M"]:
        """Coefficients of the motions nearest to demonstrated chunks."""
        return (self.projection @ chunks.double()).mT.to(chunks)

    def positions(
        self, coefficients: Float[Tensor, "*batch D M"]
    ) -> Float[Tensor, "*batch samples D"]:
        """Actions of a chunk, and the action after them."""
        return self.maps[0].to(coefficients) @ coefficients.mT

    def states(
        self, coefficients: Float[Tensor, "*batch D M"]
    ) -> Float[Tensor, "*batch samples 3 D"]:
        """Position, velocity and acceleration at the samples of a chunk."""
        x = coefficients.double().mT[..., None, :, :]
        return (self.maps[:3] @ x).transpose(-3, -2)

    def begin_in(
        self,
        coefficients: Float[Tensor, "*batch D M"],
        state: Float[Tensor, "*batch 3 D"],
        index: int = 0,
    ) -> Float[Tensor, "*batch D M"]:
        """Coefficients of a motion that passes through a state and then soon joins the plan.

        Among all changes d of the motion that lead exactly through the state, this change has
        the smallest  sum_t d(t)^2 + blend_time^6 d'''(t)^2  over the actions from `index` on.

        Args:
            coefficients: Planned coefficients.
            state: Position, velocity and acceleration.
            index: Index of the action at which the motion is in that state.
        """
        position, jerk = self.maps[0, index:], self.maps[3, index:]
        cost = position.T @ position + self.blend_time**6 * jerk.T @ jerk
        cost = cost + TINY * cost.diagonal().mean() * torch.eye(self.size).to(cost)
        through = self.maps[:3, index]
        back = torch.linalg.solve(cost, through.T)
        change = back @ torch.linalg.inv(through @ back)
        x = coefficients.double()
        off = state.double().mT - x @ through.T
        return x + off @ change.T


# A network predicts several plans for one observation, and their probabilities.

RIDGE = 1e-2
"""Ridge strength of the regression that initialises a network, relative to the spread of its
inputs.
"""
SPREAD = 1e-3
"""Smallest spread of coefficients; avoids division by zero for constant ones."""
DIFFERENCE = 0.02
"""Initial spread of plans, relative to the spread of the coefficients."""
FARTHEST = 10.0
"""Bound of whitened inputs: larger ones are probably wrong, and are clamped."""
LEFT_OVER = 0.05
"""Weight of the mean error of all plans in the loss, so that all plans learn. The error of the
nearest plan has the remaining weight.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plans:
    """K plans for each element of a batch."""

    coefficients: Float[Tensor, "B K D M"]
    scores: Float[Tensor, "B K"]
    """Logits of the probability of each plan."""
    levels: Float[Tensor, "B samples G"]
    """Logits of the probability that a two-level column is at the upper level."""


class ChunkNetwork(nn.Module):
    """Plans as a function of an observation and, if known, of its velocity.

    The plans are the sum of a linear function of the observed numbers, which is fitted in
    closed form, and of a network, which starts near zero. Velocities distinguish forward and
    return motions that look alike.
    """

    def __init__(
        self,
        *,
        numbers: int,
        features: int,
        moving: int,
        columns: int,
        two_level: int,
        decoder: ChunkDecoder,
        n_plans: int,
        hidden: int,
        dropout: float,
    ):
        """Make a network whose plans stand still.

        Args:
            numbers: Number of leading features that enter the linear function.
            features: Number of features of an observation.
            moving: Number of velocities.
            columns: Number D of smooth columns.
            two_level: Number G of two-level columns.
            decoder: Decoder of the coefficients, with the length of a chunk.
            n_plans: Number K of plans.
            hidden: Width of the network.
            dropout: Dropout probability of its hidden features.
        """
        super().__init__()
        self.numbers, self.columns, self.n_plans = numbers, columns, n_plans
        self.samples, self.two_level = decoder.samples, two_level
        self.mean = nn.Buffer(torch.zeros(columns, decoder.size))
        self.spread = nn.Buffer(torch.ones(columns, decoder.size))
        """Statistics of the coefficients of demonstrated chunks, (D, M)."""
        self.linear = nn.Linear(numbers, columns * decoder.size)
        self.levels = nn.Linear(hidden, self.samples * two_level)
        self.into = nn.Linear(features + moving + 1, hidden)
        self.blocks = nn.ModuleList(_block(hidden, dropout) for _ in range(2))
        self.plans = nn.Linear(hidden, n_plans * columns * decoder.size)
        self.scores = nn.Linear(hidden, n_plans)
        for layer in (self.linear, self.plans, self.scores):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        if n_plans > 1:  # identical plans would learn the same
            nn.init.normal_(self.plans.bias, std=DIFFERENCE)

    def forward(
        self,
        features: Float[Tensor, "B F"],
        velocity: Float[Tensor, "B V"],
        known: Float[Tensor, "B"],
    ) -> Plans:
        """Plans for an observation.

        Args:
            features: Features of the observation.
            velocity: Velocities of the observed states, relative to their spreads.
            known: 1 where the velocity is known, else 0.
        """
        features = features.clamp(-FARTHEST, FARTHEST)
        velocity = velocity.clamp(-FARTHEST, FARTHEST) * known[:, None]
        x = F.gelu(self.into(torch.cat([features, velocity, known[:, None]], dim=-1)))
        for block in self.blocks:
            x = x + block(x)
        plain = self.linear(features[:, : self.numbers])[:, None]
        plans = plain + self.plans(x).unflatten(-1, (self.n_plans, -1))
        shape = (self.columns, self.mean.shape[-1])
        return Plans(
            coefficients=plans.unflatten(-1, shape) * self.spread + self.mean,
            scores=self.scores(x),
            levels=self.levels(x).unflatten(-1, (self.samples, self.two_level)),
        )

    @torch.no_grad()
    def fit(self, numbers: Float[Tensor, "n C"], coefficients: Float[Tensor, "n D M"]) -> None:
        """Fit the linear function by regression of demonstrated chunks on observed numbers."""
        self.mean.copy_(coefficients.mean(0))
        self.spread.copy_(coefficients.std(0).clamp_min(SPREAD))
        whitened = ((coefficients - self.mean) / self.spread).flatten(1)
        if self.numbers:
            # Do not standardise again: this would amplify numbers that hardly vary.
            fit = fit_ridge(numbers.double(), whitened.double(), RIDGE, standardize=False)
            constant, slopes = fit.coefficients[0], fit.coefficients[1:]
            self.linear.weight.copy_(slopes.T)
            self.linear.bias.copy_(constant - fit.mean @ slopes)


def _block(hidden: int, dropout: float) -> nn.Module:
    return nn.Sequential(
        nn.LayerNorm(hidden),
        nn.Linear(hidden, hidden),
        nn.GELU(),
        nn.Dropout(dropout),
        nn.Linear(hidden, hidden),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionChunk:
    """Motion of the coming actions, for a batch."""

    states: Float[Tensor, "B samples 3 D"]
    """Position, velocity and acceleration of the smooth columns."""
    stepped: Float[Tensor, "B samples G"]
    """Values of the two-level columns, which jump."""
    actions: Float[Tensor, "B samples A"]


class ContinuedMotion:
    """Motion executed across chunks, with continuous acceleration (C2) for any plan.

    Smooth columns of the actions follow movement primitives; two-level columns jump.
    """

    chunk: MotionChunk | None
    """Last chunk; None: there is no present motion."""

    def __init__(self, decoder: ChunkDecoder, compose: Callable[[Tensor, Tensor], Tensor]):
        """Begin without a present motion.

        Args:
            decoder: Decoder of coefficients to the samples of a chunk.
            compose: Function from smooth columns (B, samples, D) and two-level columns (B,
                samples, G) to actions (B, samples, A).
        """
        self.decoder = decoder
        self._compose = compose
        self.reset()

    def reset(self) -> None:
        """Forget the present motion."""
        self.chunk = None

    def after(self, steps: int | Int[Tensor, "B"]) -> MotionChunk | None:
        """Remainder of the last chunk after some steps; beyond its end, the motion rests."""
        if self.chunk is None:
            return None
        states = self.chunk.states
        row = torch.arange(len(states), device=states.device)[:, None]
        ahead = torch.arange(self.decoder.samples, device=states.device)
        index = ahead + torch.as_tensor(steps, device=states.device).reshape(-1, 1)
        over = index > self.decoder.samples - 1
        index = index.clamp(max=self.decoder.samples - 1)
        states = states[row, index].clone()
        states[:, :, 1:] = torch.where(over[..., None, None], 0.0, states[:, :, 1:])
        stepped, actions = self.chunk.stepped[row, index], self.chunk.actions[row, index]
        return MotionChunk(states=states, stepped=stepped, actions=actions)

    def nearest(self, position: Float[Tensor, "B D"]) -> MotionChunk | None:
        """Remainder from the action of the last chunk that is nearest to a position.

        At least one action counts as executed.
        """
        if self.chunk is None:
            return None
        off = self.chunk.states[:, 1:, 0] - position[:, None]
        return self.after(off.square().sum(-1).argmin(1) + 1)

    def left_over(self, actions: Float[Tensor, "*one n A"]) -> MotionChunk | None:
        """Remainder of the last chunk from the first of its leftover actions.

        The result is None if the actions are not from the last chunk, as their velocity is then
        unknown.
        """
        if self.chunk is None:
            return None
        actions = actions.reshape(-1, actions.shape[-1])
        # LeRobot pads short chunks with zeros.
        there = actions.any(-1).nonzero().flatten()
        if not len(there):
            return self.after(self.decoder.samples)
        actions = actions[: int(there[-1]) + 1]
        for k in range(self.decoder.samples):
            same = self.chunk.actions[0, k : k + len(actions)]
            if len(same) and torch.equal(same, actions[: len(same)]):
                return self.after(k)
        return None

    def go_on(
        self,
        planned: Float[Tensor, "B D M"],
        stepped: Float[Tensor, "B samples G"],
        before: MotionChunk | None,
        *,
        beginning: Float[Tensor, "B 3 D"] | None = None,
        delay: int = 0,
    ) -> Float[Tensor, "B samples A"]:
        """Continue the executed motion to the plan, and store the result as the current motion.

        Args:
            planned: Coefficients of the smooth columns.
            stepped: Values of the two-level columns.
            before: Remainder of the previous chunk; None: the motion begins.
            beginning: State in which the motion begins if `before` is None; None: the first
                planned state.
            delay: Number of actions of `before` to execute before this chunk is available.
        """
        if before is None:
            delay = 0
            state = self.decoder.states(planned)[:, 0] if beginning is None else beginning
        else:
            delay = min(delay, self.decoder.samples - 1)
            state = before.states[:, delay]
        states = self.decoder.states(self.decoder.begin_in(planned, state, delay))
        if before is not None:
            stepped = stepped.clone()
            states[:, :delay] = before.states[:, :delay]
            stepped[:, :delay] = before.stepped[:, :delay].to(stepped)
        actions = self._compose(states[:, :, 0], stepped).to(planned)
        self.chunk = MotionChunk(states=states, stepped=stepped, actions=actions)
        return actions
