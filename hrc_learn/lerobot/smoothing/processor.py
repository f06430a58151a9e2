"""Processor steps that smooth the actions of any LeRobot policy and keep them within limits.

One step watches the state of the robot, the other smooths the actions. `add_smoothing` adds
both steps to a checkpoint that was trained without them.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from hrc_learn.controller.motion_filter import MotionState
from hrc_learn.lerobot.smoothing.action_limits import ActionLimits
from hrc_learn.store import json_text, parse_json, read_json, write_json

WATCH, SMOOTH = "hrc_learn_watch_state", "hrc_learn_smooth_actions"
PREPROCESSOR = "policy_preprocessor.json"
POSTPROCESSOR = "policy_postprocessor.json"

_JUMP = 5.0
"""If the robot moved faster than this multiple of the velocity limit, it was not moved by
actions, but for example by a person before a new episode."""
_SAME = 1e-6
"""Changes of an action up to this value count as rounding."""

_Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


class Changes:
    """Counts the actions that smoothing changed, and keeps the largest changes.

    Attributes:
        steps: Number of returned actions.
        changed: Number of actions that were changed.
        largest: Largest change of each value, in its unit.
    """

    def __init__(self, names: list[str]):
        self.names = tuple(names)
        self.clear()

    def clear(self) -> None:
        """Start over."""
        self.steps = self.changed = 0
        self.largest = np.zeros(len(self.names))

    def add(self, change: Float[np.ndarray, "*batch D"]) -> None:
        """Count the differences between returned and requested actions."""
        change = np.abs(change).reshape(-1, len(self.names))
        self.steps += len(change)
        self.changed += int((change > _SAME).any(-1).sum())
        self.largest = np.maximum(self.largest, change.max(0))

    def __str__(self) -> str:
        most = int(self.largest.argmax())
        return (
            f"{self.changed} of {self.steps} actions changed, by at most "
            f"{self.largest[most]:.4g} ({self.names[most]})"
        )


@dataclass
class WatchStateStep(ProcessorStep):
    """Keeps the state that the robot reports, for the `SmoothActionsStep` of the same policy.

    This step belongs at the beginning of the preprocessor, where the state still has its
    original name and units.
    """

    state: Tensor | None = field(default=None, init=False, repr=False)
    """Newest state of the robot, (batch, values); None before the first observation."""
    previous: Tensor | None = field(default=None, init=False, repr=False)
    """State before `state`; it may be older than the last reset."""

    # LeRobot builds a policy's two processors from two files: first the preprocessor with this
    # step, then the postprocessor with the `SmoothActionsStep`. Neither gets a reference to the
    # other. So a new `SmoothActionsStep` takes the newest `WatchStateStep`, if it still exists.
    # A step is taken only once, so that steps built later for another robot do not get it.
    _newest: ClassVar[weakref.ref[Any] | None] = None

    def __post_init__(self) -> None:
        self._last: Tensor | None = None
        WatchStateStep._newest = weakref.ref(self)

    @classmethod
    def take_newest(cls) -> WatchStateStep | None:
        """The step that was built last; None if it no longer exists or was taken before."""
        step, WatchStateStep._newest = cls._newest, None
        return None if step is None else step()

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        state = observation.get(OBS_STATE)
        if state is not None:
            self.previous = self._last
            self.state = self._last = torch.atleast_2d(state).detach().cpu()
        return transition

    def reset(self) -> None:
        self.state = None

    def get_config(self) -> dict[str, Any]:
        return {}

    def transform_features(self, features: _Features) -> _Features:
        return features


class SmoothActionsStep(ProcessorStep):
    """Keeps actions within limits of position, velocity, acceleration and jerk.

    This step belongs at the end of the postprocessor, where actions have their units. It takes
    one action at a time, (batch, values), as lerobot-rollout and lerobot-eval pass them on, or
    whole chunks (batch, steps, values). A motion starts with the measured position and
    velocity, and restarts after the robot was moved by other means. A chunk starts at the point
    of the previous chunk that is nearest to the robot. A value is held until it is measured for
    the first time. Later, it continues its motion while its measurement is not finite.

    Attributes:
        limits: Limits of the actions.
        watch: Step that reports the robot's state, built earlier; None: there is none.
        changes: Report of changes since the last reset.
    """

    def __init__(self, **limits: Any):
        """Set the limits; the motion starts with the first action.

        Args:
            limits: Fields of `ActionLimits`, as checkpoints keep them.
        """
        text = json_text(limits)
        self.limits = parse_json(text, ActionLimits, "limits of smooth actions")
        self._filter = self.limits.motion_filter(1.0 / self.limits.fps)
        self._columns = np.array(self.limits.state_columns)
        self.watch = WatchStateStep.take_newest()
        self.changes = Changes(self.limits.names)
        self._state: MotionState | None = None
        self._chunk: np.ndarray | None = None
        weakref.finalize(self, _log, self.changes)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        action = transition.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            return transition
        if action.shape[-1] != len(self.limits.names):
            raise ValueError(
                f"smooth actions: the policy's actions have {action.shape[-1]} values, but "
                f"limits are given for {', '.join(self.limits.names)}."
            )
        whole = action.dim() == 3
        asked = (action if whole else action.unsqueeze(-2)).detach().cpu().double().numpy()
        state, held = self._start(asked, whole)
        asked = np.where(held[:, None], state.position[:, None], asked)
        made = []
        for k in range(asked.shape[-2]):
            state = self._filter.step(state, asked[..., k, :])
            made.append(state.position)
        self._state, chunk = state, np.stack(made, axis=-2)
        self.changes.add(np.nan_to_num(chunk - asked))
        # An acceleration needs three actions; after fewer, the state itself is continued.
        self._chunk = chunk if whole and len(made) > 2 else None
        smooth = torch.from_numpy(chunk).to(action)
        return {**transition, TransitionKey.ACTION: smooth if whole else smooth.squeeze(-2)}  # pyright: ignore[reportReturnType]

    def reset(self) -> None:
        """Forget the motion: the next motion begins at the robot's position at that time."""
        _log(self.changes)
        self.changes.clear()
        self._state = self._chunk = None

    def get_config(self) -> dict[str, Any]:
        return asdict(self.limits)

    def transform_features(self, features: _Features) -> _Features:
        return features

    def _start(self, asked: np.ndarray, whole: bool) -> tuple[MotionState, np.ndarray]:
        """State from which the motion continues, and True for values that must be held."""
        here = np.nan_to_num(asked[..., 0, :])
        seen = self._measured(len(here))
        unknown = np.full_like(here, np.nan)
        measured, velocity = (unknown, unknown) if seen is None else seen
        finite = np.isfinite(measured)
        state = self._state
        if state is None or state.position.shape != here.shape:
            self._before = unknown
            start = np.where(finite, measured, here)
            state = MotionState.moving(start, np.where(finite, velocity, 0.0))
        else:
            if whole and self._chunk is not None:
                state = self._reached(np.where(finite, measured, here), finite, self._chunk)
            # Restart if a value is measured for the first time, or if the robot was moved by
            # other means.
            first = finite & np.isnan(self._before)
            farthest = _JUMP * self._filter.velocity / self.limits.fps
            jumped = (np.abs(measured - self._before) > farthest).any(-1, keepdims=True)
            state = _restarted(first | (jumped & finite), measured, state)
        self._before = np.where(finite, measured, self._before)
        held = np.isnan(self._before) & (self._columns >= 0) & (seen is not None)
        return state, held

    def _measured(self, batch: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Measured positions (NaN: not measured) and velocities, (batch, values) each.

        The velocity is the difference of two successive states. It is set to zero if any value
        exceeds its limit.
        """
        watch = self.watch
        state = None if watch is None else watch.state
        if watch is None or state is None or len(state) != batch:
            return None
        if int(self._columns.max()) >= state.shape[-1]:
            raise ValueError(
                f"smooth actions: state_columns reach {int(self._columns.max())}, but the "
                f"state has {state.shape[-1]} values."
            )
        previous = watch.previous
        if previous is None or previous.shape != state.shape:
            previous = state
        now, before = (
            np.where(self._columns >= 0, x.double().numpy()[:, self._columns], np.nan)
            for x in (state, previous)
        )
        velocity = np.nan_to_num((now - before) * self.limits.fps)
        slow = (np.abs(velocity) <= self._filter.velocity).all(-1, keepdims=True)
        return now, np.where(slow, velocity, 0.0)

    def _reached(self, here: np.ndarray, finite: np.ndarray, chunk: np.ndarray) -> MotionState:
        """State at the point of the previous chunk that is nearest to the robot.

        Args:
            here: Positions of the robot, (batch, values).
            finite: True for measured values.
            chunk: Previous chunk, (batch, steps, values).
        """
        scaled = (chunk - here[..., None, :]) / self._filter.velocity
        seen = np.where((finite | ~finite.any(-1, keepdims=True))[:, None], scaled, 0.0)
        nearest = np.maximum(np.square(seen).sum(-1).argmin(-1), 2)
        rows = np.arange(len(chunk))
        last, middle, first = (chunk[rows, nearest - k] for k in range(3))
        velocity = (last - middle) * self.limits.fps
        acceleration = (velocity - (middle - first) * self.limits.fps) * self.limits.fps
        return MotionState.moving(last, velocity, acceleration)


def _restarted(
    restarted: Bool[np.ndarray, "batch values"],
    position: Float[np.ndarray, "batch values"],
    state: MotionState,
) -> MotionState:
    """The state, with the values marked by `restarted` at rest at other positions."""
    if not restarted.any():
        return state
    rest = vars(MotionState.moving(np.where(restarted, position, state.position)))
    return MotionState(**{k: np.where(restarted, rest[k], x) for k, x in vars(state).items()})


def _log(changes: Changes) -> None:
    if changes.steps:
        logging.info("smooth actions: %s", changes)


ProcessorStepRegistry.register(WATCH)(WatchStateStep)
ProcessorStepRegistry.register(SMOOTH)(SmoothActionsStep)


def add_smoothing(checkpoint: str | Path, limits: ActionLimits) -> None:
    """Add smoothing of the actions to a trained policy's checkpoint.

    Steps from an earlier call are replaced. Weights and all other steps stay as they are.

    Args:
        checkpoint: Folder `pretrained_model` of a checkpoint of any policy.
        limits: Limits of its actions.

    Raises:
        FileNotFoundError: The folder holds no processors.
        ValueError: A processor cannot be read, or the limits do not fit the policy's actions.
    """
    checkpoint = Path(checkpoint)
    _require_width(checkpoint, limits)
    before, after = (read_pipeline(checkpoint / name) for name in (PREPROCESSOR, POSTPROCESSOR))
    watch = {"registry_name": WATCH, "config": {}}
    smooth = {"registry_name": SMOOTH, "config": asdict(limits)}
    before["steps"].insert(0, watch)  # before a step that renames or normalises the state
    after["steps"].append(smooth)
    # Write the watch first: it has no effect if the second file is never written.
    write_json(checkpoint / PREPROCESSOR, before)
    write_json(checkpoint / POSTPROCESSOR, after)


def _require_width(checkpoint: Path, limits: ActionLimits) -> None:
    path = checkpoint / "config.json"
    config = read_json(path) if path.is_file() else {}
    feature = (config.get("output_features") or {}).get(ACTION) or {}
    width = (feature.get("shape") or [None])[0]
    if width not in (None, len(limits.names)):
        raise ValueError(
            f"the policy of {checkpoint} has {width} values in an action, but the limits are "
            f"those of {', '.join(limits.names)}: give the dataset that it was trained on"
        )


def remove_smoothing(checkpoint: str | Path) -> None:
    """Remove the steps of `add_smoothing`; raises the errors of `read_pipeline`."""
    for name in (PREPROCESSOR, POSTPROCESSOR):
        write_json(Path(checkpoint, name), read_pipeline(Path(checkpoint, name)))


def read_pipeline(path: str | Path, without: Sequence[str] = (WATCH, SMOOTH)) -> dict[str, Any]:
    """Settings of a processor pipeline without the steps of these names.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be read.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(
            f"there is no {path}: give the folder `pretrained_model` of a LeRobot checkpoint."
        )
    content = read_json(path)
    if not isinstance(content.get("steps"), list):
        raise ValueError(f"{path} is not a processor of LeRobot: it lists no steps")
    content["steps"] = [s for s in content["steps"] if s.get("registry_name") not in without]
    return content
