"""The control step as a function of three vectors of numbers."""

from __future__ import annotations

from typing import NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller.controller import AdaptiveController
from hrc_learn.controller.interface import Observation
from hrc_learn.controller.runtime.layout import Layout


class Vectors(NamedTuple):
    """What a step takes, in this order."""

    state: Tensor
    observation: Tensor
    command: Tensor


class Layouts(NamedTuple):
    """Where everything stands in them."""

    state: Layout
    observation: Layout
    command: Layout


@final
class FlatStep(nn.Module):
    """`AdaptiveController.step` on vectors, in place.

    It reads the vectors of state and observation, and writes those of the command and of the
    next state. What an observation leaves out, and a `dt` that is a number, are constants.
    """

    def __init__(self, controller: AdaptiveController, observation: Observation):
        """Take the structure of a step from an example.

        Args:
            controller: Whose step.
            observation: With exactly the fields that later ones will have. The vectors are of
                the dtype of its joint position.
        """
        super().__init__()
        self.controller = controller
        q = observation.joint_position
        state = controller.initial_state(controller.chain.ready.to(q).expand_as(q))
        with torch.no_grad():
            command, _ = controller.step(state, observation)
        leaves, self._structure = _pytree.tree_flatten((state, observation))
        self._constants = [None if isinstance(x, Tensor) else x for x in leaves]
        trees = (state, observation, command)
        self.layouts = Layouts(*(Layout.of(tree, q.shape[:-1], q.dtype) for tree in trees))
        self.first_state = self.layouts.state.pack(tensors_of(state))

    def example(self, observation: Observation) -> Vectors:
        """Vectors before the first step: at rest in the ready posture."""
        return Vectors(
            self.first_state.clone(),
            self.layouts.observation.pack(tensors_of(observation)),
            self.layouts.command.empty(),
        )

    def forward(
        self,
        state: Float[Tensor, "states *batch"],
        observation: Float[Tensor, "observations *batch"],
        command: Float[Tensor, "commands *batch"],
    ) -> None:
        """One step."""
        layouts = self.layouts
        read = iter(layouts.state.unpack(state) + layouts.observation.unpack(observation))
        leaves = [next(read) if x is None else x for x in self._constants]
        said, following = self.controller.step(*_pytree.tree_unflatten(leaves, self._structure))
        command.copy_(layouts.command.pack(tensors_of(said)))
        state.copy_(layouts.state.pack(tensors_of(following)))


def tensors_of(tree: object) -> list[Tensor]:
    """The tensors in a pytree."""
    return [x for x in _pytree.tree_leaves(tree) if isinstance(x, Tensor)]
