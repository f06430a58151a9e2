"""What smoothing has changed, added up."""

import torch

from ...controller import BROKEN, SmoothReport

_SAME = 1e-6
"""Changes below this are rounding."""


class Changes:
    """Counts and the largest changes, over many actions.

    Attributes:
        steps: Actions handed out.
        changed: Of them, those that differ from what was asked for.
        broken: Of them, those asked for that would have broken each of `BROKEN`.
        largest: Largest change of each value, in its unit.
    """

    def __init__(self, names: list[str]):
        self.names = tuple(names)
        self.clear()

    def clear(self) -> None:
        """Start over."""
        self.steps = self.changed = 0
        self.broken = dict.fromkeys(BROKEN, 0)
        self.largest = dict.fromkeys(self.names, 0.0)

    def add(self, report: SmoothReport) -> None:
        """Count what was done to a chunk."""
        change = report.change.abs().reshape(-1, len(self.names))
        self.steps += len(change)
        self.changed += int((change > _SAME).any(-1).sum())
        for kind, count in zip(
            BROKEN, report.broken.flatten(0, -2).sum(0).tolist(), strict=True
        ):
            self.broken[kind] += int(count)
        for name, most in zip(self.names, torch.amax(change, 0).tolist(), strict=True):
            self.largest[name] = max(self.largest[name], most)

    def __str__(self) -> str:
        broken = ", ".join(f"{kind} {count}" for kind, count in self.broken.items())
        name = max(self.largest, key=self.largest.__getitem__)
        return (
            f"{self.changed} of {self.steps} actions changed, by at most "
            f"{self.largest[name]:.4g} ({name}); asked for beyond limits of {broken}"
        )
