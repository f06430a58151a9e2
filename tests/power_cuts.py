"""Work interrupted at any of its disk operations, as by a power cut."""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from unittest import mock

STEPS = ("mkdir", "rename", "replace", "link", "unlink", "rmdir", "fsync")
"""Functions of `os` that change the disk; Path and shutil use them."""


class PowerCutError(BaseException):
    """Raised by the first disk operation after the cut, and by all later ones."""


def cut_off(work: Callable[[], object], every: int = 1) -> Iterator[int]:
    """Repeat some work, interrupted later each time, until it completes.

    Cleaning up after the cut changes nothing on disk. Only locks are released, as by a kill,
    which closes files.

    Args:
        work: The work.
        every: Disk operations between two cuts.

    Yields:
        Number of disk operations done, after each interrupted run.
    """
    for survives in itertools.count(step=every):
        left = iter(range(survives))
        with contextlib.ExitStack() as patches:
            for name in STEPS:
                step = (
                    _mortal(getattr(os, name), left) if name != "fsync" else _mortal(int, left)
                )
                patches.enter_context(mock.patch.object(os, name, step))
            try:
                work()
            except PowerCutError:
                pass
            else:
                return
        yield survives


def _mortal(call: Callable, left: Iterator[int]) -> Callable:
    def step(*args, **kwargs):
        if next(left, None) is None:
            raise PowerCutError
        return call(*args, **kwargs)

    return step
