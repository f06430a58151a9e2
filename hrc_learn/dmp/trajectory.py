"""The motion a rollout returns."""

from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.system.response import Response


class Trajectory:
    """A motion over time, each output computed when first asked for.

    Position, velocity and acceleration are one matrix product each; a caller that needs the
    position alone pays for nothing else.
    """

    def __init__(
        self,
        *,
        coordinates: Float[Tensor, "*#batch D M"],
        s: Float[Tensor, "*#batch T"],
        duration: Float[Tensor, "*#batch"],
        response: Response,
    ):
        """Describe the motion.

        Args:
            coordinates: What `response` maps to motions.
            s: Normalised times.
            duration: [s].
            response: Of the primitive.
        """
        self._coordinates = coordinates
        self._s = s
        self._duration = duration
        self._response = response

    @cached_property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        time = self._s * self._duration[..., None]
        return time.to(self._coordinates.dtype).expand(*self._batch, -1)

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration, [rad] or [m]."""
        return self._output(0)

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """The same per second."""
        return self._output(1)

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        return self._output(2)

    def _output(self, order: int) -> Float[Tensor, "*batch T D"]:
        X = self._coordinates
        if order:
            X = X / self._duration[..., None, None] ** order
        if self._s.ndim == 1 and not self._s.requires_grad:
            # One flat product: batched ones against a shared matrix are ten times slower.
            H = self._response.matrices(self._s, X.dtype)[order]
            y = X @ H if X.ndim == 2 else (X.flatten(0, -2) @ H).view(*X.shape[:-1], -1)
        else:
            y = X @ self._rows[..., order, :].to(X.dtype).mT
        return y.mT if y.shape[:-2] == self._batch else y.mT.expand(*self._batch, -1, -1)

    @cached_property
    def _batch(self) -> torch.Size | tuple[int, ...]:
        return broadcast_shapes(
            self._coordinates.shape[:-2], self._s.shape[:-1], self._duration.shape
        )

    @cached_property
    def _rows(self) -> Float[Tensor, "*#batch T 3 M"]:
        return self._response.evaluate(self._s.double())


def broadcast_shapes(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """As `torch.broadcast_shapes`, which takes longer than a rollout of shapes all alike."""
    first = shapes[0]
    return first if all(shape == first for shape in shapes) else torch.broadcast_shapes(*shapes)
