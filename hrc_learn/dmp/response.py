"""The exact motion of a primitive, as a linear map of its coordinates.

The state x = (y - g, y') obeys x' = A x + (0, phi(s)) if a basis function phi is the forcing.
The solution is x(b) = E(b - a) x(a) + integral from a to b of E(b - u) (0, phi(u)) du, where E
is the transition matrix of the spring. The integral is computed piece by piece, summed, and
kept as a table of polynomials.
"""

import json
import math
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy, refuse_nested_forward, transforming
from hrc_learn.dmp.dynamics import (
    Basis,
    SpringDamper,
    approach_curve,
    approach_state,
    basis_config,
    restored_basis,
)
from hrc_learn.geometry.numerics import lasting

GAUSS_POINTS = 12
"""Points of Gauss-Legendre quadrature per piece; no basis function changes much on a piece."""
DEGREE = 12
"""Degree of the polynomials; pieces are so short that the remaining error is rounding."""
GRIDS_KEPT = 16
"""Number of time grids whose matrices are cached. A program uses few grids; the matrices of 16
grids of 1000 times take 10 MB in float32 with 50 functions."""

SMALL_MATRIX_CORES = {"SkylakeX", "Cooperlake", "SapphireRapids"}
"""OpenBLAS core types (version 0.3.29) with kernels for small matrices, which skip packing.
These are all processors with AVX-512, including AMD's."""
MINIMUM_ROWS = 4
"""Smallest number of rows for which kernels for small matrices are faster than one flat product
of all motions."""


def chebyshev_points() -> Float[Tensor, "P"]:
    """Chebyshev points of a piece of unit length, both ends included (float64)."""
    k = torch.arange(DEGREE + 1, dtype=torch.float64)
    return (1 - torch.cos(torch.pi * k / DEGREE)) / 2


def powers_of(
    u: Float[Tensor, "*batch"], size: int, others: Sequence[Float[Tensor, "*batch"]] = ()
) -> Float[Tensor, "*batch K"]:
    """Powers u^0 to u^(size - 1), and other values after them.

    They are computed by products, because derivatives of `**` with a tensor of exponents
    contain the logarithm of u, which may be negative.
    """
    if torch.compiler.is_compiling() or u.requires_grad or transforming():
        columns = [torch.ones_like(u)]
        for _ in range(1, size):
            columns.append(columns[-1] * u)
        return torch.stack([*columns, *others], dim=-1)
    # Written in place column by column: a cumulative product along rows of six numbers takes
    # twice as long.
    powers = u.new_ones(*u.shape, size + len(others))
    for k in range(1, size):
        torch.mul(powers[..., k - 1], u, out=powers[..., k])
    for k, values in enumerate(others, start=size):
        powers[..., k] = values
    return powers


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Matrix function f(s) = sum_p c_p u^p, with u from -1 to 1 along the piece at s."""

    coefficients: Float[Tensor, "pieces P rows columns"]
    interval: float
    """Length of a piece."""
    periodic: bool = False
    """True if the first piece follows the last."""
    _moved: dict[torch.device, "PiecewisePolynomial"] = field(default_factory=dict)

    @classmethod
    def interpolate(
        cls,
        values: Float[Tensor, "pieces P rows columns"],
        interval: float,
        periodic: bool = False,
    ) -> "PiecewisePolynomial":
        """Interpolate values given at the Chebyshev points of each piece."""
        u = 2 * chebyshev_points() - 1
        powers = u[:, None] ** torch.arange(DEGREE + 1)
        solved = torch.linalg.solve(powers, values.flatten(2))
        return cls(solved.reshape(values.shape).contiguous(), interval, periodic)

    @property
    def end(self) -> float:
        """End of the last piece."""
        return self.interval * self.coefficients.shape[0]

    def __call__(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch rows columns"]:
        """Value at `s`; a function that is not periodic keeps its value at the end."""
        pieces, P, *shape = self.coefficients.shape
        x = s / self.interval
        x = x % pieces if self.periodic else x.clamp(0, pieces)
        piece = x.detach().long().clamp(max=pieces - 1)
        powers = powers_of(2 * (x - piece) - 1, P).unsqueeze(-2)
        # `index_select`, because a tracer reads a single index in brackets as a number.
        c = self.coefficients.flatten(2).index_select(0, piece.reshape(-1))
        return (powers @ c.view(*s.shape, *c.shape[1:])).view(*s.shape, *shape)

    def at(self, s: float) -> np.ndarray:
        """Value at the number `s`, (rows, columns), in NumPy."""
        rows, exponents, shape = self._arrays
        pieces = len(rows)
        x = s / self.interval
        x = x % pieces if self.periodic else min(max(x, 0.0), float(pieces))
        piece = min(int(x), pieces - 1)
        return ((2 * (x - piece) - 1) ** exponents).dot(rows[piece]).reshape(shape)

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
        """Coefficients by piece and power, the exponents, and the shape of a value."""
        coefficients = self.coefficients.numpy()
        rows = coefficients.reshape(*coefficients.shape[:2], -1)
        return rows, np.arange(rows.shape[1], dtype=float), coefficients.shape[2:]

    def to(self, device: torch.device) -> "PiecewisePolynomial":
        """The same function on another device, cached."""
        if device == self.coefficients.device:
            return self
        if device not in self._moved:
            moved = self.coefficients.to(device)
            self._moved[device] = PiecewisePolynomial(moved, self.interval, self.periodic)
        return self._moved[device]


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """A time grid with its response matrices."""

    s: Tensor
    version: int
    """Version counter of the tensor, compared where its values cannot be read; see `holds`."""
    content: bytes
    """Bytes of the times for which the matrices were computed."""
    matrices: tuple[Tensor, Tensor, Tensor]
    to_position: np.ndarray | None
    """The first of the matrices in NumPy; None if it is not on the CPU."""

    def holds(self, s: Tensor) -> bool:
        """True if `s` has the same times; `s` must not be traced or differentiated."""
        # Reading another device would wait for its queue, and transforms refuse it.
        if not s.is_cpu or transforming():
            return s is self.s and s._version == self.version
        same = s.dtype == self.s.dtype and s.shape == self.s.shape and self.s.is_cpu
        return same and s.numpy().tobytes() == self.content


class Response:
    """Exact response of y'' = alpha (beta (g - y) - y') + sum_i phi_i(s) w_i.

    y(s) = H(s) [w_1 ... w_N, y_0', y_0, g]: each column of H is the motion that one unit of a
    coordinate causes alone. The columns of the weights are integrated once by Gauss-Legendre
    quadrature with the transition matrix of the spring, and kept as polynomials in s; the other
    columns have a closed form. The motion does not depend on the step length of a grid. All
    computations are in float64.
    """

    def __init__(self, spring: SpringDamper, basis: Basis, approach: float = 0.0):
        """Integrate the response to all coordinates.

        Args:
            spring: Gains of the spring-damper.
            basis: Basis of the forcing term.
            approach: Fraction of the motion over which start and goal act along a minimum-jerk
                curve, see `dynamics.py`; 0: they act through the spring alone, as in the paper.
        """
        if not 0 <= approach <= 1 or (approach and basis.periodic):
            raise ValueError(
                f"approach must be a fraction from 0 to 1, and 0 for rhythms, got {approach}"
            )
        self.spring = spring
        self.basis = basis
        self.approach = approach
        self.name = json.dumps([asdict(spring), basis_config(basis), approach])
        """Spring, basis and approach as JSON text, for `named_response`."""
        self.size = basis.count + 3
        """M, the number of coordinates: N weights, start velocity, start, goal."""
        with lasting():
            self.forced = self._integrate()
        """States (y, y') caused by unit weights alone, (2, N). They start from rest at the goal
        at s = 0; for a periodic basis, they are on the limit cycle."""
        self.tables: dict[Hashable, Any] = {}
        """Tables that other modules derive from this response, kept as long as the response."""
        self._matrices: OrderedDict[tuple, tuple[Tensor, Tensor, Tensor]] = OrderedDict()
        self._latest: TimeGrid | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # A copied or unpickled response is the cached response with the same parts.
        return response_of, (self.spring, self.basis, self.approach)

    def matrices(
        self, s: Float[Tensor, "T"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "M T"], Float[Tensor, "M T"], Float[Tensor, "M T"]]:
        """H, H', H'' on one time grid, transposed to multiply from the right; cached.

        Args:
            s: Normalised times, all >= 0.
            dtype: dtype of the result.
        """
        latest = self.latest_grid(s)
        if latest is None or latest.matrices[0].dtype != dtype:
            content = s.detach().cpu().numpy().tobytes()
            key = content, s.dtype, s.device, dtype
            if key not in self._matrices:
                self._matrices[key] = self._transposed(s, dtype)
                if len(self._matrices) > GRIDS_KEPT:
                    self._matrices.popitem(last=False)
            self._matrices.move_to_end(key)
            matrices = self._matrices[key]
            version = -1 if s.is_inference() else s._version
            H = matrices[0].numpy() if s.is_cpu else None
            self._latest = latest = TimeGrid(s, version, content, matrices, H)
        return latest.matrices

    def latest_grid(self, s: Tensor) -> TimeGrid | None:
        """Time grid of the last call of `matrices`, if it has these times."""
        latest = self._latest
        if latest is None or torch.compiler.is_compiling() or not latest.holds(s):
            return None
        return latest

    @torch.inference_mode(False)
    def _transposed(self, s: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the result of `matrices`, usable inside and outside of inference mode."""
        H = self.evaluate(s.detach().clone().double()).to(dtype)
        position, velocity, acceleration = without_subnormals(H).permute(1, 2, 0).contiguous()
        return position, velocity, acceleration

    def evaluate(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 M"]:
        """Rows H(s), H'(s), H''(s); differentiable any number of times in `s`.

        Raises:
            NotImplementedError: Two nested forward derivatives (`refuse_nested_forward`).
        """
        refuse_nested_forward(s)
        state = _StateAt.apply(s, self)
        return torch.cat([state, self._acceleration(s, state)], dim=-2)

    def coasting(self, s: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch"] | float:
        """Time since the end of the forcing, during which the spring acts alone."""
        if self.basis.periodic:
            return 0 * s
        past = s - self.forced.end
        return past.clamp(min=0) if isinstance(past, Tensor) else max(past, 0.0)

    def state(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 M"]:
        """Rows H(s), H'(s)."""
        E = self.spring.propagator(s)
        start, velocity = E[..., :, :1], E[..., :, 1:]
        at_rest = torch.tensor([[1.0], [0.0]], dtype=s.dtype, device=s.device)
        table = self.forced.to(s.device)
        forced = self.spring.propagator(self.coasting(s)) @ table(s)
        if self.basis.periodic:
            # The motion starts at rest: its initial distance to the limit cycle decays.
            forced = forced - E @ table(torch.zeros_like(s))
        if self.approach:
            start = -approach_state(s, self.approach)[..., None]
        return torch.cat([forced, velocity, start, at_rest - start], dim=-1)

    def approach_force(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Forcing, per unit of goal - start, that moves along m(s) (`approach_curve`)."""
        offset, slope, curvature = (approach_curve(s, self.approach, k) for k in range(3))
        return curvature - self.spring.acceleration(offset, slope)

    def _acceleration(self, s: Tensor, state: Tensor) -> Tensor:
        goal = torch.zeros(self.size, dtype=s.dtype, device=s.device)
        goal[-1] = 1.0
        forcing = torch.nn.functional.pad(self.basis.forcing(s), (0, 3))
        if self.approach:
            force = self.approach_force(s)[..., None]
            forcing = torch.cat([forcing[..., :-2], -force, force], dim=-1)
        # The goal is 0 for all columns except the column of the goal, for which it is 1.
        free = self.spring.acceleration(state[..., 0, :] - goal, state[..., 1, :])
        return (free + forcing)[..., None, :]

    def _integrate(self) -> PiecewisePolynomial:
        """Integrate all basis functions to the end of the forcing, or over one period."""
        propagate = self.spring.propagator
        interval = min(self.basis.smooth_interval, self.spring.smooth_interval)
        if self.basis.knot_spacing is not None:
            interval = self.basis.knot_spacing / math.ceil(self.basis.knot_spacing / interval)
        elif self.approach:
            interval = self.approach / math.ceil(self.approach / interval)
        # The tolerance keeps rounding from adding a piece past the last knot.
        n_pieces = math.ceil(self.basis.horizon / interval - 1e-9)
        knots = interval * torch.arange(n_pieces + 1, dtype=torch.float64)
        points = interval * chebyshev_points()
        increments = torch.stack([self._impulse(knots[:-1], point) for point in points], dim=1)
        # States at the knots, starting from rest at the first knot, by a parallel prefix sum
        # (Hillis and Steele 1986) with log2(K) steps.
        state, stride = torch.nn.functional.pad(increments[:, -1], (0, 0, 0, 0, 1, 0)), 1
        while stride < len(knots):
            E = propagate(knots[stride:] - knots[:-stride])
            state = torch.cat([state[:stride], state[stride:] + E @ state[:-stride]])
            stride *= 2
        if self.basis.periodic:
            # Start to which the motion returns after a period: x = E x + (state from rest).
            E = propagate(knots[-1])
            cycle = torch.linalg.solve(torch.eye(2, dtype=torch.float64) - E, state[-1])
            state = state + propagate(knots) @ cycle
        # On each piece: the free motion from its first knot, plus the effect of the forcing
        # since this knot.
        values = propagate(points) @ state[:-1, None] + increments
        return PiecewisePolynomial.interpolate(values, interval, self.basis.periodic)

    def _impulse(
        self, start: Float[Tensor, "pieces"], length: Float[Tensor, ""]
    ) -> Float[Tensor, "pieces 2 N"]:
        """State (y, y') at start + length that the forcing since `start` causes."""
        nodes, weights = (
            torch.from_numpy(x).to(start) for x in np.polynomial.legendre.leggauss(GAUSS_POINTS)
        )
        u = length * ((1 + nodes) / 2)
        kernel = self.spring.propagator(length - u)[..., 1] * (length / 2 * weights)[:, None]
        return kernel.mT @ self.basis.forcing(start[:, None] + u)


class _StateAt(torch.autograd.Function):
    """`Response.state`, whose derivative is given by the differential equation itself."""

    generate_vmap_rule = True

    @staticmethod
    def forward(s, response):
        return response.state(s)

    @staticmethod
    def setup_context(ctx, inputs, output):
        s, ctx.response = inputs
        ctx.save_for_backward(s)
        ctx.save_for_forward(s)

    @staticmethod
    def backward(ctx, grad):
        (s,) = ctx.saved_tensors
        # The derivative of (H, H') is (H', H'').
        rate = ctx.response.evaluate(s)[..., 1:, :]
        return (grad * rate).sum((-2, -1)), None

    @staticmethod
    def jvp(ctx, ds, _):
        (s,) = ctx.saved_tensors
        return ctx.response.evaluate(s)[..., 1:, :] * ds[..., None, None]


# A table of 50 Gaussians takes 1.3 MB; few programs use 64 different responses at a time.
@lru_cache(maxsize=64)
def response_of(spring: SpringDamper, basis: Basis, approach: float = 0.0) -> Response:
    """Cached `Response`: equal primitives use the same tables and matrices."""
    return Response(spring, basis, approach)


def named_response(name: str) -> Response:
    """Shared response with this `name`, for custom operators, which cannot take objects."""
    spring, basis, approach = json.loads(name)
    return response_of(SpringDamper(**spring), restored_basis(basis), approach)


@cache
def numpy_limit() -> int:
    """Number of multiplications up to which NumPy beats PyTorch on one thread.

    The measured example is one motion of 7 x 1000 samples and 50 functions, which takes 371,000
    multiplications. OpenBLAS needs 5 us with kernels for small matrices and 25 us without them
    (Haswell). PyTorch with MKL needs 15 us (AMD EPYC with AVX-512).
    """
    from threadpoolctl import threadpool_info

    small = any(
        library.get("architecture") in SMALL_MATRIX_CORES
        for library in threadpool_info()
        if library["internal_api"] == "openblas"
    )
    return 10**6 if small else 10**5


def product(
    X: Float[Tensor, "*batch D M"], H: Float[Tensor, "M T"]
) -> Float[Tensor, "*batch D T"]:
    """Product X H of a batch of coordinates with one matrix.

    Multiplying motion by motion takes less than half the time of one flat product if OpenBLAS
    has kernels for small matrices, and four times as long if it has none.
    """
    D, single = X.shape[-2], X.ndim == 2
    if fits_numpy(X):
        beats = single or (D >= MINIMUM_ROWS and torch.get_num_threads() == 1)
        if beats and D * H.numel() <= numpy_limit():
            return torch.from_numpy(np.matmul(X.numpy(), H.numpy()))
        if not single:
            y = empty_in_large_pages(X, *X.shape[:-1], H.shape[-1])
            torch.mm(X.flatten(0, -2), H, out=y.flatten(0, -2))
            return y
    # One flat product: PyTorch's batched product with a common matrix is ten times slower.
    return (X.flatten(0, -2) @ H).view(*X.shape[:-1], H.shape[-1])


def empty_in_large_pages(like: Tensor, *shape: int) -> Tensor:
    """Uninitialised tensor; on a CPU, in memory with large pages, which NumPy requests.

    With small pages, mapping hundreds of megabytes takes as long as the product.
    """
    if not like.is_cpu:
        return like.new_empty(shape)
    return torch.from_numpy(np.empty(shape, str(like.dtype).removeprefix("torch.")))


def without_subnormals(values: Tensor) -> Tensor:
    """Values with tiny entries set to zero: subnormal numbers slow products several times."""
    limits = torch.finfo(values.dtype)
    return torch.where(values.abs() < limits.tiny / limits.eps, 0.0, values)
