"""Ahead-of-time compilation of a control step into one file, named by a hash of its content."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.deploy._inductor import tuned_for
from hrc_learn.deploy.package import PackedStep, StepObservation, Steppable, describe, machine
from hrc_learn.kinematics import SerialChain
from hrc_learn.store import Claim, new_file


class NoCompilerError(RuntimeError):
    """No C++ compiler was found."""


def export_step(
    controller: Steppable, observation: StepObservation, folder: Path | None = None
) -> Path:
    """Compile the step of a controller, unless an equal one has been compiled before.

    A package runs on the machine that built it. Its file name is a hash of torch's version, of
    the processor, of the source of this library, and of all settings and weights of the
    controller. With classes from outside this library, whose source is unknown, the hash is
    that of the traced step, which takes seconds longer.

    Args:
        controller: Controller with the step.
        observation: An example with exactly the fields of later observations. Missing fields,
            and a `dt` that is a number, become constants; so do the controller's own goals if
            it has none. It sets batch dimensions and dtype of the package; float32 counts
            interventions to 16 million only.
        folder: Folder of the packages; default: the user's cache.

    Returns:
        Path of the `.pt2` package.

    Raises:
        NoCompilerError: There is neither a package nor a C++ compiler.
        ValueError: dt is not in (0, 1/rate] of the safety filter.
    """
    folder = folder or _default_folder()
    step = PackedStep(controller, observation)
    program = None
    try:
        key = content_hash(machine(), controller, _structure(observation))
    except UnknownCodeError:
        program = trace(step, observation)
        key = _digest(step, program)
    package = folder / f"step-{key[:24]}.pt2"
    if package.is_file():
        return package
    _require_compiler()
    folder.mkdir(parents=True, exist_ok=True)
    # Waiting for another process that compiles the same step is faster than compiling it again.
    with Claim(package, wait=True) as claim:
        if package.is_file():
            return package
        with new_file(claim) as part:
            program = program or trace(step, observation)
            metadata = {"aot_inductor.metadata": describe(step, observation)}
            with torch.no_grad(), tuned_for(step.layouts.state.batch) as options:
                torch._inductor.aoti_compile_and_package(
                    program, package_path=str(part), inductor_configs=options | metadata
                )
    return package


def trace(step: PackedStep, observation: StepObservation) -> torch.export.ExportedProgram:
    """Graph of a step in the form that AOTInductor needs."""
    with torch.no_grad():
        program = torch.export.export(step, tuple(step.example(observation)), strict=False)
    aten = torch.ops.aten
    for node in program.graph.nodes:
        # The inductor of torch 2.11 cannot raise a constant to a power.
        if node.target is aten.square.default:
            node.target, node.args = aten.mul.Tensor, (node.args[0], node.args[0])
    return program


def _structure(observation: StepObservation) -> list[tuple[str, str]]:
    """Structure of an example: all fields, with shapes and dtypes in place of tensors."""
    leaves, _ = _pytree.tree_flatten_with_path(observation)
    return [
        (
            _pytree.keystr(path),
            f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else repr(x),
        )
        for path, x in leaves
    ]


def _digest(step: PackedStep, program: torch.export.ExportedProgram) -> str:
    """Hash of a traced step, its constants and the machine."""
    digest = hashlib.sha256()
    fields = [field for layout in step.layouts for field in layout.fields]
    for text in (machine(), program.graph, program.graph_signature, fields):
        digest.update(str(text).encode())
    digest.update(step.first_state.numpy().tobytes())
    for name, value in sorted((program.state_dict | program.constants).items()):
        assert isinstance(value, Tensor)
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def _require_compiler() -> None:
    from torch._inductor import cpp_builder, exc

    try:
        cpp_builder.get_cpp_compiler()
    except exc.InvalidCxxCompiler as error:
        raise NoCompilerError("no C++ compiler found: install g++, or set CXX") from error


def _default_folder() -> Path:
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))
    return base / "hrc_learn"


# Sources of a compiled step, all hashed: equal hashes mean equal compiled code.
_ROOT = Path(__file__).parents[1]
_SOURCES = (
    "pytree.py",
    "geometry",
    "kinematics",
    "regions",
    "jacobian",
    "controller",
    "deploy",
)
# Types whose `repr` represents their whole value.
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device)


class UnknownCodeError(TypeError):
    """The code of an object's class, or of a function it holds, is outside this library."""


def content_hash(*objects: Any) -> str:
    """Hash of all values in some objects, and of the source of this library.

    Args:
        objects: Modules, dataclasses and their contents.

    Raises:
        UnknownCodeError: They hold an object of a class outside this library and torch.
    """
    hasher = _ObjectHasher()
    for x in objects:
        hasher.add(x)
    hasher.digest.update(_source_hash())
    return hasher.digest.hexdigest()


@final
class _ObjectHasher:
    """Hash of values in a fixed order; each object once, further references by its number."""

    def __init__(self):
        self.digest = hashlib.sha256()
        self.seen: dict[int, Any] = {}  # keeps the objects alive, so that ids stay unique

    def add(self, x: Any) -> None:
        kind = type(x)
        self._update(f"{kind.__module__}.{kind.__qualname__}")
        if isinstance(x, Tensor):
            self._update(f"{x.dtype} {tuple(x.shape)} {x.device}")
            self.digest.update(x.detach().cpu().contiguous().numpy().tobytes())
        elif isinstance(x, _PLAIN):
            self._update(repr(x))
        elif id(x) in self.seen:
            self._update(f"again {list(self.seen).index(id(x))}")
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
        elif isinstance(x, SerialChain):
            # The shape of an arm, which may be a function that reads it, is no part of a step.
            self.add([x.joint_names, x.mounts, x.flange, x.tcp, x.limits, x.ready, x.kinds])
        elif type(x).__module__.split(".")[0] in ("hrc_learn", "torch") and hasattr(
            x, "__dict__"
        ):
            self.add(x.__getstate__())
        else:
            raise UnknownCodeError(f"the code of {type(x).__qualname__} is unknown")
        self._update("end")

    def _update(self, text: str) -> None:
        self.digest.update(f"{text}\n".encode())


@cache
def _source_hash() -> bytes:
    digest = hashlib.sha256()
    for name in _SOURCES:
        for path in sorted([_ROOT / name, *(_ROOT / name).rglob("*.py")]):
            if path.is_file():
                digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.digest()
