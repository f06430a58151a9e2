"""Runners of a control step with NumPy arrays, and a fixed loop rate without drift."""

from __future__ import annotations

import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch.utils import _pytree

from hrc_learn.deploy.export import NoCompilerError, export_step
from hrc_learn.deploy.package import (
    PackedStep,
    StepLayouts,
    StepObservation,
    Steppable,
    Vectors,
    load,
    tensors_of,
)

type _Joints = Float[np.ndarray, "*batch n"]


class StepRunner(ABC):
    """A control step with its state, operated by writing into arrays.

        runner.observation["joint_position"][:] = q
        velocity = runner.step()

    Attributes:
        observation: Arrays that the step reads, by field, for example "joint_position" or
            "goals.vision.target"; flags are 0 or 1.
        joint_velocity: Command of the last step [rad/s]; overwritten by the next.
    """

    def __init__(self, layouts: StepLayouts):
        self._layouts = layouts
        self._vectors = Vectors(*(layout.empty() for layout in layouts))
        self.observation = layouts.observation.arrays(self._vectors.observation)
        self._command = layouts.command.arrays(self._vectors.command)
        self.joint_velocity: Float[np.ndarray, "*batch n"] = self._command["joint_velocity"]

    @abstractmethod
    def start(
        self,
        joint_position: _Joints,
        joint_velocity: _Joints | None = None,
        joint_acceleration: _Joints | None = None,
    ) -> None:
        """Reset the state to an arm at rest, or in motion: pass what is measured.

        Args:
            joint_position: Joint positions [rad].
            joint_velocity: Joint velocities [rad/s]; None: at rest.
            joint_acceleration: Joint accelerations [rad/s^2]; None: zero.
        """

    @abstractmethod
    def step(self) -> Float[np.ndarray, "*batch n"]:
        """Take one step with the values in `observation`.

        Returns:
            `joint_velocity`.
        """

    def observe(self, observation: StepObservation) -> None:
        """Write all fields of an observation at once."""
        vector = self._layouts.observation.pack(tensors_of(observation))
        self._vectors.observation.copy_(vector)

    def command(self, field: str) -> np.ndarray:
        """One field of the last command, for example "xi_x" or "safety.flags".

        Raises:
            ValueError: There is no such field.
        """
        return _named(field, self._command)

    def state(self, field: str) -> np.ndarray:
        """One field of the state, for example "safety.counts".

        Raises:
            ValueError: There is no such field.
        """
        return _named(field, self._layouts.state.arrays(self._state_vector()))

    def set_state(self, field: str, value: Float[np.ndarray, "..."]) -> None:
        """Replace one field of the state, for example after an arm ignored a command.

        Raises:
            ValueError: There is no such field.
        """
        vector = self._state_vector()
        _named(field, self._layouts.state.arrays(vector))[...] = value
        self._set_state_vector(vector)

    @abstractmethod
    def _state_vector(self) -> torch.Tensor:
        """The state after the last step."""

    @abstractmethod
    def _set_state_vector(self, vector: torch.Tensor) -> None:
        """Continue from a state."""


@final
class PackageRunner(StepRunner):
    """A step compiled ahead of time; a step allocates nothing.

    Numbers of the observation are NaN, and its flags 0, until they are written.
    """

    def __init__(self, package: Path):
        """Load a package written by `export_step`, in milliseconds.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: `export_step` did not write the file, or wrote it for another machine.
        """
        loaded = load(package)
        super().__init__(loaded.layouts)
        self._run = loaded.run
        self._arguments = list(self._vectors)
        self._first_state = loaded.first_state
        self._vectors.state.copy_(loaded.first_state)

    def start(
        self,
        joint_position: _Joints,
        joint_velocity: _Joints | None = None,
        joint_acceleration: _Joints | None = None,
    ) -> None:
        self._vectors.state.copy_(self._first_state)
        state = self._layouts.state.arrays(self._vectors.state)
        known = {
            "safety.position": joint_position,
            "pose_drift.joint_position": joint_position,
            "safety.velocity": joint_velocity,
            "safety.acceleration": joint_acceleration,
        }
        for field, value in known.items():
            if value is not None and field in state:
                state[field][...] = value

    def step(self) -> Float[np.ndarray, "*batch n"]:
        self._run(self._arguments)
        return self.joint_velocity

    def _state_vector(self) -> torch.Tensor:
        return self._vectors.state

    def _set_state_vector(self, vector: torch.Tensor) -> None:
        self._vectors.state.copy_(vector)


@final
class EagerRunner(StepRunner):
    """A step without compilation."""

    def __init__(self, controller: Steppable, observation: StepObservation):
        """Prepare the step; later observations have the fields of this one."""
        super().__init__(PackedStep(controller, observation).layouts)
        self._controller, self._last_command = controller, None
        self._leaves, self._structure = _pytree.tree_flatten(observation)
        views = iter(self._layouts.observation.views(self._vectors.observation))
        self._views = [
            (k, next(views), x.dtype)
            for k, x in enumerate(self._leaves)
            if isinstance(x, torch.Tensor)
        ]
        self.observe(observation)
        self.start(self.observation["joint_position"])

    def start(
        self,
        joint_position: _Joints,
        joint_velocity: _Joints | None = None,
        joint_acceleration: _Joints | None = None,
    ) -> None:
        dtype = self._layouts.observation.fields[0].dtype
        known = (joint_position, joint_velocity, joint_acceleration)
        q, *motion = (None if x is None else torch.tensor(x, dtype=dtype) for x in known)
        self._state = self._controller.initial_state(q, *motion)

    @torch.inference_mode()
    def step(self) -> Float[np.ndarray, "*batch n"]:
        for k, view, dtype in self._views:
            # A state that used the observation's memory would change with the next one.
            self._leaves[k] = view.to(dtype, copy=True)
        observation = _pytree.tree_unflatten(self._leaves, self._structure)
        self._last_command, self._state = self._controller.step(self._state, observation)
        self.joint_velocity[...] = self._last_command.joint_velocity.numpy()
        return self.joint_velocity

    def command(self, field: str) -> np.ndarray:
        if self._last_command is not None:
            vector = self._layouts.command.pack(tensors_of(self._last_command))
            self._vectors.command.copy_(vector)
        return super().command(field)

    def _state_vector(self) -> torch.Tensor:
        return self._layouts.state.pack(tensors_of(self._state))

    def _set_state_vector(self, vector: torch.Tensor) -> None:
        leaves, structure = _pytree.tree_flatten(self._state)
        read = iter(self._layouts.state.unpack(vector))
        new = [next(read) if isinstance(x, torch.Tensor) else x for x in leaves]
        self._state = _pytree.tree_unflatten(new, structure)


def _named(field: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    if field not in arrays:
        raise ValueError(f"no field {field!r}; there are {', '.join(arrays)}")
    return arrays[field]


def open_step(
    controller: Steppable, observation: StepObservation, folder: Path | None = None
) -> StepRunner:
    """The fastest available runner: compiled, or eager with a warning without a C++ compiler.

    Args:
        controller: Controller with the step.
        observation: First observation, with exactly the fields of later ones.
        folder: Folder of the packages; default: the user's cache.
    """
    try:
        runner = PackageRunner(export_step(controller, observation, folder))
    except NoCompilerError as error:
        warnings.warn(f"control steps run uncompiled and slower: {error}", stacklevel=2)
        return EagerRunner(controller, observation)
    runner.observe(observation)
    runner.start(runner.observation["joint_position"])
    return runner


# Last part of a wait, spent spinning [s]: a sleeping process wakes up late by about as much.
_SPIN = 0.0002


@final
class Rate:
    """Fixed rate of a loop, with a count of missed periods.

        rate = Rate(0.004)
        while running():
            step()
            rate.wait()

    Attributes:
        ticks: Number of returns of `wait`.
        missed: Number of skipped ticks: the loop was busy, or woken too late, until the next
            one was due.
        latest: Largest lateness of a tick so far [s].
    """

    def __init__(
        self,
        period: float,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """Start the first period.

        Args:
            period: Time between two returns of `wait` [s].
            clock: Function that returns the time [s].
            sleep: Function that waits for at least a given time [s].

        Raises:
            ValueError: The period is not positive.
        """
        if not period > 0:
            raise ValueError(f"period must be positive, but is {period}")
        self.ticks, self.missed, self.latest = 0, 0, 0.0
        self._period, self._clock, self._sleep = period, clock, sleep
        self._next = clock() + period

    def wait(self) -> float:
        """Wait for the next tick; if several are due, all but one are missed.

        Returns:
            Lateness of the first due tick [s]; more than a period if ticks are missed.
        """
        # Ticks count from the start, not from the last return, so delays do not add up.
        rest = self._next - self._clock()
        if rest > _SPIN:
            self._sleep(rest - _SPIN)
        while (now := self._clock()) < self._next:
            pass
        late = now - self._next
        skipped = int(late / self._period)
        self.ticks += 1
        self.missed += skipped
        self.latest = max(self.latest, late)
        self._next += (skipped + 1) * self._period
        return late
