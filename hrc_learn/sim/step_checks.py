"""Checks of a simulation after each step: contacts between groups of geoms, and divergence.

MuJoCo goes on when a simulation diverges: it writes a line to a log, resets the state to the
first pose at time zero, and counts a warning. Measurements of such a run are meaningless.
"""

from collections.abc import Iterable
from dataclasses import replace

import mujoco
import numpy as np

from hrc_learn.protocols import Touch

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

FASTEST = 1e3
"""Largest plausible speed of a coordinate [m/s or rad/s]. The arm's joints reach 2.6 rad/s, and
a falling object would reach `FASTEST` after 100 s. MuJoCo itself warns only at 1e10."""

_INDEXED = {
    int(mujoco.mjtWarning.mjWARN_BADQPOS): "qpos",
    int(mujoco.mjtWarning.mjWARN_BADQVEL): "qvel",
    int(mujoco.mjtWarning.mjWARN_BADQACC): "qacc",
}
"""Name of the array that the index in a warning refers to, by the kind of the warning."""


def body_geoms(model: mujoco.MjModel, bodies: Iterable[str]) -> np.ndarray:
    """Mask of the geoms of the named bodies and of all bodies that they carry.

    The body "world" has floor and pedestal only.
    """
    roots = {model.body(name).id for name in bodies}
    member = np.zeros(model.nbody, dtype=bool)
    for body, parent in enumerate(model.body_parentid):  # parents come before children
        member[body] = body in roots or (parent != 0 and member[parent])
    return member[model.geom_bodyid]


class ContactMonitor:
    """Records every touch between two groups of geoms.

    Attributes:
        watched: Watched pairs of geoms, (geoms, geoms), bool.
        touches: Finished and running touches, in order of their start.
    """

    def __init__(self, model: mujoco.MjModel, movers: Iterable[str], obstacles: Iterable[str]):
        """Watch contacts of one group of bodies with another.

        Args:
            model: The model.
            movers: Bodies that move, with all bodies that they carry.
            obstacles: Bodies that the movers should not touch.
        """
        self._model = model
        mover, obstacle = body_geoms(model, movers), body_geoms(model, obstacles)
        self._mover, self._obstacle = mover, obstacle
        # A table of pairs, so that most steps need only one look-up for each contact.
        self.watched = np.outer(mover, obstacle) | np.outer(obstacle, mover)
        self.touches: list[Touch] = []
        self._running: dict[tuple[int, int], int] = {}

    def clear(self) -> None:
        """Forget all touches."""
        self.touches = []
        self._running = {}

    def update(self, data: mujoco.MjData) -> None:
        """Record the watched contacts of one step."""
        running = {}
        for pair, depth in self._current(data).items():
            k = self._running.get(pair, len(self.touches))
            if k == len(self.touches):
                first, second = (self._model.geom(g).name for g in pair)
                self.touches.append(
                    Touch(
                        first=first, second=second, start=data.time, end=data.time, depth=depth
                    )
                )
            else:
                old = self.touches[k]
                self.touches[k] = replace(old, end=data.time, depth=max(old.depth, depth))
            running[pair] = k
        self._running = running

    def pause(self) -> None:
        """Record a step without watched contacts."""
        self._running = {}

    def _current(self, data: mujoco.MjData) -> dict[tuple[int, int], float]:
        geoms = data.contact.geom
        matters = self.watched[geoms[:, 0], geoms[:, 1]]
        found: dict[tuple[int, int], float] = {}
        for i in np.flatnonzero(matters & (data.contact.dist < 0)):
            a, b = geoms[i].tolist()
            pair = (a, b) if self._mover[a] and self._obstacle[b] else (b, a)
            found[pair] = max(found.get(pair, 0.0), -float(data.contact.dist[i]))
        return found


class PhysicsError(RuntimeError):
    """A simulation diverged or was reset by MuJoCo: its measurements are invalid.

    Skills do not retry after this error, because it is not the task that failed. An experiment
    counts the run as failed.

    Attributes:
        time: Simulated time of the detection [s].
        body: Body where the error began; empty if unknown.
    """

    def __init__(self, reason: str, time: float, body: str = ""):
        where = f" at {body}" if body else ""
        super().__init__(f"physics failed{where} at {time:.3f} s: {reason}")
        self.reason, self.time, self.body = reason, time, body

    def __reduce__(self):
        # Trials run in other processes. By default, pickling would keep the message only.
        return type(self), (self.reason, self.time, self.body)


class PhysicsWatch:
    """Checks a simulation after each step, and more thoroughly on request."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        """Watch a simulation.

        Disables MuJoCo's automatic reset, so that an invalid state remains for inspection.

        Args:
            model: The model.
            data: State of the model.
        """
        self._model, self._data = model, data
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.restart()

    def restart(self) -> None:
        """Accept the present state as valid: time and warnings count from here."""
        self._time = self._data.time
        self._warnings = np.array(self._data.warning.number)

    def after_step(self) -> None:
        """Detect an implausible speed before it spreads to other bodies.

        Raises:
            PhysicsError: A speed is implausible or not a number.
        """
        speed = np.abs(self._data.qvel)
        # This form of the comparison also finds NaN.
        if not speed.max(initial=0.0) <= FASTEST:
            self.check()
            dof = int(np.nanargmax(speed))
            raise self._error(f"it moves at {speed[dof]:.3g} m/s or rad/s", self._body(dof))

    def check(self) -> None:
        """Check state, warnings and time since the last check.

        Raises:
            PhysicsError: A value is not finite, MuJoCo warned, or time went backwards.
        """
        data = self._data
        # A force that is not finite spoils the accelerations of all bodies in the same step.
        if len(bad := np.flatnonzero(~np.isfinite(data.xfrc_applied).all(-1))):
            body = self._model.body(int(bad[0])).name
            raise self._error("a force on it is not finite", body)
        if len(new := np.flatnonzero(data.warning.number != self._warnings)):
            kind = int(new[0])
            # Name the body where the error began; during the step it may have spread to others.
            place = int(data.warning.lastinfo[kind])
            body = self._body(place, _INDEXED[kind]) if kind in _INDEXED else ""
            raise self._error(f"MuJoCo warns: {mujoco.mju_warningText(kind, place)}", body)
        for name in ("qpos", "qvel", "qacc"):
            if len(bad := np.flatnonzero(~np.isfinite(values := getattr(data, name)))):
                place = int(bad[0])
                raise self._error(f"{name} holds {values[place]}", self._body(place, name))
        if data.time < self._time:
            raise self._error(f"time went back from {self._time:.3f} s")
        self._time = data.time

    def _body(self, place: int, values: str = "qvel") -> str:
        """Name of the body that an entry of `qpos`, `qvel` or `qacc` belongs to.

        Args:
            place: Index of the entry.
            values: Name of the array.
        """
        model = self._model
        starts = model.jnt_qposadr if values == "qpos" else model.jnt_dofadr
        joint = int(np.searchsorted(starts, place, side="right")) - 1
        return model.body(int(model.jnt_bodyid[joint])).name

    def _error(self, reason: str, body: str = "") -> PhysicsError:
        return PhysicsError(reason, self._data.time, body)
