"""The scenarios by the names that command lines give them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..tasks.scenario import Scenario

SCENARIOS = ("placing", "grasping")
SHELVES = ("lower", "middle", "upper")


def check_scenario(name: str, shelf: str, pixels: bool) -> None:
    """Refuse what there is not, before anything heavy is imported.

    Raises:
        ValueError: There is no such scenario or shelf, or its object has no pixel.
    """
    if name not in SCENARIOS:
        raise ValueError(f"no scenario {name!r}: there are {', '.join(SCENARIOS)}.")
    if shelf not in SHELVES:
        raise ValueError(f"no shelf {shelf!r}: there are {', '.join(SHELVES)}.")
    if pixels and name == "placing":
        raise ValueError("placing begins with the object in the hand, so it has no pixels.")


def make_scenario(name: str, shelf: str) -> Scenario:
    """A scenario in the default workplace."""
    from ..tasks.scenario import Grasping, Placing

    return Placing(shelf=shelf) if name == "placing" else Grasping()
