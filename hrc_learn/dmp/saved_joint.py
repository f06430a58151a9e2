"""What a saved joint primitive holds, read back as the arguments that make it again."""

from types import NoneType
from typing import Any

from torch import Tensor

from hrc_learn.dmp.fitting.report import FitReport
from hrc_learn.dmp.system.parts import restore_basis
from hrc_learn.dmp.system.spring import SpringDamper
from hrc_learn.storage import SavedModel

TENSORS = ("weights", "start", "goal", "start_velocity", "duration", "amplitude", "stamps")


def saved_arguments(saved: SavedModel) -> dict[str, Any]:
    """Arguments of `JointDMP`.

    Raises:
        ValueError: Names the file and the field that is wrong.
    """
    tensors = {name: saved.tensor(name) for name in TENSORS}
    _check_shapes(saved, tensors)
    arguments = {
        **tensors,
        "spring": _part(saved, "spring", lambda fields: SpringDamper(**fields)),
        "basis": _part(saved, "basis", restore_basis),
        "scaling": saved.get("scaling", str),
        "approach": float(saved.get("approach", float, int)),
        "joint_names": saved.get("joint_names", list, NoneType),
        "units": saved.get("units", dict).get("coordinates", ""),
    }
    if "fit_report.rmse" in saved.tensors:
        report = {name: saved.tensor(f"fit_report.{name}") for name in ("rmse", "peak", "span")}
        arguments["fit_report"] = FitReport(**report)
    return arguments


def _check_shapes(saved: SavedModel, tensors: dict[str, Tensor]) -> None:
    """All but the stamps follow from the shape of the weights."""
    weights = tensors["weights"]
    for name in TENSORS[1:-1]:
        shape = weights.shape[:-2] if name == "duration" else weights.shape[:-1]
        if weights.ndim < 2 or tensors[name].shape != shape:
            raise saved.invalid(
                f"{name} has shape {tuple(tensors[name].shape)}, which does not fit weights "
                f"{tuple(weights.shape)}"
            )


def _part(saved: SavedModel, field: str, make: Any) -> Any:
    fields = saved.get(field, dict)
    try:
        return make(fields)
    except KeyError as error:
        raise saved.invalid_field(field, f"{error} is missing") from None
    except (TypeError, ValueError) as error:
        raise saved.invalid_field(field, error) from None
