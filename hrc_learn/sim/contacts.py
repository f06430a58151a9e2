"""Who touches whom, from MuJoCo's contact list."""

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Two objects in contact, from `start` until `end`."""

    first: str
    """Geom of the moving side (arm, hand or carried object)."""
    second: str
    """Geom that it met."""
    start: float
    """[s]"""
    end: float
    """Time of the last step in contact [s]."""
    depth: float
    """Deepest penetration [m]."""

    def __str__(self) -> str:
        depth_mm = 1e3 * self.depth
        return f"{self.first} met {self.second} at {self.start:.2f} s, {depth_mm:.1f} mm deep"


def body_geoms(model: mujoco.MjModel, bodies: Iterable[str]) -> np.ndarray:
    """Mask over geoms: those of the named bodies and of all that hangs on them."""
    roots = {model.body(name).id for name in bodies}
    member = np.zeros(model.nbody, dtype=bool)
    for body in range(model.nbody):  # parents come before children
        member[body] = body in roots or (body != 0 and member[model.body_parentid[body]])
    return member[model.geom_bodyid]


class ContactMonitor:
    """Remembers every touch between two groups of geoms.

    Attributes:
        touches: Finished and running touches, in order of their start.
    """

    def __init__(self, model: mujoco.MjModel, movers: Iterable[str], obstacles: Iterable[str]):
        """Watch contacts of one group of bodies with another.

        Args:
            model: The model.
            movers: Bodies that move, with all that hangs on them.
            obstacles: Bodies they should not meet.
        """
        self._model = model
        mover, obstacle = body_geoms(model, movers), body_geoms(model, obstacles)
        self._mover, self._obstacle = mover, obstacle
        # One look-up a contact: most steps end there, five times a control step.
        self._matters = np.outer(mover, obstacle) | np.outer(obstacle, mover)
        self.touches: list[Touch] = []
        self._running: dict[tuple[int, int], int] = {}

    def clear(self) -> None:
        """Forget all touches."""
        self.touches = []
        self._running = {}

    def update(self, data: mujoco.MjData) -> None:
        """Look at the contacts of one step."""
        running = {}
        for pair, depth in self._current(data).items():
            k = self._running.get(pair)
            if k is None:
                k = len(self.touches)
                names = (self._model.geom(g).name for g in pair)
                first, second = names
                self.touches.append(
                    Touch(
                        first=first, second=second, start=data.time, end=data.time, depth=depth
                    )
                )
            else:
                old = self.touches[k]
                self.touches[k] = Touch(
                    first=old.first,
                    second=old.second,
                    start=old.start,
                    end=data.time,
                    depth=max(old.depth, depth),
                )
            running[pair] = k
        self._running = running

    def _current(self, data: mujoco.MjData) -> dict[tuple[int, int], float]:
        geoms = data.contact.geom
        if len(geoms) == 0:
            return {}
        matters = self._matters[geoms[:, 0], geoms[:, 1]]
        if not matters.any():
            return {}
        found: dict[tuple[int, int], float] = {}
        for i in np.flatnonzero(matters & (data.contact.dist < 0)):
            a, b = geoms[i].tolist()
            pair = (a, b) if self._mover[a] and self._obstacle[b] else (b, a)
            found[pair] = max(found.get(pair, 0.0), -float(data.contact.dist[i]))
        return found
