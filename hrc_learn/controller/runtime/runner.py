"""Runs a control step in a loop, NumPy in and out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.controller import AdaptiveController
from hrc_learn.controller.interface import Observation
from hrc_learn.controller.runtime.export import NoCompilerError, export_step, read_example
from hrc_learn.controller.runtime.flat import COMMAND, OBSERVATION, STATE, Example, FlatStep

_POSITIONS = (f"{STATE}.safety.position", f"{STATE}.hold.joint_position")


@final
class StepRunner:
    """A control step with its state, driven by writing into arrays.

        runner.observation["joint_position"][:] = q
        velocity = runner.step()

    Attributes:
        observation: Arrays to write each observation into, by field, as in "joint_position" or
            "goals.vision.target". They share memory with what the step reads.
        joint_velocity: What the last step commands [rad/s]; overwritten by the next.
    """

    def __init__(self, run: Callable[[list[Tensor]], list[Tensor]], example: Example):
        """Bind a step to its arrays.

        Args:
            run: From the tensors of state and observation to those of command and next state.
            example: Of them.
        """
        self._run = run
        self._first = list(example.state.values())
        self._index = {name: k for k, name in enumerate(example.state)}
        self._observation = list(example.observation.values())
        self.observation = {
            name.removeprefix(f"{OBSERVATION}."): x.numpy()
            for name, x in example.observation.items()
        }
        self._commands = {
            name.removeprefix(f"{COMMAND}."): k for k, name in enumerate(example.command)
        }
        self._count = len(self._commands)
        self._velocity_index = self._commands["joint_velocity"]
        self._velocity = torch.zeros_like(example.command[f"{COMMAND}.joint_velocity"])
        self.joint_velocity: Float[np.ndarray, "*batch n"] = self._velocity.numpy()
        self._outputs = list(example.command.values())
        self.start(self.observation["joint_position"])

    @classmethod
    def load(cls, package: Path) -> StepRunner:
        """Load what `export_step` wrote, in milliseconds.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not a package of ours.
        """
        example = read_example(package)  # first: it tells foreign files apart
        return cls(open_package(package), example)

    @classmethod
    def eager(cls, controller: AdaptiveController, observation: Observation) -> StepRunner:
        """The same step uncompiled; observations have the fields of the example."""
        step = FlatStep(controller, observation)
        return cls(torch.inference_mode()(lambda inputs: step(*inputs)), step.example)

    def start(self, joint_position: Float[np.ndarray, "*batch n"]) -> None:
        """Forget everything: the arm is at rest in a joint position [rad]."""
        self._state = [x.clone() for x in self._first]
        for name in _POSITIONS:
            self._state[self._index[name]].copy_(torch.as_tensor(joint_position))

    def step(self) -> Float[np.ndarray, "*batch n"]:
        """Take one step on what stands in `observation`.

        Returns:
            `joint_velocity`.
        """
        outputs = self._run(self._state + self._observation)
        self._velocity.copy_(outputs[self._velocity_index])
        self._outputs, self._state = outputs[: self._count], outputs[self._count :]
        return self.joint_velocity

    def command(self, field: str) -> np.ndarray:
        """One field of the last command, as in "xi_x" or "safety.flags".

        Raises:
            ValueError: There is no such field.
        """
        if field not in self._commands:
            raise ValueError(f"no field {field!r}; there are {', '.join(self._commands)}")
        return self._outputs[self._commands[field]].numpy()


def open_step(
    controller: AdaptiveController, observation: Observation, folder: Path | None = None
) -> StepRunner:
    """The fastest runner there is: compiled, or eager with a warning without a C++ compiler.

    Args:
        controller: Whose step.
        observation: An example with exactly the fields that later ones will have.
        folder: Where packages are kept; default: the user's cache.
    """
    try:
        return StepRunner.load(export_step(controller, observation, folder))
    except NoCompilerError as error:
        warnings.warn(f"control steps run uncompiled and slower: {error}", stacklevel=2)
        return StepRunner.eager(controller, observation)


def open_package(package: Path) -> Callable[[list[Tensor]], list[Tensor]]:
    """What runs a package: from the inputs of `FlatStep` to its outputs."""
    try:
        # Private, but ready in milliseconds; the public loader probes compilers for seconds.
        loader: Any = torch._C._aoti.AOTIModelPackageLoader  # pyright: ignore
        return loader(str(package), "model", False, 1, -1).run
    except (AttributeError, TypeError):
        model = torch._inductor.aoti_load_package(str(package))
        return lambda inputs: list(model(*inputs))
