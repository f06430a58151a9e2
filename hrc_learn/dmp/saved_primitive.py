"""Files of primitives: bases and phases as JSON values, and saved primitives read back."""

from collections.abc import Mapping
from dataclasses import asdict
from dataclasses import fields as dataclass_fields
from types import NoneType
from typing import Any

from torch import Tensor

from hrc_learn.dmp._system.bases import (
    Basis,
    ExponentialPhase,
    GaussianBasis,
    PeriodicBasis,
    SigmoidPhase,
    SplineBasis,
)
from hrc_learn.dmp._system.spring import SpringDamper
from hrc_learn.dmp.fitting.samples import FitReport
from hrc_learn.dmp.forcing_scale import Scaling, find_scaling
from hrc_learn.model_files import SavedModel

BASES: dict[str, type[Any]] = {
    basis.__name__: basis for basis in (GaussianBasis, PeriodicBasis, SplineBasis)
}
PHASES: dict[str, type[Any]] = {
    phase.__name__: phase for phase in (ExponentialPhase, SigmoidPhase)
}
TENSORS = ("weights", "start", "goal", "start_velocity", "duration", "amplitude", "timestamps")


def basis_config(basis: Basis) -> dict[str, Any]:
    """Description of a basis from which `restore_basis` makes it again.

    Raises:
        ValueError: The basis or its phase is not one of this package.
    """
    fields = _config(basis, BASES)
    if "phase" in fields:
        fields["phase"] = _config(basis.phase, PHASES)
    return fields


def restore_basis(config: Mapping[str, Any]) -> Basis:
    """Basis that `basis_config` described.

    Raises:
        ValueError: Unknown type, or values that it refuses.
        TypeError: Fields that the type does not have.
        KeyError: The type is missing.
    """
    fields = dict(config)
    if "phase" in fields:
        # Older files name no phase type, because there was only one.
        fields["phase"] = _restore({"type": "ExponentialPhase", **fields["phase"]}, PHASES)
    return _restore(fields, BASES)


def _config(part: Any, known: Mapping[str, type[Any]]) -> dict[str, Any]:
    kind = type(part).__name__
    if known.get(kind) is not type(part):
        raise ValueError(f"{kind} cannot be saved; files hold {', '.join(known)}")
    return {"type": kind, **asdict(part)}


def _restore(fields: Mapping[str, Any], known: Mapping[str, type[Any]]) -> Any:
    arguments = {k: v for k, v in fields.items() if k != "type"}
    kind: str = fields["type"]
    if kind not in known:
        raise ValueError(f"unknown type {kind!r}; choose from {', '.join(known)}")
    return known[kind](**arguments)


def linear_arguments(saved: SavedModel) -> dict[str, Any]:
    """Arguments of `LinearPrimitive` from a saved primitive.

    Raises:
        ValueError: A wrong field; the message names the file and the field.
    """
    older = {"timestamps": "stamps"} if "stamps" in saved.tensors else {}
    tensors = {name: saved.tensor(older.get(name, name)) for name in TENSORS}
    _check_shapes(saved, tensors)
    arguments = {
        **tensors,
        "spring": _part(saved, "spring", lambda fields: SpringDamper(**fields)),
        "basis": _part(saved, "basis", restore_basis),
        "scaling": _scaling(saved),
        "approach": float(saved.get("approach", float, int)),
        "joint_names": saved.get("joint_names", list, NoneType),
        "units": saved.get("units", dict).get("coordinates", ""),
    }
    if "fit_report.rmse" in saved.tensors:
        names = [field.name for field in dataclass_fields(FitReport)]
        report = {
            n: saved.tensor(f"fit_report.{n}")
            for n in names
            if f"fit_report.{n}" in saved.tensors
        }
        arguments["fit_report"] = FitReport(**report)
    return arguments


def _scaling(saved: SavedModel) -> Scaling:
    name = saved.get("scaling", str)
    # Older files have no columns, because all were scaled.
    columns = saved.config.get("scaled_columns")
    if columns is not None:
        columns = saved.get("scaled_columns", int)
    try:
        return find_scaling(name, columns)
    except ValueError as error:
        raise saved.invalid_field("scaling", error) from None


def _check_shapes(saved: SavedModel, tensors: dict[str, Tensor]) -> None:
    """Check all tensors but the timestamps against the shape of the weights."""
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
