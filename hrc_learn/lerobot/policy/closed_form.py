"""A policy's first primitives, by regression instead of gradients, from whole demonstrations;
and samples of these for the gradients that may follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.demos.read.frames import read_frames
from hrc_learn.demos.read.opened_dataset import select_episodes
from hrc_learn.dmp import JointDMP, Response, RidgeFit, fit_ridge
from hrc_learn.lerobot.policy.networks import ContextualMotion

# A policy's first primitives, by regression instead of gradients.

REGULARIZATIONS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge strengths of the regression, chosen by cross-validation."""
FEWEST = 4
"""Fewest demonstrations for which a regression can be distinguished from chance."""
SMALLEST_VARIATION = 0.05
"""Fraction of its spread by which a context value must vary between demonstrations."""
MARGIN = 0.5
"""Fraction of the demonstrated range by which contexts may lie outside."""


@torch.no_grad()
def fit_closed_form(
    motion: ContextualMotion,
    demonstrations: Sequence[Float[Tensor, "_frames A"]],
    contexts: Float[Tensor, "n C"],
    fps: float,
) -> float:
    """Set base and slopes of `motion` from demonstrations.

    One primitive is fitted to each demonstration. Of few, or where the context explains
    nothing, their mean is kept; else a ridge regression on the context, as strong as predicts
    demonstrations left out best.

    Args:
        motion: Changed in place.
        demonstrations: Coordinates frame by frame.
        contexts: Whitened context of each.
        fps: Frames a second.

    Returns:
        Root mean square error of the motions of demonstrations left out, in the spread of the
        coordinates; NaN of one demonstration.
    """
    x = _fit_each(motion.response, demonstrations, fps)
    c = contexts.double()
    regression = _best_regression(motion, c, x)
    motion.base.copy_(regression.base)
    motion.slopes.copy_(regression.slopes)
    motion.centre.copy_(c.mean(0))
    low, high = torch.aminmax(c, dim=0)
    motion.low.copy_(low - MARGIN * (high - low))
    motion.high.copy_(high + MARGIN * (high - low))
    return regression.error


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """x = base + (c - mean) slopes."""

    base: Float[Tensor, "K"]
    slopes: Float[Tensor, "C K"]
    error: float
    """Cross-validated error."""


def _fit_each(
    response: Response, demonstrations: Sequence[Tensor], fps: float
) -> Float[Tensor, "n K"]:
    """Coordinates of a primitive each, as `ContextualMotion` counts them."""
    position = pad_sequence([d.double() for d in demonstrations], batch_first=True)
    lengths = torch.tensor([len(d) for d in demonstrations])
    frame = torch.arange(position.shape[1])
    dmp = JointDMP.fit(
        frame.double() / fps,
        position,
        mask=frame < lengths[:, None],
        basis=response.basis,
        spring=response.spring,
    )
    each = dmp.coordinates()
    each[..., :-3] /= response.spring.stiffness
    return torch.cat([each.flatten(1), dmp.duration.log()[:, None]], dim=-1)


def _best_regression(motion: ContextualMotion, c: Tensor, x: Tensor) -> Regression:
    n = len(x)
    mean = x.mean(0)
    left_out = (x - mean) * n / (n - 1) if n > 1 else x * torch.nan
    best = Regression(
        base=mean, slopes=c.new_zeros(c.shape[1], len(mean)), error=_error(motion, left_out)
    )
    varies = (c - c.mean(0)).square().mean(0).sqrt() > SMALLEST_VARIATION
    if n < FEWEST or not varies.any():
        return best
    for regularization in REGULARIZATIONS:
        fit = fit_ridge(c[:, varies], x, regularization)
        error = _error(motion, fit.held_out)
        if error < best.error:
            best = Regression(base=mean, slopes=_slopes(fit, varies), error=error)
    return best


def _slopes(fit: RidgeFit, varies: Tensor) -> Tensor:
    slopes = fit.coefficients.new_zeros(len(varies), fit.coefficients.shape[1])
    slopes[varies] = fit.coefficients[1:] / fit.scale[:, None]
    return slopes


def _error(motion: ContextualMotion, difference: Float[Tensor, "n K"]) -> float:
    """Motion error caused by a difference in coordinates, root mean square."""
    # The map to motions is linear in all but the duration, which shifts them in time.
    per_coordinate = difference[:, :-1].unflatten(-1, (motion.width, -1)).clone()
    per_coordinate[..., :-3] *= motion.response.spring.stiffness
    s = torch.linspace(0, 1, 100, dtype=torch.float64)
    position, _, _ = motion.response.matrices(s, torch.float64)
    square = (per_coordinate @ position).square().mean() + difference[:, -1].square().mean()
    return float(square.sqrt())


# Whole demonstrations of a dataset's folder, in the columns and units a policy trains on.

MOST = 256
"""Demonstrations that say enough of a motion to start from; more are spread evenly."""


def read_episodes(
    root: str | Path, keys: Sequence[str], episodes: Sequence[int] | None = None
) -> list[dict[str, Tensor]]:
    """Columns of whole episodes, (frames, components) each, just as they are on disk.

    Args:
        root: Folder of a LeRobot dataset.
        keys: Columns wanted.
        episodes: Indices; None: all. Of more than 256, that many are read.

    Raises:
        DatasetError: A `ValueError` that says what of the dataset cannot be read.
    """
    folder = open_folder(root)
    chosen = select_episodes(folder, episodes)
    if len(chosen) > MOST:
        spread = np.linspace(0, len(chosen) - 1, MOST).round().astype(int)
        chosen = tuple(chosen[i] for i in spread)
    entries = sorted(chosen, key=lambda entry: (entry.file, entry.start))
    return [
        {key: torch.from_numpy(np.array(frames[key])) for key in keys}
        for _, frames in read_frames(folder, entries, keys)
    ]


class SampleWindows:
    """Samples of all frames of episodes, with the steps around each that a policy asks for.

    The same batches as of LeRobot's loader, which looks up every action of every chunk by
    itself, some 200 samples a second; few demonstrations fit into memory, where a batch is one
    gather.
    """

    def __init__(
        self,
        episodes: Sequence[Mapping[str, Tensor]],
        deltas: Mapping[str, Sequence[int] | None],
        fps: float | int,
    ):
        """Lay the episodes out.

        Args:
            episodes: Columns by key, (frames, ...) each.
            deltas: Offsets in frames for each key; None: the frame itself, without
                an axis of time.
            fps: Frames a second.
        """
        lengths = torch.tensor([len(next(iter(episode.values()))) for episode in episodes])
        self._columns = {key: torch.cat([e[key] for e in episodes]) for key in deltas}
        self._deltas = deltas
        end = lengths.cumsum(0)
        self._start = (end - lengths).repeat_interleave(lengths)
        self._last = (end - 1).repeat_interleave(lengths)
        self._fps = fps

    def __len__(self) -> int:
        return len(self._start)

    def batch(self, index: Int[Tensor, "B"]) -> dict[str, Tensor]:
        """Samples by the number of their frame, counted through all episodes."""
        start, last = self._start[index], self._last[index]
        batch = {"timestamp": (index - start) / self._fps}
        for key, deltas in self._deltas.items():
            if deltas is None:
                batch[key] = self._columns[key][index]
                continue
            wanted = index[:, None] + torch.tensor(deltas)
            within = wanted.clamp(start[:, None], last[:, None])
            batch[key] = self._columns[key][within]
            batch[f"{key}_is_pad"] = within != wanted
        return batch

    def draw(self, size: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Samples drawn at random."""
        return self.batch(torch.randint(len(self), (size,), generator=generator))
