"""Dataclasses of tensors that are PyTorch pytrees, and selection of their batch elements."""

import dataclasses
from collections.abc import Callable
from typing import Any, dataclass_transform

import torch
from torch import Tensor
from torch.utils import _pytree


def static(default: Any) -> Any:
    """Field of a pytree dataclass that belongs to the structure and is not a leaf.

    Use it for gains and names: `vmap` then maps the tensors only, and `torch.compile` and
    `torch.export` treat the field's value as a constant.
    """
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
def pytree[T](cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass with keyword arguments, registered as a pytree."""
    return registered(dataclasses.dataclass(frozen=True, kw_only=True)(cls))


def registered[T](cls: type[T]) -> type[T]:
    """Register a dataclass as a pytree: `static` fields are structure, others are children.

    A field that is None adds no child, so an optional tensor may be absent. Unlike
    `torch.export.register_dataclass`, this function supports static fields. Fields with floats
    have to be static, because `vmap` refuses floats as leaves.
    """
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    children = [f.name for f in fields if not f.metadata.get("static")]
    statics = [f.name for f in fields if f.metadata.get("static")]

    def flatten(instance: T) -> tuple[list[Any], Any]:
        present = [name for name in children if getattr(instance, name) is not None]
        context = (tuple(present), tuple(getattr(instance, name) for name in statics))
        return [getattr(instance, name) for name in present], context

    def flatten_with_keys(instance: T) -> tuple[list[Any], Any]:
        values, context = flatten(instance)
        keys = [_pytree.GetAttrKey(name) for name in context[0]]
        return list(zip(keys, values, strict=True)), context

    def unflatten(values: Any, context: Any) -> T:
        # Bypasses __init__, because torch also unflattens placeholders that are not tensors.
        present, structure = context
        instance = object.__new__(cls)
        for name in children:
            object.__setattr__(instance, name, None)
        for name, value in zip(present, values, strict=True):
            object.__setattr__(instance, name, value)
        for name, value in zip(statics, structure, strict=True):
            object.__setattr__(instance, name, value)
        return instance

    _pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"{cls.__module__}.{cls.__qualname__}",
        flatten_with_keys_fn=flatten_with_keys,
    )
    return cls


def zero_where[T](mask: Tensor, tree: T) -> T:
    """Copy of a pytree with zeros, or False, in the batch elements where a mask is true.

    Args:
        mask: Elements to clear, (*batch).
        tree: Tensors whose batch dimensions lead.
    """

    def cleared(x: Tensor) -> Tensor:
        return x.masked_fill(mask[(..., *[None] * (x.dim() - mask.dim()))], 0)

    return _pytree.tree_map(cleared, tree)


def apply_where(
    mask: Tensor, function: Callable[[Any], Any], arguments: Any, otherwise: Any
) -> Any:
    """Results of a batched function where a mask is true, and given values elsewhere.

    To save time, the function is called on the selected elements of the batch only.

    Args:
        mask: Elements for which to call the function, (*batch).
        function: Maps a pytree of tensors to a pytree; batch dimensions lead.
        arguments: Pytree for the whole batch.
        otherwise: Values elsewhere, with the structure of the function's result.
    """
    if not bool(mask.any()):
        return otherwise
    if bool(mask.all()):
        return function(arguments)
    rows = mask.nonzero(as_tuple=True)
    part = function(_pytree.tree_map(lambda x: x[rows], arguments))
    return _pytree.tree_map(lambda x, new: x.index_put(rows, new), otherwise, part)


def chosen(mask: Tensor, one: Any, other: Any) -> Any:
    """Batch elements of the pytree `one` where a mask is true, and of `other` elsewhere.

    Args:
        mask: Elements to take from `one`, (*batch).
        one: Pytree of tensors (*batch, ...).
        other: Pytree of the same structure.
    """

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask[(..., *[None] * (a.dim() - mask.dim()))], a, b)

    return _pytree.tree_map(pick, one, other)
