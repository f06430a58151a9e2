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
        self._duration = duration[..., None]
        self._response = response
        self._batch = broadcast_shapes(coordinates.shape[:-2], s.shape[:-1], duration.shape)

    @cached_property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        return (self._s * self._duration).to(self._coordinates.dtype).expand(*self._batch, -1)

    @cached_property
    def position(self) -> Float[Tensor, "*batch T D"]:
        """In the units of the demonstration, [rad] or [m]."""
        return self._output(0).expand(*self._batch, -1, -1)

    @cached_property
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """The same per second."""
        return self._output(1).expand(*self._batch, -1, -1)

    @cached_property
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """The same per second squared."""
        return self._output(2).expand(*self._batch, -1, -1)

    def _output(self, order: int) -> Tensor:
        X = self._coordinates
        if order:
            X = X / self._duration[..., None] ** order
        if self._s.ndim == 1 and not self._s.requires_grad:
            # One flat product: batched ones against a shared matrix are ten times slower.
            H = self._response.matrices(self._s, X.dtype)[order]
            return (X.reshape(-1, X.shape[-1]) @ H).view(*X.shape[:-1], -1).mT
        return self._rows[..., order, :].to(X.dtype) @ X.mT

    @cached_property
    def _rows(self) -> Float[Tensor, "*#batch T 3 M"]:
        return self._response.evaluate(self._s.double())


def broadcast_shapes(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """As `torch.broadcast_shapes`, which takes longer than a rollout of shapes all alike."""
    first = shapes[0]
    return first if all(shape == first for shape in shapes) else torch.broadcast_shapes(*shapes)
