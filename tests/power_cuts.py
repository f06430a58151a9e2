"""Work that is cut off at any of its steps on disk, as by a power cut."""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from unittest import mock

STEPS = ("mkdir", "rename", "replace", "link", "unlink", "rmdir", "fsync")
"""Functions of `os` that change what is on disk; what Path and shutil do goes through them."""


class PowerCutError(BaseException):
    """Raised by the first step that is not done any more, and by all after it."""


def cut_off(work: Callable[[], object]) -> Iterator[int]:
    """Do some work again and again, each time cut off one step later, until it gets to its end.

    Whatever cleans up after the cut changes nothing on disk any more. Only what is locked is
    given back as if by a kill, because that closes files.

    Yields:
        After each time but the last, how many steps had been done.
    """
    for survives in itertools.count():
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
