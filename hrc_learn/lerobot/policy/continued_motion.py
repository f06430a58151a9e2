"""Chunks as one motion: each starts in the state at the end of the previous actions."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.lerobot.policy.chunk_network import ChunkDecoder


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionChunk:
    """Actions to come as a motion, of a batch."""

    states: Float[Tensor, "B samples 3 D"]
    """Position, velocity and acceleration of the smooth columns."""
    stepped: Float[Tensor, "B samples G"]
    """Values of the columns that jump."""
    actions: Float[Tensor, "B samples A"]

    def after(self, steps: Int[Tensor, "B"]) -> "MotionChunk":
        """Remainder after a number of actions; stands still beyond the end."""
        samples = self.states.shape[1]
        index = steps[:, None] + torch.arange(samples, device=steps.device)
        over = index > samples - 1
        index = index.clamp(max=samples - 1)
        row = torch.arange(len(steps), device=steps.device)[:, None]
        states = self.states[row, index].clone()
        states[:, :, 1:] = torch.where(over[..., None, None], 0.0, states[:, :, 1:])
        return MotionChunk(
            states=states, stepped=self.stepped[row, index], actions=self.actions[row, index]
        )


class ContinuedMotion:
    """Motion executed across chunks, C2 for any plan.

    Smooth columns of the actions follow a movement primitive; two-level columns jump.
    """

    chunk: MotionChunk | None
    """The last one; None: nothing is under way."""

    def __init__(
        self,
        decoder: ChunkDecoder,
        compose: Callable[[Tensor, Tensor], Tensor],
        decompose: Callable[[Tensor], tuple[Tensor, Tensor]],
    ):
        """Begin with nothing under way.

        Args:
            decoder: Decoder of coefficients to the samples of a chunk.
            compose: Function from smooth columns (B, samples, D) and those that jump (B,
                samples, G) to actions (B, samples, A).
            decompose: And back.
        """
        self.decoder = decoder
        self._compose, self._decompose = compose, decompose
        self.reset()

    def reset(self) -> None:
        """Forget the motion that is under way."""
        self.chunk = None

    def after(self, steps: int) -> MotionChunk | None:
        """Remainder after a number of actions of the last chunk."""
        if self.chunk is None:
            return None
        states = self.chunk.states
        return self.chunk.after(torch.full((len(states),), steps, device=states.device))

    def nearest(self, position: Float[Tensor, "B D"]) -> MotionChunk | None:
        """Remainder from the action of the last chunk that is nearest to a position.

        At least one action counts as executed.
        """
        if self.chunk is None:
            return None
        off = self.chunk.states[:, 1:, 0] - position[:, None]
        return self.chunk.after(off.square().sum(-1).argmin(1) + 1)

    def left_over(self, actions: Float[Tensor, "*one n A"]) -> MotionChunk | None:
        """Continuation of the last chunk, or of other given actions."""
        samples = self.decoder.samples
        actions = actions.reshape(-1, actions.shape[-1])
        # LeRobot fills short ones up with zeros.
        there = actions.any(-1).nonzero().flatten()
        actions = actions[: int(there[-1]) + 1] if len(there) else actions[:0]
        if self.chunk is not None:
            if not len(actions):
                return self.after(samples)
            for k in range(samples):
                same = self.chunk.actions[0, k : k + len(actions)]
                if len(same) and torch.equal(same, actions[: len(same)]):
                    return self.after(k)
        if not len(actions):
            return None
        # Actions of another source: velocity by differences, at rest after the last.
        index = torch.arange(samples, device=actions.device).clamp(max=len(actions) - 1)
        position, stepped = self._decompose(actions[index][None])
        position = position.double()
        (velocity,) = torch.gradient(position, spacing=self.decoder.step, dim=1)
        (acceleration,) = torch.gradient(velocity, spacing=self.decoder.step, dim=1)
        return MotionChunk(
            states=torch.stack([position, velocity, acceleration], dim=2),
            stepped=stepped,
            actions=actions[index][None],
        )

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
            stepped: Values of the columns that jump.
            before: Remainder of the previous chunk; None: the motion begins.
            beginning: State to begin in then; None: as planned.
            delay: Actions of `before` that will be carried out before this chunk is there.
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
