"""The columns of a dataset as its `meta/info.json` declares them."""

from dataclasses import dataclass
from math import prod

from .finding import DatasetError

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
