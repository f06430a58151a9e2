"""Compare tokens of action chunks on LeRobot datasets: ours, FAST's, BEAST's recipe and bins.

Each tokenizer is fitted to four of five episodes and encodes chunks of one second of the other
episodes. FAST's recipe (Pertsch et al. 2025: DCT, rounding, byte-pair encoding, with LeRobot's
default scale of 10) needs `pip install tokenizers`. All other tokenizers are adjusted to its
root mean square error: ours by the tolerance, B-spline coefficients in 256 levels (BEAST, Zhou
et al. 2025) by their number, bins (RT-2) by their width. Errors are relative to half the range
between the quantiles of 1 and 99 % of each column, as FAST normalises.

    python benchmarks/bench_tokens.py --datasets so101/pick unitree/pour
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from rich.table import Table

from hrc_learn import cli
from hrc_learn.cli._run import write_values
from hrc_learn.cli.tokens_command import Chunks, held_out, read_chunks
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.dmp.motion_components import spline
from hrc_learn.dmp.tokens import MotionTokenizer

VOCABULARY = 1024
LEVELS = 256
"""Levels of a coefficient in BEAST's recipe, and bins of RT-2."""
WRONG = 0.05
"""Fraction of tokens that are replaced, to test if chunks still decode."""


@dataclass(frozen=True, kw_only=True)
class Args:
    datasets: tuple[Path, ...]
    """LeRobot datasets."""
    feature: str = "action"
    """Feature to encode."""
    scale: float = 10.0
    """Scale of FAST's coefficients; all tokenizers are compared at its error."""
    seconds: float = 1.0
    """Duration of a chunk [s]."""
    fitted: int = 4000
    """Largest number of chunks to fit to."""
    measured: int = 200
    """Largest number of chunks to encode."""
    random: int = 0
    """Number of random sequences to decode with each of our tokenizers."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class Fast:
    """FAST's recipe: rounded coefficients of a cosine transform, byte-pair encoded."""

    def __init__(self, chunks: Float[np.ndarray, "N T D"], scale: float):
        """Learn the merges."""
        from tokenizers import ByteLevelBPETokenizer  # pyright: ignore[reportMissingImports]
        from tokenizers.trainers import BpeTrainer  # pyright: ignore[reportMissingImports]

        self.scale, self.shape = scale, chunks.shape[1:]
        q = self.rounded(chunks)
        self.least, self.most = int(q.min()), int(q.max())
        most = self.most
        if most - self.least >= VOCABULARY:
            raise ValueError("the coefficients need more symbols than the vocabulary has")
        self.code: Any = ByteLevelBPETokenizer()
        trainer = BpeTrainer(
            vocab_size=VOCABULARY,
            min_frequency=2,
            show_progress=False,
            special_tokens=[],
            initial_alphabet=[chr(i) for i in range(most - self.least + 1)],
            max_token_length=10000,
        )
        self.code._tokenizer.train_from_iterator(map(self.text, q), trainer=trainer)

    def rounded(self, chunks: Float[np.ndarray, "N T D"]) -> Int[np.ndarray, "N K"]:
        """Coefficients, low frequencies of all columns first."""
        from scipy.fft import dct

        q = np.around(np.asarray(dct(chunks, axis=1, norm="ortho")) * self.scale).astype(int)
        return q.reshape(len(q), -1)

    def text(self, q: Int[np.ndarray, "K"]) -> str:
        """Coefficients as characters; those beyond the fitted ones would be dropped."""
        return "".join(map(chr, q.clip(self.least, self.most) - self.least))

    def encode(self, chunks: Float[np.ndarray, "N T D"]) -> list[list[int]]:
        """Tokens of chunks."""
        return [self.code.encode(self.text(q)).ids for q in self.rounded(chunks)]

    def decode(self, ids: list[int]) -> Float[np.ndarray, "T D"] | None:
        """Chunk from tokens; None if the number of coefficients is wrong."""
        q = np.array([ord(c) for c in self.code.decode(ids)]) + self.least
        return self.restored(q[None])[0] if len(q) == np.prod(self.shape) else None

    def restored(self, q: Int[np.ndarray, "N K"]) -> Float[np.ndarray, "N T D"]:
        """Chunks from coefficients."""
        from scipy.fft import idct

        q = q.reshape(-1, *self.shape).clip(self.least, self.most)
        return np.asarray(idct(q / self.scale, axis=1, norm="ortho"))


def main(args: Args) -> None:
    """Compare the tokenizers on each dataset."""
    table = Table("dataset", "RMSE", "FAST", "ours", "ratio", "BEAST", "bins", "FAST broken")
    figures: dict[str, float] = {}
    console = Console()
    for dataset in args.datasets:
        found = compare(dataset, args)
        figures |= {f"{dataset.name}_{name}": value for name, value in found.items()}
        table.add_row(dataset.name, *(f"{value:.3g}" for value in list(found.values())[:7]))
        console.print({name: round(value, 5) for name, value in found.items()})
    console.print(table)
    write_values(args.json, figures)


def compare(dataset: Path, args: Args) -> dict[str, float]:
    """Tokens per chunk at FAST's error, and the fraction of damaged sequences that do not
    decode.
    """
    every = [entry.index for entry in open_folder(dataset).episodes]
    unseen = held_out(every, 5)
    kept = [i for i in every if i not in unseen]
    train = read_chunks(dataset, args.feature, args.seconds, kept, args.fitted)
    test = read_chunks(dataset, args.feature, args.seconds, unseen, args.measured)
    low, high = np.quantile(train.motions, (0.01, 0.99), axis=(0, 1))
    moves = high > low
    half = np.where(moves, (high - low) / 2, 1)
    train, test = (
        Chunks(
            c.time,
            ((c.motions - (low + high) / 2) / half)[..., moves],
            (c.start_velocity / half)[:, moves],
        )
        for c in (train, test)
    )
    fast = Fast(train.motions[:, 1:], args.scale)
    y = test.motions[:, 1:]
    ids = fast.encode(y)
    # The number of coefficients: some of FAST's own sequences do not decode.
    made = fast.restored(fast.rounded(y))
    rmse = float(np.sqrt(np.mean((made - y) ** 2)))
    counts = float(np.mean([len(row) for row in ids]))
    tokenizer, ours, error = matched(train, test, rmse)
    rng = np.random.default_rng(0)
    broken = [
        fast.decode([int(rng.integers(VOCABULARY)) if rng.random() < WRONG else i for i in row])
        for row in ids
    ]
    result = {
        "rmse": rmse,
        "fast_tokens": counts,
        "tokens": ours,
        "ratio": ours / counts,
        "beast_tokens": beast(train, test, rmse),
        "bins": float(y[0].size),
        "fast_undecodable_share": float(np.mean([b is None for b in broken])),
        "fast_own_undecodable_share": float(np.mean([fast.decode(row) is None for row in ids])),
        "our_rmse": error,
        "bin_rmse": float(
            np.sqrt(np.mean(np.ptp(train.motions, (0, 1)) ** 2 / LEVELS**2 / 12))
        ),
        "chunks": float(len(y)),
    }
    if args.random:
        result |= at_random(tokenizer, train, args.random)
    return result


def matched(
    train: Chunks,
    test: Chunks,
    rmse: float,
    vocabulary: int = VOCABULARY,
    *,
    start_known: bool = True,
) -> tuple[MotionTokenizer, float, float]:
    """Tokenizer with about this error, its tokens per chunk at this error, and its own error.

    The tokens are interpolated between two near errors, on logarithmic scales.
    """
    state = torch.from_numpy(test.motions[:, 0]), torch.from_numpy(test.start_velocity)
    state = state if start_known else ()
    tolerance, points = rmse / 2, []
    for _ in range(3):
        tokenizer = MotionTokenizer.fit(
            train.time,
            train.motions,
            vocabulary,
            start_velocity=train.start_velocity if start_known else None,
            start_known=start_known,
            tolerance=tolerance,
        )
        ids = tokenizer.encode(test.time, test.motions, test.start_velocity)
        made = tokenizer.decode(ids, test.time, *state).numpy()
        error = float(np.sqrt(np.mean((made - test.motions)[:, 1:] ** 2)))
        points.append((np.log(error), np.mean([tokenizer.length(row) for row in ids.tolist()])))
        if abs(np.log(rmse / error)) < 0.01:
            return tokenizer, float(points[-1][1]), error
        tolerance *= rmse / error
    (e0, n0), (e1, n1) = sorted(points, key=lambda p: abs(p[0] - np.log(rmse)))[:2]
    n = n0 + (n1 - n0) * (np.log(rmse) - e0) / (e1 - e0) if abs(e1 - e0) > 1e-3 else n0
    return tokenizer, float(n), error


def beast(train: Chunks, test: Chunks, rmse: float) -> float:
    """Tokens per chunk of B-spline coefficients in equal levels, with an error of at most
    `rmse`.
    """
    s = torch.linspace(0, 1, test.motions.shape[1] - 1, dtype=torch.float64)
    for count in range(4, len(s) + 1):
        B = spline(s, count).numpy()
        known, c = (np.linalg.pinv(B) @ x.motions[:, 1:] for x in (train, test))
        low, high = known.min((0, 1)), known.max((0, 1))
        step = (high - low) / (LEVELS - 1)
        made = B @ (low + np.around((c.clip(low, high) - low) / step) * step)
        if np.sqrt(np.mean((made - test.motions[:, 1:]) ** 2)) <= rmse:
            return float(count * c.shape[-1])
    return float("nan")


def at_random(tokenizer: MotionTokenizer, train: Chunks, count: int) -> dict[str, float]:
    """Fractions of random sequences that fail to decode or exceed limits, and largest seams."""
    rng = torch.Generator().manual_seed(0)
    low, high = (torch.from_numpy(f(train.motions, axis=(0, 1))) for f in (np.min, np.max))
    low, high = low - (high - low) / 10, high + (high - low) / 10
    failed = beyond = 0
    seam = 0.0
    for _ in range(0, count, 1000):
        ids = torch.randint(0, VOCABULARY, (1000, 20), generator=rng)
        at = torch.randint(0, len(train.motions), (1000,), generator=rng).numpy()
        start, rate = train.motions[at, 0], train.start_velocity[at]
        made = tokenizer.decode(ids, train.time, start, rate)
        failed += int((~made.isfinite()).flatten(1).any(1).sum())
        beyond += int(((made < low) | (made > high)).flatten(1).any(1).sum())
        for order, state in ((0, start), (1, rate)):
            joined = tokenizer.decode(ids, [0.0], start, rate, order=order)[:, 0].numpy()
            seam = max(seam, float(np.abs(joined - state).max()))
    return {
        "random_undecodable_share": failed / count,
        "random_beyond_share": beyond / count,
        "seam": seam,
    }


if __name__ == "__main__":
    cli.run(main, Args)
