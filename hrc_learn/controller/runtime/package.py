"""The file of a compiled step: code, and what to know to call it."""

from __future__ import annotations

import hashlib
import platform
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hrc_learn.controller.interface import Observation
from hrc_learn.controller.runtime.flat import FlatStep, Layouts
from hrc_learn.controller.runtime.layout import Field, Layout

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
        lines = Path("/proc/cpuinfo").read_text().splitlines()
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
