"""Rhythmic movement primitives: periodic motions of joints, orientations and poses."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Points, Quaternions, Times
from hrc_learn.dmp.dynamics import PeriodicBasis, SpringDamper
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.orientation_error import centred_error, to_orientation
from hrc_learn.dmp.pose_dmp import ERROR, PoseDMP, pose_columns
from hrc_learn.dmp.response import Response, response_of
from hrc_learn.dmp.samples import check_samples
from hrc_learn.dmp.solvers import REGULARIZATION, ridge_inverse

SEARCH_RANGE = 0.1
"""Half width of the search for a period, relative to the estimate by autocorrelation."""
HIGH_PEAK = 0.9
"""Smallest height of a high peak of the autocorrelation, relative to the highest peak."""
GOLDEN = (5**0.5 - 1) / 2
"""Fraction of an interval that a golden-section search keeps."""
SEARCH_RIDGE = 1e-6
"""Ridge during the search for a period: larger than in the fit, to smooth the misfit."""
PERIOD_ERROR = 1e-6
"""Relative error at which the search ends: far below what samples resolve."""


def fit_rhythmic(
    time: Times,
    position: Points,
    n_basis: int = 25,
    period: float | None = None,
    mask: Mask | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    units: str = "rad",
) -> JointDMP:
    """Fit a rhythm to each demonstration of at least one cycle.

    The result is a `JointDMP` on a `PeriodicBasis`: its duration is the period, and its goal is
    the centre of the oscillation. From any start, its motion converges to the limit cycle;
    `duration` (or `speed`) and `forcing_gain` modulate the rhythm.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        position: Positions, (T, D) or (*B, T, D).
        n_basis: Number of basis functions per period.
        period: Period [s]; by default estimated from the positions.
        mask: Mask (*B, T), false at samples to ignore.
        joint_names: Names of the D coordinates, stored with the primitive.
        units: Units of the coordinates.

    Raises:
        ValueError: Bad samples (the message names them), or samples of less than one period.
    """
    samples = check_samples(time, position, mask=mask)
    response = response_of(SpringDamper(), PeriodicBasis(count=n_basis))
    parts = []
    for s, duration, y, valid in zip(
        samples.s, samples.duration, samples.position.double(), samples.mask, strict=True
    ):
        elapsed, y = (s * duration)[valid], y[:, valid].mT
        tau = find_period(elapsed, y, response) if period is None else period
        tau = torch.as_tensor(tau, dtype=elapsed.dtype, device=elapsed.device)
        if not 0 < tau <= duration:
            raise ValueError(
                f"a rhythm needs a whole period of {tau:.3f} s, got {duration.item():.3f} s"
            )
        parts.append((tau, _solve(response, elapsed / tau, y, REGULARIZATION)))
    tau, x = (torch.stack(part) for part in zip(*parts, strict=True))

    dmp = JointDMP.from_coordinates(
        samples.batched(x),
        samples.batched(tau),
        samples.batched(samples.amplitude),
        (samples.s * (samples.duration / tau)[:, None]).reshape(*samples.batch, -1),
        response,
        joint_names=joint_names,
        units=units,
    )
    with torch.no_grad():
        dmp.fit_report = samples.compare(dmp.rollout().position)
    return dmp


def find_period(
    elapsed: Float[Tensor, "T"], y: Float[Tensor, "T D"], response: Response
) -> Float[Tensor, ""]:
    """Period [s] of an oscillation: the first high peak of the autocorrelation, refined.

    A golden-section search around the peak finds the period whose rhythm fits the samples best.
    """
    span = elapsed[-1]
    rough = _autocorrelation_peak(elapsed, y)
    low, high = rough * (1 - SEARCH_RANGE), torch.minimum(rough * (1 + SEARCH_RANGE), span)

    def misfit(tau: Tensor) -> Tensor:
        s = elapsed / tau
        x = _solve(response, s, y, SEARCH_RIDGE)
        return (response.state(s)[:, 0] @ x.mT - y).square().sum()

    while high - low > PERIOD_ERROR * rough:
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        if misfit(left) < misfit(right):
            high = right
        else:
            low = left
    return (low + high) / 2


def _autocorrelation_peak(elapsed: Tensor, y: Tensor) -> Tensor:
    """First lag [s] of a high peak of the autocorrelation, after a zero crossing."""
    T = len(elapsed)
    even = torch.linspace(0, 1, T, dtype=elapsed.dtype, device=elapsed.device) * elapsed[-1]
    after = torch.searchsorted(elapsed, even).clamp(1, T - 1)
    fraction = (even - elapsed[after - 1]) / (elapsed[after] - elapsed[after - 1])
    even_y = y[after - 1] + fraction[:, None] * (y[after] - y[after - 1])
    # Padded to twice the length, so that the end does not overlap the start.
    power = torch.fft.rfft(even_y - even_y.mean(0), n=2 * T, dim=0).abs().square()
    similar = torch.fft.irfft(power, n=2 * T, dim=0)[:T].sum(-1)
    # Late lags overlap little, so their sums are small: compare means, and drop the last
    # quarter.
    similar = similar[: T * 3 // 4] / torch.arange(T, T - T * 3 // 4, -1).to(y)
    crossed = (similar < 0).cummax(0).values
    peak = (similar[1:-1] >= similar[:-2]) & (similar[1:-1] >= similar[2:]) & crossed[1:-1]
    if not peak.any():
        raise ValueError("no period found in the positions: give `period` or more cycles")
    # Every multiple of the period has a peak of equal height: take the first high one.
    high = peak & (similar[1:-1] >= HIGH_PEAK * similar[1:-1][peak].max())
    return even[1 + high.long().argmax()]


def _solve(
    response: Response, s: Tensor, y: Float[Tensor, "T D"], regularization: float
) -> Float[Tensor, "D M"]:
    """Coordinates of the closest rhythm: weights, start velocity dy/ds, start, and centre."""
    centre = _mean_of_whole_cycles(s, y)
    H = response.state(s)[:, 0]
    # Units in which the ridge penalises all columns equally.
    A = H[:, :-1]
    size = A.norm(dim=0)
    residual = y - H[:, -1:] * centre
    x = ridge_inverse(A / size, regularization) @ residual / size[:, None]
    return torch.cat([x.mT, centre[:, None]], dim=-1)


def _mean_of_whole_cycles(s: Tensor, y: Tensor) -> Tensor:
    """Average over the largest number of whole cycles, counted from the end."""
    whole = s[-1] - s[-1].floor().clamp(min=1)
    inside = s >= whole
    return torch.trapezoid(y[inside].mT, s[inside]) / (s[-1] - s[inside][0])


def fit_rhythmic_orientation(
    time: Times,
    orientation: Quaternions,
    n_basis: int = 25,
    period: float | None = None,
    mask: Mask | None = None,
) -> OrientationDMP:
    """Fit a rhythm of an orientation to each demonstration of at least one cycle.

    The error to the mean orientation is fitted like the positions in `fit_rhythmic`. The goal
    of the result is the centre of the oscillation. `duration` (or `speed`) and `forcing_gain`
    modulate the rhythm.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        orientation: Unit quaternions (w, x, y, z), (*B, T, 4), within half a turn of their
            mean; signs may flip.
        n_basis: Number of basis functions per period.
        period: Period [s]; by default estimated from the motion.
        mask: Mask (*B, T), false at samples to ignore.

    Raises:
        ValueError: Bad samples (the message names them), samples of less than one period, or a
            motion that passes half a turn from its mean.
    """
    error, reference = centred_error(time, orientation, mask)
    motion = fit_rhythmic(time, error, n_basis, period, mask)
    return OrientationDMP(motion, to_orientation(motion.goal, reference))


def fit_rhythmic_pose(
    time: Times,
    position: Points,
    orientation: Quaternions,
    n_basis: int = 25,
    body: Points | None = None,
    period: float | None = None,
    mask: Mask | None = None,
) -> PoseDMP:
    """Fit a rhythm of a pose; arguments as for `PoseDMP.fit` and `fit_rhythmic`.

    All coordinates have the same period, by default estimated from all of them.
    """
    error, reference = centred_error(time, orientation, mask)
    columns = pose_columns(time, position, error, body, mask)
    motion = fit_rhythmic(time, columns, n_basis, period, mask, units="m, rad, body")
    goal = to_orientation(motion.goal[..., ERROR], reference.to(columns))
    return PoseDMP(motion, goal)
