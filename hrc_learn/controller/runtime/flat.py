"""The control step as a function of plain tensors with names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.controller import AdaptiveController
from hrc_learn.controller.interface import Observation

STATE, OBSERVATION, COMMAND = "state", "observation", "command"
"""What the names of tensors begin with."""


@dataclass(frozen=True, kw_only=True)
class Example:
    """Named tensors of one step, in the order in which the step takes and returns them."""

    state: dict[str, Tensor]
    """Of an arm at rest in the observed joint position."""
    observation: dict[str, Tensor]
    command: dict[str, Tensor]
    """Their values mean nothing, their shapes and dtypes do."""

    @property
    def inputs(self) -> list[Tensor]:
        """What the step takes."""
        return [*self.state.values(), *self.observation.values()]


@final
class FlatStep(nn.Module):
    """`AdaptiveController.step` on flat lists of tensors.

    It takes the tensors of the state, then those of the observation, and returns those of the
    command, then those of the next state. What an observation leaves out, and a `dt` that is
    a number, are constants.
    """

    def __init__(self, controller: AdaptiveController, observation: Observation):
        """Take the structure of a step from an example.

        Args:
            controller: Whose step.
            observation: With exactly the fields that later ones will have.
        """
        super().__init__()
        self.controller = controller
        state = controller.initial_state(observation.joint_position)
        named_state = _named(STATE, state)
        named_observation = _named(OBSERVATION, observation)
        leaves, self._structure = _pytree.tree_flatten((state, observation))
        self._constants = [None if isinstance(x, Tensor) else x for x in leaves]
        with torch.no_grad():
            command, _ = controller.step(state, observation)
        self.example = Example(
            state=named_state, observation=named_observation, command=_named(COMMAND, command)
        )

    def forward(self, *inputs: Tensor) -> list[Tensor]:
        """One step."""
        tensors = iter(inputs)
        leaves = [next(tensors) if x is None else x for x in self._constants]
        state, observation = _pytree.tree_unflatten(leaves, self._structure)
        command, state = self.controller.step(state, observation)
        # Copies: a state that shares memory with an observation would change with the next.
        # Contiguous as the example is: compiled code reads other layouts wrongly, unchecked.
        kept = [_copy(x) for x in _pytree.tree_leaves(state)]
        return [*_pytree.tree_leaves(command), *kept]


def _named(prefix: str, tree: Any) -> dict[str, Tensor]:
    """Copies of the tensors of a tree by their path, as in "state.safety.velocity"."""
    leaves, _ = _pytree.tree_flatten_with_path(tree)
    # Copies: an export takes one tensor in two places for one input.
    return {
        prefix + _pytree.keystr(path): _copy(x.detach())
        for path, x in leaves
        if isinstance(x, Tensor)
    }


def _copy(x: Tensor) -> Tensor:
    return x.clone(memory_format=torch.contiguous_format)
