"""Movement primitive of joints, or of other coordinates that can be added and scaled."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn import distributed
from hrc_learn.dmp._arguments import (
    Mask,
    Points,
    Scalars,
    Times,
    Vectors,
    checked_vector,
    finite,
    full_precision,
    positive,
)
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.dynamics import Basis, GaussianBasis, SpringDamper
from hrc_learn.dmp.forcing_scale import Demonstrated, Scaling, find_scaling
from hrc_learn.dmp.linear_primitive import LinearPrimitive, check_names
from hrc_learn.dmp.motion_primitive import MotionPrimitive
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.samples import Samples, check_samples, densified, padded, smoothed
from hrc_learn.dmp.solvers import REGULARIZATION, fit_samples, normal_products, solve_normal
from hrc_learn.dmp.trajectory import Trajectory

LIMIT_SAMPLES = 2001
"""Number of times at which limits are checked: 40 for each of 50 basis functions. A peak
between two of these times exceeds the checked values by less than 0.1 %."""
TOLERANCE = 1.05
"""Held-out errors of at most this factor times the smallest one are treated as equal to it."""
DEFAULT_COUNT = 50
"""Default number of basis functions. 50 functions reproduce recordings of arms to 5e-5 of the
range. If the samples have no noise, fewer functions would not give a smoother motion."""


STRONG_RIDGE = 1e-5
"""Ridge for samples that do not determine all weights; its square is well above rounding."""
TIMESTAMPS = 1000
"""Number of samples in the default rollout after `fit_shared`, whose demonstrations have no
common time grid."""


class FitOptions(TypedDict, total=False):
    """Options that `fit` of every kind of primitive accepts."""

    method: str
    """`"trajectory"` (default): least squares on the positions, which reproduces the samples
    most closely. `"ridge"`: ridge regression on the force. `"lwr"`: locally weighted regression
    on the force, as in the paper by Yan et al."""
    approach: float | int | None
    """Fraction of the motion, 0 to 1, over which it adapts smoothly to a new start and goal; 0:
    the spring alone adapts it, as in the paper. None (default): 1, but 0 for rhythms and for
    the scaling `"paper"`."""
    basis: Basis | None
    """Basis of the forcing term; `n_basis` Gaussians by default."""
    spring: SpringDamper | None
    """Gains; alpha = 25, critically damped, by default."""
    regularization: float
    """Ridge, relative to the largest singular value; 1e-7 by default."""
    smooth: bool | None
    """True to estimate the noise of the samples and remove it before the fit; see `samples.py`.
    None (default): True unless `n_basis` or `basis` is given."""


def _fit(
    recorded: Samples,
    n_basis: int | None,
    *,
    method: str = "trajectory",
    scaling: str,
    approach: float | int | None = None,
    basis: Basis | None = None,
    spring: SpringDamper | None = None,
    regularization: float = REGULARIZATION,
    smooth: bool | None = None,
) -> tuple[Response, Samples, Tensor | None, Tensor, Tensor]:
    """Fit in float64; arguments as in `FitOptions`.

    Returns:
        Five results. The response of spring and basis. The fitted samples, without noise if it
        was removed. The standard deviation (B, D) of the removed noise, or None. The weights
        (B, D, N) of the unscaled forcing term. The start velocities dy/ds (B, D).
    """
    chosen = n_basis is not None or basis is not None
    if basis is None:
        basis = GaussianBasis(count=DEFAULT_COUNT if n_basis is None else n_basis)
    if approach is None:
        approach = 0.0 if basis.periodic or scaling == "paper" else 1.0
    response = response_of(spring or SpringDamper(), basis, float(approach))
    samples, noise = recorded, None
    if smooth or (smooth is None and not chosen):
        samples, noise = smoothed(recorded)
    fitted = fit_samples(method, response, densified(samples, basis.count), regularization)
    return response, samples, noise, *fitted


def _unscaled(
    weights: Float[Tensor, "B D N"],
    samples: Samples,
    recorded: Samples,
    scaling: Scaling,
    names: Sequence[str] | None,
) -> Float[Tensor, "B D N"]:
    """Weights for the given scaling, from weights of the unscaled forcing term.

    Raises:
        ValueError: A motion for which the scaling is singular.
    """
    if scaling.name == "none":
        return weights
    amplitude = samples.amplitude.double()
    # Noise or its removal may separate a start and a goal that agree: check the samples with
    # and without noise.
    for each in (recorded, samples):
        shown = Demonstrated(each.first.double(), each.last.double(), amplitude)
        scaling.check(shown, each.batch, names)
    return scaling.unscale(weights.mT, shown).mT


class JointDMP(LinearPrimitive, MotionPrimitive[Vectors, Trajectory, DMPState]):
    """Discrete movement primitive of D coordinates with a common phase.

    It is a `LinearPrimitive` whose columns are the coordinates. Values are (*batch, D) in the
    units of the demonstration; velocities are in these units per s, couplings per s^2.
    """

    @property
    def motion(self) -> "JointDMP":  # pyright: ignore[reportIncompatibleVariableOverride]
        """The primitive itself, because joints are columns."""
        return self

    @classmethod
    @full_precision
    def fit(
        cls,
        time: Times,
        position: Points,
        n_basis: int | None = None,
        velocity: Points | None = None,
        mask: Mask | None = None,
        *,
        scaling: str | Scaling = "none",
        joint_names: Sequence[str] | None = None,
        units: str = "rad",
        **options: Unpack[FitOptions],
    ) -> "JointDMP":
        """Fit one primitive to each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T), with any origin and spacing.
            position: Positions, (T, D) or (*B, T, D); D = 1 if they have the shape of `time`.
                For demonstrations of different lengths, a list of (T_i, D), with a list of
                (T_i,) as `time`. The primitive has the floating-point dtype of the positions;
                the fit runs in float64.
            n_basis: Number N of basis functions, unless `basis` is given. None: 50 functions,
                and noise is removed from the samples; see `FitOptions.smooth`. If there are at
                most 1.5 N samples, the motion follows piecewise cubics between them.
            velocity: Recorded velocity per second, shaped like `position`. Without it, the
                default method also fits the start velocity, and the other methods differentiate
                the positions.
            mask: Mask (*B, T), false at samples to ignore, such as padding and dropouts.
            scaling: Scaling of the forcing term: `"none"`, `"paper"`, `"amplitude"` or
                `"rotation"`.
            joint_names: Names of the D coordinates, stored with the primitive.
            units: Units of the coordinates.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), values whose weights their dtype
                cannot hold, or a motion for which the scaling is singular.
        """
        scaling = find_scaling(scaling)
        time, mask, (position, velocity) = padded(time, mask, position, velocity)
        recorded = check_samples(time, position, velocity, mask)
        check_names(joint_names, recorded.position.shape[1])
        response, samples, noise, weights, rate = _fit(
            recorded, n_basis, scaling=scaling.name, **options
        )
        weights = _unscaled(weights, samples, recorded, scaling, joint_names)
        ends = torch.stack([rate, samples.first.double(), samples.last.double()], dim=-1)
        dmp = cls.from_coordinates(
            samples.batched(torch.cat([weights, ends], dim=-1)),
            samples.batched(samples.duration),
            samples.batched(samples.amplitude),
            samples.timestamps,
            response,
            scaling=scaling,
            joint_names=joint_names,
            units=units,
        )
        finite(f"weights in {dmp.weights.dtype}", dmp.weights)
        with torch.no_grad():
            dmp.fit_report = recorded.compare(dmp.rollout().position, noise)
        return dmp

    def refit(
        self, time: Times, position: Points, scaling: str | Scaling = "none"
    ) -> "JointDMP":
        """Primitives fitted to other motions, with basis, spring and approach of this one."""
        return JointDMP.fit(
            time,
            position,
            scaling=scaling,
            basis=self.basis,
            spring=self.spring,
            approach=self.response.approach,
        )

    def admissible_duration(
        self,
        velocity: Vectors | Scalars | None = None,
        acceleration: Vectors | Scalars | None = None,
        *,
        start: Vectors | None = None,
        goal: Vectors | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Shortest duration [s] at which the motion is within the limits, for use in `rollout`.

        A slower motion keeps its path if its start velocity is scaled too. Velocities then fall
        as 1 / duration and accelerations as 1 / duration^2.

        Args:
            velocity: Limit of each coordinate [1/s], (D,) or one for all; None: no limit.
            acceleration: Limit of each coordinate [1/s^2], (D,) or one for all.
            start: Start of the motion; None: as demonstrated.
            goal: Goal of the motion; None: as demonstrated.

        Raises:
            ValueError: No limit, a limit that is not positive, or a wrong number of limits.
        """
        if velocity is None and acceleration is None:
            raise ValueError("a limit is needed: give velocity or acceleration, or both")
        fine = torch.linspace(0, 1, LIMIT_SAMPLES, dtype=torch.float64).to(self.start.device)
        motion = self.rollout(fine * self.duration[..., None].double(), start, goal)
        factors = [torch.zeros_like(self.duration)]
        for n, name, limit in ((1, "velocity", velocity), (2, "acceleration", acceleration)):
            if limit is not None:
                largest = getattr(motion, name).abs().amax(-2)
                limit = positive(name, limit, largest)
                limit = checked_vector(name, limit, largest) if limit.ndim else limit
                factors.append((largest / limit).amax(-1) ** (1 / n))
        return self.duration * torch.stack(torch.broadcast_tensors(*factors)).amax(0)


@dataclass(frozen=True, kw_only=True)
class BasisSelection:
    """Held-out error as a function of the number of basis functions."""

    count: int
    """Smallest number of basis functions whose error is within 5 % of the smallest error."""
    candidates: tuple[int, ...]
    error: Float[Tensor, "candidates"]
    """RMSE on the held-out samples of all demonstrations, relative to the largest range of a
    coordinate in any of them."""


def select_basis_count(
    time: Times,
    position: Points,
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 50, 70, 100),
    *,
    n_folds: int = 5,
    mask: Mask | None = None,
    scaling: str | Scaling = "none",
    **options: Unpack[FitOptions],
) -> BasisSelection:
    """Choose the number of basis functions by the error on held-out samples.

    Every `n_folds`-th sample is held out in turn. The first and last samples are always fitted,
    because they are the start and the goal.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        position: Positions, (T,), (T, D) or (*B, T, D).
        candidates: Numbers of basis functions to try.
        n_folds: Number of fits per candidate.
        mask: Mask (*B, T), false at samples to ignore.
        scaling: Scaling of the forcing term.
        options: Options of the fit; see `FitOptions`.

    Raises:
        ValueError: Bad samples or arguments; the message names them.
    """
    time, mask, (position,) = padded(time, mask, position)
    samples = check_samples(time, position, mask=mask)
    if not candidates or n_folds < 2:
        raise ValueError(f"needs candidates and at least 2 folds, got {candidates}, {n_folds}")
    folds = [_held_out(samples.mask, fold, n_folds) for fold in range(n_folds)]
    elapsed = (samples.s * samples.duration[:, None]).reshape(*samples.batch, -1)
    span, errors = samples.span.amax() or 1.0, []
    for count in candidates:
        square, weight = torch.zeros((), dtype=torch.float64), 0
        for held in folds:
            kept = (samples.mask & ~held).reshape(*samples.batch, -1)
            dmp = JointDMP.fit(time, position, count, mask=kept, scaling=scaling, **options)
            with torch.no_grad():
                reproduction = dmp.rollout(elapsed).position.mT.reshape(samples.position.shape)
                error = (reproduction - samples.position).double() / span
            square = square + error.mT[held].square().sum()
            weight += int(held.sum()) * error.shape[1]
        errors.append((square / weight).sqrt())
    error = torch.stack(errors)
    good = error <= TOLERANCE * error.min()
    count = min(n for n, is_good in zip(candidates, good.tolist(), strict=True) if is_good)
    return BasisSelection(count=count, candidates=tuple(candidates), error=error)


def _held_out(mask: Bool[Tensor, "B T"], fold: int, n_folds: int) -> Bool[Tensor, "B T"]:
    """Mask of the samples that a fold holds out: every n-th valid one, except the ends."""
    order = mask.long().cumsum(-1)
    inner = (order > 1) & (order < order[..., -1:])
    return mask & inner & (order % n_folds == fold)


def fit_shared(
    demonstrations: Sequence[tuple[Times, Points]],
    n_basis: int = 50,
    *,
    joint_names: Sequence[str] | None = None,
    units: str = "rad",
) -> tuple[JointDMP, Float[Tensor, "D"]]:
    """Fit one primitive to all demonstrations, in one pass and bounded memory.

    All demonstrations have the same weights and start velocity (per duration), but each has its
    own start, goal and duration. The fit minimises the distance between the samples and the
    motions with these boundaries. For demonstrations on one time grid, the result is the mean
    of their separate primitives.

    The least-squares problem min |A X - B|^2, with unknowns X and one row of A and B for each
    sample, is solved from [A B]'[A B]. This product is a sum over the rows, in any order. In a
    distributed run, each process reads a part of the demonstrations, and all processes return
    the same result.

    Args:
        demonstrations: Timestamps (T,) [s] and positions (T, D) of each. They are read one by
            one, so a sequence that loads them on demand is enough.
        n_basis: Number N of basis functions.
        joint_names: Names of the D coordinates, stored with the primitive.
        units: Units of the coordinates.

    Returns:
        The primitive, and its RMSE over all samples with the start, goal and duration of each
        demonstration.

    Raises:
        ValueError: No demonstrations, or one that cannot be fitted; the message names it.
    """
    if not len(demonstrations):
        raise ValueError("there are no demonstrations to learn from")
    response = response_of(SpringDamper(), GaussianBasis(count=n_basis), 1.0)
    products, sums, rows = _accumulate(demonstrations, response)
    # The start velocity is one more unknown after the weights.
    n = n_basis + 1
    X, square, undetermined = solve_normal(response, n, products, REGULARIZATION)
    if undetermined.any():
        X, square, _ = solve_normal(response, n, products, STRONG_RIDGE)
    mean = sums / len(demonstrations)
    start, goal, amplitude, duration = mean[0], mean[1], mean[2], mean[3, 0]
    primitive = JointDMP.from_coordinates(
        torch.cat([X[0], start[:, None], goal[:, None]], dim=-1),
        duration,
        torch.where(amplitude > 0, amplitude, 1.0),
        torch.linspace(0, 1, TIMESTAMPS, dtype=torch.float64),
        response,
        joint_names=joint_names,
        units=units,
    )
    return primitive, (square[0] / rows).sqrt()


def _accumulate(
    demonstrations: Sequence[tuple[Times, Points]], response: Response
) -> tuple[Float[Tensor, "1 m m"], Float[Tensor, "4 D"], int]:
    """Sums over all processes: normal products, boundaries, and number of samples.

    The rows of the boundaries are start, goal, range and duration.
    """
    D, rows, products, sums = 0, 0, None, None
    for i, (time, position) in distributed.local_items(demonstrations):
        samples = _checked(i, time, position, D)
        D, rows = samples.position.shape[1], rows + samples.s.shape[1]
        ends = torch.stack([samples.first, samples.last], 1).double()
        own = normal_products(response, samples, ends)
        products = own if products is None else products + own
        last = [samples.span[0], samples.duration.expand(D)]
        values = torch.stack([*ends[0], *last]).double()
        sums = values if sums is None else sums + values
    # A process without demonstrations contributes zeros in the shapes of the other processes.
    D, m = int(max(distributed.gather(torch.tensor(D)))), response.size - 2
    if products is None or sums is None:
        products = torch.zeros(1, m + D, m + D, dtype=torch.float64)
        sums = torch.zeros(4, D, dtype=torch.float64)
    total = distributed.sum_over_processes
    return total(products), total(sums), int(total(torch.tensor(rows)))


def _checked(index: int, time: Times, position: Points, D: int) -> Samples:
    """Samples of one demonstration with D coordinates; D = 0 accepts any number."""
    try:
        samples = check_samples(time, position)
    except ValueError as error:
        raise ValueError(f"demonstration {index}: {error}") from None
    if samples.batch or D not in (0, samples.position.shape[1]):
        wanted = f"(T, {D or 'D'}), without a batch"
        raise ValueError(f"demonstration {index}: position must be {wanted}")
    return samples
