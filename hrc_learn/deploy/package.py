"""Pack a control step into a function of vectors, and define the files of its compiled form.

A compiled step reads and writes three vectors of numbers instead of dataclasses: any language
can fill them, and a step allocates nothing. The metadata (`step.json`) lists the rows that each
named tensor of state, observation and command has in these vectors.
"""

from __future__ import annotations

import hashlib
import math
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from llvmlite import binding
from torch import Tensor, nn
from torch.utils import _pytree

from hrc_learn.controller import Observation, WantedVelocity
from hrc_learn.deploy.native_code import NativeStep
from hrc_learn.kinematics import SerialChain
from hrc_learn.store import read_json, require_unchanged

type StepObservation = Observation | WantedVelocity
"""Observation of a controller's step."""


@runtime_checkable
class Steppable(Protocol):
    """Module with a control step: `AdaptiveController` or `VelocityStep`."""

    chain: SerialChain

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
        joint_acceleration: Float[Tensor, "*batch n"] | None = None,
        /,
    ) -> Any:
        """State of an arm at rest or in motion, as a pytree."""
        ...

    def step(self, state: Any, observation: Any, /) -> tuple[Any, Any]:
        """Take one step; returns command and next state, both pytrees."""
        ...


@dataclass(frozen=True)
class Field:
    """Description of one tensor of a dataclass."""

    name: str
    """Path in the dataclass, for example "safety.flags"."""
    dtype: torch.dtype
    """Type of the tensor's elements."""
    batched: bool
    """True: one value for each element of the batch; False: one for the whole batch."""
    shape: tuple[int, ...]
    """Shape without the batch axes."""


@final
class IOLayout:
    """Assignment of a dataclass's tensors to the rows of a vector (rows, *batch).

    The batch axes come last: a row in memory is one quantity for all elements of the batch, as
    vector instructions require. All numbers have one dtype, and flags are 0 or 1.
    """

    def __init__(
        self, fields: Sequence[Field], batch: Sequence[int], dtype: torch.dtype = torch.float64
    ):
        self.fields, self.batch, self.dtype = tuple(fields), tuple(batch), dtype
        # Batch axes of a tensor, and of a vector.
        self._first, self._last = list(range(len(batch))), list(range(-len(batch), 0))
        edges = np.cumsum([0, *(math.prod(field.shape) for field in fields)]).tolist()
        self.size: int = edges[-1]
        """Number of rows."""
        names = (field.name for field in fields)
        self.rows = dict(zip(names, (slice(*ends) for ends in pairwise(edges)), strict=True))
        """Rows of each field."""

    @staticmethod
    def of(tree: Any, batch: Sequence[int], dtype: torch.dtype = torch.float64) -> IOLayout:
        """Layout of the tensors in a pytree; leaves that are no tensors are left out."""
        batch, fields = tuple(batch), []
        for path, x in _pytree.tree_flatten_with_path(tree)[0]:
            if isinstance(x, Tensor):
                batched = tuple(x.shape[: len(batch)]) == batch
                shape = tuple(x.shape[len(batch) :] if batched else x.shape)
                name = _pytree.keystr(path).removeprefix(".")
                fields.append(Field(name, x.dtype, batched, shape))
        return IOLayout(fields, batch, dtype)

    def empty(self) -> Float[Tensor, "rows *batch"]:
        """Vector with NaN for every number and 0 for every flag."""
        vector = torch.full((self.size, *self.batch), math.nan, dtype=self.dtype)
        for field, view in zip(self.fields, self.views(vector), strict=True):
            if field.dtype == torch.bool:
                view.zero_()
        return vector

    def pack(self, tensors: Sequence[Tensor]) -> Float[Tensor, "rows *batch"]:
        """Vector of tensors given in the order of the fields."""
        parts = []
        for field, x in zip(self.fields, tensors, strict=True):
            if field.batched:
                x = x.movedim(self._first, self._last)
            else:
                x = x[(..., *(None for _ in self.batch))].expand(*field.shape, *self.batch)
            parts.append(x.reshape((-1, *self.batch)).to(self.dtype))
        return torch.cat(parts)

    def unpack(self, vector: Float[Tensor, "rows *batch"]) -> list[Tensor]:
        """Tensors in a vector: views of the vector, or copies if the dtypes differ."""
        views = zip(self.views(vector), self.fields, strict=True)
        return [view.to(field.dtype) for view, field in views]

    def views(self, vector: Float[Tensor, "rows *batch"]) -> list[Tensor]:
        """Views of a vector in the shapes of the fields."""
        views = []
        for field in self.fields:
            part = vector[self.rows[field.name]].reshape((*field.shape, *self.batch))
            if field.batched:
                part = part.movedim(self._last, self._first)
            else:
                # A value for the whole batch is repeated for each element: read the first.
                part = part[(..., *(0 for _ in self.batch))]
            views.append(part)
        return views

    def shared_rows(self) -> Int[Tensor, " rows"]:
        """Rows of the fields that have one value for the whole batch."""
        every = torch.arange(self.size)
        shared = [every[self.rows[field.name]] for field in self.fields if not field.batched]
        return torch.cat([every[:0], *shared])

    def arrays(self, vector: Float[Tensor, "rows *batch"]) -> Mapping[str, np.ndarray]:
        """Views of a vector by field name, for reading and writing."""
        views = zip(self.rows, self.views(vector), strict=True)
        return MappingProxyType({name: view.numpy() for name, view in views})


class Vectors(NamedTuple):
    """Vectors of a step, in the order of its arguments."""

    state: Tensor
    observation: Tensor
    command: Tensor


class StepLayouts(NamedTuple):
    """Layouts of the vectors of a step."""

    state: IOLayout
    observation: IOLayout
    command: IOLayout


@final
class PackedStep(nn.Module):
    """Step of a controller that reads vectors and updates them in place.

    A step reads the vectors of state and observation, writes the command, and replaces the
    state by the next one. Missing fields of the observation, and a `dt` that is a number, are
    constants.
    """

    def __init__(self, controller: Steppable, observation: StepObservation):
        """Derive the layouts from an example.

        Args:
            controller: Controller with the step.
            observation: An example with exactly the fields of later observations. The vectors
                have the dtype of its joint positions.
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

    def example(self, observation: StepObservation) -> Vectors:
        """Vectors before the first step, with the arm at rest in the ready posture."""
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
        """Take one step."""
        layouts = self.layouts
        read = layouts.state.unpack(state) + layouts.observation.unpack(observation)
        results, count = self.stepped(read), len(layouts.command.fields)
        command.copy_(layouts.command.pack(results[:count]))
        state.copy_(layouts.state.pack(results[count:]))

    def stepped(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Tensors of command and next state, from those of state and observation."""
        read = iter(tensors)
        leaves = [next(read) if x is None else x for x in self._constants]
        return tensors_of(
            self.controller.step(*_pytree.tree_unflatten(leaves, self._structure))
        )


def tensors_of(tree: object) -> list[Tensor]:
    """The tensors in a pytree."""
    return [x for x in _pytree.tree_leaves(tree) if isinstance(x, Tensor)]


# Keys of the metadata. Later versions of this library must be able to read them.
_LAYOUT, _BATCH, _DTYPE = "hrc_learn.layout", "hrc_learn.batch", "hrc_learn.dtype"
_STATE, _OBSERVATION = "hrc_learn.state", "hrc_learn.observation"
_BUILT_FOR = "hrc_learn.built_for"
LANES, WORKSPACE = "hrc_learn.lanes", "hrc_learn.workspace"
"""Keys of the machine code: number of arms computed at once, and size of the workspace in
numbers."""

CODE, DESCRIPTION = "step.o", "step.json"
"""Files of a compiled step: machine code, and the metadata as one JSON object."""


def describe(step: PackedStep, observation: StepObservation) -> dict[str, str]:
    """Metadata of a compiled step, as text that any language can read.

    Its entry "hrc_learn.layout" has a line for each field: vector, name, dtype, 1 if batched or
    else 0, and shape. The rows of a vector are in the order of the lines.
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


def load(path: Path) -> tuple[Callable[[list[Tensor]], object], StepLayouts, Tensor]:
    """Load the machine code of `export_step`.

    Returns:
        Function of the three vectors that updates state and command in place; layouts of the
        vectors; and the state vector of an arm at rest in its ready posture.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file was not written by this library, has changed since, or was written
            for another machine.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no compiled step {path}")
    require_unchanged(path.parent)
    metadata = read_json(path.with_name(DESCRIPTION), dict[str, str], "export it again")
    keys = {_LAYOUT, _BATCH, _DTYPE, _STATE, _BUILT_FOR, LANES, WORKSPACE}
    if missing := sorted(keys - metadata.keys()):
        raise ValueError(f"{path} was not written by export_step: no {missing[0]}")
    if metadata[_BUILT_FOR] != machine():
        raise ValueError(
            f"{path} was built for {metadata[_BUILT_FOR]}, but this is {machine()}: export the "
            "step on this machine"
        )
    layouts = _layouts(metadata)
    batch, dtype = layouts.state.batch, layouts.state.dtype
    sizes = int(metadata[LANES]), int(metadata[WORKSPACE])
    shared = [layout.shared_rows() for layout in layouts[:2]] if batch else []
    run = NativeStep(path.read_bytes(), *sizes, shared)
    first = torch.tensor([float(x) for x in metadata[_STATE].split()], dtype=dtype)
    return run, layouts, first.reshape((-1, *batch))


def _layouts(metadata: Mapping[str, str]) -> StepLayouts:
    """Layouts of the vectors from the metadata that `describe` returns."""
    fields: dict[str, list[Field]] = {vector: [] for vector in StepLayouts._fields}
    for line in metadata[_LAYOUT].splitlines():
        vector, name, kind, batched, *shape = line.split()
        field = Field(name, getattr(torch, kind), batched == "1", tuple(map(int, shape)))
        fields[vector].append(field)
    batch = [int(n) for n in metadata[_BATCH].split()]
    dtype: torch.dtype = getattr(torch, metadata[_DTYPE])
    return StepLayouts(*(IOLayout(part, batch, dtype) for part in fields.values()))


def machine() -> str:
    """Description of what compiled code depends on: version of torch, and processor."""
    capability = torch.backends.cpu.get_cpu_capability()
    extensions = binding.get_host_cpu_features().flatten()
    return (
        f"torch {torch.__version__} on {platform.machine()} with {capability}, "
        f"instructions {hashlib.sha256(extensions.encode()).hexdigest()[:8]}"
    )


def _text(vector: Tensor) -> str:
    return " ".join(map(repr, vector.flatten().tolist()))


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def c_header(metadata: Mapping[str, str]) -> str:
    """Header of the machine code for C and C++: its function and the rows of each field."""
    dtype = {"float64": "double", "float32": "float"}[metadata[_DTYPE]]
    layouts = _layouts(metadata)
    places = []
    for vector, layout in layouts._asdict().items():
        for name, rows in layout.rows.items():
            word = re.sub(r"\W+", "_", f"{vector}_{name}").upper()
            places.append(f"#define {word} {rows.start} /* {rows.stop - rows.start} rows */")
    return "\n".join([
        "/* One control step. Vectors are arrays of rows; a row has a number for each arm. */",
        f"#define STEP_ARMS {math.prod(layouts.state.batch)}",
        f"#define STEP_ARMS_AT_ONCE {metadata[LANES]}",
        *(f"#define {name.upper()}_ROWS {x.size}" for name, x in layouts._asdict().items()),
        f"#define WORKSPACE_SIZE {metadata[WORKSPACE]} /* numbers, of any value */",
        *places,
        "/* State at rest in the ready posture, and the observation given to export_step. */",
        *(
            f"static const {dtype} first_{name}[] = {{{_c_numbers(metadata[key])}}};"
            for name, key in (("state", _STATE), ("observation", _OBSERVATION))
        ),
        '#ifdef __cplusplus\nextern "C"\n#endif',
        "/* Takes a step for `count` arms, a multiple of STEP_ARMS_AT_ONCE: reads the",
        "   observation, writes the command and the next state. Rows are `stride` numbers",
        "   apart. If STEP_ARMS_AT_ONCE is 1, pass 1 for `stride` and `count`. */",
        f"void control_step({dtype} *state, const {dtype} *observation, {dtype} *command,",
        f"                  {dtype} *workspace, long long stride, long long count);",
        "",
    ])  # fmt: skip


def _c_numbers(text: str) -> str:
    return text.replace("nan", "(0.0 / 0.0)").replace("inf", "(1.0 / 0.0)").replace(" ", ", ")
