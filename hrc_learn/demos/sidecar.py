"""`meta/hrc_learn.json`: what LeRobot's own metadata cannot say.

LeRobot declares no units and no frames, and drops fields it does not know from its own
files, so they stand in a file beside them.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .finding import DatasetError
from .roles import ROLES
from .schema import Column

SIDECAR_PATH = "meta/hrc_learn.json"
_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """Units and meaning of a dataset's columns, as its writer declared them."""

    units: dict[str, str] = field(default_factory=dict)
    """Role -> unit of its values on disk."""
    columns: dict[str, dict] = field(default_factory=dict)
    """Role -> {"key": feature, "names": components}."""
    joint_names: tuple[str, ...] = ()
    frames: dict[str, str] = field(default_factory=dict)
    """What poses are relative to ("base") and of ("ee")."""
    details: dict = field(default_factory=dict)
    """Whatever else the writer was asked to keep."""


def sidecar_content(
    columns: Sequence[Column],
    joint_names: Sequence[str],
    frames: Mapping[str, str],
    details: Mapping[str, object],
) -> dict:
    """What the file of a dataset with these columns says."""
    known = {column.role: column for column in columns if column.role is not None}
    return {
        "format": _FORMAT,
        "units": {role: ROLES[role].unit for role in known},
        "columns": {
            role: {"key": column.key, "names": list(column.names)}
            for role, column in known.items()
        },
        "joint_names": list(joint_names),
        "frames": dict(frames),
        "details": dict(details),
    }


def sidecar_copy(sidecar: Sidecar, units: Mapping[str, str]) -> dict:
    """What the file of a copy says, in these units; {} where there is nothing to be said."""
    if not units and sidecar == Sidecar():
        return {}
    return {"format": _FORMAT, **vars(sidecar), "units": dict(units)}


def read_sidecar(root: Path) -> Sidecar:
    """The dataset's sidecar, an empty one where there is none.

    Raises:
        DatasetError: The file is damaged or of a later format.
    """
    path = root / SIDECAR_PATH
    if not path.exists():
        return Sidecar()
    try:
        content = json.loads(path.read_text())
        if content["format"] != _FORMAT:
            raise DatasetError(
                f"format {content['format']} is not known here (only {_FORMAT}); a newer "
                f"hrc_learn wrote it",
                file=SIDECAR_PATH,
            )
        return Sidecar(
            units=content["units"],
            columns=content["columns"],
            joint_names=tuple(content["joint_names"]),
            frames=content["frames"],
            details=content["details"],
        )
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise DatasetError(
            f"damaged ({error!r}); delete it to have units guessed, or restore it",
            file=SIDECAR_PATH,
        ) from error
