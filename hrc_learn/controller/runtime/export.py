"""The control step compiled ahead of time into one file."""

from __future__ import annotations

import hashlib
import io
import os
import platform
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch

from hrc_learn.controller.controller import AdaptiveController
from hrc_learn.controller.interface import Observation
from hrc_learn.controller.runtime.flat import Example, FlatStep

EXAMPLE = "extra/hrc_learn.npz"
"""Entry of a package with names, shapes and dtypes of all tensors, and an initial state."""


class NoCompilerError(RuntimeError):
    """There is no C++ compiler to build a package with."""


def export_step(
    controller: AdaptiveController, observation: Observation, folder: Path | None = None
) -> Path:
    """Compile a controller's step, unless an equal one was compiled before.

    A package fits the machine it was built on: its name in the folder is a hash of torch's
    version, of the instructions the processor has, and of the traced step with all weights.

    Args:
        controller: Whose step.
        observation: An example with exactly the fields that later ones will have. Fields
            left out, and a `dt` that is a number, become constants; so do the controller's
            own goals where it brings none. Its batch dimensions are those of the package.
        folder: Where packages are kept; default: the user's cache.

    Returns:
        The `.pt2` package.

    Raises:
        NoCompilerError: No C++ compiler was found, and no package either.
        ValueError: dt is not in (0, 1/rate] of the safety filter.
    """
    step = FlatStep(controller, observation)
    program = trace(step)
    package = (folder or _default_folder()) / f"step-{_digest(program)}.pt2"
    if package.is_file():
        return package
    _require_compiler()
    package.parent.mkdir(parents=True, exist_ok=True)
    unfinished = package.with_name(f".{package.stem}.{os.getpid()}.pt2")
    try:
        with torch.no_grad():
            torch._inductor.aoti_compile_and_package(program, package_path=str(unfinished))
        _append_example(unfinished, step.example)
        unfinished.replace(package)
    finally:
        unfinished.unlink(missing_ok=True)
    return package


def read_example(package: Path) -> Example:
    """The named tensors that `export_step` kept in a package.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a package of ours.
    """
    try:
        with zipfile.ZipFile(package) as archive:
            arrays = np.load(io.BytesIO(archive.read(EXAMPLE)))
    except (zipfile.BadZipFile, KeyError) as error:
        raise ValueError(f"{package} was not written by export_step: {error}") from error
    groups = {"state": {}, "observation": {}, "command": {}}
    for name in arrays.files:
        groups[name.split(".")[0]][name] = torch.from_numpy(arrays[name])
    return Example(**groups)


def trace(step: FlatStep) -> torch.export.ExportedProgram:
    """One graph of a step, as AOTInductor takes it."""
    with torch.no_grad():
        program = torch.export.export(step, tuple(step.example.inputs), strict=False)
    aten = torch.ops.aten
    for node in program.graph.nodes:
        # Inductor of torch 2.11 cannot raise a constant number to a power.
        if node.target is aten.square.default:
            node.target, node.args = aten.mul.Tensor, (node.args[0], node.args[0])
    return program


def _digest(program: torch.export.ExportedProgram) -> str:
    """Hash of all that decides what a package computes and where it runs."""
    digest = hashlib.sha256()
    for text in (
        torch.__version__,
        platform.machine(),
        torch.backends.cpu.get_cpu_capability(),
        program.graph,
        program.graph_signature,
    ):
        digest.update(str(text).encode())
    for node in program.graph.nodes:
        if node.op == "placeholder":
            value = node.meta["val"]
            digest.update(f"{value.dtype} {tuple(value.shape)}".encode())
    for name, value in sorted((program.state_dict | program.constants).items()):
        assert isinstance(value, torch.Tensor)
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:24]


def _require_compiler() -> None:
    from torch._inductor import cpp_builder, exc

    try:
        cpp_builder.get_cpp_compiler()
    except exc.InvalidCxxCompiler as error:
        raise NoCompilerError(
            "no C++ compiler found: install g++, or name one in CXX"
        ) from error


def _append_example(package: Path, example: Example) -> None:
    tensors = example.state | example.observation | example.command
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{name: x.numpy() for name, x in tensors.items()})
    with zipfile.ZipFile(package, "a", zipfile.ZIP_STORED) as archive:
        archive.writestr(EXAMPLE, buffer.getvalue())


def _default_folder() -> Path:
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))
    return base / "hrc_learn"
