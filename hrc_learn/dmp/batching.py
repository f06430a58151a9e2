"""Batches of primitives: some of them taken out, several of them put together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hrc_learn.dmp._arguments import FitReport

SHARED = ("lower", "upper", "softness")
"""Tensors of a primitive without batch axes: limits are those of the arm."""


def select[M: nn.Module](primitive: M, index: Any) -> M:
    """Primitives of a batch, with memory of their own: `primitive[index]`.

    Gradients flow through weights that are no parameter; a parameter is copied.

    Raises:
        IndexError: There is no such one.
    """

    def chosen(path: str, x: Tensor) -> Tensor:
        x = x.detach() if isinstance(x, nn.Parameter) else x
        name = path.rpartition(".")[2]
        alike = name in SHARED or (name == "timestamps" and x.ndim == 1)
        return x.clone() if alike else x[index].clone()

    return _changed(primitive, chosen)


def stack[M: nn.Module](primitives: Sequence[M]) -> M:
    """A batch of primitives of one kind, basis and spring; a new first axis counts them.

    Those sampled differently keep their own timestamps, the last of them repeated. There is a
    fit report if all have one.

    Raises:
        ValueError: There are none, or they differ; says in what.
    """
    if not primitives:
        raise ValueError("there are no primitives to stack")
    first, *others = (_described(primitive) for primitive in primitives)
    for i, other in enumerate(others, start=1):
        for name, value in first.items():
            if other[name] != value:
                raise ValueError(
                    f"primitives of one batch must be alike, but {name} of primitive {i} is "
                    f"{other[name]}, of the first {value}"
                )
    tensors = [dict(_tensors(primitive)) for primitive in primitives]

    def stacked(path: str, x: Tensor) -> Tensor | None:
        every = [each.get(path) for each in tensors]
        name = path.rpartition(".")[2]
        if name in SHARED:
            return x.clone()
        found = [
            other.detach() if isinstance(other, nn.Parameter) else other for other in every
        ]
        present = [other for other in found if other is not None]
        if len(present) < len(primitives):
            return None
        return _timestamps(present) if name == "timestamps" else torch.stack(present)

    return _changed(primitives[0], stacked)


def concatenate[M: nn.Module](batches: Iterable[M], samples: int) -> M:
    """Batches of primitives of one kind, one after another along their first axis.

    They are taken one by one, and none of them is held longer than it takes to copy. Their
    demonstrations need not be sampled alike: the timestamps of the result, those of a rollout
    without arguments, are even.

    Args:
        batches: Each with one batch axis or more, alike in the axes behind the first.
        samples: Timestamps of the result.

    Raises:
        ValueError: There are none, or they differ; says in what.
    """
    first, described, count = None, {}, 0
    parts: dict[str, list[Tensor]] = {}
    for batch in batches:
        weights: Any = batch.motion.weights  # pyright: ignore[reportAttributeAccessIssue]
        own = _described(batch) | {"shape of the weights": weights.shape[1:]}
        if first is None:
            # A copy: what a batch was made from goes with it.
            first, described = select(batch, slice(0, 1)), own
        for name, value in described.items():
            if own[name] != value:
                raise ValueError(
                    f"primitives of one batch must be alike, but {name} of batch {count} is "
                    f"{own[name]}, of the first {value}"
                )
        count += 1
        for path, x in _tensors(batch):
            if path.rpartition(".")[2] not in (*SHARED, "timestamps"):
                parts.setdefault(path, []).append(x.detach().clone())
    if first is None:
        raise ValueError("there are no primitives to concatenate")

    def joined(path: str, x: Tensor) -> Tensor | None:
        name = path.rpartition(".")[2]
        if name == "timestamps":
            return torch.linspace(0, 1, samples, dtype=x.dtype, device=x.device)
        if name in SHARED:
            return x.clone()
        found = parts[path]
        return torch.cat(found) if len(found) == count else None

    return _changed(first, joined)


def _timestamps(every: list[Tensor]) -> Tensor:
    """One grid if all have it, else a row for each."""
    if all(x.shape == every[0].shape and torch.equal(x, every[0]) for x in every):
        return every[0].clone()
    T = max(x.shape[-1] for x in every)
    rows = [
        torch.cat([x, x[..., -1:].expand(*x.shape[:-1], T - x.shape[-1])], -1) for x in every
    ]
    return torch.stack(torch.broadcast_tensors(*rows))


def _described(primitive: Any) -> dict[str, Any]:
    return {
        "kind": type(primitive).__name__,
        **primitive.motion.config(),
        **primitive._own_config(),
        "shape of the weights": tuple(primitive.motion.weights.shape),
    }


def _own_tensors(module: nn.Module) -> Iterator[tuple[str, Tensor]]:
    yield from module._parameters.items()  # pyright: ignore[reportReturnType]
    yield from module._buffers.items()  # pyright: ignore[reportReturnType]
    # Of some kinds it is a property, and another module's.
    if isinstance(report := vars(module).get("fit_report"), FitReport):
        yield from ((f"fit_report.{name}", x) for name, x in report.tensors().items())


def _tensors(module: nn.Module, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    for path, part in module.named_modules(prefix=prefix):
        for name, x in _own_tensors(part):
            yield f"{path}.{name}" if path else name, x


def _changed[M: nn.Module](
    module: M, change: Callable[[str, Tensor], Tensor | None], prefix: str = ""
) -> M:
    """A module of its own around changed tensors; what else it is made of, the two share."""
    new = type(module).__new__(type(module))
    new.__dict__.update(vars(module))
    tensors = {name: change(prefix + name, x) for name, x in _own_tensors(module)}
    report = {k.partition(".")[2]: x for k, x in tensors.items() if k.startswith("fit_report.")}
    if report:
        known = {k: x for k, x in report.items() if x is not None}
        complete = {"rmse", "peak", "span"} <= known.keys()
        new.__dict__["fit_report"] = FitReport(**known) if complete else None
    new._parameters, new._buffers = {}, {}
    for name in module._buffers:
        new._buffers[name] = tensors[name]
    for name in module._parameters:
        x = tensors[name]
        assert x is not None
        new._parameters[name] = nn.Parameter(x)
    new._modules = {
        name: None if part is None else _changed(part, change, f"{prefix}{name}.")
        for name, part in module._modules.items()
    }
    return new
