"""Checked conversion of the arguments of movement primitives to tensors.

Tensors, NumPy arrays and nested lists of integers or floats are accepted everywhere. `...`
stands for any number of leading batch axes. The axis names in the aliases (`_T`, `_D`) only
document the layout. They are not checked, because the arguments of a call broadcast and the
demonstrations in a list differ in length. Sizes that have to agree are compared where the
values are used.
"""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.autograd.forward_ad import unpack_dual

FLOATING = (torch.float32, torch.float64)
MOST_SAMPLES = 10**9
"""Largest number of samples of a motion at a regular interval."""
type Nested = Sequence
"""Lists or tuples of numbers, nested to any depth."""
type Number = float | int | np.number
type ArrayLike = Real[Tensor, "..."] | Real[np.ndarray, "..."] | Nested | Number
"""Any array of numbers."""
type Scalars = ArrayLike
"""One number per primitive, (*batch): durations [s], gains, time steps [s]."""
type Times = Real[Tensor, "... _T"] | Real[np.ndarray, "... _T"] | Nested
"""Times [s], (T,) for the whole batch or (*batch, T)."""
type Points = ArrayLike
"""Samples over time, (*batch, T, D); the shape (T,) means D = 1."""
type Vectors = Real[Tensor, "... _D"] | Real[np.ndarray, "... _D"] | Nested
"""One vector per primitive, (*batch, D)."""
type Quaternions = Real[Tensor, "... 4"] | Real[np.ndarray, "... 4"] | Nested
"""Unit quaternions (w, x, y, z), (*batch, 4), or over time (*batch, T, 4)."""
type Mask = Bool[Tensor, "... _T"] | Bool[np.ndarray, "... _T"] | Times
"""False (or zero) at samples to ignore, (T,) or (*batch, T)."""


def to_tensor(
    values: ArrayLike | Mask,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> Tensor:
    """Convert like `torch.as_tensor`; arrays may be read-only or have negative strides or any
    byte order. Series and tables of pandas are arrays too.

    Raises:
        ValueError: Values that are not real numbers, or booleans where `dtype` is floating.
    """
    if isinstance(values, Tensor) and values.dtype == dtype and values.device == device:
        return values  # the common case; `as_tensor` would return the same, but more slowly
    if hasattr(values, "__array__") and not isinstance(values, Tensor):
        values = np.asarray(values)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"expected real numbers, got an array of {values.dtype}")
        values = np.require(values, values.dtype.newbyteorder("="), ["C", "W"])
    try:
        tensor = torch.as_tensor(values)
    except (TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"expected numbers, got {values!r:.80} ({error})") from None
    if tensor.is_complex() or (tensor.dtype == torch.bool and dtype in FLOATING):
        raise ValueError(f"expected real numbers, got {tensor.dtype}")
    # Convert the original values again, because `tensor` holds Python's floats as float32.
    return torch.as_tensor(values, dtype=dtype, device=device)


def full_precision[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Decorator that disables `torch.autocast`: half precision visibly distorts paths."""

    @wraps(function)
    def exact(*arguments: P.args, **options: P.kwargs) -> R:
        if not any(map(torch.is_autocast_enabled, ("cpu", "cuda"))):
            return function(*arguments, **options)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*arguments, **options)

    return exact


def readable(*tensors: Tensor) -> bool:
    """True if Python may branch on the values of the tensors.

    Branching is impossible during tracing, in a `torch.func` transform and in a forward
    derivative.
    """
    if torch.compiler.is_compiling():
        return False
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    # A loop is faster: a comprehension takes as long as the matrix product of a short rollout.
    for x in tensors:
        if functorch.is_functorch_wrapped_tensor(x):
            return False
        if forward_ad._current_level >= 0 and unpack_dual(x).tangent is not None:
            return False
    return True


_transform_level = getattr(
    torch._C._functorch,  # pyright: ignore[reportAttributeAccessIssue]
    "maybe_current_level",
    lambda: 0,
)
"""Function that returns the nesting level of `torch.func` transforms, None outside of them.

If PyTorch lacks the function, the code acts as if it always ran inside a transform.
"""


def transforming() -> bool:
    """True inside `torch.func` transforms and forward derivatives.

    Inside of them, NumPy cannot read tensors.
    """
    return _transform_level() is not None or forward_ad._current_level >= 0


def refuse_nested_forward(s: Tensor) -> None:
    """Raise NotImplementedError if times `s` may be inside two nested forward derivatives.

    PyTorch then silently treats the outer derivative of an `autograd.Function` as zero.
    """
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    if torch.compiler.is_compiling() or not functorch.is_functorch_wrapped_tensor(s):
        return
    from torch._functorch.pyfunctorch import retrieve_all_functorch_interpreters

    levels = [str(level.key()) for level in retrieve_all_functorch_interpreters()]
    if levels.count("TransformType.Jvp") > 1:
        raise NotImplementedError(
            "PyTorch returns zero for the outer of two nested forward derivatives of a motion: "
            "use jacfwd(jacrev(f)), as torch.func.hessian does"
        )


def fits_numpy(detached: Tensor, *others: Any) -> bool:
    """True if NumPy may compute with the tensors: no tracing, no `vmap`, no gradients.

    For a few numbers, NumPy takes a third of the time of PyTorch, where dispatch dominates.

    Args:
        detached: Tensor that may require gradients, because the caller detaches it.
        others: Tensors that must be plain CPU tensors of the same dtype without gradients.
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    if transforming():
        return False
    dtype = detached.dtype
    if type(detached) not in (Tensor, nn.Parameter) or not detached.is_cpu:
        return False
    for x in others:  # a comprehension takes twice as long
        if type(x) is not Tensor or x.dtype is not dtype or x.requires_grad or not x.is_cpu:
            return False
    return True


def broadcast_shapes(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Shape after broadcasting, as from `torch.broadcast_shapes`.

    The function of PyTorch takes longer than a rollout even for equal shapes, and its first
    call imports sympy.
    """
    first = shapes[0]
    if all(shape == first for shape in shapes):
        return first
    if torch.compiler.is_compiling():
        return torch.broadcast_shapes(*shapes)
    return np.broadcast_shapes(*shapes)


def checked_vector(
    name: str, value: Vectors, like: Float[Tensor, "*batch D"]
) -> Float[Tensor, "*other D"]:
    """Vector with as many coordinates as `like`, in its dtype and on its device.

    Raises:
        ValueError: Wrong number of coordinates, or a value that is not finite.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    D = like.shape[-1]
    if tensor.ndim == 0 or tensor.shape[-1] != D:
        raise ValueError(f"{name} must have shape (..., {D}), got {tuple(tensor.shape)}")
    return finite(name, tensor)


def finite(name: str, values: Tensor) -> Tensor:
    """Return the values unchanged.

    Raises:
        ValueError: A value is NaN or infinite.
    """
    # Reading from another device would wait for all work queued there.
    if not values.is_cpu or not readable(values):
        return values
    # For a few numbers, Python's sum takes half the time of a sum in PyTorch. In a transform,
    # PyTorch 2.8 refuses `tolist`, even for tensors from outside.
    few = values.ndim == 1 and values.numel() <= 32 and not transforming()
    if not math.isfinite(sum(values.tolist()) if few else values.detach().sum().item()):
        wrong = values[~values.isfinite()]
        if len(wrong):  # finite values may overflow in the sum
            raise ValueError(f"{name} must be finite, but contains {wrong[0].item()}")
    return values


def positive(name: str, value: Scalars, like: Tensor) -> Float[Tensor, "*batch"]:
    """Positive numbers, in the dtype and on the device of `like`.

    Raises:
        ValueError: A number is not positive and finite.
    """
    tensor = to_tensor(value, dtype=like.dtype, device=like.device)
    if readable(tensor) and not ((tensor > 0) & (tensor < math.inf)).all():
        wrong = tensor[~((tensor > 0) & (tensor < math.inf))].reshape(-1)
        raise ValueError(f"{name} must be positive and finite, got {wrong[0].item()}")
    return tensor


def check_not_negative(name: str, value: Tensor | float | int) -> None:
    """Raise ValueError unless all numbers are finite and not negative.

    Tensors that are not on the CPU are not checked.
    """
    if isinstance(value, Tensor):
        if not value.is_cpu or not readable(value):
            return
        good = bool(((value >= 0) & (value < math.inf)).all())
    else:
        good = not isinstance(value, bool) and 0 <= value < math.inf
    if not good:
        raise ValueError(f"{name} must be finite and not negative, got {value}")


def seconds(time: Times, device: torch.device) -> Float[Tensor, "*batch T"]:
    """Times [s] since the start of a motion (float64).

    Raises:
        ValueError: A single number instead of an array, or a time that is negative or not
            finite.
    """
    time = to_tensor(time, dtype=torch.float64, device=device)
    if time.ndim == 0 or (readable(time) and not ((time >= 0) & (time < math.inf)).all()):
        raise ValueError(
            "time must be an array of finite, non-negative seconds since the start"
        )
    return time


def normalised_time(
    time: Times, duration: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch T"]:
    """Times [s] since the start of a motion, divided by its duration (float64).

    Raises:
        ValueError: Bad times, or a batch shape that does not match the durations.
    """
    time = seconds(time, duration.device)
    try:
        broadcast_shapes(time.shape[:-1], duration.shape)
    except (ValueError, RuntimeError):
        raise ValueError(
            f"time has shape {tuple(time.shape)}, but the durations have shape "
            f"{tuple(duration.shape)}: time must be (T,) or {(*duration.shape, time.shape[-1])}"
        ) from None
    # If all grids are identical, one response matrix serves the whole batch.
    if readable(time, duration) and not (time.requires_grad or duration.requires_grad):
        time, duration = _collapse_identical(time, 1), _collapse_identical(duration, 0)
    return time / duration.double()[..., None]


def regular_times(dt: float | int, duration: Float[Tensor, "*batch"]) -> Float[Tensor, "T"]:
    """Times [s] at interval `dt`, from zero to the first one at or after the longest duration.

    Raises:
        ValueError: The interval is not positive and finite, or gives too many samples.
    """
    longest = duration.max().item() if duration.numel() else 0.0
    if not (dt > (least := longest / MOST_SAMPLES) and math.isfinite(dt)):
        raise ValueError(f"dt must be positive and finite, above {least:g} s, got {dt}")
    # The tolerance keeps rounding from adding a sample past the end.
    last = math.ceil(longest / dt * (1 - 1e-7))
    return dt * torch.arange(last + 1, dtype=torch.float64, device=duration.device)


def _collapse_identical(values: Tensor, ndim: int) -> Tensor:
    """First of a batch of `ndim`-dimensional tensors if all are equal, otherwise the batch."""
    if values.ndim == ndim or not values.numel():
        return values
    first = values[(0,) * (values.ndim - ndim)]
    return first if bool((values == first).all()) else values


def contexts_of(values: Any, n: int, device: torch.device | None = None) -> Tensor:
    """Contexts (n, C) in float64, one row for each of `n` demonstrations.

    Raises:
        ValueError: The number of rows differs from `n`, or a number is not finite.
    """
    given = to_tensor(values, torch.float64, device)
    if not given.ndim or len(given) != n or not given.numel():
        raise ValueError(
            f"context must have one row for each of {n} demonstrations, got "
            f"{tuple(given.shape)}"
        )
    if not given.isfinite().all():
        raise ValueError("context must be finite")
    return given.reshape(n, -1)
