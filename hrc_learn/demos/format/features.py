"""The columns of a dataset as its metadata declares them: `meta/info.json`, and our own
`meta/hrc_learn.json`.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path

from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.component_names import ROLES
from hrc_learn.demos.write.schema import Column

# The columns of a dataset as its `meta/info.json` declares them.

INFO_PATH = "meta/info.json"
NUMERIC = ("float", "int", "uint", "bool")
"""How the dtypes begin that hold numbers."""


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One column of the frames, as `meta/info.json` declares it."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    """One name a component, from whichever nesting they were written in."""

    @property
    def width(self) -> int:
        """Components a frame."""
        return prod(self.shape)

    @property
    def numeric(self) -> bool:
        return self.dtype.startswith(NUMERIC)


def read_features(info: dict) -> dict[str, Feature]:
    """The declared features.

    Raises:
        DatasetError: A declaration is malformed, or gives not one name a component.
    """
    features = {}
    for key, declared in info["features"].items():
        try:
            dtype, shape = str(declared["dtype"]), tuple(int(n) for n in declared["shape"])
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"the feature's declaration is malformed: {error!r}", file=INFO_PATH, key=key
            ) from error
        feature = Feature(key=key, dtype=dtype, shape=shape, names=None)
        if feature.numeric:
            names = flatten_names(declared.get("names"))
            if names is not None and len(names) != feature.width:
                raise DatasetError(
                    f"{len(names)} names for {feature.width} components; correct names or "
                    f"shape of the feature",
                    file=INFO_PATH,
                    key=key,
                )
            feature = Feature(key=key, dtype=dtype, shape=shape, names=names)
        features[key] = feature
    return features


def flatten_names(names: object) -> tuple[str, ...] | None:
    """Names of components from any of the forms met: flat, nested, in a dict, or none."""
    if names is None:
        return None
    if isinstance(names, dict):
        names = list(names.values())
    if not isinstance(names, list | tuple):
        return (str(names),)
    flat: list[str] = []
    for item in names:
        flat.extend(flatten_names(item) or () if isinstance(item, list | dict) else [str(item)])
    return tuple(flat)


# `meta/hrc_learn.json`: what LeRobot's own metadata cannot say.
#
# LeRobot declares no units and no frames, and drops fields it does not know from its own
# files, so they stand in a file beside them.

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
        content = json.loads(path.read_text(encoding="utf-8"))
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
