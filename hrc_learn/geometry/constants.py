"""Fixed tensors that follow the dtype and device of the data they meet."""

import torch
from torch import Tensor


class Constant:
    """A fixed tensor, kept ready for every dtype and device it has met.

    Floating-point values are converted from float64; integers keep their dtype.
    """

    def __init__(self, value: Tensor):
        self._value = value
        self._ready: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def __getstate__(self) -> dict[str, object]:
        # What was met is no part of what it is.
        return {"_value": self._value, "_ready": {}}

    def like(self, x: Tensor) -> Tensor:
        """The tensor on the device of `x`, and of its dtype if floating-point."""
        dtype = x.dtype if self._value.is_floating_point() else self._value.dtype
        if torch.compiler.is_compiling():
            return self._value.to(device=x.device, dtype=dtype)
        key = (dtype, x.device)
        tensor = self._ready.get(key)
        if tensor is None:
            # Once kept, it must serve autograd as well.
            with torch.inference_mode(False):
                tensor = self._value.to(device=x.device, dtype=dtype)
            if _outlives_the_call(tensor):
                self._ready[key] = tensor
        return tensor


def _outlives_the_call(tensor: Tensor) -> bool:
    """False for stand-ins that a tracer or a functional transform will take down again."""
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return type(tensor) is Tensor and not functorch.is_functorch_wrapped_tensor(tensor)
