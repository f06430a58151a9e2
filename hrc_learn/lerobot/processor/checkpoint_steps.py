"""Adding the steps to a checkpoint that was trained without them."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hrc_learn.lerobot.processor.action_limits import ActionLimits
from hrc_learn.store import new_file

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
WATCH, SMOOTH = "hrc_learn_watch_state", "hrc_learn_smooth_actions"


def add_smoothing(checkpoint: Path, limits: ActionLimits) -> None:
    """Let a trained policy's actions be smoothed wherever its checkpoint is used.

    Steps from an earlier call are replaced. Weights and all other steps stay as they are.

    Args:
        checkpoint: Folder `pretrained_model` of a checkpoint of any policy.
        limits: Of its actions.

    Raises:
        FileNotFoundError: The folder holds no processors.
        ValueError: They cannot be read.
    """
    before, after = (_read(checkpoint / name) for name in (PREPROCESSOR, POSTPROCESSOR))
    watch = {"registry_name": WATCH, "config": {"pair": "smooth"}}
    smooth = {"registry_name": SMOOTH, "config": {**asdict(limits), "pair": "smooth"}}
    before["steps"].insert(0, watch)  # before a step that renames or normalises the state
    after["steps"].append(smooth)
    # Without the one that watches, the other still works: so it comes first.
    _write(checkpoint / PREPROCESSOR, before)
    _write(checkpoint / POSTPROCESSOR, after)


def remove_smoothing(checkpoint: Path) -> None:
    """Take the steps out again; complains as `add_smoothing`."""
    for name in (PREPROCESSOR, POSTPROCESSOR):
        _write(checkpoint / name, _read(checkpoint / name))


def _read(path: Path) -> dict[str, Any]:
    """A pipeline's settings without our steps."""
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no {path}: give the folder `pretrained_model` of a LeRobot checkpoint."
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        steps = content["steps"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a processor of LeRobot: {error}") from None
    content["steps"] = [s for s in steps if s.get("registry_name") not in (WATCH, SMOOTH)]
    return content


def _write(path: Path, content: dict[str, Any]) -> None:
    with new_file(path) as new:
        new.write_text(json.dumps(content, indent=2), encoding="utf-8")
