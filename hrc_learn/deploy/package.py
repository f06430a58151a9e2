"""The file of a compiled step: code, what to know to call it, and the hash that tells
whether it is current.
"""

from __future__ import annotations

import hashlib
import platform
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor

from hrc_learn.controller import Observation
from hrc_learn.deploy.io_layout import Field, FlatStep, Layout, Layouts

# The file of a compiled step: code, and what to know to call it.

_LAYOUT, _BATCH, _DTYPE = "hrc_learn.layout", "hrc_learn.batch", "hrc_learn.dtype"
_STATE, _OBSERVATION = "hrc_learn.state", "hrc_learn.observation"
_BUILT_FOR = "hrc_learn.built_for"


@dataclass(frozen=True)
class Package:
    """A compiled step, loaded."""

    run: Callable[[list[Tensor]], object]
    """Takes the three vectors and updates state and command in place."""
    layouts: Layouts
    first_state: Tensor
    """Vector of an arm at rest in its ready posture."""
    example: Tensor
    """Vector of the observation that it was exported with."""


def describe(step: FlatStep, observation: Observation) -> dict[str, str]:
    """What a package says about a step, as text that any language can read.

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
        run, says = _open(path)
    except RuntimeError as error:
        raise ValueError(f"{path} was not written by export_step: {error}") from error
    if _LAYOUT not in says:
        raise ValueError(f"{path} was not written by export_step: it has no layout")
    if says[_BUILT_FOR] != machine():
        raise ValueError(
            f"{path} was built for {says[_BUILT_FOR]}, but this is {machine()}: export the "
            "step on this machine"
        )
    batch = [int(n) for n in says[_BATCH].split()]
    dtype: torch.dtype = getattr(torch, says[_DTYPE])
    fields: dict[str, list[Field]] = {vector: [] for vector in Layouts._fields}
    for line in says[_LAYOUT].splitlines():
        vector, name, kind, batched, *shape = line.split()
        field = Field(name, getattr(torch, kind), batched == "1", tuple(map(int, shape)))
        fields[vector].append(field)
    return Package(
        run=run,
        layouts=Layouts(*(Layout(part, batch, dtype) for part in fields.values())),
        first_state=_vector(says[_STATE], batch, dtype),
        example=_vector(says[_OBSERVATION], batch, dtype),
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


# Tells whether two objects of ours would do the same, without running them.

_ROOT = Path(__file__).parents[2]
_SOURCES = ("pytree.py", "geometry", "kinematics", "regions", "jacobian", "controller")
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device)
_CONTAINERS = (list, tuple, dict, set, OrderedDict)


class UnknownCodeError(TypeError):
    """An object is of a class, or holds a function, whose code is not ours to know."""


def fingerprint(*objects: Any) -> str:
    """Hash of all values within some objects, and of the source of this library.

    Args:
        objects: Modules, dataclasses and what they hold.

    Raises:
        UnknownCodeError: They hold something whose code is not of this library or torch's.
    """
    walk = _Walk()
    for x in objects:
        walk.add(x)
    walk.digest.update(_source_hash())
    return walk.digest.hexdigest()


@final
class _Walk:
    """Visits values in a fixed order; each object once."""

    def __init__(self):
        self.digest = hashlib.sha256()
        self.seen: dict[int, Any] = {}  # keeps what it names alive, or ids would be reused

    def add(self, x: Any) -> None:
        kind = type(x)
        self._say(f"{kind.__module__}.{kind.__qualname__}")
        if isinstance(x, Tensor):
            self._say(f"{x.dtype} {tuple(x.shape)} {x.device}")
            self.digest.update(x.detach().cpu().contiguous().numpy().tobytes())
        elif isinstance(x, _PLAIN):
            self._say(repr(x))
        elif id(x) in self.seen:
            self._say(f"again {list(self.seen).index(id(x))}")
        else:
            self.seen[id(x)] = x
            self._add_parts(x)

    def _add_parts(self, x: Any) -> None:
        if isinstance(x, Mapping):
            for key, value in x.items():
                self.add(key)
                self.add(value)
        elif isinstance(x, set):
            self.add(sorted(x, key=repr))
        elif isinstance(x, list | tuple):
            for value in x:
                self.add(value)
        elif type(x).__module__.split(".")[0] in ("hrc_learn", "torch") and hasattr(
            x, "__dict__"
        ):
            self.add(x.__getstate__())
        else:
            raise UnknownCodeError(f"cannot tell what a {type(x).__qualname__} does")
        self._say("end")

    def _say(self, text: str) -> None:
        self.digest.update(f"{text}\n".encode())


@cache
def _source_hash() -> bytes:
    digest = hashlib.sha256()
    for name in _SOURCES:
        for path in sorted([_ROOT / name, *(_ROOT / name).rglob("*.py")]):
            if path.is_file():
                digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.digest()
