"""Reading a Rerun recording back, for tests."""

from pathlib import Path

import numpy as np

try:
    from rerun.chunk import RrdReader  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError:  # before Rerun 0.41
    from rerun.experimental import RrdReader


class Rrd:
    """Contents of an .rrd file: its entities, and their components as Python lists."""

    def __init__(self, path: Path):
        reader = RrdReader(path)
        (self.store,) = reader.recordings()
        self.blueprints = len(reader.blueprints())
        self._batches = [
            (chunk.entity_path.lstrip("/"), chunk.is_static, chunk.to_record_batch())
            for chunk in reader.stream()
        ]

    @property
    def entities(self) -> set[str]:
        """Paths that hold anything."""
        return {path for path, _, _ in self._batches}

    def column(
        self, path: str, component: str, *, static: bool = False, timeline: str | None = None
    ) -> list:
        """All rows of a component of an entity, in the order they were sent."""
        return [
            row
            for entity, is_static, batch in self._batches
            if entity == path and is_static == static and component in batch.schema.names
            if timeline is None or timeline in batch.schema.names
            for row in batch.column(component).to_pylist()
        ]

    def rows(self, path: str, *, static: bool = False) -> int:
        """How often anything was sent to an entity."""
        return sum(entity == path and still == static for entity, still, _ in self._batches)

    def time(self, path: str, timeline: str = "time") -> np.ndarray:
        """Times of an entity's rows [s]."""
        return np.concatenate(
            [
                batch.column(timeline).to_numpy().astype(np.int64) / 1e9
                for entity, is_static, batch in self._batches
                if entity == path and not is_static and timeline in batch.schema.names
            ]
        )

    def scalars(self, path: str, timeline: str | None = None) -> np.ndarray:
        """Curves of an entity, (T, D)."""
        return np.array(self.column(path, "Scalars:scalars", timeline=timeline))
