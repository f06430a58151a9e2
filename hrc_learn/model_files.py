"""Learned models on disk: folders with `config.json` and `model.safetensors`.

Models are written through `hrc_learn.store`: an interrupted save leaves the old model, or none,
but never an incomplete one.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from hrc_learn import store

FORMAT = "hrc_learn"
VERSION = 1
CONFIG, MODEL = "config.json", "model.safetensors"


def write_model(
    folder: str | Path, kind: str, config: dict[str, Any], tensors: dict[str, Tensor]
) -> None:
    """Write or replace a saved model.

    Args:
        folder: Folder of the model.
        kind: Class of the model, checked when the folder is read.
        config: Contents other than tensors, as JSON values.
        tensors: Tensors by name.

    Raises:
        InTheWayError: `folder` holds something other than a saved model and is left unchanged.
            The error is a ValueError.
        BusyError: Another process is writing to `folder`.
    """
    # Clones, because safetensors refuses tensors that use the same memory.
    tensors = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    header = {"format": FORMAT, "version": VERSION, "kind": kind}
    with store.replacing(folder, store.MODEL, overwrite=True) as new:
        new.mkdir()
        (new / CONFIG).write_text(store.json_text(header | config), encoding="utf-8")
        # `save_file` would raise errors that are not OSErrors.
        (new / MODEL).write_bytes(save(tensors))


class SavedModel:
    """A saved model, read and checked. Error messages name the file and the field."""

    def __init__(self, folder: str | Path, kind: str):
        self.folder = Path(folder)
        self.config = _read_config(self.folder)
        for field, wanted in (("format", FORMAT), ("version", VERSION), ("kind", kind)):
            found = self.get(field, type(wanted))
            if found != wanted:
                raise ValueError(
                    f"{self.folder / CONFIG}: {field} is {found!r}, expected {wanted!r}"
                )
        store.require_unchanged(self.folder)
        self.tensors = self._read_tensors()

    def get(self, field: str, *types: type) -> Any:
        """Value of a config field, which must have one of the given types."""
        if field not in self.config:
            raise ValueError(f"{self.folder / CONFIG}: field {field!r} is missing")
        value = self.config[field]
        # Exact types: for isinstance, a bool is also an int.
        if type(value) not in types:
            names = " or ".join(t.__name__ for t in types)
            raise ValueError(
                f"{self.folder / CONFIG}: field {field!r} must be {names}, got {value!r}"
            )
        return value

    def part[T](self, field: str, kind: type, make: Callable[[Any], T]) -> T:
        """Object made from a config field, which must have the type `kind`.

        Raises:
            ValueError: The field, which the message names, is missing or wrong.
        """
        value = self.get(field, kind)
        try:
            return make(value)
        except KeyError as error:
            complaint = f"{error} is missing"
        except (TypeError, ValueError) as error:
            complaint = str(error)
        raise ValueError(f"{self.folder / CONFIG}: field {field!r}: {complaint}")

    def tensor(self, name: str) -> Tensor:
        """Tensor with this name, which must be finite."""
        if name not in self.tensors:
            raise ValueError(f"{self.folder / MODEL}: tensor {name!r} is missing")
        if not self.tensors[name].isfinite().all():
            raise ValueError(f"{self.folder / MODEL}: tensor {name!r} is not finite")
        return self.tensors[name]

    def invalid(self, complaint: object) -> ValueError:
        """Error that adds the model's folder to the complaint of a constructor."""
        return ValueError(f"{self.folder}: {complaint}")

    def _read_tensors(self) -> dict[str, Tensor]:
        path = self.folder / MODEL
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist")
        try:
            return load(path.read_bytes())
        except SafetensorError as error:
            raise ValueError(f"{path}: not a safetensors file ({error})") from None


class StoredModel:
    """Model with a `config` of JSON values and `tensors` by name, from which `restore` makes it
    again.
    """

    @classmethod
    def restore[S: "StoredModel"](cls: type[S], saved: SavedModel) -> S:
        """Model from its files.

        Raises:
            ValueError: A wrong field; the message names the file and the field.
        """
        raise NotImplementedError

    def save(self: Any, folder: str | Path) -> None:
        """Write config.json and model.safetensors into `folder`, replacing an older save."""
        write_model(folder, type(self).__name__, self.config(), self.tensors())

    @classmethod
    def load[S: "StoredModel"](cls: type[S], folder: str | Path) -> S:
        """Read a model that `save` wrote.

        Raises:
            FileNotFoundError: The folder holds no saved model.
            ValueError: A wrong field; the message names the file and the field.
        """
        return cls.restore(SavedModel(folder, cls.__name__))


def _read_config(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG
    store.settle(folder)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: no model was saved here")
    return store.read_json(path, dict, "save the model again")
