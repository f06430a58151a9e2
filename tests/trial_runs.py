"""Trials that other processes can import."""

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Breaks:
    """Works until one seed, then fails as no trial should."""

    at: int

    def __call__(self, seed: int) -> dict[str, int]:
        if seed == self.at:
            raise ZeroDivisionError("a mistake of ours")
        return {"process": os.getpid()}
