"""The control step as a function of vectors, and the file of its compiled form.

Code compiled for real time takes and returns a few vectors of numbers, not dataclasses: any
language can fill them, and nothing is allocated in a step. The file says where the named
tensors of state, observation and command stand in them.
"""

from __future__ import annotations

import hashlib
import math
import platform
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller import Observation, WantedVelocity
from hrc_learn.kinematics import SerialChain

type Seen = Observation | WantedVelocity
"""What the steps of a controller are given."""


@runtime_checkable
class Steppable(Protocol):
    """A module with a step to run in a loop: `AdaptiveController` or `VelocityStep`."""

    chain: SerialChain

    def initial_state(self, joint_position: Float[Tensor, "*batch n"], /) -> Any:
        """State of an arm at rest [rad], a pytree."""
        ...

    def step(self, state: Any, observation: Any, /) -> tuple[Any, Any]:
        """Take one step on what it is given; command and next state, pytrees."""
        ...


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
    """The step of a controller on vectors, in place.

    It reads the vectors of state and observation, and writes those of the command and of the
    next state. What an observation leaves out, and a `dt` that is a number, are constants.
    """

    def __init__(self, controller: Steppable, observation: Seen):
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

    def example(self, observation: Seen) -> Vectors:
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


# Keys of the package's metadata, which later versions must be able to read.
_LAYOUT, _BATCH, _DTYPE = "hrc_learn.layout", "hrc_learn.batch", "hrc_learn.dtype"
_STATE, _OBSERVATION = "hrc_learn.state", "hrc_learn.observation"
_BUILT_FOR = "hrc_learn.built_for"


@dataclass(frozen=True)
class Package:
    """A compiled step, loaded."""

    run: Callable[[list[Tensor]], object]
    """Takes the three vectors and updates state and command in place."""
    layouts: StepLayouts
    first_state: Tensor
    """Vector of an arm at rest in its ready posture."""
    example: Tensor
    """Vector of the observation that it was exported with."""


def describe(step: PackedStep, observation: Seen) -> dict[str, str]:
    """Metadata of a package: what to know of its step, as text that any language can read.

    The layout has a line for each field: which vector, field, dtype, 1 if it is batched, and
    its shape. Rows follow each other in the order of the lines.
    """
    lines = [
        " ".join([vector, field.name, _name(field.dtype), str(int(field.batched)),
                  *map(str, field.shape)])
        for vector, layout in step.layouts._asdict().items()
        for field in layout.fields
    ]  # fmt: skip
    example = step.example(observation)
    return {
        _LAYOUT: "\n".join(lines),
        _BATCH: " ".join(map(str, step.layouts.state.batch)),
        _DTYPE: _name(step.layouts.state.dtype),
        _STATE: _text(example.state),
        _OBSERVATION: _text(example.observation),
        _BUILT_FOR: machine(),
    }


def load(path: Path) -> Package:
    """Load a package in milliseconds.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a package of ours, or was built for another machine.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no package {path}")
    try:
        run, metadata = _open(path)
    except RuntimeError as error:
        raise ValueError(f"{path} was not written by export_step: {error}") from error
    if _LAYOUT not in metadata:
        raise ValueError(f"{path} was not written by export_step: it has no layout")
    if metadata[_BUILT_FOR] != machine():
        raise ValueError(
            f"{path} was built for {metadata[_BUILT_FOR]}, but this is {machine()}: export the "
            "step on this machine"
        )
    batch = [int(n) for n in metadata[_BATCH].split()]
    dtype: torch.dtype = getattr(torch, metadata[_DTYPE])
    fields: dict[str, list[Field]] = {vector: [] for vector in StepLayouts._fields}
    for line in metadata[_LAYOUT].splitlines():
        vector, name, kind, batched, *shape = line.split()
        field = Field(name, getattr(torch, kind), batched == "1", tuple(map(int, shape)))
        fields[vector].append(field)
    return Package(
        run=run,
        layouts=StepLayouts(*(IOLayout(part, batch, dtype) for part in fields.values())),
        first_state=_vector(metadata[_STATE], batch, dtype),
        example=_vector(metadata[_OBSERVATION], batch, dtype),
    )


def machine() -> str:
    """What compiled code depends on: torch, and the instructions of the processor."""
    capability = torch.backends.cpu.get_cpu_capability()
    return (
        f"torch {torch.__version__} on {platform.machine()} with {capability}, "
        f"instructions {_instructions()}"
    )


@cache
def _instructions() -> str:
    """Short hash of the extensions of the processor, all of which a compiler may use."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown"
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(flags.encode()).hexdigest()[:8]


def _text(vector: Tensor) -> str:
    return " ".join(map(repr, vector.flatten().tolist()))


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _vector(text: str, batch: list[int], dtype: torch.dtype) -> Tensor:
    numbers = torch.tensor([float(x) for x in text.split()], dtype=dtype)
    return numbers.reshape((-1, *batch))


def _open(path: Path) -> tuple[Callable[[list[Tensor]], object], dict[str, str]]:
    try:
        loader = _fast_loader()(str(path), "model", False, 1, -1)
        return loader.run, loader.get_metadata()
    except (AttributeError, TypeError):
        warnings.warn(
            f"torch {torch.__version__} lacks the fast loader of packages: starting takes up "
            "to half a minute, and each step some microseconds more",
            stacklevel=2,
        )
        model = torch._inductor.aoti_load_package(str(path))
        return lambda vectors: model(*vectors), model.get_metadata()


def _fast_loader() -> Any:
    """Private, but ready in milliseconds; the public one probes compilers for seconds."""
    return torch._C._aoti.AOTIModelPackageLoader  # pyright: ignore
