"""The open episode of a recording: frames gathered, completed, and examined."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Shaped

from .schema import FRAME_WIDTHS

Episode = dict[str, Shaped[np.ndarray, "_frames ..."]]


class EpisodeBuffer:
    """Frames of one episode, each giving the same quantities."""

    def __init__(self, joint_names: Sequence[str], features: Mapping[str, Sequence[str]]):
        self._widths = {
            **{name: width or len(joint_names) for name, width in FRAME_WIDTHS.items()},
            **{key: len(names) for key, names in features.items()},
        }
        self._rows: dict[str, list[np.ndarray]] = {}

    def __len__(self) -> int:
        return len(next(iter(self._rows.values()), ()))

    def append(self, values: Mapping[str, object]) -> None:
        """Copy one frame in.

        Raises:
            ValueError: A quantity is unknown, missing, new, or of the wrong length; the
                frame is left out then.
        """
        if not len(self):
            self._rows = {name: [] for name in values}
        if values.keys() != self._rows.keys():
            difference = describe_difference(values.keys(), self._rows.keys())
            raise ValueError(f"frame {len(self)} {difference}")
        for name, row in [(name, self._row(name, value)) for name, value in values.items()]:
            self._rows[name].append(row)

    def arrays(self) -> Episode:
        """The frames so far, stacked."""
        return {name: np.stack(rows) for name, rows in self._rows.items()}

    def _row(self, name: str, value: object) -> Float64[np.ndarray, " width"]:
        if name not in self._widths:
            raise ValueError(
                f"{name!r} is no quantity of a frame; known are {', '.join(self._widths)}. "
                f"Declare others as features={{'observation.{name}': [names of components]}}."
            )
        row, width = np.array(value, dtype=np.float64), self._widths[name]
        if row.size != width or row.ndim > 1:
            raise ValueError(
                f"frame {len(self)}: {name} needs {width} numbers, got shape {row.shape}"
            )
        return row.reshape(width)


def describe_difference(given: Collection[str], expected: Collection[str]) -> str:
    """What a frame or an episode gives too little or too much, in words."""
    missing, new = sorted(set(expected) - set(given)), sorted(set(given) - set(expected))
    parts = [f"lacks {', '.join(missing)}"] * bool(missing)
    parts += [f"gives {', '.join(new)} besides"] * bool(new)
    return f"{' and '.join(parts)}: all give what the first frame gave"


def complete(episode: Episode, fps: float) -> Episode:
    """The episode with stamps and visibility filled in where its frames gave none.

    A feature that was not seen need not be finite; it is written as zero.
    """
    length = len(next(iter(episode.values())))
    episode = {"time": np.arange(length) / fps, **episode}
    if "feature" in episode:
        visible = episode.get("feature_visible", np.ones(length)).reshape(length, 1) > 0
        lost = ~visible & ~np.isfinite(episode["feature"])
        episode["feature"] = np.where(lost, 0.0, episode["feature"])
        episode["feature_visible"] = visible
    return episode


def examine(episode: Episode) -> None:
    """Refuse what no reader could use.

    Raises:
        ValueError: A value is not finite, time does not increase, or an orientation is no
            unit quaternion.
    """
    for name, values in episode.items():
        bad = np.argwhere(~np.isfinite(values.reshape(len(values), -1)))
        if len(bad):
            raise ValueError(f"{name} is not finite at frame {bad[0, 0]}")
    stalled = np.flatnonzero(np.diff(episode["time"].reshape(-1)) <= 0)
    if len(stalled):
        raise ValueError(f"time must increase, but does not after frame {stalled[0]}")
    if "orientation" in episode:
        wrong = np.abs(np.linalg.norm(episode["orientation"], axis=1) - 1) > 1e-3
        if wrong.any():
            raise ValueError(
                f"orientation must be a unit quaternion (w, x, y, z), but is not at frame "
                f"{wrong.argmax()}"
            )
