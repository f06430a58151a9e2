"""The control step compiled ahead of time into one file, named by a hash of what it does."""

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
from hrc_learn.deploy.package import PackedStep, Seen, Steppable, describe, machine
from hrc_learn.store import Claim, new_file


class NoCompilerError(RuntimeError):
    """There is no C++ compiler to build a package with."""


def export_step(controller: Steppable, observation: Seen, folder: Path | None = None) -> Path:
    """Compile a controller's step, unless an equal one was compiled before.

    A package fits the machine it was built on. Its name in the folder is a hash of torch's
    version, of the processor, of the source of this library, and of all settings and weights
    of the controller. With parts of your own, whose source it cannot know, it is one of the
    traced step, which takes seconds more.

    Args:
        controller: Whose step.
        observation: An example with exactly the fields that later ones will have. Fields
            left out, and a `dt` that is a number, become constants; so do the controller's
            own goals where it brings none. Its batch dimensions and dtype are those of the
            package; float32 counts interventions to 16 million only.
        folder: Where packages are kept; default: the user's cache.

    Returns:
        The `.pt2` package.

    Raises:
        NoCompilerError: No C++ compiler was found, and no package either.
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
    # Another process that compiles the same step is waited for: quicker than doing it too.
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


def trace(step: PackedStep, observation: Seen) -> torch.export.ExportedProgram:
    """One graph of a step, in the form that AOTInductor takes."""
    with torch.no_grad():
        program = torch.export.export(step, tuple(step.example(observation)), strict=False)
    aten = torch.ops.aten
    for node in program.graph.nodes:
        # Inductor of torch 2.11 cannot raise a constant number to a power.
        if node.target is aten.square.default:
            node.target, node.args = aten.mul.Tensor, (node.args[0], node.args[0])
    return program


def _structure(observation: Seen) -> list[tuple[str, str]]:
    """What of an example makes a difference to the step: all but the values of tensors."""
    leaves, _ = _pytree.tree_flatten_with_path(observation)
    return [
        (
            _pytree.keystr(path),
            f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else repr(x),
        )
        for path, x in leaves
    ]


def _digest(step: PackedStep, program: torch.export.ExportedProgram) -> str:
    """Hash of all that decides what a package computes and where it runs."""
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
        raise NoCompilerError(
            "no C++ compiler found: install g++, or name one in CXX"
        ) from error


def _default_folder() -> Path:
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))
    return base / "hrc_learn"


# The hash that names a package: of all values within a controller and of the source of this
# library. An equal hash means that the compiled code would do the same.

# What a compiled step is made from: the package itself, and those it imports.
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
# Values whose `repr` says all of them.
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device)


class UnknownCodeError(TypeError):
    """An object is of a class, or holds a function, whose code is not ours to know."""


def content_hash(*objects: Any) -> str:
    """Hash of all values within some objects, and of the source of this library.

    Args:
        objects: Modules, dataclasses and what they hold.

    Raises:
        UnknownCodeError: They hold something whose code is not of this library or torch's.
    """
    hasher = _ObjectHasher()
    for x in objects:
        hasher.add(x)
    hasher.digest.update(_source_hash())
    return hasher.digest.hexdigest()


@final
class _ObjectHasher:
    """Hashes values in a fixed order; each object once, later visits by its number."""

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
