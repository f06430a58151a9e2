"""The control step as a function of vectors, and the layout of its named tensors in them.

Code compiled for real time takes and returns a few vectors of numbers, not dataclasses: any
language can fill them, and nothing is allocated in a step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller import AdaptiveController, Observation


@dataclass(frozen=True)
class Field:
    """One of the tensors."""

    name: str
    """Path in the dataclass, as in "safety.flags"."""
    dtype: torch.dtype
    batched: bool
    """False: one value for the whole batch."""
    shape: tuple[int, ...]
    """Without the batch where there is one."""


@final
class IOLayout:
    """Where the tensors of a dataclass stand in a vector (rows, *batch).

    The batch comes last in memory: a row is one quantity of all its elements, which is what
    vector instructions work on. All numbers are of one dtype, and flags are 0 or 1.
    """

    def __init__(
        self,
        fields: Sequence[Field],
        batch: Sequence[int],
        dtype: torch.dtype = torch.float64,
    ):
        self.fields, self.batch, self.dtype = tuple(fields), tuple(batch), dtype
        edges = np.cumsum([0, *(math.prod(field.shape) for field in fields)]).tolist()
        self.size: int = edges[-1]
        """Number of rows."""
        names = (field.name for field in fields)
        self.rows = dict(zip(names, (slice(*ends) for ends in pairwise(edges)), strict=True))
        """Of each field."""

    @staticmethod
    def of(tree: Any, batch: Sequence[int], dtype: torch.dtype = torch.float64) -> IOLayout:
        """IOLayout of the tensors in a pytree; what else it holds is left out."""
        batch, fields = tuple(batch), []
        for path, x in _pytree.tree_flatten_with_path(tree)[0]:
            if isinstance(x, Tensor):
                batched = tuple(x.shape[: len(batch)]) == batch
                shape = tuple(x.shape[len(batch) :] if batched else x.shape)
                name = _pytree.keystr(path).removeprefix(".")
                fields.append(Field(name, x.dtype, batched, shape))
        return IOLayout(fields, batch, dtype)

    def empty(self) -> Float[Tensor, "rows *batch"]:
        """A vector in which nothing is known: every number is NaN, no flag is set."""
        vector = torch.full((self.size, *self.batch), math.nan, dtype=self.dtype)
        for field, view in zip(self.fields, self.views(vector), strict=True):
            if field.dtype == torch.bool:
                view.zero_()
        return vector

    def pack(self, tensors: Sequence[Tensor]) -> Float[Tensor, "rows *batch"]:
        """The vector of some tensors, in the order of the fields."""
        parts = []
        for field, x in zip(self.fields, tensors, strict=True):
            if field.batched:
                x = x.movedim(self._first, self._last)
            else:
                x = x[(..., *(None for _ in self.batch))].expand(*field.shape, *self.batch)
            parts.append(x.reshape((-1, *self.batch)).to(self.dtype))
        return torch.cat(parts)

    def unpack(self, vector: Float[Tensor, "rows *batch"]) -> list[Tensor]:
        """The tensors in a vector: views of it, except those of another dtype."""
        views = zip(self.views(vector), self.fields, strict=True)
        return [view.to(field.dtype) for view, field in views]

    def views(self, vector: Float[Tensor, "rows *batch"]) -> list[Tensor]:
        """The parts of a vector in the shapes of the fields."""
        return [self._part(field, vector) for field in self.fields]

    def arrays(self, vector: Float[Tensor, "rows *batch"]) -> dict[str, np.ndarray]:
        """Views of a vector by field, to read from and to write into."""
        views = zip(self.rows, self.views(vector), strict=True)
        return {name: view.numpy() for name, view in views}

    def _part(self, field: Field, vector: Tensor) -> Tensor:
        part = vector[self.rows[field.name]].reshape((*field.shape, *self.batch))
        if field.batched:
            return part.movedim(self._last, self._first)
        # One value for the whole batch stands there once for each element: read the first.
        return part[(..., *(0 for _ in self.batch))]

    @property
    def _first(self) -> list[int]:
        """Where the batch stands in a tensor."""
        return list(range(len(self.batch)))

    @property
    def _last(self) -> list[int]:
        """Where it stands in a vector."""
        return list(range(-len(self.batch), 0))


class Vectors(NamedTuple):
    """What a step takes, in this order."""

    state: Tensor
    observation: Tensor
    command: Tensor


class StepLayouts(NamedTuple):
    """Where everything stands in them."""

    state: IOLayout
    observation: IOLayout
    command: IOLayout


@final
class PackedStep(nn.Module):
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
        self.layouts = StepLayouts(
            *(IOLayout.of(tree, q.shape[:-1], q.dtype) for tree in trees)
        )
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
        before, seen = _pytree.tree_unflatten(leaves, self._structure)
        said, after = self.controller.step(before, seen)
        command.copy_(layouts.command.pack(tensors_of(said)))
        state.copy_(layouts.state.pack(tensors_of(after)))


def tensors_of(tree: object) -> list[Tensor]:
    """The tensors in a pytree."""
    return [x for x in _pytree.tree_leaves(tree) if isinstance(x, Tensor)]
