"""Shape checks of annotated functions, for the first calls of each test.

A simulation calls the same functions a million times with the same shapes, and checks of all
calls take a quarter of the suite's time. To prepare the check of a function takes 1 ms, which
functions that are never checked need not wait for: most of the package's at import, and those
inside of others, which are made anew with each call.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import beartype
import jaxtyping
from jaxtyping import _decorator

_MOST = 100
# A whole number may stand where a float is annotated, as for static type checkers (PEP 484).
_checking = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
_calls = 0
_prepared = _decorator.jaxtyped


def _prepared_when_checked(fn: Any = None, *, typechecker: Any = None) -> Any:
    """`jaxtyping.jaxtyped`, which prepares the check of a function when it is first needed."""
    if fn is None:
        return functools.partial(_prepared_when_checked, typechecker=typechecker)
    if isinstance(fn, type | classmethod | staticmethod | property):
        return _prepared(fn, typechecker=typechecker)  # comes back with the functions in it
    check = None

    @functools.wraps(fn)
    def called(*args: Any, **kwargs: Any) -> Any:
        nonlocal check
        if jaxtyping.config.jaxtyping_disable:
            return fn(*args, **kwargs)
        if check is None:
            check = _prepared(fn, typechecker=typechecker)
        return check(*args, **kwargs)

    return called


jaxtyping.jaxtyped = _decorator.jaxtyped = _prepared_when_checked


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function that checks its arguments and result, and counts the checks."""
    check = _checking(function)

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
    """Check anew, although earlier calls, such as those at import, have used up theirs."""
    global _calls
    before = jaxtyping.config.jaxtyping_disable
    _calls = 0
    jaxtyping.config.update("jaxtyping_disable", False)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
