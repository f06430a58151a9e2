"""Ranges of settings."""

from collections.abc import Iterable


def check_settings(
    settings: object,
    *,
    positive: Iterable[str] = (),
    not_negative: Iterable[str] = (),
    below_one: Iterable[str] = (),
) -> None:
    """Check that settings are in their ranges; NaN is in none.

    Args:
        settings: Object with the settings as attributes.
        positive: Names of those that must be positive.
        not_negative: Names of those that must be zero or positive.
        below_one: Names of those that must be in [0, 1).

    Raises:
        ValueError: A setting is not in its range.
    """
    rules = (
        (positive, "must be positive", lambda x: x > 0),
        (not_negative, "must not be negative", lambda x: x >= 0),
        (below_one, "must be in [0, 1)", lambda x: 0 <= x < 1),
    )
    for names, rule, holds in rules:
        for name in names:
            value = getattr(settings, name)
            if not holds(value):
                raise ValueError(f"{name} {rule}, but is {value}")
