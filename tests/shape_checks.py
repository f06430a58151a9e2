"""Shape checks of annotated functions, for the first calls of each test.

A simulation calls the same functions a million times with the same shapes, and checks of all
calls take a quarter of the suite's time.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import beartype
import jaxtyping

_MOST = 100
_calls = 0


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function that checks its arguments and result, and counts the checks."""
    check = beartype.beartype(function)

    @functools.wraps(function)
    def counted(*args: Any, **kwargs: Any) -> Any:
        global _calls
        _calls += 1
        if _calls == _MOST:
            jaxtyping.config.update("jaxtyping_disable", True)
        return check(*args, **kwargs)

    return counted


@contextmanager
def first_calls_checked() -> Iterator[None]:
    """Count checks anew, and leave checks as they were."""
    global _calls
    before = jaxtyping.config.jaxtyping_disable
    _calls = 0
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
