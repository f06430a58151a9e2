"""Batches of training samples from memory, for policies that are trained in a benchmark."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int
from torch import Tensor


class SampleWindows:
    """Samples of all frames of episodes, with the neighbouring frames that a policy needs.

    The batches equal those of LeRobot's loader, which looks up every action of every chunk
    separately and reaches some 200 samples per second. Few demonstrations fit into memory,
    where a batch is one gather operation.
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
