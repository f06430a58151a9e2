"""Run a control step on NumPy arrays, and run a loop at a fixed rate without drift."""

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import final

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.deploy.export import export_step
from hrc_learn.deploy.package import (
    IOLayout,
    PackedStep,
    StepLayouts,
    StepObservation,
    Steppable,
    Vectors,
    load,
    tensors_of,
)
from hrc_learn.deploy.scalar_program import UnknownOperationError

type _Joints = Float[np.ndarray, "*batch n"]


class StepRunner:
    """A control step with its state. The caller writes the observation into arrays.

        runner.observation["joint_position"][:] = q
        velocity = runner.step()

    Numbers of the observation are NaN, and its flags 0, until they are written.

    Attributes:
        observation: Arrays that the step reads, by field, for example "joint_position" or
            "goals.vision.target"; flags are 0 or 1.
        state: Fields of the state, for example "safety.counts"; they can be overwritten, for
            example after an arm has ignored a command.
        command: Fields of the last command, for example "xi_x" or "safety.flags"; overwritten
            by the next step.
        joint_velocity: Field "joint_velocity" of the command [rad/s].
    """

    def __init__(
        self,
        run: Callable[[list[torch.Tensor]], object],
        layouts: StepLayouts,
        first_state: torch.Tensor,
    ):
        """Prepare the vectors.

        Args:
            run: Function of the vectors of state, observation and command that updates state
                and command in place.
            layouts: Layouts of the vectors.
            first_state: State of an arm at rest.
        """
        self._run, self._layouts, self._first_state = run, layouts, first_state
        self._vectors = Vectors(*(layout.empty() for layout in layouts))
        self._vectors.state.copy_(first_state)
        self._arguments = list(self._vectors)
        self.state, self.observation, self.command = (
            layout.arrays(vector) for layout, vector in zip(layouts, self._vectors, strict=True)
        )
        self.joint_velocity: _Joints = self.command["joint_velocity"]

    def start(
        self,
        joint_position: _Joints,
        joint_velocity: _Joints | None = None,
        joint_acceleration: _Joints | None = None,
    ) -> None:
        """Reset the state to an arm at rest, or in the measured motion.

        Args:
            joint_position: Joint positions [rad].
            joint_velocity: Joint velocities [rad/s]; None: at rest.
            joint_acceleration: Joint accelerations [rad/s^2]; None: zero.
        """
        self._vectors.state.copy_(self._first_state)
        known = {
            "safety.position": joint_position,
            "pose_drift.joint_position": joint_position,
            "safety.velocity": joint_velocity,
            "safety.acceleration": joint_acceleration,
        }
        for field, value in known.items():
            if value is not None and field in self.state:
                self.state[field][...] = value

    def step(self) -> _Joints:
        """Take one step with the values in `observation`.

        Returns:
            `joint_velocity`.
        """
        self._run(self._arguments)
        return self.joint_velocity

    def observe(self, observation: StepObservation) -> None:
        """Write all fields of an observation at once.

        Raises:
            ValueError: The observation has other fields than the step reads.
        """
        layout = self._layouts.observation
        given = IOLayout.of(observation, layout.batch)
        if wrong := sorted(given.rows.keys() ^ layout.rows.keys()):
            fields = ", ".join(wrong)
            raise ValueError(f"only the step or only the observation has the field {fields}")
        self._vectors.observation.copy_(layout.pack(tensors_of(observation)))


@final
class PackageRunner(StepRunner):
    """A control step compiled ahead of time, which allocates no memory."""

    def __init__(self, package: str | Path):
        """Load machine code written by `export_step`, in milliseconds.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file was not written by this library, has changed since, or was
                written for another machine.
        """
        super().__init__(*load(Path(package)))


@final
class EagerRunner(StepRunner):
    """A control step without compilation."""

    def __init__(self, controller: Steppable, observation: StepObservation):
        """Prepare the step; later observations must have the same fields as `observation`."""
        self._packed = PackedStep(controller, observation)
        layouts = self._packed.layouts
        super().__init__(self._run_eagerly, layouts, self._packed.first_state)
        # Fields of the state are written while others are still read: read from a copy.
        self._before = self._vectors.state.clone()
        parts = zip((layouts.state, *layouts), (self._before, *self._vectors), strict=True)
        self._views = [layout.views(vector) for layout, vector in parts]
        self._dtypes = [x.dtype for x in layouts.state.fields + layouts.observation.fields]
        self.observe(observation)
        self.start(self.observation["joint_position"])

    @torch.inference_mode()
    def _run_eagerly(self, vectors: list[torch.Tensor]) -> None:
        self._before.copy_(vectors[0])
        before, state, observation, command = self._views
        read = zip(before + observation, self._dtypes, strict=True)
        read = [x if x.dtype == dtype else x.to(dtype) for x, dtype in read]
        results = self._packed.stepped(read)
        torch._foreach_copy_(command + state, results)


def open_step(
    controller: Steppable, observation: StepObservation, folder: str | Path | None = None
) -> StepRunner:
    """The fastest available runner: compiled, or uncompiled with a warning.

    The step runs uncompiled if it uses an operation without machine code.

    Args:
        controller: Controller with the step.
        observation: First observation, with exactly the fields of later ones.
        folder: Folder of the compiled steps; default: the user's cache.
    """
    try:
        runner = PackageRunner(export_step(controller, observation, folder))
    except UnknownOperationError as error:
        warnings.warn(f"control steps run uncompiled and slower: {error}", stacklevel=2)
        return EagerRunner(controller, observation)
    runner.observe(observation)
    runner.start(runner.observation["joint_position"])
    return runner


# Last part of a wait, spent in a busy loop [s]: sleeping processes wake up too late by about
# this time.
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
        missed: Number of skipped ticks. A tick is skipped if the loop was busy, or woke up too
            late, until the following tick was due.
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
        longest = self._period
        while (rest := self._next - self._clock()) > 0:
            if rest > _SPIN:
                self._sleep(min(rest - _SPIN, longest))
            # After the first sleep, sleep briefly: a clock such as an arm's advances in steps.
            longest = _SPIN
        late = -rest
        skipped = int(late / self._period)
        self.ticks += 1
        self.missed += skipped
        self.latest = max(self.latest, late)
        self._next += (skipped + 1) * self._period
        return late
