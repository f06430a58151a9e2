"""Smooth, limit-checked actions for any policy, as steps of its processors.

One step watches where the robot is, one smooths what it is sent; `add_smoothing` adds both to a
checkpoint that was trained without them.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from .action_limits import ActionLimits, read_json, write_json
from .motion_filter import LIMIT_KINDS, MotionFilter, MotionState

# What smoothing has changed, added up.

_SAME = 1e-6
"""Changes below this are rounding."""


class Changes:
    """Counts and the largest changes, over many actions.

    Attributes:
        steps: Actions handed out.
        changed: Number of actions that were changed.
        broken: Number of requested actions that would have violated each of `LIMIT_KINDS`.
        largest: Largest change of each value, in its unit.
    """

    def __init__(self, names: list[str]):
        self.names = tuple(names)
        self.clear()

    def clear(self) -> None:
        """Start over."""
        self.steps = self.changed = 0
        self.broken = dict.fromkeys(LIMIT_KINDS, 0)
        self.largest = dict.fromkeys(self.names, 0.0)

    def add(
        self, broken: Bool[np.ndarray, "*batch T 4"], change: Float[np.ndarray, "*batch T D"]
    ) -> None:
        """Count what was done to a chunk.

        Args:
            broken: True for each of `LIMIT_KINDS` that an action would have violated.
            change: Difference between returned and requested action.
        """
        change = np.abs(change).reshape(-1, len(self.names))
        self.steps += len(change)
        self.changed += int((change > _SAME).any(-1).sum())
        counts = broken.reshape(-1, len(LIMIT_KINDS)).sum(0).tolist()
        for kind, count in zip(LIMIT_KINDS, counts, strict=True):
            self.broken[kind] += count
        for name, most in zip(self.names, change.max(0).tolist(), strict=True):
            self.largest[name] = max(self.largest[name], most)

    def __str__(self) -> str:
        broken = ", ".join(f"{kind} {count}" for kind, count in self.broken.items())
        name = max(self.largest, key=self.largest.__getitem__)
        return (
            f"{self.changed} of {self.steps} actions changed, by at most "
            f"{self.largest[name]:.4g} ({name}); asked for beyond limits of {broken}"
        )


# The steps.

WATCH, SMOOTH = "hrc_learn_watch_state", "hrc_learn_smooth_actions"
_JUMP = 5.0
"""A robot that moves this many times faster than its limit was put there: an episode began."""

_Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@dataclass
class WatchStateStep(ProcessorStep):
    """Keeps the state as the robot reports it, for the `SmoothActionsStep` of the same policy.

    Belongs at the beginning of the preprocessor, where the state has its name and units.
    """

    pair: str = "smooth"
    """Name by which both steps of a policy find each other."""
    state: Tensor | None = field(default=None, init=False, repr=False)
    """Newest state of the robot, (batch, values); None before the first observation."""

    # LeRobot builds a policy's processors from two files, first the one with this step, and
    # gives neither to the other. So the next step to be built that smooths takes the newest of
    # its name, once: what is built for another robot later is not asked.
    _built: ClassVar[dict[str, weakref.ref[Any]]] = {}

    def __post_init__(self) -> None:
        self._built[self.pair] = weakref.ref(self)

    @classmethod
    def take_newest(cls, pair: str) -> WatchStateStep | None:
        """The step of that name that was built last; None where it is gone or taken."""
        step = cls._built.pop(pair, None)
        return None if step is None else step()

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        state = observation.get(OBS_STATE)
        if state is not None:
            self.state = torch.atleast_2d(state).detach().cpu()
        return transition

    def reset(self) -> None:
        self.state = None

    def get_config(self) -> dict[str, Any]:
        return {"pair": self.pair}

    def transform_features(self, features: _Features) -> _Features:
        return features


@dataclass
class SmoothActionsStep(ProcessorStep):
    """Keeps actions within limits of position, velocity, acceleration and jerk.

    Belongs at the end of the postprocessor, where actions have their units. Takes one action at
    a time, (batch, values), as lerobot-rollout and lerobot-eval hand them on, or whole chunks
    (batch, steps, values). A motion begins where the robot is, and anew where it is put; a
    chunk begins where the robot is on the one before. See `MotionFilter`.
    """

    fps: float
    """Actions a second, of the policy's data."""
    names: list[str]
    """Names of an action's values."""
    velocity: list[float]
    """Limit of each value [1/s]."""
    acceleration: list[float]
    """[1/s^2]"""
    jerk: list[float]
    """[1/s^3]"""
    lower: list[float | None]
    """Lowest of each value; None: no limit."""
    upper: list[float | None]
    """Highest of each value; None: no limit."""
    state_columns: list[int]
    """Columns of `observation.state` that measure each value; -1: not measured."""
    pair: str = "smooth"
    """Name of the `WatchStateStep` that tells where the robot is."""
    changes: Changes = field(init=False, repr=False)
    """Report of changes since the last reset."""

    def __post_init__(self) -> None:
        limits = {f.name: getattr(self, f.name) for f in fields(ActionLimits)}
        self._filter = MotionFilter(ActionLimits(**limits), 1.0 / self.fps)
        self._columns = np.array(self.state_columns)
        self._watch: weakref.ref[WatchStateStep] | None = None
        self.watch = WatchStateStep.take_newest(self.pair)
        self._state: MotionState | None = None
        self._chunk: np.ndarray | None = None
        self._before: np.ndarray | None = None
        self.changes = Changes(self.names)
        weakref.finalize(self, _log, self.changes)

    @property
    def watch(self) -> WatchStateStep | None:
        """The step that tells where the robot is; None: none does."""
        if self._watch is None:
            self.watch = WatchStateStep.take_newest(self.pair)
        return None if self._watch is None else self._watch()

    @watch.setter
    def watch(self, step: WatchStateStep | None) -> None:
        self._watch = None if step is None else weakref.ref(step)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        action = transition.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            return transition
        if action.shape[-1] != len(self.names):
            raise ValueError(
                f"smooth actions: the policy's actions have {action.shape[-1]} values, but "
                f"limits are given for {', '.join(self.names)}."
            )
        whole = action.dim() == 3
        asked = (action if whole else action.unsqueeze(-2)).detach().cpu().double().numpy()
        state = self._start(asked, whole)
        broken, made = self._filter.broken(state, asked), []
        for k in range(asked.shape[-2]):
            state = self._filter.step(state, asked[..., k, :])
            made.append(state.position)
        self._state, chunk = state, np.stack(made, axis=-2)
        self.changes.add(broken, np.nan_to_num(chunk - asked))
        # An acceleration takes three actions; with fewer the next chunk goes on from the state.
        self._chunk = chunk if whole and len(made) > 2 else None
        smooth = torch.from_numpy(chunk).to(action)
        return {**transition, TransitionKey.ACTION: smooth if whole else smooth.squeeze(-2)}  # pyright: ignore[reportReturnType]

    def reset(self) -> None:
        """Forget the motion: the next one begins where the robot then is."""
        _log(self.changes)
        self.changes.clear()
        self._state = self._chunk = self._before = None

    def get_config(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.init}

    def transform_features(self, features: _Features) -> _Features:
        return features

    def _start(self, asked: np.ndarray, whole: bool) -> MotionState:
        """State from which the motion continues."""
        measured = self._measured(asked)
        state = self._state
        if state is None or state.position.shape != measured.shape:
            self._before = measured
            return MotionState.moving(measured)
        if whole and self._chunk is not None:
            state = self._reached(measured, self._chunk)
        jumped = self._jumped(measured)
        self._before = measured
        return _where(jumped, MotionState.moving(measured), state)

    def _measured(self, asked: np.ndarray) -> Float[np.ndarray, "batch values"]:
        """Measured position of the robot; unmeasured values are taken as commanded."""
        here = np.nan_to_num(asked[..., 0, :])
        state = None if self.watch is None else self.watch.state
        if state is None or state.shape[0] != here.shape[0]:
            return here
        if int(self._columns.max()) >= state.shape[-1]:
            raise ValueError(
                f"smooth actions: state_columns reach {int(self._columns.max())}, but the "
                f"state has {state.shape[-1]} values."
            )
        values = state.double().numpy()[..., np.maximum(self._columns, 0)]
        return np.where(self._columns >= 0, values, here)

    def _jumped(self, measured: np.ndarray) -> Bool[np.ndarray, " batch"]:
        """True if the robot was moved by other means than its motion."""
        assert self._before is not None  # there is one as soon as there is a state
        farthest = _JUMP * self._filter.velocity / self.fps
        moved = np.abs(measured - self._before) > farthest
        return np.any(moved & (self._columns >= 0), axis=-1)

    def _reached(self, measured: np.ndarray, chunk: np.ndarray) -> MotionState:
        """State on the chunk before, where it is nearest to the robot."""
        scaled = (chunk - measured[..., None, :]) / self._filter.velocity
        seen = np.where(self._columns >= 0, scaled, 0.0)
        nearest = np.maximum(np.square(seen).sum(-1).argmin(-1), 2)
        rows = np.arange(len(chunk))
        last, middle, first = (chunk[rows, nearest - k] for k in range(3))
        velocity = (last - middle) * self.fps
        acceleration = (velocity - (middle - first) * self.fps) * self.fps
        return MotionState.moving(last, velocity, acceleration)


def _where(rows: Bool[np.ndarray, " batch"], yes: MotionState, no: MotionState) -> MotionState:
    if not rows.any():
        return no
    values = {
        name: np.where(rows[..., None], getattr(yes, name), getattr(no, name))
        for name in vars(no)
    }
    return MotionState(**values)


def _log(changes: Changes) -> None:
    if changes.steps:
        logging.info("smooth actions: %s", changes)


for _name, _step in ((WATCH, WatchStateStep), (SMOOTH, SmoothActionsStep)):
    # The same steps may be installed as a distribution of their own, and known already.
    if _name not in ProcessorStepRegistry.list():
        ProcessorStepRegistry.register(_name)(_step)


# Adding the steps to a checkpoint.

PREPROCESSOR = "policy_preprocessor.json"
POSTPROCESSOR = "policy_postprocessor.json"


def add_smoothing(checkpoint: Path, limits: ActionLimits) -> None:
    """Let a trained policy's actions be smoothed wherever its checkpoint is used.

    Steps from an earlier call are replaced. Weights and all other steps stay as they are.

    Args:
        checkpoint: Folder `pretrained_model` of a checkpoint of any policy.
        limits: Limits of its actions.

    Raises:
        FileNotFoundError: The folder holds no processors.
        ValueError: They cannot be read.
    """
    before, after = (read_pipeline(checkpoint / name) for name in (PREPROCESSOR, POSTPROCESSOR))
    watch = {"registry_name": WATCH, "config": {"pair": "smooth"}}
    smooth = {"registry_name": SMOOTH, "config": {**asdict(limits), "pair": "smooth"}}
    before["steps"].insert(0, watch)  # before a step that renames or normalises the state
    after["steps"].append(smooth)
    # Without the one that watches, the other still works: so it comes first.
    write_json(checkpoint / PREPROCESSOR, before)
    write_json(checkpoint / POSTPROCESSOR, after)


def remove_smoothing(checkpoint: Path) -> None:
    """Take the steps out again; complains as `add_smoothing`."""
    for name in (PREPROCESSOR, POSTPROCESSOR):
        write_json(checkpoint / name, read_pipeline(checkpoint / name))


def read_pipeline(path: Path, without: Sequence[str] = (WATCH, SMOOTH)) -> dict[str, Any]:
    """A pipeline's settings without the steps of these names.

    Raises:
        FileNotFoundError: It is not there.
        ValueError: It cannot be read.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no {path}: give the folder `pretrained_model` of a LeRobot checkpoint."
        )
    content = read_json(path)
    try:
        steps = content["steps"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a processor of LeRobot: {error}") from None
    content["steps"] = [s for s in steps if s.get("registry_name") not in without]
    return content
