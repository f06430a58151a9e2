"""From observations to chunks of one continuous motion; the policy without LeRobot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hrc_learn.lerobot.policy.action_encoding import ActionChart
from hrc_learn.lerobot.policy.closed_form import fit_closed_form
from hrc_learn.lerobot.policy.observation_encoder import Observation, ObservationEncoder
from hrc_learn.lerobot.policy.primitive_head import ContextualMotion, Primitives

STATE = "observation.state"


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """What a chunk starts from, in the coordinates of the primitives."""

    position: Float[Tensor, "B A"]
    velocity: Float[Tensor, "B A"]
    elapsed: Float[Tensor, "B"]
    """When the motion was there, since the start of the episode [s]."""
    lead: Float[Tensor, "B"]
    """From then to the first action of the chunk [s]: one step, or none in the first chunk."""

    @property
    def clock(self) -> Float[Tensor, "B"]:
        """Time of the chunk's first action since the start of the episode [s]."""
        return self.elapsed + self.lead


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """What is kept of the first observation of an episode."""

    context: Float[Tensor, "B C"]
    features: Float[Tensor, "B F"]
    start: Start


@dataclass(frozen=True, kw_only=True, eq=False)
class Chunk:
    """Motion at the times of a chunk's actions, in the coordinates of the primitives."""

    position: Float[Tensor, "B T A"]
    velocity: Float[Tensor, "B T A"]
    clock: Float[Tensor, "B"]
    """Time of the first action since the start of the episode [s]."""

    def start_after(self, actions: int, step: float) -> Start:
        """What the next chunk starts from when so many `actions` were carried out."""
        k = actions - 1
        return Start(
            position=self.position[:, k],
            velocity=self.velocity[:, k],
            elapsed=self.clock + k * step,
            lead=torch.full_like(self.clock, step),
        )


class MotionPlanner(nn.Module):
    """Plans chunks that each start where, and as fast as, the motion is by then."""

    measured: Int[Tensor, "A"]
    """Columns of the state that hold the action's components; -1: none does."""

    def __init__(
        self,
        encoder: ObservationEncoder,
        chart: ActionChart,
        motion: ContextualMotion,
        *,
        measured: Sequence[int],
        step: float,
        chunk_size: int,
    ):
        """Put it together.

        Args:
            encoder: Of observations.
            chart: From actions to coordinates.
            motion: From what is seen to primitives of these coordinates.
            measured: For each component of the action its column of `observation.state`, -1
                for those that are not measured.
            step: From one action to the next [s].
            chunk_size: Actions planned at once.
        """
        super().__init__()
        self.encoder = encoder
        self.chart = chart
        self.motion = motion
        self.step = step
        self.chunk_size = chunk_size
        self.register_buffer("measured", torch.tensor(measured), persistent=False)

    def open(self, observation: Observation) -> Opening:
        """Begin an episode: where the arm is, as far as that is measured."""
        context, features = self.encoder.numbers(observation), self.encoder(observation)
        clock = features.new_zeros(len(features))
        primitives = self._primitives(context, features, features, clock)
        position = primitives.start
        if (self.measured >= 0).any():
            values = observation[STATE][:, None, self.measured.clamp_min(0)].to(position)
            seen = self.chart.to_coordinates(values)[:, 0]
            position = torch.where(self.measured >= 0, seen, position)
        velocity = primitives.start_velocity
        start = Start(position=position, velocity=velocity, elapsed=clock, lead=clock)
        return Opening(context=context, features=features, start=start)

    def plan(self, opening: Opening, observation: Observation, start: Start) -> Chunk:
        """The next chunk of an episode, for what is seen now."""
        return self._plan(opening, self.encoder(observation), start)

    def rehearse(
        self, first: Observation, now: Observation, clock: Float[Tensor, "B"]
    ) -> Chunk:
        """The chunk at a time of an episode that until then runs as its first observation told.

        So training starts chunks from where the policy's own motion comes to, as it does when
        it runs, and not from what was shown, where noise has no velocity.

        Args:
            first: The first observation of the episode.
            now: The one at `clock`.
            clock: Since the start of the episode [s].
        """
        opening = self.open(first)
        begin = opening.start
        elapsed = (clock - self.step).clamp_min(0)
        primitives = self._primitives(
            opening.context, opening.features, opening.features, begin.clock
        )
        position, velocity = self._continued(primitives, begin, elapsed[:, None])
        start = Start(
            position=position[:, 0],
            velocity=velocity[:, 0],
            elapsed=elapsed,
            lead=clock - elapsed,
        )
        return self._plan(opening, self.encoder(now), start)

    def fit(self, demonstrations: Sequence[Mapping[str, Tensor]], action: str) -> float:
        """Start from demonstrations in closed form, numbers being whitened already.

        Args:
            demonstrations: Columns by key, (frames, components).
            action: Key of the actions.

        Returns:
            As of `fit_closed_form`.
        """
        actions = [shown[action].to(self.chart.mean) for shown in demonstrations]
        self.chart.learn(actions)
        first = [{key: d[key][0] for key in self.encoder.widths} for d in demonstrations]
        contexts = torch.stack([self.encoder.numbers(seen) for seen in first])
        coordinates = [self.chart.to_coordinates(shown) for shown in actions]
        return fit_closed_form(self.motion, coordinates, contexts, 1 / self.step)

    def _plan(self, opening: Opening, seen: Float[Tensor, "B F"], start: Start) -> Chunk:
        primitives = self._primitives(opening.context, opening.features, seen, start.clock)
        steps = self.step * torch.arange(self.chunk_size).to(start.lead)
        position, velocity = self._continued(primitives, start, start.lead[:, None] + steps)
        return Chunk(position=position, velocity=velocity, clock=start.clock)

    def _primitives(
        self, context: Tensor, first_seen: Tensor, seen: Tensor, clock: Tensor
    ) -> Primitives:
        return self.motion(context, torch.cat([first_seen, seen], dim=-1), clock)

    def _continued(
        self, primitives: Primitives, start: Start, time: Float[Tensor, "B T"]
    ) -> tuple[Tensor, Tensor]:
        return self.motion.continued(
            primitives, start.position, start.velocity, elapsed=start.elapsed, time=time
        )
