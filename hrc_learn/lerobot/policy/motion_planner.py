"""Planner from observations to chunks of one continuous motion; the policy without LeRobot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hrc_learn.dmp import orientation_error
from hrc_learn.geometry import quaternion
from hrc_learn.lerobot.policy.closed_form import fit_closed_form
from hrc_learn.lerobot.policy.networks import (
    ContextualMotion,
    Observation,
    ObservationEncoder,
    Primitives,
)

# The coordinates in which actions move linearly.

SMALLEST_SPREAD = 1e-3
"""Components that vary by less are not blown up to a spread of one."""


class ActionEncoding(nn.Module):
    """Actions as coordinates of mean zero and spread one, and back.

    A rotation vector becomes the error e = log(r conj(q)) to a reference r, in which an
    orientation moves linearly (see `hrc_learn/dmp/orientation_error.py`), r being the mean
    orientation of the demonstrations. So nothing jumps where a rotation vector does, at half a
    turn, which is where a gripper that points down is.
    """

    mean: Tensor
    std: Tensor
    reference: Tensor
    """Unit quaternions (w, x, y, z), one for each rotation vector."""

    def __init__(self, width: int, triples: Sequence[Sequence[int]]):
        """Identity, until it has learned.

        Args:
            width: A, components of an action.
            triples: Those that make up rotation vectors [rad].
        """
        super().__init__()
        self.triples = [list(triple) for triple in triples]
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.register_buffer("reference", identity.repeat(len(self.triples), 1))

    def to_coordinates(
        self, actions: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Coordinates of actions along time."""
        return (self._unrolled(actions) - self.mean) / self.std

    def to_actions(
        self, coordinates: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Actions again; rotation vectors are the ones nearest to the reference's."""
        actions = coordinates * self.std + self.mean
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = orientation_error.to_orientation(actions[..., triple], reference)
            vector = orientation_error.nearest_turn(
                quaternion.log(q), quaternion.log(reference)
            )
            actions = _replaced(actions, triple, vector)
        return actions

    @torch.no_grad()
    def learn(self, episodes: Sequence[Float[Tensor, "_frames A"]]) -> None:
        """Take mean, spread and references from demonstrated actions.

        Raises:
            ValueError: Orientations more than half a turn away from their mean.
        """
        for k, triple in enumerate(self.triples):
            q = quaternion.exp(torch.cat([e[:, triple] for e in episodes]))
            self.reference[k] = quaternion.mean(q)
        unrolled = [self._unrolled(episode) for episode in episodes]
        for triple in self.triples:
            for k, episode in enumerate(unrolled):
                if (episode[:, triple].norm(dim=-1) > torch.pi).any():
                    raise ValueError(
                        f"demonstration {k} turns the end effector by more than half a turn "
                        "from the mean orientation, where a rotation vector is ambiguous: "
                        "leave it out (fit_episodes), or use joints as actions"
                    )
        self.whiten(*torch.std_mean(torch.cat(unrolled), dim=0))

    def whiten(self, std: Float[Tensor, "A"], mean: Float[Tensor, "A"]) -> None:
        """Take these for spread and mean of what is to be whitened."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(SMALLEST_SPREAD))

    def _unrolled(self, actions: Tensor) -> Tensor:
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = quaternion.exp(actions[..., triple])
            error = orientation_error.to_error(q, reference)
            actions = _replaced(actions, triple, quaternion.unwrap_log(error))
        return actions


def _replaced(values: Tensor, columns: list[int], new: Tensor) -> Tensor:
    index = torch.tensor(columns, device=values.device)
    return values.index_copy(-1, index, new.to(values))


# Which components of action and state belong together, by their names.

ROTATION = ("wx", "wy", "wz")
"""Last part of the names of a rotation vector's components, as LeRobot has them."""
ENDINGS = ("", ".pos")
"""Possible endings of names: lerobot-rollout only passes on names with one."""


def rotation_triples(names: Sequence[str] | None) -> list[list[int]]:
    """Components that make up rotation vectors, such as ee.wx, ee.wy, ee.wz.

    Args:
        names: Names of all components; None: unknown.
    """
    index = {name: i for i, name in enumerate(names or ())}
    triples = []
    for name in index:
        for ending in ENDINGS:
            stem = name.removesuffix(ROTATION[0] + ending)
            triple = [stem + part + ending for part in ROTATION]
            if stem != name and index.keys() >= {*triple}:
                triples.append([index[part] for part in triple])
    return triples


def matched_columns(
    action_names: Sequence[str] | None,
    state_names: Sequence[str] | None,
    widths: tuple[int, int],
) -> list[int]:
    """State columns that measure each component of the action; -1: not measured.

    If neither has names and their widths agree, states are taken for measured actions. A
    rotation vector is measured whole or not at all.

    Args:
        action_names: Names of the action's components; None: unknown.
        state_names: Names of the state's components; None: unknown.
        widths: Number of components of action and state.
    """
    actions, states = widths
    if action_names is None and state_names is None and actions == states:
        return list(range(actions))
    index = {name: i for i, name in enumerate(state_names or ())}
    columns = [index.get(name, -1) for name in action_names or [""] * actions]
    for triple in rotation_triples(action_names):
        if any(columns[i] < 0 for i in triple):
            for i in triple:
                columns[i] = -1
    return columns


# Chunks of the motion.

STATE = "observation.state"


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Initial state of a chunk, in the coordinates of the primitives."""

    position: Float[Tensor, "B A"]
    velocity: Float[Tensor, "B A"]
    elapsed: Float[Tensor, "B"]
    """Time of this state since the start of the episode [s]."""
    lead: Float[Tensor, "B"]
    """Time from this state to the first action of the chunk [s]: one step, or zero in the first
    chunk.
    """

    @property
    def clock(self) -> Float[Tensor, "B"]:
        """Time of the chunk's first action since the start of the episode [s]."""
        return self.elapsed + self.lead


@dataclass(frozen=True, kw_only=True, eq=False)
class InitialPlan:
    """Quantities kept from the first observation of an episode."""

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
        """Initial state of the next chunk after a number of executed `actions`."""
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
        encoding: ActionEncoding,
        motion: ContextualMotion,
        *,
        measured: Sequence[int],
        step: float,
        chunk_size: int,
    ):
        """Put it together.

        Args:
            encoder: Encoder of observations.
            encoding: Encoding of actions in coordinates.
            motion: Network from observations to primitives of these coordinates.
            measured: Column of `observation.state` of each action component, -1
                for those that are not measured.
            step: Time between actions [s].
            chunk_size: Actions planned at once.
        """
        super().__init__()
        self.encoder = encoder
        self.encoding = encoding
        self.motion = motion
        self.step = step
        self.chunk_size = chunk_size
        self.register_buffer("measured", torch.tensor(measured), persistent=False)

    def initial_plan(self, observation: Observation) -> InitialPlan:
        """Begin an episode: where the arm is, as far as that is measured."""
        context, features = self.encoder.numbers(observation), self.encoder(observation)
        clock = features.new_zeros(len(features))
        primitives = self._primitives(context, features, features, clock)
        position = primitives.start
        if (self.measured >= 0).any():
            values = observation[STATE][:, None, self.measured.clamp_min(0)].to(position)
            seen = self.encoding.to_coordinates(values)[:, 0]
            position = torch.where(self.measured >= 0, seen, position)
        velocity = primitives.start_velocity
        start = Start(position=position, velocity=velocity, elapsed=clock, lead=clock)
        return InitialPlan(context=context, features=features, start=start)

    def plan(self, plan_start: InitialPlan, observation: Observation, start: Start) -> Chunk:
        """The next chunk of an episode, for what is seen now."""
        return self._plan(plan_start, self.encoder(observation), start)

    def condition(
        self, first: Observation, now: Observation, clock: Float[Tensor, "B"]
    ) -> Chunk:
        """Chunk at a time of an episode that so far followed the prediction at its first
        observation.

        Training thus starts chunks from the policy's own motion, as execution does, and not
        from the demonstration, whose noise has no valid velocity.

        Args:
            first: First observation of the episode.
            now: Observation at `clock`.
            clock: Time since the start of the episode [s].
        """
        plan_start = self.initial_plan(first)
        begin = plan_start.start
        elapsed = (clock - self.step).clamp_min(0)
        primitives = self._primitives(
            plan_start.context, plan_start.features, plan_start.features, begin.clock
        )
        position, velocity = self._continued(primitives, begin, elapsed[:, None])
        start = Start(
            position=position[:, 0],
            velocity=velocity[:, 0],
            elapsed=elapsed,
            lead=clock - elapsed,
        )
        return self._plan(plan_start, self.encoder(now), start)

    def fit(self, demonstrations: Sequence[Mapping[str, Tensor]], action: str) -> float:
        """Start from demonstrations in closed form, numbers being whitened already.

        Args:
            demonstrations: Columns by key, (frames, components).
            action: Key of the actions.

        Returns:
            As of `fit_closed_form`.
        """
        actions = [shown[action].to(self.encoding.mean) for shown in demonstrations]
        self.encoding.learn(actions)
        first = [{key: d[key][0] for key in self.encoder.widths} for d in demonstrations]
        contexts = torch.stack([self.encoder.numbers(seen) for seen in first])
        coordinates = [self.encoding.to_coordinates(shown) for shown in actions]
        return fit_closed_form(self.motion, coordinates, contexts, 1 / self.step)

    def _plan(self, plan_start: InitialPlan, seen: Float[Tensor, "B F"], start: Start) -> Chunk:
        primitives = self._primitives(
            plan_start.context, plan_start.features, seen, start.clock
        )
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
