"""Statistics of features, as LeRobot keeps them for every episode and for the whole."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Shaped, UInt8

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Statistics = dict[str, dict[str, list]]
"""Feature -> statistic (min, max, mean, std, count, q01 ... q99) -> one number a component."""


def episode_statistics(features: Mapping[str, Shaped[np.ndarray, "_frames ..."]]) -> Statistics:
    """Statistics of each feature over the frames of one episode."""
    return {key: _of_columns(np.asarray(values, float)) for key, values in features.items()}


def image_statistics(images: UInt8[np.ndarray, "_count _height _width 3"]) -> dict[str, list]:
    """Statistics of each colour channel, scaled to 0..1, in the nesting LeRobot expects."""
    flat = _of_columns(images.reshape(-1, 3) / 255)
    nested = {name: [[[value]] for value in values] for name, values in flat.items()}
    return nested | {"count": [len(images)]}


def combined_statistics(episodes: Sequence[Statistics]) -> Statistics:
    """Statistics over all episodes.

    Exact but for the quantiles, which are the means of the episodes' weighted by length:
    that is how LeRobot itself combines them.
    """
    return {key: _combine([episode[key] for episode in episodes]) for key in episodes[0]}


def _of_columns(values: np.ndarray) -> dict[str, list]:
    values = values.reshape(len(values), -1)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(0).tolist(),
        "max": values.max(0).tolist(),
        "mean": values.mean(0).tolist(),
        "std": values.std(0).tolist(),
        "count": [len(values)],
        **{name: row.tolist() for name, row in zip(QUANTILES, quantiles, strict=True)},
    }


def _combine(episodes: Sequence[dict[str, list]]) -> dict[str, list]:
    stacked = {name: np.array([episode[name] for episode in episodes]) for name in episodes[0]}
    weights = (stacked["count"] / stacked["count"].sum()).reshape(
        -1, *[1] * (stacked["mean"].ndim - 1)
    )
    mean = (weights * stacked["mean"]).sum(0)
    variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
    combined = {
        "min": stacked["min"].min(0),
        "max": stacked["max"].max(0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": stacked["count"].sum(0),
        **{name: (weights * stacked[name]).sum(0) for name in QUANTILES},
    }
    return {name: values.tolist() for name, values in combined.items()}
