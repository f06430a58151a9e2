"""A small transformer that writes the tokens of action chunks, and its training."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from token_codes import Code, Windows, equal_length
from torch import Tensor, nn
from torch.nn import functional as F

BATCH, RATE, WARM_UP, DECAY = 64, 3e-3, 50, 0.01
"""Number of chunks in a batch; AdamW's learning rate, number of steps until it is reached, and
weight decay."""


class Block(nn.Module):
    """Transformer layer with causal attention and normalisation before each part."""

    def __init__(self, width: int, heads: int = 4):
        super().__init__()
        self.heads = heads
        self.norm, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )

    def forward(
        self, x: Float[Tensor, "B L W"], past: list[Tensor]
    ) -> tuple[Float[Tensor, "B L W"], list[Tensor]]:
        """Outputs, and keys and values of all positions so far."""
        q, k, v = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1)).unbind(-3)
        q, k, v = (part.transpose(1, 2) for part in (q, k, v))
        if past:
            k, v = torch.cat([past[0], k], 2), torch.cat([past[1], v], 2)
        y = F.scaled_dot_product_attention(q, k, v, is_causal=not past)
        x = x + self.out(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.norm2(x)), [k, v]


class Writer(nn.Module):
    """Decoder-only transformer whose first position is the observation."""

    mean: Tensor
    spread: Tensor

    def __init__(
        self, inputs: Float[Tensor, "N I"], size: int, length: int, width: int, layers: int
    ):
        """Prepare for sequences of at most `length` of `size` tokens."""
        super().__init__()
        self.register_buffer("mean", inputs.mean(0))
        self.register_buffer("spread", inputs.std(0).clamp(min=1e-4))
        self.read = nn.Sequential(
            nn.Linear(inputs.shape[1], 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.embed, self.place = nn.Embedding(size, width), nn.Embedding(length, width)
        self.blocks = nn.ModuleList(Block(width) for _ in range(layers))
        self.norm, self.next = nn.LayerNorm(width), nn.Linear(width, size)
        for weight in (self.embed.weight, self.place.weight):
            nn.init.normal_(weight, std=0.02)

    def forward(
        self, inputs: Float[Tensor, "B I"], ids: Int[Tensor, "B L"]
    ) -> Float[Tensor, "B L1 S"]:
        """Scores of the token at each position and of the next one."""
        x = torch.cat([self._first(inputs), self.embed(ids)], 1)
        x = x + self.place.weight[: x.shape[1]]
        for block in self.blocks:
            x, _ = block(x, [])
        return self.next(self.norm(x))

    @torch.no_grad()
    def write(self, inputs: Float[Tensor, "B I"], end: int | None) -> Int[Tensor, "B L"]:
        """Most probable tokens, one after another, until `end` or the maximum length."""
        x, past, ids = self._first(inputs), [[] for _ in self.blocks], []
        finished = torch.zeros(len(inputs), dtype=torch.bool)
        for place in self.place.weight:
            x = x + place
            for i, block in enumerate(self.blocks):
                x, past[i] = block(x, past[i])
            best = self.next(self.norm(x))[:, -1].argmax(-1)
            if end is not None:
                best = torch.where(finished, end, best)
                finished |= best == end
            ids.append(best)
            if finished.all():
                break
            x = self.embed(best)[:, None]
        return torch.stack(ids, 1)

    def _first(self, inputs: Float[Tensor, "B I"]) -> Float[Tensor, "B 1 W"]:
        # Inputs far beyond the demonstrated ones would dominate the output.
        x = (inputs - self.mean) / self.spread
        return self.read(x.clamp(-10, 10))[:, None]


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained network, and the code of its tokens."""

    writer: Writer
    code: Code

    def act(
        self, last: Windows, relaxed: bool
    ) -> tuple[Float[np.ndarray, "B T D"], Bool[np.ndarray, "B"]]:
        """The next chunks, and flags of sequences that did not decode."""
        ids = self.writer.write(last.inputs(), self.code.end)
        return self.code.decode(ids.numpy(), last, relaxed)


class Training:
    """Training of a network, step by step."""

    def __init__(
        self,
        windows: Windows,
        size: int,
        ids: list[list[int]],
        *,
        seed: int,
        width: int,
        layers: int,
    ):
        """Draw the weights.

        Args:
            windows: What is known before each chunk.
            size: Number of tokens that there are.
            ids: Tokens of each chunk.
            seed: Seed of weights and batches.
            width: Width of the network.
            layers: Layers of the network.
        """
        torch.manual_seed(seed)
        self._rng = torch.Generator().manual_seed(seed)
        self._tokens, self._counts = equal_length(ids, 0)
        self._inputs, length = windows.inputs(), self._tokens.shape[1]
        self.writer, self._done = Writer(self._inputs, size, length, width, layers), 0
        self._optimizer = torch.optim.AdamW(
            self.writer.parameters(), RATE, weight_decay=DECAY, fused=True
        )

    def step(self, share: float) -> float:
        """Learn from a batch; returns the loss per token [nat].

        Args:
            share: Completed fraction of the training, 0 to 1; the learning rate falls along a
            cosine.
        """
        self._done += 1
        rate = RATE * min(1, self._done / WARM_UP) * (1 + math.cos(math.pi * share)) / 2
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        index = torch.randint(len(self._tokens), (BATCH,), generator=self._rng)
        count = self._counts[index]
        batch = self._tokens[index, : int(count.max())]
        scores = self.writer(self._inputs[index], batch[:, :-1])
        wanted = torch.arange(batch.shape[1]) < count[:, None]
        loss = F.cross_entropy(scores[wanted], batch[wanted])
        self._optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.writer.parameters(), 1.0)
        self._optimizer.step()
        return loss.item()

    def run(self, steps: int) -> list[float]:
        """Train for this number of steps; returns the mean loss per token [nat] of each tenth
        of them.
        """
        losses = [self.step(k / steps) for k in range(steps)]
        self.writer.eval()
        return [float(part.mean()) for part in np.array_split(losses, 10)]


def relative_costs(trainings: Sequence[Training], rounds: int = 15) -> list[float]:
    """CPU time of a step of each training relative to that of the first.

    They take turns, so that other programs on the machine slow all of them alike.
    """
    times = np.empty((rounds, len(trainings)))
    for k in range(rounds):
        for i, training in enumerate(trainings):
            begun = time.process_time()
            training.step(0.0)
            times[k, i] = time.process_time() - begun
    median = np.median(times, axis=0)
    return (median / median[0]).tolist()
