"""Motions over time, the results of rollouts."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import broadcast_shapes, full_precision, readable
from hrc_learn.dmp.ragged_times import LONG, motion, spring_rows
from hrc_learn.dmp.response import Response, numpy_limit, product


class PlottableTensor(Tensor):
    """Tensor that NumPy and Matplotlib read as it is, although gradients flow through it.

    Its slices are plottable too; the result of any other operation is an ordinary tensor.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.detach().cpu().numpy(), dtype=dtype, copy=copy)

    def __getitem__(self, index: Any) -> Tensor:
        return plottable(super().__getitem__(index))


def plottable(values: Tensor) -> Tensor:
    """The same tensor, readable by NumPy; gradients still flow through it."""
    if not values.requires_grad or not readable(values):
        return values  # NumPy reads it anyway, or a program is traced or mapped
    return values.as_subclass(PlottableTensor)


class output[T](cached_property[T]):  # noqa: N801  a decorator, like `property`
    """Output of a rollout: computed on first access, then kept, and plottable."""

    def __init__(self, compute: Callable[[Any], T]):
        def compute_plottable(trajectory: Any) -> Any:
            values: Any = compute(trajectory)
            return plottable(values)

        super().__init__(compute_plottable)
        self.__doc__ = compute.__doc__


class ArrayOutputs:
    """Outputs of a rollout as NumPy arrays."""

    outputs: ClassVar[tuple[str, ...]]

    def numpy(self) -> dict[str, np.ndarray]:
        """All outputs by name, detached from gradients."""
        return {name: getattr(self, name).detach().cpu().numpy() for name in self.outputs}


class Trajectory(ArrayOutputs):
    """Motion over time; each output is computed on first access.

    Position, velocity and acceleration take one matrix product each, so a caller that needs
    the position alone pays for nothing else. Outputs can be plotted directly.
    """

    outputs = ("time", "position", "velocity", "acceleration")

    def __init__(
        self,
        *,
        coordinates: Float[Tensor, "*#batch D M"] | Float[np.ndarray, "D M"],
        s: Float[Tensor, "*#batch T"],
        duration: Float[Tensor, "*#batch"],
        response: Response,
    ):
        """Describe a motion.

        Args:
            coordinates: Weights, start velocity, start and goal, which `response` maps to the
                motion; an array if it is a single motion without gradients.
            s: Normalised times.
            duration: Duration [s].
            response: Response of the primitive.
        """
        self._array = coordinates if isinstance(coordinates, np.ndarray) else None
        self._given = coordinates
        self.s = s
        """Normalised times."""
        self.duration = duration
        """Duration of the motion [s]."""
        self._response = response

    @output
    def time(self) -> Float[Tensor, "*batch T"]:
        """Time since the start of the motion [s]."""
        time = self.s * self.duration[..., None]
        return time.to(self._coordinates.dtype).expand(*self._batch, -1)

    @output
    def position(self) -> Float[Tensor, "*batch T D"]:
        """Position in the units of the demonstration, [rad] or [m]."""
        return self._derivative(0)

    @output
    def velocity(self) -> Float[Tensor, "*batch T D"]:
        """Velocity, position units per second."""
        return self._derivative(1)

    @output
    def acceleration(self) -> Float[Tensor, "*batch T D"]:
        """Acceleration, position units per second squared."""
        return self._derivative(2)

    @output
    def jerk(self) -> Float[Tensor, "*batch T D"]:
        """Jerk, position units per second cubed."""
        return self._derivative(3)

    @full_precision
    def _derivative(self, order: int) -> Float[Tensor, "*batch T D"]:
        """Time derivative of the motion."""
        s = self.s
        latest = None if s.requires_grad else self._response.latest_grid(s)
        if not order and self._array is not None and latest is not None:
            # A shortcut for a single motion without gradients.
            x, h = self._array, latest.to_position
            if h is not None and h.dtype == x.dtype and len(x) * h.size <= numpy_limit():
                return torch.from_numpy(x.dot(h).T)
        X = self._coordinates
        if order:
            X = X / self.duration[..., None, None] ** order
        # Matrices made inside a derivative transform could not be kept.
        shared = latest is not None or (
            s.ndim == 1 and not s.requires_grad and readable(s, s.detach())
        )
        # On a long grid, the matrices for few motions would be larger than the motions.
        if order > 2 or not shared or (s.shape[-1] > LONG and X.numel() < 3 * X.shape[-1] ** 2):
            return self._at_ragged_times(X, order)
        y = product(X, self._response.matrices(s, X.dtype)[order]).mT
        single = X.ndim == 2 and not self.duration.ndim  # comparing shapes takes longer
        if single or self.duration.shape == X.shape[:-2]:
            return y
        return y.expand(*self._batch, -1, -1)

    def _at_ragged_times(self, X: Tensor, order: int) -> Float[Tensor, "*batch T D"]:
        s, (D, M) = self.s.double(), X.shape[-2:]
        if X.ndim == 2:
            # All times of the batch belong to one motion.
            y = motion(self._response, s.reshape(1, -1), X[None], order).view(*s.shape, D)
        else:
            batch = broadcast_shapes(X.shape[:-2], s.shape[:-1])
            s = s.expand(*batch, -1).flatten(0, -2)
            y = motion(self._response, s, X.expand(*batch, D, M).flatten(0, -3), order)
            y = y.view(*batch, *y.shape[1:])
        return y.expand(*self._batch, -1, -1)

    @cached_property
    def _coordinates(self) -> Float[Tensor, "*#batch D M"]:
        given = self._given
        return given if isinstance(given, Tensor) else torch.from_numpy(given)

    @cached_property
    def _batch(self) -> torch.Size | tuple[int, ...]:
        return broadcast_shapes(
            self._coordinates.shape[:-2], self.s.shape[:-1], self.duration.shape
        )


class ContinuedTrajectory(Trajectory):
    """Motion that continues from any state at the normalised time s_0.

    y(s) = H(s) x + E(s - s_0) [state - (H, H')(s_0) x]

    H x is the motion with the coordinates x, from which the state may differ. The difference
    decays like the unforced spring, whose transition matrix is E. The motion is exact, linear
    in x and the state, and starts with the given position and velocity. If the state lies on H
    x, the motion is the remainder of H x.
    """

    def __init__(
        self,
        *,
        since: Float[Tensor, "*#batch"] | None,
        position: Float[Tensor, "*#batch D"],
        velocity: Float[Tensor, "*#batch D"],
        **motion: Any,
    ):
        """Describe a motion that passes a state.

        Args:
            since: Normalised time s_0 of the state; None: the motion is H x from its start.
            position: Position at s_0.
            velocity: Velocity at s_0 [1/s].
            motion: Arguments of `Trajectory` for the whole motion; no time in `s` is before
                `since`.
        """
        super().__init__(**motion)
        self._since = since
        if since is not None:
            reached = Trajectory(**motion | dict[str, Any](s=since[..., None]))
            off = position - reached.position[..., 0, :]
            off_rate = (velocity - reached.velocity[..., 0, :]) * self.duration[..., None]
            self._off = torch.stack([off, off_rate], dim=-1)

    @full_precision
    def _derivative(self, order: int) -> Float[Tensor, "*batch T D"]:
        y = super()._derivative(order)
        if self._since is None:
            return y
        back = spring_rows(self._response, self.s - self._since[..., None], order)
        return y + back.to(y) @ (self._off / self.duration[..., None, None] ** order).mT
