"""Times that may be read as numbers.

Arithmetic of one number costs PyTorch microseconds where Python takes a tenth of one, and a
step in closed loop is mostly that.
"""

import torch
from torch import Tensor
from torch.autograd import forward_ad


def as_numbers(*times: Tensor) -> tuple[Tensor, ...] | tuple[float, ...]:
    """The times as floats if each is a single one that nothing derives or traces."""
    if torch.compiler.is_compiling() or not all(map(_plain, times)):
        return times
    return tuple(time.item() for time in times)


def _plain(time: Tensor) -> bool:
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return (
        time.ndim == 0
        and time.is_cpu  # of another device, reading would wait for all that was asked of it
        and type(time) is Tensor
        and not time.requires_grad
        and not functorch.is_functorch_wrapped_tensor(time)
        and forward_ad.unpack_dual(time).tangent is None
    )
