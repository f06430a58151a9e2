"""The motion of a primitive as a linear map of its coordinates."""

from collections import OrderedDict
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.basis import GaussianBasis
from hrc_learn.dmp.spring import SpringDamper

KNOTS_PER_BASIS = 8
"""Table knots per basis function. With 4 Gauss points a knot interval the quadrature
error is below 1e-13 of the response (the tests compare it with an ODE solver)."""
GAUSS_POINTS = 4
GRIDS_KEPT = 16


class Response:
    """Response of y'' = alpha (beta (g - y) - y') + sum_i phi_i(s) w_i, solved exactly.

    y(s) = H(s) [w_1 ... w_N, y_0', y_0, g]: the columns of H are the motions that a unit of
    each coordinate causes alone. Their state (y, y') is tabulated at knots and carried from
    a knot to any s between by the transition matrix of the spring, with the forcing
    integrated by Gauss-Legendre quadrature; nothing depends on the step length of a grid.
    Everything is float64 until it is handed out.
    """

    def __init__(self, spring: SpringDamper, basis: GaussianBasis):
        self.spring = spring
        self.basis = basis
        self.size = basis.count + 3
        """Number of coordinates: N weights, start velocity, start, goal."""
        self._interval = 1.0 / (KNOTS_PER_BASIS * basis.count)
        self._tables: dict[torch.device, Tensor] = {}
        self._matrices: OrderedDict[tuple, tuple[Tensor, Tensor, Tensor]] = OrderedDict()

    def matrices(
        self, s: Float[Tensor, "T"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "M T"], Float[Tensor, "M T"], Float[Tensor, "M T"]]:
        """H, H', H'' over one time grid, transposed for a product from the right; cached.

        Args:
            s: Normalised times, all >= 0.
            dtype: Of the result.
        """
        key = (s.detach().cpu().numpy().tobytes(), s.dtype, s.device, dtype)
        if key in self._matrices:
            self._matrices.move_to_end(key)
            return self._matrices[key]
        rows = self.evaluate(s.detach().double()).to(dtype)
        position, velocity, acceleration = rows.permute(1, 2, 0).contiguous()
        matrices = position, velocity, acceleration
        self._matrices[key] = matrices
        if len(self._matrices) > GRIDS_KEPT:
            self._matrices.popitem(last=False)
        return matrices

    def evaluate(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 M"]:
        """Rows H(s), H'(s), H''(s); differentiable any number of times in `s`."""
        state = _StateAt.apply(s, self)
        return torch.cat([state, self._acceleration(s, state)], dim=-2)

    def forced_state(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 N"]:
        """(y, y') that unit weights alone have caused by `s`, from rest at the goal."""
        knot = (s / self._interval).floor().clamp(0, self._last_knot)
        table = self._table(s.device)
        return self._carry(table[knot.long()], knot * self._interval, s)

    def _state(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 M"]:
        E = self.spring.propagator(s)
        start, velocity = E[..., :, :1], E[..., :, 1:]
        at_rest = torch.tensor([[1.0], [0.0]], dtype=s.dtype, device=s.device)
        return torch.cat([self.forced_state(s), velocity, start, at_rest - start], dim=-1)

    def _acceleration(self, s: Tensor, state: Tensor) -> Tensor:
        goal = torch.zeros(self.size, dtype=s.dtype, device=s.device)
        goal[-1] = 1.0
        forcing = torch.nn.functional.pad(self.basis.forcing(s), (0, 3))
        free = self.spring.acceleration(state[..., 0, :] - goal, state[..., 1, :])
        return (free + forcing)[..., None, :]

    def _carry(self, state: Tensor, s_from: Tensor, s_to: Tensor) -> Tensor:
        """Forced state at `s_to` from the one at `s_from`, no further than a knot away."""
        nodes, node_weights = (
            torch.as_tensor(a).to(s_to) for a in np.polynomial.legendre.leggauss(GAUSS_POINTS)
        )
        half = (s_to - s_from) / 2
        u = s_from[..., None] + half[..., None] * (1 + nodes)
        # Late enough the forcing is zero, and only then may s_to be far from the last knot.
        impulse = self.spring.propagator(s_to[..., None] - u)[..., 1]
        kernel = (half[..., None] * node_weights)[..., None] * impulse
        added = kernel.mT @ self.basis.forcing(u)
        return self.spring.propagator(s_to - s_from) @ state + added

    @property
    def _last_knot(self) -> int:
        return int(self.basis.phase.horizon / self._interval)

    def _table(self, device: torch.device) -> Float[Tensor, "knots 2 N"]:
        if device not in self._tables:
            self._tables[device] = self._build_table().to(device)
        return self._tables[device]

    def _build_table(self) -> Tensor:
        """Forced state at every knot, by a parallel prefix sum over the knot intervals."""
        knots = self._interval * torch.arange(self._last_knot + 1, dtype=torch.float64)
        rest = torch.zeros(len(knots) - 1, 2, self.basis.count, dtype=torch.float64)
        state = torch.cat([rest[:1], self._carry(rest, knots[:-1], knots[1:])])
        stride = 1
        while stride < len(knots):
            E = self.spring.propagator(knots[stride])
            state = torch.cat([state[:stride], state[stride:] + E @ state[:-stride]])
            stride *= 2
        return state


class _StateAt(torch.autograd.Function):
    """State of the response at s, whose derivative is the differential equation itself."""

    generate_vmap_rule = True

    @staticmethod
    def forward(s, response):
        return response._state(s)

    @staticmethod
    def setup_context(ctx, inputs, output):
        s, ctx.response = inputs
        ctx.save_for_backward(s)

    @staticmethod
    def backward(ctx, grad):
        (s,) = ctx.saved_tensors
        rate = ctx.response.evaluate(s)[..., 1:, :]
        return (grad * rate).sum((-2, -1)), None


@lru_cache(maxsize=64)
def response_of(spring: SpringDamper, basis: GaussianBasis) -> Response:
    """The one `Response` of these parts: primitives alike share tables and matrices."""
    return Response(spring, basis)
