"""A saved image Jacobian: a folder with `config.json` and `model.safetensors`."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

FORMAT = "hrc_learn.jacobian"
VERSION = 1
_CONFIG, _MODEL = "config.json", "model.safetensors"
_UNITS = {"position": "m", "rotation": "rad", "jacobian": "px/m, px/rad", "pixels": "u, v"}


def write_folder(
    folder: str | Path, config: dict[str, Any], tensors: dict[str, Tensor]
) -> None:
    """Write beside the target, then rename: a save cut short leaves the old one or none.

    Raises:
        ValueError: The folder holds something else; it is left alone.
    """
    folder = Path(folder)
    if folder.exists() and not _is_ours(folder):
        raise ValueError(f"{folder} exists and is no saved image Jacobian: choose another.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        fresh, stale = Path(temporary, "new"), Path(temporary, "old")
        fresh.mkdir()
        header = {"format": FORMAT, "version": VERSION, "units": _UNITS}
        (fresh / _CONFIG).write_text(json.dumps(header | config, indent=2) + "\n")
        save_file(
            {k: t.detach().cpu().contiguous() for k, t in tensors.items()}, fresh / _MODEL
        )
        if folder.exists():
            os.replace(folder, stale)
        os.replace(fresh, folder)


def read_folder(folder: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Configuration and tensors of a saved image Jacobian.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is damaged, of another format or version, or not finite.
    """
    config_file, model_file = Path(folder, _CONFIG), Path(folder, _MODEL)
    for file in (config_file, model_file):
        if not file.is_file():
            raise FileNotFoundError(f"{file} does not exist: no image Jacobian was saved here.")
    config = _read_config(config_file)
    try:
        tensors = load_file(model_file)
    except SafetensorError as error:
        raise ValueError(f"{model_file}: not a safetensors file ({error}).") from error
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{model_file}: tensor {name!r} is not finite.")
    return config, tensors


def _read_config(file: Path) -> dict[str, Any]:
    try:
        config = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file}: not valid JSON ({error}).") from error
    for field, wanted in (("format", FORMAT), ("version", VERSION)):
        found = config.get(field) if isinstance(config, dict) else None
        if found != wanted:
            raise ValueError(f"{file}: {field} is {found!r}, this reads {wanted!r}.")
    return config


def _is_ours(folder: Path) -> bool:
    try:
        _read_config(folder / _CONFIG)
    except (OSError, ValueError):
        return False
    return True
