"""Codes of action chunks that a policy writes: ours, FAST's recipe and the bins of RT-2."""

import math
from typing import NamedTuple, Protocol

import numpy as np
import torch
from bench_tokens import LEVELS, VOCABULARY, Fast, matched
from jaxtyping import Bool, Float, Int
from scipy.fft import dct
from torch import Tensor

from hrc_learn.cli.tokens_command import Chunks

CODES = ("ours", "fast", "bins")
SCALE = 10.0
"""Scale of FAST's coefficients, LeRobot's default."""
MOST_COMPARED = 300
"""Largest number of chunks on which errors are compared."""
MOST_BINS = 80
"""Largest number of bins in a chunk."""


class Windows(NamedTuple):
    """Chunks of T actions with D columns, and the information before each chunk."""

    seen: Float[np.ndarray, "N F"]
    """Observations."""
    start: Float[np.ndarray, "N D"]
    """Last action."""
    velocity: Float[np.ndarray, "N D"]
    """Difference of the last two actions [1/s]."""
    chunk: Float[np.ndarray, "N T D"]

    def some(self, most: int) -> "Windows":
        """At most `most` of the chunks, evenly spread."""
        index = np.unique(np.linspace(0, len(self.seen) - 1, most).round().astype(int))
        return Windows(*(x[index] for x in self))

    def inputs(self) -> Float[Tensor, "N I"]:
        """Inputs of the network."""
        known = np.concatenate([self.seen, self.start, self.velocity], 1)
        return torch.from_numpy(known).float()

    def chunks(self, fps: float) -> Chunks:
        """Motions from the last action on."""
        motions = np.concatenate([self.start[:, None], self.chunk], 1)
        return Chunks(np.arange(motions.shape[1]) / fps, motions, self.velocity)


class Code(Protocol):
    """Map between chunks and tokens 0 ... size - 1."""

    size: int

    @property
    def end(self) -> int | None:
        """Token that ends a sequence; None: all have the same length."""
        ...

    def encode(self, chunks: Chunks) -> list[list[int]]:
        """Tokens of each chunk, as targets of a network."""
        ...

    def decode(
        self, ids: Int[np.ndarray, "B L"], last: Windows, relaxed: bool
    ) -> tuple[Float[np.ndarray, "B T D"], Bool[np.ndarray, "B"]]:
        """Chunks, and flags of sequences that do not decode; `last` holds the information
        before them.
        """
        ...


class OurCode:
    """`MotionTokenizer` with the error of FAST's recipe."""

    def __init__(self, chunks: Chunks, size: int = VOCABULARY, start_known: bool = True):
        """Fit to chunks.

        Args:
            chunks: Motions from the last action on.
            size: Number of tokens.
            start_known: False: tokens also encode the start of a chunk.
        """
        self.start_known = start_known
        some = _thinned(chunks)
        # The transform is orthogonal: coefficients have the error of the chunks.
        y = SCALE * np.asarray(dct(some.motions[:, 1:], axis=1, norm="ortho"))
        rmse = np.sqrt(np.mean((y - y.round()) ** 2)) / SCALE
        self.tokenizer, _, _ = matched(chunks, some, float(rmse), size, start_known=start_known)
        self.size, self.end, self.time = size, self.tokenizer.end, chunks.time

    def encode(self, chunks: Chunks) -> list[list[int]]:
        rows = self.tokenizer.encode(*chunks).tolist()
        return [[*row, self.tokenizer.end][: self.tokenizer.length(row)] for row in rows]

    def decode(
        self, ids: Int[np.ndarray, "B L"], last: Windows, relaxed: bool
    ) -> tuple[Float[np.ndarray, "B T D"], Bool[np.ndarray, "B"]]:
        state = (last.start, last.velocity) if self.start_known else ()
        made = self.tokenizer.decode(ids, self.time, *state)
        return made.numpy()[:, 1:], np.zeros(len(ids), bool)


class FastCode:
    """FAST's recipe and a token that ends sequences."""

    def __init__(self, chunks: Chunks):
        """Learn the merges from chunks."""
        self.fast = Fast(chunks.motions[:, 1:], SCALE)
        self.size, self.end = VOCABULARY + 1, VOCABULARY

    def encode(self, chunks: Chunks) -> list[list[int]]:
        return [[*row, self.end] for row in self.fast.encode(chunks.motions[:, 1:])]

    def decode(
        self, ids: Int[np.ndarray, "B L"], last: Windows, relaxed: bool
    ) -> tuple[Float[np.ndarray, "B T D"], Bool[np.ndarray, "B"]]:
        rows = [row[: row.index(self.end)] if self.end in row else row for row in ids.tolist()]
        made = [self.fast.decode(row) for row in rows]
        failed = np.array([chunk is None for chunk in made])
        for i in failed.nonzero()[0]:
            held = np.tile(last.start[i], (self.fast.shape[0], 1))
            made[i] = self._padded(rows[i]) if relaxed else held
        return np.array(made), failed

    def _padded(self, row: list[int]) -> Float[np.ndarray, "T D"]:
        """Chunk from its coefficients; missing coefficients are zero."""
        q = np.array([ord(c) for c in self.fast.code.decode(row)], int) + self.fast.least
        size = math.prod(self.fast.shape)
        return self.fast.restored(np.pad(q[:size], (0, max(0, size - len(q))))[None])[0]


class Bins:
    """256 equal levels for each column of every k-th action, and straight lines between."""

    def __init__(self, chunks: Chunks):
        """Determine the levels' range from chunks."""
        T, D = chunks.motions[0, 1:].shape
        stride = next(k for k in range(1, T + 1) if T % k == 0 and T // k * D <= MOST_BINS)
        self.at = np.arange(0, T + 1, stride)
        self.low, self.high = chunks.motions.min((0, 1)), chunks.motions.max((0, 1))
        self.size, self.end = LEVELS, None

    def encode(self, chunks: Chunks) -> list[list[int]]:
        share = (chunks.motions[:, self.at[1:]] - self.low) / (self.high - self.low)
        ids = (share * LEVELS).astype(int).clip(0, LEVELS - 1)
        return ids.reshape(len(ids), -1).tolist()

    def decode(
        self, ids: Int[np.ndarray, "B L"], last: Windows, relaxed: bool
    ) -> tuple[Float[np.ndarray, "B T D"], Bool[np.ndarray, "B"]]:
        levels = ids.reshape(len(ids), len(self.at) - 1, -1)
        made = self.low + (levels + 0.5) / LEVELS * (self.high - self.low)
        knots = np.concatenate([last.start[:, None], made], 1)
        t = np.arange(1, self.at[-1] + 1)
        k = (t - 1) // self.at[1]
        share = (t / self.at[1] - k)[:, None]
        return (1 - share) * knots[:, k] + share * knots[:, k + 1], np.zeros(len(ids), bool)


def code_of(name: str, chunks: Chunks) -> Code:
    """Code by its name, fitted to chunks.

    Raises:
        ValueError: There is no such code.
    """
    match name.split("-"):
        case ["fast"]:
            return FastCode(chunks)
        case ["bins"]:
            return Bins(chunks)
        case ["ours", *settings]:
            size = [int(word) for word in settings if word.isdecimal()] or [VOCABULARY]
            return OurCode(chunks, size[0], "free" not in settings)
    raise ValueError(f"--codes takes {', '.join(CODES)} or ours-free-256, not {name!r}")


def _thinned(chunks: Chunks) -> Chunks:
    """Some chunks, on which errors are compared."""
    every = math.ceil(len(chunks.motions) / MOST_COMPARED)
    return chunks._replace(
        motions=chunks.motions[::every], start_velocity=chunks.start_velocity[::every]
    )


def equal_length(
    rows: list[list[int]], fill: int
) -> tuple[Int[Tensor, "N L"], Int[Tensor, "N"]]:
    """Sequences of one length, and their lengths."""
    counts = torch.tensor([len(row) for row in rows])
    L = int(counts.max())
    return torch.tensor([row + [fill] * (L - len(row)) for row in rows]), counts
