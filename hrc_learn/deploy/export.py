"""Compile a controller's step ahead of time, and keep the machine code in a cache folder.

The name of the folder is a hash of everything that determines the code, so that no step is
compiled twice.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.deploy.native_code import NativeCode, assemble, lanes_of
from hrc_learn.deploy.package import (
    CODE,
    DESCRIPTION,
    LANES,
    WORKSPACE,
    PackedStep,
    StepLayouts,
    StepObservation,
    Steppable,
    c_header,
    describe,
    machine,
)
from hrc_learn.deploy.scalar_program import UnknownOperationError, scalar_program
from hrc_learn.kinematics import SerialChain
from hrc_learn.store import EXPORT, Claim, cache_home, replacing, write_json, write_text


def export_step(
    controller: Steppable, observation: StepObservation, folder: str | Path | None = None
) -> Path:
    """Compile the step of a controller, unless an equal one has been compiled before.

    The machine code comes from LLVM, so no compiler needs to be installed. It runs only on
    processors like the one that built it. Next to it are `step.h`, a header for C and C++, and
    `step.json`, a description for other languages. The name of their folder is a hash of
    everything that determines the code: torch's version, the processor, the parts of this
    library that a step uses (`_PARTS`), all settings and weights of the controller, and the
    example (names, shapes and dtypes of its fields, and its constants). A controller that holds
    functions, or objects of classes outside this library, is hashed by its traced step instead.
    Tracing takes seconds.

    Args:
        controller: Controller with the step.
        observation: An example with exactly the fields of later observations. Missing fields,
            and a `dt` that is a number, become constants; so do the controller's goals if the
            example has none. The step takes batch dimensions and dtype from the example. In
            float32, the counts of interventions stop at 16 million.
        folder: Folder of the compiled steps; default: the user's cache.

    Returns:
        Path of the machine code, `step.o` in its folder.

    Raises:
        UnknownOperationError: The step uses an operation of PyTorch for which there is no code.
        ValueError: dt is not in (0, 1/rate] of the safety filter.
    """
    folder = Path(folder or cache_home() / "hrc_learn")
    step = PackedStep(controller, observation)
    try:
        key = content_hash(machine(), controller, _structure(observation))
    except UnknownCodeError:
        key = _hash_of_trace(step, trace(step, observation))
    target = folder / f"step-{key[:24]}"
    code = target / CODE
    if code.is_file():
        return code
    folder.mkdir(parents=True, exist_ok=True)
    # Waiting for another process that compiles the same step is faster than compiling it again.
    with Claim(target, wait=True) as claim:
        if code.is_file():
            return code
        with replacing(claim, EXPORT, overwrite=True) as new:
            new.mkdir()
            _compile(step, observation, new)
    return code


def _compile(step: PackedStep, observation: StepObservation, folder: Path) -> None:
    """Write machine code, header and description of a step."""
    few, fewer = _few_arms(step, observation)
    program = scalar_program(trace(few, fewer), step.layouts.state.dtype)
    lanes = lanes_of(np.dtype(program.number)) if step.layouts.state.batch else 1
    native = NativeCode(program, StepLayouts._fields, lanes)
    (folder / CODE).write_bytes(assemble(native.text))
    sizes = {LANES: str(native.lanes), WORKSPACE: str(native.workspace)}
    about = describe(step, observation) | sizes
    write_text(folder / "step.h", c_header(about))
    write_json(folder / DESCRIPTION, about)


def _few_arms(
    step: PackedStep, observation: StepObservation
) -> tuple[PackedStep, StepObservation]:
    """The step and its example for only a few arms of a batch; unchanged without a batch.

    A few arms suffice to check that the arms of a batch do not affect each other.
    """
    batch = step.layouts.state.batch
    if not batch:
        return step, observation
    # An unbatched field may have the chosen size by chance, and would then count as batched.
    # Try sizes until the layouts equal those of the whole batch.
    for size in (2, 3, 5, 11):
        part = (slice(size), *(slice(1) for _ in batch[1:]))
        few = _pytree.tree_map_only(
            Tensor,
            lambda x, part=part: x[part] if tuple(x.shape[: len(batch)]) == batch else x,
            observation,
        )
        smaller = PackedStep(step.controller, few)
        if all(
            ours.fields == theirs.fields
            for ours, theirs in zip(smaller.layouts, step.layouts, strict=True)
        ):
            return smaller, few
    raise UnknownOperationError("batched fields cannot be distinguished from unbatched ones")


def trace(step: PackedStep, observation: StepObservation) -> torch.export.ExportedProgram:
    """Trace a step into a graph of PyTorch operations."""
    with torch.no_grad():
        return torch.export.export(step, tuple(step.example(observation)), strict=False)


def _structure(observation: StepObservation) -> list[tuple[str, str]]:
    """Name of each field of an example, with dtype and shape of a tensor, or else the value."""
    leaves, _ = _pytree.tree_flatten_with_path(observation)
    return [
        (
            _pytree.keystr(path),
            f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else repr(x),
        )
        for path, x in leaves
    ]


def _hash_of_trace(step: PackedStep, program: torch.export.ExportedProgram) -> str:
    """Hash of a traced step, its constants and the machine."""
    graph = str(program.graph), str(program.graph_signature)
    fields = [layout.fields for layout in step.layouts]
    constants = dict(program.state_dict) | program.constants
    return content_hash(machine(), graph, fields, step.first_state, constants)


# Parts of this library that a compiled step depends on. All their modules are hashed, so that
# equal hashes mean equal compiled code.
_ROOT = Path(__file__).parents[1]
_PARTS = ("pytree.py", "geometry", "kinematics", "regions", "jacobian", "controller", "deploy")
# Types whose `repr` represents their whole value.
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device)


class UnknownCodeError(TypeError):
    """An object cannot be hashed: it is a function, or its class is outside this library and
    torch.
    """


def content_hash(*objects: Any) -> str:
    """Hash of all values in some objects, and of the sources in `_PARTS`.

    Args:
        objects: Modules, dataclasses and their contents.

    Raises:
        UnknownCodeError: The objects hold a function (also one of this library), or an object
            of a class outside this library and torch.
    """
    digest, seen = hashlib.sha256(_source_hash()), {}
    for x in objects:
        for part in _hashed(x, seen):
            digest.update(part)
    return digest.hexdigest()


def _hashed(x: Any, seen: dict[int, Any]) -> Iterator[bytes]:
    """Bytes to hash: type and value of all parts of an object, in a fixed order.

    A repeated object gives only the number of its first occurrence.

    Args:
        x: The object.
        seen: Objects so far, by their id. The dictionary keeps the objects alive, so that ids
            stay unique.
    """
    kind = type(x)
    yield f"{kind.__module__}.{kind.__qualname__}\n".encode()
    if isinstance(x, Tensor):
        yield f"{x.dtype} {tuple(x.shape)} {x.device}\n".encode()
        yield x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    elif isinstance(x, _PLAIN):
        yield f"{x!r}\n".encode()
    elif id(x) in seen:
        yield f"again {list(seen).index(id(x))}\n".encode()
    else:
        seen[id(x)] = x
        for part in _parts(x):
            yield from _hashed(part, seen)
        yield b"end\n"


def _parts(x: Any) -> Iterable[Any]:
    """Values that an object consists of."""
    library = type(x).__module__.split(".")[0]
    if library in ("builtins", "collections", "hrc_learn", "torch", "types"):
        if isinstance(x, Mapping):
            return x.items()
        if isinstance(x, set):
            return sorted(x, key=repr)
        if isinstance(x, list | tuple):
            return x
    if isinstance(x, SerialChain):
        # Everything that affects a step. The arm's shape is left out: it does not affect a
        # step, and may be a function, which cannot be hashed.
        return x.description_of_chain().values()
    if library in ("hrc_learn", "torch") and hasattr(x, "__dict__"):
        return (x.__getstate__(),)
    raise UnknownCodeError(f"the code of {type(x).__qualname__} is unknown")


@cache
def _source_hash() -> bytes:
    digest = hashlib.sha256()
    for name in _PARTS:
        for path in sorted([_ROOT / name, *(_ROOT / name).rglob("*.py")]):
            if path.is_file():
                digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.digest()
