"""Tells whether two objects of ours would do the same, without running them."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor

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
