"""Gains of the controller in a file: written by tuning, taken by the programs that run it."""

import json
from dataclasses import fields, replace
from pathlib import Path

from ..controller import ControllerConfig

TUNED = ("vision_rate", "linear_speed", "angular_speed")
"""Fields of `ControllerConfig` that tuning searches."""


def with_gains(config: ControllerConfig, path: Path | None) -> ControllerConfig:
    """The settings with the gains of a file in their place.

    Args:
        config: The settings.
        path: Of training/tune_controller.py; None: as they are.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds something else; names the field.
    """
    if path is None:
        return config
    try:
        gains = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: not valid JSON ({error})") from None
    known = {field.name for field in fields(ControllerConfig)}
    wrong = [
        name
        for name, value in (gains.items() if isinstance(gains, dict) else [("it", None)])
        if name not in known or isinstance(value, bool) or not isinstance(value, int | float)
    ]
    if wrong:
        raise ValueError(f"{path}: {wrong[0]} is no gain; there are {', '.join(TUNED)}")
    return replace(config, **gains)
