"""Bases and phases as JSON values, and back."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from hrc_learn.dmp.system.basis import Basis, GaussianBasis, PeriodicBasis
from hrc_learn.dmp.system.canonical import ExponentialPhase, SigmoidPhase
from hrc_learn.dmp.system.placed import PlacedBasis
from hrc_learn.dmp.system.spline import SplineBasis

BASES: dict[str, type[Any]] = {
    basis.__name__: basis for basis in (GaussianBasis, PeriodicBasis, PlacedBasis, SplineBasis)
}
PHASES: dict[str, type[Any]] = {
    phase.__name__: phase for phase in (ExponentialPhase, SigmoidPhase)
}


def basis_config(basis: Basis) -> dict[str, Any]:
    """What `restore_basis` makes the same basis of.

    Raises:
        ValueError: A basis or phase of the caller's own, which no file could name.
    """
    fields = _config(basis, BASES)
    if "phase" in fields:
        fields["phase"] = _config(basis.phase, PHASES)
    return fields


def restore_basis(config: Mapping[str, Any]) -> Basis:
    """The basis that `basis_config` described.

    Raises:
        ValueError: A type that no file can name, or values that it refuses.
        TypeError: Fields that it does not have.
        KeyError: There is no type.
    """
    fields = dict(config)
    if "phase" in fields:
        # Older files name no phase: there was one only.
        fields["phase"] = _restore({"type": "ExponentialPhase", **fields["phase"]}, PHASES)
    return _restore(fields, BASES)


def _config(part: Any, known: Mapping[str, type[Any]]) -> dict[str, Any]:
    kind = type(part).__name__
    if known.get(kind) is not type(part):
        raise ValueError(f"{kind} cannot be saved; files hold {', '.join(known)}")
    return {"type": kind, **asdict(part)}


def _restore(fields: Mapping[str, Any], known: Mapping[str, type[Any]]) -> Any:
    # Tuples are lists in a file, and lists cannot be hashed.
    arguments = {
        k: tuple(v) if isinstance(v, list) else v for k, v in fields.items() if k != "type"
    }
    kind = fields["type"]
    if kind not in known:
        raise ValueError(f"unknown type {kind!r}; there are {', '.join(known)}")
    return known[kind](**arguments)
