"""Smooth, limit-checked actions for any policy, as steps of its processors.

One step watches where the robot is, one smooths what it is sent; `add_smoothing` adds both to a
checkpoint that was trained without them.
"""

from __future__ import annotations

import json
import logging
import math
import weakref
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import torch
from jaxtyping import Bool, Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from hrc_learn.controller import (
    LIMIT_KINDS,
    ActionChunkFilter,
    ActionChunkReport,
    ActionChunkState,
)
from hrc_learn.kinematics import MotionLimits
from hrc_learn.lerobot.action_limits import ActionLimits
from hrc_learn.store import new_file

# What smoothing has changed, added up.

_SAME = 1e-6
"""Changes below this are rounding."""


class Changes:
    """Counts and the largest changes, over many actions.

    Attributes:
        steps: Actions handed out.
        changed: Of them, those that differ from what was asked for.
        broken: Of them, those asked for that would have broken each of `LIMIT_KINDS`.
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

    def add(self, report: ActionChunkReport) -> None:
        """Count what was done to a chunk."""
        change = report.change.abs().reshape(-1, len(self.names))
        self.steps += len(change)
        self.changed += int((change > _SAME).any(-1).sum())
        broken = report.broken.flatten(0, -2).sum(0).tolist()
        for kind, count in zip(LIMIT_KINDS, broken, strict=True):
            self.broken[kind] += count
        for name, most in zip(self.names, torch.amax(change, 0).tolist(), strict=True):
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


@ProcessorStepRegistry.register(WATCH)
@dataclass
class WatchStateStep(ProcessorStep):
    """Keeps the state as the robot reports it, for the `SmoothActionsStep` of the same name.

    Belongs at the beginning of the preprocessor, where the state has its name and units.
    """

    pair: str = "smooth"
    """Name that both steps of a policy share."""
    state: Tensor | None = field(default=None, init=False, repr=False)
    """Newest state of the robot, (batch, values); None before the first observation."""

    # LeRobot builds both steps of a policy from files, each without the other: the one that
    # smooths finds the one that watches by name, for as long as somebody holds it.
    _alive: ClassVar[WeakValueDictionary[str, Any]] = WeakValueDictionary()

    def __post_init__(self) -> None:
        self._alive[self.pair] = self

    @classmethod
    def newest_state(cls, pair: str) -> Tensor | None:
        """What the step of that name saw last; None where no such step is in use."""
        step = cls._alive.get(pair)
        return None if step is None else step.state

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


@ProcessorStepRegistry.register(SMOOTH)
@dataclass
class SmoothActionsStep(ProcessorStep):
    """Keeps actions within limits of position, velocity, acceleration and jerk.

    Belongs at the end of the postprocessor, where actions have their units. Takes one action at
    a time, (batch, values), as lerobot-rollout and lerobot-eval hand them on, or whole chunks
    (batch, steps, values). A motion begins where the robot is, and anew where it is put; a
    chunk begins where the robot is on the one before. See `ActionChunkFilter`.
    """

    fps: float
    """Actions a second, of the policy's data."""
    names: list[str]
    """Of an action's values."""
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
    """Where each value is measured in `observation.state`; -1: nowhere."""
    pair: str = "smooth"
    """Name of the `WatchStateStep` that tells where the robot is."""
    changes: Changes = field(init=False, repr=False)
    """What was changed since the last reset."""

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "jerk", "lower", "upper", "state_columns"):
            if len(getattr(self, name)) != len(self.names):
                raise ValueError(
                    f"smooth actions: {name} must have one entry for each of "
                    f"{', '.join(self.names)}, but has {len(getattr(self, name))}."
                )
        limits = MotionLimits(
            lower=_tensor(self.lower, missing=-math.inf),
            upper=_tensor(self.upper, missing=math.inf),
            velocity=_tensor(self.velocity),
            acceleration=_tensor(self.acceleration),
            jerk=_tensor(self.jerk),
        )
        self._smoother = ActionChunkFilter(limits, 1.0 / self.fps)
        self._columns = torch.tensor(self.state_columns)
        self._state: ActionChunkState | None = None
        self._chunk: Tensor | None = None
        self._before: Tensor | None = None
        self.changes = Changes(self.names)
        weakref.finalize(self, _log, self.changes)

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
        chunk = (action if whole else action.unsqueeze(-2)).detach().cpu()
        with torch.inference_mode():
            state = self._start(chunk, whole)
            smooth, self._state, report = self._smoother(chunk, state)
        self.changes.add(report)
        # An acceleration takes three actions; with fewer the next chunk goes on from the state.
        self._chunk = smooth.to(torch.float64) if whole and smooth.shape[-2] > 2 else None
        smooth = smooth.to(action)
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

    def _start(self, chunk: Tensor, whole: bool) -> ActionChunkState:
        """Where the motion goes on from."""
        measured = self._measured(chunk)
        fresh = self._smoother.initial_state(measured)
        if self._state is None or self._state.position.shape != measured.shape:
            self._before = measured
            return fresh
        state = self._state
        if whole and self._chunk is not None:
            state = self._reached(measured, self._chunk)
        jumped = self._jumped(measured)
        self._before = measured
        return _where(jumped, fresh, state) if jumped.any() else state

    def _measured(self, chunk: Tensor) -> Float[Tensor, "batch values"]:
        """Where the robot is; values that are not measured are where they are sent."""
        here = chunk[..., 0, :].to(torch.float64)
        state = WatchStateStep.newest_state(self.pair)
        if state is None or state.shape[0] != here.shape[0]:
            return here
        if int(self._columns.max()) >= state.shape[-1]:
            raise ValueError(
                f"smooth actions: state_columns reach {int(self._columns.max())}, but the "
                f"state has {state.shape[-1]} values."
            )
        values = state[..., self._columns.clamp(min=0)].to(here)
        return torch.where(self._columns >= 0, values, here)

    def _jumped(self, measured: Tensor) -> Bool[Tensor, " batch"]:
        """Whether the robot was put somewhere, which no motion explains."""
        assert self._before is not None  # there is one as soon as there is a state
        farthest = _JUMP * self._smoother.barrier.velocity / self.fps
        moved = (measured - self._before).abs() > farthest
        return (moved & (self._columns >= 0)).any(-1)

    def _reached(self, measured: Tensor, chunk: Tensor) -> ActionChunkState:
        """State on the chunk before, where it is nearest to the robot."""
        scaled = (chunk - measured.unsqueeze(-2)) / self._smoother.barrier.velocity
        seen = torch.where(self._columns >= 0, scaled, 0.0)
        nearest = seen.square().sum(-1).argmin(-1).clamp(min=2)
        rows = torch.arange(len(chunk))
        last, middle, first = (chunk[rows, nearest - k] for k in range(3))
        velocity = (last - middle) * self.fps
        state = self._smoother.initial_state(last, velocity)
        acceleration = (velocity - (middle - first) * self.fps) * self.fps
        return replace(state, acceleration=acceleration)


def _tensor(values: Sequence[float | None], missing: float = math.nan) -> Float[Tensor, " n"]:
    return torch.tensor([missing if v is None else v for v in values], dtype=torch.float64)


def _where(
    rows: Bool[Tensor, " batch"], yes: ActionChunkState, no: ActionChunkState
) -> ActionChunkState:
    values = {
        name: torch.where(rows.unsqueeze(-1), getattr(yes, name), getattr(no, name))
        for name in vars(no)
    }
    return replace(no, **values)


def _log(changes: Changes) -> None:
    if changes.steps:
        logging.info("smooth actions: %s", changes)


# Adding the steps to a checkpoint.

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"


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
    before, after = (read_pipeline(checkpoint / name) for name in (PREPROCESSOR, POSTPROCESSOR))
    watch = {"registry_name": WATCH, "config": {"pair": "smooth"}}
    smooth = {"registry_name": SMOOTH, "config": {**asdict(limits), "pair": "smooth"}}
    before["steps"].insert(0, watch)  # before a step that renames or normalises the state
    after["steps"].append(smooth)
    # Without the one that watches, the other still works: so it comes first.
    write_pipeline(checkpoint / PREPROCESSOR, before)
    write_pipeline(checkpoint / POSTPROCESSOR, after)


def remove_smoothing(checkpoint: Path) -> None:
    """Take the steps out again; complains as `add_smoothing`."""
    for name in (PREPROCESSOR, POSTPROCESSOR):
        write_pipeline(checkpoint / name, read_pipeline(checkpoint / name))


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
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        steps = content["steps"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a processor of LeRobot: {error}") from None
    content["steps"] = [s for s in steps if s.get("registry_name") not in without]
    return content


def write_pipeline(path: Path, content: dict[str, Any]) -> None:
    """Write a pipeline's settings; the file is whole or as it was."""
    with new_file(path) as new:
        new.write_text(json.dumps(content, indent=2), encoding="utf-8")
