"""`hrc tokens`: a tokenizer of action chunks fitted to a dataset, and its errors."""

import math
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console

from hrc_learn.cli._run import with_settings, write_values
from hrc_learn.cli.arguments import Tokens, refuse_given, sibling
from hrc_learn.demos.read.dataset_folder import open_folder, select_episodes
from hrc_learn.demos.read.frames import read_frames
from hrc_learn.dmp.tokens import MotionTokenizer
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.store import new_folder, read_made_by, read_toml, write_json
from hrc_learn.viz.report import Measurement, show_measurements

MODEL = "tokens"
"""Folder of the tokenizer in the results of `hrc tokens fit`."""
MOST_FITTED, MOST_MEASURED = 20_000, 500
"""Largest number of chunks for fitting and for measuring, evenly spread over the episodes."""


@dataclass(frozen=True, kw_only=True)
class TokenSettings:
    """Settings of tokenizers."""

    feature: str = "action"
    """Feature of the dataset to encode."""
    seconds: float = 1.0
    """Duration of a chunk [s]."""
    vocabulary_size: int = 1024
    """Number of tokens."""
    tolerance: float = 0.01
    """Root mean square error of decoded chunks, relative to the range of each column."""
    start_known: bool = True
    """True if a chunk starts at the arm's state; False: the tokens also encode the start, and
    no velocity is used."""
    held_out: int = 5
    """n: every n-th episode is held out of the fit, for the report; 0: none is held out."""

    def __post_init__(self) -> None:
        check_settings(self, positive=["seconds"], not_negative=["held_out"])


class Chunks(NamedTuple):
    """Chunks of T frames that follow a known frame, (N, T + 1, D)."""

    time: Float[np.ndarray, "T1"]
    """Time since the known frame [s]."""
    motions: Float[np.ndarray, "N T1 D"]
    start_velocity: Float[np.ndarray, "N D"]
    """Velocity at the known frame, as the difference from the frame before [1/s]."""


def read_chunks(
    dataset: Path, feature: str, seconds: float, episodes: list[int], most: int
) -> Chunks:
    """Chunks from evenly spread frames of episodes.

    Raises:
        ValueError: The dataset does not have the feature, or no episode is long enough.
    """
    folder = open_folder(dataset)
    if feature not in folder.features:
        known = ", ".join(folder.features)
        raise ValueError(f"{dataset} has no feature {feature!r}; it has {known}")
    T = max(2, round(seconds * folder.fps))
    entries = select_episodes(folder, episodes)
    read = read_frames(folder, sorted(entries, key=lambda e: (e.file, e.start)), [feature])
    values = [frames[feature].astype(float) for _, frames in read]
    # The known frame, the one before it and T frames to encode.
    counts = [max(0, len(x) - T - 1) for x in values]
    if not sum(counts):
        raise ValueError(f"no episode of {dataset} has {T + 2} frames: shorten seconds")
    stride = math.ceil(sum(counts) / most)
    firsts = [(x, t) for x, n in zip(values, counts, strict=True) for t in range(0, n, stride)]
    return Chunks(
        np.arange(T + 1) / folder.fps,
        np.array([x[t + 1 : t + T + 2] for x, t in firsts]),
        np.array([x[t + 1] - x[t] for x, t in firsts]) * folder.fps,
    )


def tokens(args: Tokens) -> None:
    """Fit a tokenizer, or report the errors of one.

    Raises:
        ValueError: An option belongs to the other action, or the dataset lacks the feature.
    """
    every = [entry.index for entry in open_folder(args.dataset).episodes]
    if args.action == "report":
        refuse_given(args, ["out", "config", "overwrite"], "belongs to hrc tokens fit")
        if args.model is None:
            raise ValueError("hrc tokens report needs --model, a folder of hrc tokens fit")
        tokenizer = MotionTokenizer.load(args.model / MODEL)  # refuses other models
        settings = TokenSettings(**read_made_by(args.model)["settings"])
        with Console().status("Encoding"):
            figures = _measured(tokenizer, args.dataset, settings, every)
    else:
        refuse_given(args, ["model"], "belongs to hrc tokens report")
        settings = with_settings(args.config, TokenSettings())
        folder = args.out or sibling(args.dataset, "tokens")
        made_by = asdict(args) | {"settings": asdict(settings)}
        fitting = Console().status("Fitting a tokenizer")
        with new_folder(folder, made_by, args.overwrite) as out, fitting:
            kept = [i for i in every if i not in held_out(every, settings.held_out)]
            tokenizer = fit(args.dataset, settings, kept)
            tokenizer.save(out / MODEL)
            figures = _measured(tokenizer, args.dataset, settings, every)
            write_json(out / "metrics.json", figures)
        print(f"Tokenizer in {shlex.quote(str(folder / MODEL))}")
    rows = [Measurement(name=_ROWS[name], value=value) for name, value in figures.items()]
    show_measurements(rows, title=f"Tokens of {args.dataset}")
    write_values(args.json, figures)


def fit(dataset: Path, settings: TokenSettings, episodes: list[int]) -> MotionTokenizer:
    """Tokenizer fitted to chunks of these episodes."""
    chunks = read_chunks(dataset, settings.feature, settings.seconds, episodes, MOST_FITTED)
    return MotionTokenizer.fit(
        chunks.time,
        chunks.motions,
        settings.vocabulary_size,
        start_velocity=chunks.start_velocity if settings.start_known else None,
        start_known=settings.start_known,
        tolerance=settings.tolerance,
    )


def held_out(episodes: list[int], number: int) -> list[int]:
    """Held-out episodes: every `number`-th, or the last one if there are fewer."""
    return [] if not number else episodes[number - 1 :: number] or episodes[1:][-1:]


def _measured(
    tokenizer: MotionTokenizer, dataset: Path, settings: TokenSettings, every: list[int]
) -> dict[str, float]:
    """Length and error of the tokens of unseen chunks."""
    episodes = held_out(every, settings.held_out) or every
    time, recorded, velocity = read_chunks(
        dataset, settings.feature, settings.seconds, episodes, MOST_MEASURED
    )
    motions = torch.from_numpy(recorded)
    ids = tokenizer.encode(time, motions, velocity)
    counts = [tokenizer.length(row) for row in ids.tolist()]
    state = (motions[:, 0], velocity) if tokenizer.components.known else ()
    error = (tokenizer.decode(ids, time, *state) - motions)[:, 1:]
    span = (motions.amax((0, 1)) - motions.amin((0, 1))).clamp(min=1e-12)
    bits = math.log2(tokenizer.vocabulary_size)
    return {
        "chunks": float(len(motions)),
        "tokens_mean": float(np.mean(counts)),
        "tokens_p95": float(np.quantile(counts, 0.95)),
        "bits_per_s": float(np.mean(counts)) * bits / tokenizer.duration,
        "rmse": float(error.square().mean().sqrt()),
        "rmse_of_range": float((error / span).square().mean().sqrt()),
    }


_ROWS = read_toml(Path(__file__).with_name("token_rows.toml"))
