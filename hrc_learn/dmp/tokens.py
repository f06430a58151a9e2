"""Conversion between motions and tokens, which are short sequences of integers.

Language models can predict motions as tokens, and every sequence of tokens decodes to a bounded
motion. The components of a motion (`MotionComponents`) are rounded to integer multiples of one
step, so components of less variance take fewer bits. For a given number of bits, this minimises
the error (reverse water-filling: Cover and Thomas, "Elements of information theory", section
10.3). `TokenCode` turns the integers into tokens, the first components first.

Columns that jump between a few values, such as those of grippers, are called columns of steps.
Their integers encode the times of the jumps.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hrc_learn.dmp._arguments import (
    ArrayLike,
    Points,
    Times,
    Vectors,
    checked_vector,
    seconds,
    to_tensor,
)
from hrc_learn.dmp.motion_components import MARGIN, MotionComponents
from hrc_learn.dmp.samples import Samples, check_samples, expanded, padded
from hrc_learn.dmp.token_code import END, HEADROOM, TokenCode
from hrc_learn.model_files import SavedModel, write_model

PRICE = 0.1155
"""Price of a bit in squared steps, (ln 4) / 12. One more bit reduces the squared error by about
this amount if steps are fine."""
REPRESENTED = 1 / 3
"""Largest error of splines relative to the error of tokens; it adds 5 % to the total error."""
ROUNDS = 8
"""Number of iterations in which step and probabilities adapt to each other."""
SMALLEST, LARGEST = 16, 2**15
"""Smallest and largest size of the vocabulary."""
STEP_LEVELS, SWITCHES, MOST_SLOTS = 4, 4, 64
"""`STEP_LEVELS`: largest number of values of a column of steps. `SWITCHES`: largest number of
its switches in a motion (later switches are left out). `MOST_SLOTS`: largest number of times at
which it can switch."""
OF_SCALE = 0.07
"""Product of `tolerance` and the scale of the tokenizer FAST at which both tokenizers have
equal errors, on five teleoperated datasets."""


class MotionTokenizer(nn.Module):
    """Map between motions of D columns and tokens 0 ... vocabulary_size - 1.

    Token 0 ends and pads sequences. Every sequence decodes to a motion within the demonstrated
    range, extended by a tenth to either side. The first tokens of a sequence alone decode to a
    coarser form of its motion.
    """

    end = END
    """Token that ends and pads sequences."""
    levels: Tensor
    """Values of each column of steps in order, padded with the last value, (steps, L)."""

    def __init__(
        self,
        config: dict[str, Any],
        components: MotionComponents,
        code: TokenCode,
        levels: Tensor,
    ):
        """Join the parts; `fit` makes them.

        Args:
            config: Four settings. `steps` lists the columns of steps; `slots` is the number of
                times at which they can switch. Components are rounded to multiples of `step`.
                `shift` is the mean difference between the magnitudes of components and of their
                integers, in steps.
            components: Components of all other columns.
            code: Code of the integers.
            levels: Values of the columns of steps, (steps, L).
        """
        super().__init__()
        self.config, self.components, self._code = config, components, code
        self.steps: list[int] = config["steps"]
        """Columns of steps."""
        self.columns = len(components.start) + len(self.steps)
        self._smooth = [i for i in range(self.columns) if i not in self.steps]
        self._own = len(self.steps) * SWITCHES
        self.register_buffer("levels", levels)

    @property
    def vocabulary_size(self) -> int:
        """Number of tokens."""
        return self._code.vocabulary_size

    @property
    def duration(self) -> float:
        """Duration of a motion [s]; the mean where durations differ."""
        return self.components.duration

    @classmethod
    def fit(
        cls,
        time: Times | Sequence[Times],
        motions: Points | Sequence[Points],
        vocabulary_size: int = 1024,
        *,
        start_velocity: Vectors | None = None,
        start_known: bool = True,
        tolerance: float = 0.01,
        steps: Iterable[int] | None = None,
    ) -> "MotionTokenizer":
        """Learn components and the probabilities of their values from motions.

        Args:
            time: Timestamps [s], (T,), (N, T) or a list of (T_i,). Durations that differ by
                more than 1 % are encoded.
            motions: Motions, (N, T, D) or a list of (T_i, D); the first sample is the start.
            vocabulary_size: Number of tokens.
            start_velocity: Velocity at the start [1/s], (N, D), if it will be known whenever a
                motion is encoded or decoded; this saves about 7 % of the tokens.
            start_known: True if the start will be known; False: tokens determine it.
            tolerance: Root mean square error of decoded motions, relative to the range of each
                column between its quantiles of 1 and 99 %.
            steps: Columns that jump between a few values, such as those of grippers; by default
                all columns with 2 to 4 values.

        Raises:
            ValueError: Fewer than two motions, shapes that differ, or values out of range.
        """
        if not SMALLEST <= vocabulary_size <= LARGEST:
            raise ValueError(
                f"vocabulary_size must be {SMALLEST} to {LARGEST}, got {vocabulary_size}"
            )
        if not 0 < tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance}")
        samples = _samples(time, motions)
        if len(samples.s) < 2:
            raise ValueError(f"motions must be (N, T, D), N of 2 or more, got {len(samples.s)}")
        y = samples.position.mT
        seen = y[samples.mask].numpy()
        chosen, levels = _levels(seen, steps)
        smooth = [i for i in range(y.shape[-1]) if i not in chosen]
        velocity = None
        if start_velocity is not None:
            velocity = checked_vector("start_velocity", start_velocity, y[:, 0])
            velocity = expanded("start_velocity", velocity, y[:, 0].shape, y[:, 0])[:, smooth]
        parts = replace(samples, position=samples.position[:, smooth])
        accuracy = REPRESENTED * tolerance
        units = _units(seen[:, smooth])
        components = MotionComponents.fit(parts, units, velocity, start_known, accuracy)
        config: dict[str, Any] = {"steps": chosen, "slots": min(y.shape[1] - 1, MOST_SLOTS)}
        # If starts are unknown, columns of steps start at their lowest value, as in `encode`
        # and `decode`.
        reference = y[:, 0, chosen] if start_known else levels[:, 0].expand(len(y), -1)
        switches = _switches(samples, reference, chosen, levels, config["slots"])
        z = components.encode(parts, velocity) * components.spread
        # The squared errors of all columns add up.
        aim = tolerance * max(len(smooth), 1) ** 0.5
        # Begin with a step at which all components are exact enough.
        step, bits = aim * (12 / max(1, z.shape[1])) ** 0.5, None
        for _ in range(ROUNDS):
            q = _rounded(z / step, bits)
            code = TokenCode.fit(torch.cat([switches, q], 1).long().numpy(), vocabulary_size)
            bits = code.bits()[switches.shape[1] :]
            shift = float((z.abs() / step - q.abs())[q != 0].mean().nan_to_num())
            config |= {"step": step, "shift": shift}
            error = z - (q + shift * q.sign()) * step
            change = aim / error.square().sum(-1).mean().sqrt().clamp(min=aim / 4)
            step *= max(float(change), 1 / HEADROOM)
        used = switches.shape[1] + int(q.any(0).nonzero().amax() + 1 if q.any() else 0)
        return cls(config, components, TokenCode(vocabulary_size, code.table[:used]), levels)

    def parameters(
        self, time: Times, motion: Points, start_velocity: Vectors | None = None
    ) -> Float[Tensor, "*batch P"]:
        """Parameters of `components` for recorded motions, without rounding."""
        return self._encoded(_samples(time, motion), start_velocity)

    def encode(
        self,
        time: Times,
        motion: Points,
        start_velocity: Vectors | None = None,
        *,
        length: int | None = None,
    ) -> Int[Tensor, "*batch L"]:
        """Tokens of recorded motions, padded with token 0.

        Args:
            time: Timestamps [s], (T,) or (*batch, T).
            motion: Motions from the start on, (*batch, T, D).
            start_velocity: Velocity at the start [1/s], (*batch, D), if the tokenizer was
                fitted with it; zero by default.
            length: Length L of all sequences; longer ones are cut, which makes motions coarser.

        Raises:
            ValueError: Shapes that differ from those of the fit, or values that are not finite.
        """
        if length is not None and length < 0:
            raise ValueError(f"length must not be negative, got {length}")
        samples = _samples(time, motion)
        z = self._encoded(samples, start_velocity).reshape(len(samples.s), -1)
        bits, config = self._code.bits()[self._own :], self.config
        z = (z * self.components.spread)[:, : len(bits)]
        start = samples.position[..., 0] if self.components.known else self._start()
        start = start.expand(len(z), -1)[:, self.steps]
        switches = _switches(samples, start, self.steps, self.levels, config["slots"])
        integers = torch.cat([switches, _rounded(z / config["step"], bits)], 1)
        rows = [self._code.encode(row) for row in integers.long().tolist()]
        L = max(map(len, rows), default=0) if length is None else length
        ids = [row[:L] + [END] * (L - len(row)) for row in rows]
        return torch.tensor(ids, dtype=torch.long).reshape(*samples.batch, L)

    def decode(
        self,
        ids: Int[Tensor, "*batch L"] | Sequence[Any] | np.ndarray,
        time: Times,
        start: Vectors | None = None,
        start_velocity: Vectors | None = None,
        *,
        order: int = 0,
    ) -> Float[Tensor, "*batch T D"]:
        """Motions for any sequences of tokens.

        A motion begins exactly in the given state. It stays within the demonstrated range,
        extended by a tenth to either side. A start outside of these limits moves them
        outwards. A motion can leave the limits if its start velocity puts the second control
        point outside by more than a quarter of the range.

        Args:
            ids: Tokens, (*batch, L) or a list of lists; all tokens after token 0 are ignored.
                An empty list is one sequence without tokens: the coarsest motion.
            time: Time since the start [s], (T,) or (*batch, T), at any sampling rate. After
                its end, a motion rests.
            start: Start, (*batch, D). None: the mean start if the tokenizer was fitted with
                known starts, otherwise the encoded start.
            start_velocity: Velocity at the start [1/s], (*batch, D). None: zero if the
                tokenizer was fitted with velocities, otherwise the encoded velocity.
            order: Derivative with respect to time, 0, 1 or 2; zero for columns of steps.

        Raises:
            ValueError: Tokens that are not in the vocabulary, or shapes that do not match.
        """
        integers = self._integers(ids)
        q = integers[..., self._own :]
        z = (q + self.config["shift"] * q.sign()) * self.config["step"]
        z = z / self.components.spread[: q.shape[-1]]
        state = self._given("start", start), self._given("start_velocity", start_velocity)
        y = self.components(z, time, *state, order=order)
        if not self.steps:
            return y
        _, duration = self.components.polygon(z, *state)
        s = seconds(time, y.device) / duration[..., None]
        first = self._start() if start is None else to_tensor(start).to(y)
        stepped = self._stepped(integers[..., : self._own], s, first[..., self.steps])
        whole = y.new_zeros(*y.shape[:-1], self.columns)
        whole[..., self._smooth] = y
        if order == 0:
            whole[..., self.steps] = stepped
        return whole

    def length(self, ids: Sequence[int]) -> int:
        """Number of tokens that determine the motion; further tokens would not change it."""
        for i in range(1, len(ids) + 1):
            if ids[i - 1] == END or self._code.decode(ids[:i])[1]:
                return i
        return len(ids) + 1  # with the end token

    def save(self, folder: str | Path) -> None:
        """Write or replace a folder with `config.json` and `model.safetensors`."""
        config = {"vocabulary_size": self.vocabulary_size, "tokens": self.config}
        config |= {"components": self.components.config}
        tensors = dict(self.state_dict()) | {"code": torch.from_numpy(self._code.table)}
        write_model(folder, type(self).__name__, config, tensors)

    @classmethod
    def load(cls, folder: str | Path) -> "MotionTokenizer":
        """Read a saved tokenizer.

        Raises:
            FileNotFoundError: The folder holds no saved tokenizer.
            ValueError: A file is not valid.
        """
        saved = SavedModel(folder, cls.__name__)
        parts = {name: saved.tensor(name) for name in saved.tensors}
        buffers = {k.partition(".")[2]: v for k, v in parts.items() if k.startswith("compo")}
        try:
            return cls(
                saved.get("tokens", dict),
                MotionComponents(saved.get("components", dict), buffers),
                TokenCode(saved.get("vocabulary_size", int), saved.tensor("code").numpy()),
                saved.tensor("levels"),
            )
        except (KeyError, TypeError, IndexError) as error:
            raise saved.invalid(f"not a complete tokenizer ({error}): fit it again") from None

    def _encoded(self, samples: Samples, start_velocity: Vectors | None) -> Tensor:
        """Parameters of recorded motions, (*batch, P)."""
        if samples.position.shape[1] != self.columns:
            raise ValueError(
                f"motion must have {self.columns} columns, got {samples.position.shape[1]}"
            )
        velocity = self._given("start_velocity", start_velocity)
        if velocity is not None:
            velocity = velocity.expand(*samples.batch, -1)
        parts = replace(samples, position=samples.position[:, self._smooth])
        return self.components.encode(parts, velocity).reshape(*samples.batch, -1)

    def _given(self, name: str, value: Vectors | None) -> Tensor | None:
        """A given start or velocity without the columns of steps."""
        if value is None:
            return None
        return checked_vector(name, value, self._start())[..., self._smooth]

    def _start(self) -> Float[Tensor, "D"]:
        """Mean start; for columns of steps, the lowest value."""
        mean = self.levels.new_empty(self.columns)
        mean[self._smooth] = self.components.start
        mean[self.steps] = self.levels[:, 0]
        return mean

    def _integers(self, ids: Any) -> Float[Tensor, "*batch K"]:
        """Integers of sequences of tokens.

        Raises:
            ValueError: A token that is not in the vocabulary.
        """
        if isinstance(ids, Sequence) and {*map(np.ndim, ids)} == {1}:
            rows, batch = [[int(i) for i in row] for row in ids], (len(ids),)
        else:
            tokens = torch.atleast_1d(to_tensor(ids)).long()
            batch = tokens.shape[:-1]
            rows = tokens.reshape(batch.numel(), tokens.shape[-1]).tolist()
        wrong = {i for row in rows for i in row if not 0 <= i < self.vocabulary_size}
        if wrong:
            raise ValueError(f"token {min(wrong)} is not in 0 to {self.vocabulary_size - 1}")
        integers = np.zeros((len(rows), self._code.size))
        for row, found in zip(rows, integers, strict=True):
            for k, sign, low, _ in self._code.decode(row)[0]:
                found[k] = sign * low
        integers = torch.from_numpy(integers).to(self.levels)
        return integers.reshape(*batch, self._code.size)

    def _stepped(self, jumps: Tensor, s: Tensor, start: Tensor) -> Float[Tensor, "*batch T S"]:
        """Columns of steps at normalised times."""
        jumps = jumps.unflatten(-1, (-1, SWITCHES))[..., None, :, :]
        at = (jumps.abs() - 1) / self.config["slots"]
        # The tolerance keeps rounding from delaying a switch at a requested time.
        now = (jumps != 0) & (s[..., None, None] >= at - 1e-9)
        index = _nearest(start, self.levels)[..., None, :] + (now * jumps.sign()).sum(-1).long()
        index = index.clamp(0, self.levels.shape[1] - 1)
        reached = self.levels[torch.arange(len(self.levels)), index]
        return torch.where(now.any(-1), reached, start[..., None, :])


class ActionProcessor:
    """Tokenizer of action chunks with the interface of FAST, the tokenizer that LeRobot calls.

    The tokens encode the start of a chunk too, because the interface does not pass the start.
    """

    pad_token_id = eos_token_id = END

    def __init__(self, tokenizer: MotionTokenizer):
        """Wrap a tokenizer of chunks whose time is counted in frames."""
        self.tokenizer = tokenizer
        self.vocab_size = tokenizer.vocabulary_size
        self.time_horizon, self.action_dim = round(tokenizer.duration) + 1, tokenizer.columns

    @classmethod
    def fit(
        cls,
        action_data: Sequence[Float[np.ndarray, "T D"]],
        scale: float = 10.0,
        vocab_size: int = 1024,
        *,
        time_horizon: int | None = None,
        action_dim: int | None = None,
    ) -> "ActionProcessor":
        """Learn from chunks of T frames.

        Args:
            action_data: The chunks.
            scale: Scale of the coefficients in FAST; the tokens are as accurate as those of
                FAST at this scale.
            vocab_size: Number of tokens.
            time_horizon: Ignored; T is read from the chunks.
            action_dim: Ignored; D is read from the chunks.

        Raises:
            ValueError: The scale is infinite, or so small that the tolerance is 1 or more.
        """
        if not OF_SCALE < scale < np.inf:
            raise ValueError(f"scale must be above {OF_SCALE} and finite, got {scale}")
        chunks = np.stack(list(action_data))
        time, tolerance = np.arange(chunks.shape[1]), OF_SCALE / scale
        return cls(
            MotionTokenizer.fit(
                time, chunks, vocab_size, start_known=False, tolerance=tolerance
            )
        )

    def __call__(self, action_chunk: ArrayLike) -> list[list[int]]:
        """Tokens of chunks (B, T, D), or of one (T, D)."""
        chunks = to_tensor(action_chunk).double()
        chunks = chunks.reshape(-1, *chunks.shape[-2:])
        frames = np.arange(chunks.shape[1])
        ids = self.tokenizer.encode(frames, chunks).tolist() if len(chunks) else []
        return [row[: self.tokenizer.length(row)] for row in ids]

    def decode(
        self,
        tokens: Sequence[Sequence[int]],
        *,
        time_horizon: int | None = None,
        action_dim: int | None = None,
    ) -> Float[np.ndarray, "B T D"]:
        """Chunks of `time_horizon` frames, by default T, from any tokens."""
        frames = np.arange(time_horizon or self.time_horizon)
        ids = [list(row) for row in tokens] or torch.zeros(0, 0)  # an empty batch
        return self.tokenizer.decode(ids, frames).numpy()

    def save_pretrained(self, save_directory: str | Path) -> None:
        """Write the tokenizer's folder."""
        self.tokenizer.save(save_directory)

    @classmethod
    def from_pretrained(cls, folder: str | Path) -> "ActionProcessor":
        """Read a folder of `save_pretrained`."""
        return cls(MotionTokenizer.load(folder))


def _samples(time: Any, motions: Any) -> Samples:
    time, mask, (motions,) = padded(time, None, motions)
    return check_samples(time, to_tensor(motions).double(), mask=mask, name="motions")


def _units(seen: Float[np.ndarray, "n D"]) -> dict[str, Tensor]:
    """Centre, scale and limits of columns."""
    low, high = seen.min(0), seen.max(0)
    bottom, top = np.quantile(seen, (0.01, 0.99), axis=0)
    scale = np.where(top > bottom, top - bottom, high - low)
    margin = MARGIN * (high - low) * (1 - 1e-9)
    units = {"centre": (bottom + top) / 2, "scale": np.where(scale > 0, scale, 1.0)}
    units |= {"low": low - margin, "high": high + margin}
    return {name: torch.from_numpy(value) for name, value in units.items()}


def _levels(
    seen: Float[np.ndarray, "n D"], steps: Iterable[int] | None
) -> tuple[list[int], Float[Tensor, "S L"]]:
    """Columns of steps, and their values in order."""
    values = [np.unique(column) for column in seen.T]
    few = [i for i, found in enumerate(values) if len(found) <= STEP_LEVELS]
    chosen = [i for i in few if len(values[i]) > 1] if steps is None else sorted(set(steps))
    if not set(chosen) <= set(few):
        raise ValueError(f"steps must be columns of {STEP_LEVELS} values or fewer, got {steps}")
    most = max((len(values[i]) for i in chosen), default=1)
    rows = [np.pad(values[i], (0, most - len(values[i])), mode="edge") for i in chosen]
    return chosen, torch.from_numpy(np.array(rows).reshape(-1, most))


def _nearest(
    values: Float[Tensor, "*batch S"], levels: Float[Tensor, "S L"]
) -> Int[Tensor, "*batch S"]:
    return (values[..., None] - levels).abs().argmin(-1)


def _switches(
    samples: Samples, start: Float[Tensor, "B S"], steps: list[int], levels: Tensor, slots: int
) -> Float[Tensor, "B K"]:
    """Integers of columns of steps: numbers of the slots at which they switch, in turn.

    A switch downwards has a negative number. Slot k is at the fraction (k - 1) / slots of the
    duration.
    """
    y = torch.cat([start[:, None], samples.position.mT[..., steps].to(start)], 1)
    changes = _nearest(y, levels).diff(dim=1) * samples.mask[..., None]
    slot = (samples.s * slots).round().long() + 1
    found = [[[] for _ in steps] for _ in y]
    for i, t, c in changes.nonzero().tolist():
        change = int(changes[i, t, c])
        found[i][c] += [int(slot[i, t]) * (1 if change > 0 else -1)] * abs(change)
    return torch.tensor(
        [[(row + [0] * SWITCHES)[:SWITCHES] for row in rows] for rows in found],
        dtype=torch.float64,
    ).reshape(len(y), -1)


def _rounded(x: Float[Tensor, "B P"], bits: Tensor | None) -> Float[Tensor, "B P"]:
    """Integers that minimise the squared error plus the price of their bits.

    `bits` holds the information of each magnitude, (P, M); None: the price is not counted.
    """
    if bits is None:
        return x.round()
    size = x.abs()
    largest = bits.isfinite().sum(-1) - 1
    choices = torch.stack([torch.zeros_like(x), size.floor(), size.ceil()])
    choices = torch.minimum(choices, largest)
    prices = bits.expand(*choices.shape, -1).gather(-1, choices.long()[..., None])[..., 0]
    best = ((choices - size).square() + PRICE * prices).argmin(0, keepdim=True)
    return choices.gather(0, best)[0] * x.sign()
