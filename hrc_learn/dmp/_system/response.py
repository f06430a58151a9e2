"""The motion of a primitive as a linear map of its coordinates, and the trajectory it gives.

What the forcing alone does to the spring: x' = A x + (0, phi(s)) has the solution x(b) =
E(b - a) x(a) + integral from a to b of E(b - u) (0, phi(u)) du, E the transition matrix. It is
integrated along pieces, summed up, and kept as a table of polynomials.
"""

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import fits_numpy, readable
from hrc_learn.dmp._system.bases import Basis
from hrc_learn.dmp._system.closed_forms import SpringDamper, approach_state, minimum_jerk
from hrc_learn.dmp._system.own_times import OwnTimesTable, motion
from hrc_learn.dmp._system.products import most_in_numpy, product, without_subnormals

GAUSS_POINTS = 12
"""For the forcing over one piece of a table, which no basis function changes much in."""

type Propagate = Callable[[Tensor], Tensor]
"""Times (*batch) to transition matrices (*batch 2 2)."""
type Forcing = Callable[[Tensor], Tensor]
"""Times (*batch) to the forcing of each basis function (*batch N)."""


def impulse(
    propagate: Propagate,
    forcing: Forcing,
    start: Float[Tensor, "pieces"],
    length: Float[Tensor, "*pieces"],
    n_points: int = GAUSS_POINTS,
) -> Float[Tensor, "pieces 2 N"]:
    """(y, y') at start + length that the forcing since `start` has caused, by quadrature.

    Args:
        propagate: Transition matrix.
        forcing: Of the basis.
        start: Of each piece.
        length: Of each piece, or of all.
        n_points: Of Gauss-Legendre quadrature.
    """
    nodes, weights = (
        torch.from_numpy(x).to(start) for x in np.polynomial.legendre.leggauss(n_points)
    )
    u = length[..., None] * ((1 + nodes) / 2)
    kernel = (
        propagate(length[..., None] - u)[..., 1] * (length[..., None] / 2 * weights)[..., None]
    )
    return kernel.mT @ forcing(start[:, None] + u)


def accumulate(
    propagate: Propagate,
    knots: Float[Tensor, "K"],
    shares: Float[Tensor, "K_less_1 2 N"],
) -> Float[Tensor, "K 2 N"]:
    """States at the knots, from rest at the first, that the shares of the pieces add up to.

    A parallel prefix sum (Hillis and Steele 1986): its steps are the logarithm of K.
    """
    state = torch.cat([torch.zeros_like(shares[:1]), shares])
    stride = 1
    while stride < len(knots):
        E = propagate(knots[stride:] - knots[:-stride])
        state = torch.cat([state[:stride], state[stride:] + E @ state[:-stride]])
        stride *= 2
    return state


DEGREE = 12
"""Of the polynomial on a piece, whose error is then rounding: pieces are chosen that short."""


def chebyshev_points() -> Float[Tensor, "P"]:
    """Chebyshev points of a piece of unit length, both ends included."""
    k = torch.arange(DEGREE + 1, dtype=torch.float64)
    return (1 - torch.cos(torch.pi * k / DEGREE)) / 2


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """A matrix f(s) = sum_p c_p u^p, u from -1 to 1 along the piece that s lies on."""

    coefficients: Float[Tensor, "pieces P rows columns"]
    interval: float
    """Length of a piece."""
    periodic: bool = False
    """Whether the last piece is followed by the first."""
    _exponents: Float[Tensor, "1 P"] = field(init=False)
    _moved: dict[torch.device, "PiecewisePolynomial"] = field(default_factory=dict)

    def __post_init__(self):
        # Now and not when first needed: that may be while a program is traced, and what is
        # made there is no tensor to keep.
        exponents = torch.arange(DEGREE + 1)[None].to(self.coefficients)
        object.__setattr__(self, "_exponents", exponents)

    @classmethod
    def interpolate(
        cls,
        values: Float[Tensor, "pieces P rows columns"],
        interval: float,
        periodic: bool = False,
    ) -> "PiecewisePolynomial":
        """The function that has these values at the Chebyshev points of its pieces."""
        u = 2 * chebyshev_points() - 1
        powers = u[:, None] ** torch.arange(DEGREE + 1)
        solved = torch.linalg.solve(powers, values.flatten(2))
        return cls(solved.reshape(values.shape).contiguous(), interval, periodic)

    @property
    def points(self) -> Float[Tensor, "P"]:
        """Where a piece of unit length is interpolated (float64)."""
        return chebyshev_points()

    @property
    def end(self) -> float:
        """Where the last piece ends."""
        return self.interval * self.coefficients.shape[0]

    def __call__(
        self, s: Float[Tensor, "*batch"] | float
    ) -> Float[Tensor, "*batch rows columns"]:
        """Value at `s`; past the end of what is not periodic, the value at the end."""
        pieces, P, *shape = self.coefficients.shape
        if not isinstance(s, Tensor):
            x = s / self.interval
            x = x % pieces if self.periodic else min(max(x, 0.0), float(pieces))
            piece = min(int(x), pieces - 1)
            powers = torch.pow(2 * (x - piece) - 1, self._exponents)
            return (powers @ self.coefficients[piece].view(P, -1)).view(shape)
        x = s / self.interval
        x = x % pieces if self.periodic else x.clamp(0, pieces)
        piece = x.detach().long().clamp(max=pieces - 1)
        powers = (2 * (x - piece) - 1)[..., None, None] ** self._exponents
        # Not by brackets: those read a single index as a number, which no export can trace.
        c = self.coefficients.view(pieces, -1).index_select(0, piece.reshape(-1))
        return (powers @ c.view(*s.shape, P, -1)).view(*s.shape, *shape)

    def at(self, s: float) -> np.ndarray:
        """Value at `s`, (rows, columns), in NumPy."""
        rows, exponents, shape = self._arrays
        pieces = len(rows)
        x = s / self.interval
        x = x % pieces if self.periodic else min(max(x, 0.0), float(pieces))
        piece = min(int(x), pieces - 1)
        return ((2 * (x - piece) - 1) ** exponents).dot(rows[piece]).reshape(shape)

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
        """Coefficients by piece and power, the powers, and the shape of a value."""
        coefficients = self.coefficients.numpy()
        rows = coefficients.reshape(*coefficients.shape[:2], -1)
        return rows, np.arange(rows.shape[1], dtype=float), coefficients.shape[2:]

    def to(self, device: torch.device) -> "PiecewisePolynomial":
        """The same function on another device; made once."""
        if device == self.coefficients.device:
            return self
        if device not in self._moved:
            moved = self.coefficients.to(device)
            self._moved[device] = PiecewisePolynomial(moved, self.interval, self.periodic)
        return self._moved[device]


GRIDS_KEPT = 16
"""Time grids whose matrices are kept: a program rolls out on a few, and 16 of 1000 times in
float32 with 50 functions take 10 MB."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Times that matrices were asked for, as they were then."""

    own: Tensor
    address: int
    version: int
    """Of the tensor; -1: it counts none."""
    memory: np.ndarray | None
    """Its numbers as they are now; None: on another device."""
    content: bytes
    copy: Tensor
    matrices: tuple[Tensor, Tensor, Tensor]
    to_position: np.ndarray | None
    """The first of them, on a CPU."""

    @classmethod
    def of(cls, s: Tensor, matrices: tuple[Tensor, Tensor, Tensor]) -> "_Grid":
        """Of times that nothing derives, maps or traces."""
        memory = s.detach().numpy() if s.is_cpu else None
        content = b"" if memory is None else memory.tobytes()
        version = -1 if s.is_inference() else s._version
        H = None if memory is None else matrices[0].numpy()
        address, copy = s.data_ptr(), s.detach().clone()
        return cls(s, address, version, memory, content, copy, matrices, H)

    def is_like(self, s: Tensor) -> bool:
        """Whether these are the same times, in whatever tensor."""
        alike = self.copy.dtype == s.dtype and self.copy.device == s.device
        return alike and torch.equal(self.copy, s)

    def is_still(self, s: Tensor) -> bool:
        """Whether this is the tensor, and holds the same times."""
        if s is not self.own or s.data_ptr() != self.address:
            return False
        if self.memory is None:  # to look would wait for all that was asked of the device
            return self.version >= 0 and s._version == self.version
        # What is written past PyTorch, as through `data`, counts for no version.
        return s.numel() == self.memory.size and self.memory.tobytes() == self.content


class Response:
    """Response of y'' = alpha (beta (g - y) - y') + sum_i phi_i(s) w_i, solved exactly.

    y(s) = H(s) [w_1 ... w_N, y_0', y_0, g]: the columns of H are the motions that a unit of
    each coordinate causes alone. What the weights cause is integrated once by Gauss-Legendre
    quadrature and the transition matrix of the spring, and kept as polynomials in s; the
    rest is closed form. Nothing depends on the step length of a grid. Everything is float64
    until it is handed out.
    """

    def __init__(self, spring: SpringDamper, basis: Basis, approach: float = 0.0):
        """Solve the equation for all coordinates.

        Args:
            spring: Gains.
            basis: Of the forcing term.
            approach: Share of the motion over which start and goal act along a minimum-jerk
                curve, see `closed_forms.py`; 0: they act through the spring alone, as printed.
        """
        if not 0 <= approach <= 1 or (approach and basis.periodic):
            raise ValueError(
                f"approach must be a share, 0 to 1, and 0 for rhythms, got {approach}"
            )
        self.spring = spring
        self.basis = basis
        self.approach = approach
        self.size = basis.count + 3
        """Number of coordinates: N weights, start velocity, start, goal."""
        # Tensors made in inference mode cannot take part in a backward pass later.
        with torch.inference_mode(False):
            self.forced = self._integrate()
        """(y, y') that unit weights alone cause, (2, N): from rest at the goal at s = 0, or,
        of a periodic basis, the limit cycle."""
        self._matrices: OrderedDict[tuple, tuple[Tensor, Tensor, Tensor]] = OrderedDict()
        self.own_times: dict[tuple[int, torch.dtype, torch.device], OwnTimesTable] = {}
        """For motions each at times of its own, see `own_times.py`."""
        self._latest: _Grid | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Tables are made again from what they were made of, or found: there is one for all.
        return response_of, (self.spring, self.basis, self.approach)

    def matrices(
        self, s: Float[Tensor, "T"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "M T"], Float[Tensor, "M T"], Float[Tensor, "M T"]]:
        """H, H', H'' over one time grid, transposed for a product from the right; cached.

        Args:
            s: Normalised times, all >= 0.
            dtype: Of the result.
        """
        latest = self._latest
        if latest is not None and latest.is_like(s) and latest.matrices[0].dtype == dtype:
            # A transform would not let its memory be seen.
            if latest.own is not s and fits_numpy(s):
                self._latest = _Grid.of(s, latest.matrices)
            return latest.matrices
        key = (s.detach().cpu().numpy().tobytes(), s.dtype, s.device, dtype)
        if key not in self._matrices:
            self._matrices[key] = self._transposed(s, dtype)
            if len(self._matrices) > GRIDS_KEPT:
                self._matrices.popitem(last=False)
        self._matrices.move_to_end(key)
        self._latest = _Grid.of(s, self._matrices[key])
        return self._matrices[key]

    def latest_grid(self, s: Tensor) -> _Grid | None:
        """The one that `matrices` were last asked for, if that is it: it has been read."""
        latest = self._latest
        if latest is None or torch.compiler.is_compiling() or not latest.is_still(s):
            return None
        return latest

    @torch.inference_mode(False)
    def _transposed(self, s: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """`matrices`, for all calls to come."""
        H = self.evaluate(s.detach().clone().double()).to(dtype)
        position, velocity, acceleration = without_subnormals(H).permute(1, 2, 0).contiguous()
        return position, velocity, acceleration

    def evaluate(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 M"]:
        """Rows H(s), H'(s), H''(s); differentiable any number of times in `s`."""
        state = _StateAt.apply(s, self)
        return torch.cat([state, self._acceleration(s, state)], dim=-2)

    def coasting(self, s: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch"] | float:
        """How long the spring alone has moved on what the forcing caused until it ended."""
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
            # From rest: what it takes to be off the limit cycle at first dies out.
            forced = forced - E @ table(torch.zeros_like(s))
        if self.approach:
            start = -approach_state(s, self.approach)[..., None]
        return torch.cat([forced, velocity, start, at_rest - start], dim=-1)

    def approach_force(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Forcing per unit of goal - start that makes the motion between them m(s)."""
        m, slope, curvature = minimum_jerk(s, self.approach)
        return curvature - self.spring.acceleration(m - 1, slope)

    def _acceleration(self, s: Tensor, state: Tensor) -> Tensor:
        goal = torch.zeros(self.size, dtype=s.dtype, device=s.device)
        goal[-1] = 1.0
        forcing = torch.nn.functional.pad(self.basis.forcing(s), (0, 3))
        if self.approach:
            force = self.approach_force(s)[..., None]
            forcing = torch.cat([forcing[..., :-2], -force, force], dim=-1)
        # The spring sees all but the goal's own column as offsets; that one is shifted by one.
        free = self.spring.acceleration(state[..., 0, :] - goal, state[..., 1, :])
        return (free + forcing)[..., None, :]

    def _integrate(self) -> PiecewisePolynomial:
        """Solve for all basis functions at once, to where the forcing ends or starts over."""
        propagate, forcing = self.spring.propagator, self.basis.forcing
        interval = min(self.basis.smooth_interval, self.spring.smooth_interval)
        if self.basis.knot_spacing is not None:
            interval = self.basis.knot_spacing / math.ceil(self.basis.knot_spacing / interval)
        # Rounding must not add a piece past the last knot.
        n_pieces = math.ceil(self.basis.horizon / interval - 1e-9)
        knots = interval * torch.arange(n_pieces + 1, dtype=torch.float64)
        points = interval * chebyshev_points()
        share = torch.stack(
            [impulse(propagate, forcing, knots[:-1], point) for point in points], dim=1
        )
        state = accumulate(propagate, knots, share[:, -1])
        if self.basis.periodic:
            # The start that a period leads back to: x = E x + (what is there from rest).
            E = propagate(knots[-1])
            cycle = torch.linalg.solve(torch.eye(2, dtype=torch.float64) - E, state[-1])
            state = state + propagate(knots) @ cycle
        # On each piece the motion from its first knot, and what the forcing adds since then.
        values = propagate(points) @ state[:-1, None] + share
        return PiecewisePolynomial.interpolate(values, interval, self.basis.periodic)


class _StateAt(torch.autograd.Function):
    """State of the response at s, whose derivative is the differential equation itself."""

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
        # Of (H, H'), the derivative is (H', H'').
        rate = ctx.response.evaluate(s)[..., 1:, :]
        return (grad * rate).sum((-2, -1)), None

    @staticmethod
    def jvp(ctx, ds, _):
        (s,) = ctx.saved_tensors
        return ctx.response.evaluate(s)[..., 1:, :] * ds[..., None, None]


# A table of 50 Gaussians has 1.3 MB; few programs hold 64 kinds of primitive at a time.
@lru_cache(maxsize=64)
def response_of(spring: SpringDamper, basis: Basis, approach: float = 0.0) -> Response:
    """The one `Response` of these parts: primitives alike share tables and matrices."""
    return Response(spring, basis, approach)


class ArrayOutputs:
    """Outputs of a rollout as NumPy arrays."""

    outputs: ClassVar[tuple[str, ...]]

    def numpy(self) -> dict[str, np.ndarray]:
        """Every output by name, without gradients."""
        return {name: getattr(self, name).detach().cpu().numpy() for name in self.outputs}


class Trajectory(ArrayOutputs):
    """A motion over time, each output computed when first asked for.

    Position, velocity and acceleration are one matrix product each; a caller that needs the
    position alone pays for nothing else.
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
        """Describe the motion.

        Args:
            coordinates: What `response` maps to motions; an array of one that nothing derives.
            s: Normalised times.
            duration: [s].
            response: Of the primitive.
        """
        self._array = coordinates if isinstance(coordinates, np.ndarray) else None
        self._given = coordinates
        self.s = s
        """Normalised times."""
        self.duration = duration
        """[s]."""
        self._response = response

    @cached_property
    def time(self) -> Float[Tensor, "*batch T"]:
        """Since the start of the motion [s]."""
        time = self.s * self.duration[..., None]
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

    @cached_property
    def jerk(self) -> Float[Tensor, "*batch T D"]:
        """The same per second cubed."""
        return self._output(3)

    def _output(self, order: int) -> Float[Tensor, "*batch T D"]:
        s = self.s
        latest = None if s.requires_grad else self._response.latest_grid(s)
        if not order and self._array is not None and latest is not None:
            # What follows, without asking again what is known of an array.
            x, h = self._array, latest.to_position
            if h is not None and h.dtype == x.dtype and len(x) * h.size <= most_in_numpy():
                return torch.from_numpy(x.dot(h).T)
        X = self._coordinates
        if order:
            X = X / self.duration[..., None, None] ** order
        given = latest is not None or (s.ndim == 1 and not s.requires_grad and readable(s))
        if order > 2 or not given:
            return self._at_own_times(X, order)
        y = product(X, self._response.matrices(s, X.dtype)[order]).mT
        is_single = X.ndim == 2 and not self.duration.ndim  # shapes take longer to compare
        if is_single or self.duration.shape == X.shape[:-2]:
            return y
        return y.expand(*self._batch, -1, -1)

    def _at_own_times(self, X: Tensor, order: int) -> Float[Tensor, "*batch T D"]:
        s, (D, M) = self.s.double(), X.shape[-2:]
        if X.ndim == 2:
            # Of one primitive, the times of a batch are times of one motion.
            y = motion(self._response, s.reshape(1, -1), X[None], order)
            y = y.view(*s.shape, D)
        else:
            batch = broadcast_shapes(X.shape[:-2], s.shape[:-1])
            s = s.expand(*batch, -1).reshape(-1, s.shape[-1])
            y = motion(self._response, s, X.expand(*batch, D, M).reshape(-1, D, M), order)
            y = y.view(*batch, -1, D)
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


def broadcast_shapes(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """As `torch.broadcast_shapes`, which takes longer than a rollout of shapes all alike, and
    imports sympy when it is first called, which takes longer than a thousand of them.
    """
    first = shapes[0]
    if all(shape == first for shape in shapes):
        return first
    if torch.compiler.is_compiling():
        return torch.broadcast_shapes(*shapes)
    return np.broadcast_shapes(*shapes)
