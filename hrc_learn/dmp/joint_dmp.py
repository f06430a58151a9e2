"""Movement primitive of joints, or of any coordinates that add up like them."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import (
    Mask,
    Points,
    Scalars,
    Times,
    Vectors,
    check_samples,
    padded,
    positive,
    to_tensor,
)
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp._fitting import FitOptions, fit_motion
from hrc_learn.dmp._system.response import Trajectory, broadcast_shapes
from hrc_learn.dmp.coordinate_adapter import ColumnPoints, CoordinateAdapter, Retargeted
from hrc_learn.dmp.forcing_scale import Scaling, find_scaling
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive, check_names
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel


class JointCoordinates(CoordinateAdapter[Vectors, Trajectory, DMPState]):
    """Joints are columns as they are; there is no frame."""

    def ends(self, motion: LinearPrimitive, given: Ends, duration: Tensor) -> tuple[Ends, None]:
        """As given."""
        return given, None

    def trajectory(self, columns: Trajectory, frame: None) -> Trajectory:
        """Of the columns."""
        return columns

    def state(self, columns: DMPState, frame: None) -> DMPState:
        """The columns."""
        return columns

    def columns(self, state: DMPState) -> tuple[DMPState, None]:
        """The state."""
        return state, None

    def retarget(
        self, motion: LinearPrimitive, columns: DMPState, frame: None, goal: Vectors | None
    ) -> Retargeted:
        """The goal as given."""
        return Retargeted(columns, None, goal)

    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Points | None,
        velocity: Points | None,
    ) -> ColumnPoints:
        """As given."""
        return points_as_given(now, value, velocity)


JOINTS = JointCoordinates()


class JointDMP(AdaptedPrimitive[Vectors, Trajectory, DMPState], LinearPrimitive):
    """Discrete movement primitive of D coordinates under one phase.

    It is a `LinearPrimitive` whose columns are the coordinates: values are (*batch, D) in the
    units of the demonstration, velocities the same per second, couplings per s^2.
    """

    @property
    def motion(self) -> "JointDMP":  # pyright: ignore[reportIncompatibleVariableOverride]
        """Itself: joints are columns."""
        return self

    @property
    def adapter(self) -> JointCoordinates:
        """Joints are columns as they are."""
        return JOINTS

    @classmethod
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
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T); any origin, any spacing.
            position: (T, D) or (*B, T, D); of the shape of `time`, it is taken as D = 1. Or a
                list of (T_i, D) with a list of (T_i,), for demonstrations of any lengths. Its
                floating dtype is the primitive's; the fit itself runs in float64.
            n_basis: N, unless `basis` is given. None: 50, of samples that noise was taken off;
                see `FitOptions.smooth`.
            velocity: Recorded velocity per second, like `position`. Without it, the default
                method fits the start velocity along and the others differentiate positions.
            mask: (*B, T), false where a sample does not count (padding, dropouts).
            scaling: Of the forcing term: `"none"`, `"paper"`, `"amplitude"` or `"rotation"`.
            joint_names: D names, kept with the primitive.
            units: Of the coordinates.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or a scaling that the motion forbids.
        """
        scaling = find_scaling(scaling)
        time, mask, (position, velocity) = padded(time, mask, position, velocity)
        recorded = check_samples(time, position, velocity, mask)
        check_names(joint_names, recorded.position.shape[1])
        fit = fit_motion(recorded, n_basis, **options)
        arguments = fit.arguments(scaling, joint_names)
        dmp = cls(**arguments, joint_names=joint_names, units=units)
        with torch.no_grad():
            dmp.fit_report = fit.report(dmp.rollout())
        return dmp

    def admissible_duration(
        self,
        velocity: Vectors | Scalars | None = None,
        acceleration: Vectors | Scalars | None = None,
        *,
        start: Vectors | None = None,
        goal: Vectors | None = None,
    ) -> Float[Tensor, "*batch"]:
        """The shortest duration [s] in which the path keeps limits: put it into `rollout`.

        Slowed down, a motion keeps its path, its start velocity going along: velocities fall
        as 1 / duration and accelerations as its square.

        Args:
            velocity: Largest of each coordinate, per s, (D,) or one for all; None: any.
            acceleration: Per s^2, likewise.
            start: Of the motion; the demonstrated one, as the goal, unless given.
            goal: Of the motion.
        """
        fine = torch.linspace(
            0, 1, LIMIT_SAMPLES, dtype=torch.float64, device=self.start.device
        )
        motion = self.rollout(fine * self.duration[..., None].double(), start, goal)
        factors = [torch.zeros_like(self.duration)]
        for order, (made, limit) in enumerate(
            ((motion.velocity, velocity), (motion.acceleration, acceleration)), start=1
        ):
            if limit is not None:
                share = made.abs().amax(-2) / positive("a limit", limit, made)
                factors.append(share.amax(-1) ** (1 / order))
        return self.duration * torch.stack(torch.broadcast_tensors(*factors)).amax(0)

    def with_motion[S: "JointDMP"](self: S, motion: Any, frame: None = None) -> S:
        """The motion itself."""
        return motion

    @classmethod
    def _restored[S: "JointDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls.restore(saved)


def points_as_given(
    now: ColumnPoints, value: Points | None, velocity: Points | None
) -> ColumnPoints:
    """Via points of columns that are values as they are."""
    position = given_points(value, now.position)
    return ColumnPoints(position, given_points(velocity, now.velocity, "velocity"))


def given_points(
    value: Any, like: Tensor, name: str = "value", columns: int | None = None
) -> Tensor:
    """Via values (*batch, n, D) in float64 as they were given; NaN if nothing was.

    Raises:
        ValueError: Not of the shape that `like` has, with `columns` for D if given.
    """
    if isinstance(value, Pose):
        raise ValueError("a Pose is no value for joints or an orientation")
    shape = (*like.shape[:-1], like.shape[-1] if columns is None else columns)
    if value is None:
        return torch.full(shape, torch.nan).to(like)
    tensor = to_tensor(value, torch.float64, like.device)
    if tensor.ndim < 2 or tensor.shape[-2:] != shape[-2:]:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    return tensor.expand(broadcast_shapes(tensor.shape, shape))


LIMIT_SAMPLES = 2001
"""Times at which limits are looked at: 40 for a basis function, between which a peak is higher
by less than 1e-3."""
TOLERANCE = 1.05
"""A held-out error this close to the smallest, by ratio, is as good."""


@dataclass(frozen=True, kw_only=True)
class BasisSelection:
    """Held-out error over basis counts."""

    count: int
    """The smallest count whose error is within 5 % of the best."""
    candidates: tuple[int, ...]
    error: Float[Tensor, "candidates"]
    """RMSE on samples not fitted, relative to the largest range, over all demonstrations."""


def select_basis_count(
    time: Times,
    position: Points,
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 50, 70, 100),
    *,
    n_folds: int = 5,
    **fit_arguments: Any,
) -> BasisSelection:
    """Choose the number of basis functions by the error on held-out samples.

    Every `n_folds`-th sample is held out in turn. First and last samples stay, as they are
    the start and the goal.

    Args:
        time: Timestamps [s], (T,) or (*B, T).
        position: (T,), (T, D) or (*B, T, D).
        candidates: Counts to try.
        n_folds: Fits per candidate.
        fit_arguments: For `JointDMP.fit`, such as `mask`, `method` or `scaling`.

    Raises:
        ValueError: Bad samples or arguments; says which.
    """
    mask = fit_arguments.pop("mask", None)
    samples = check_samples(time, position, mask=mask)
    if not candidates or n_folds < 2:
        raise ValueError(f"needs candidates and 2 folds or more, got {candidates}, {n_folds}")
    folds = [_held_out(samples.mask, fold, n_folds) for fold in range(n_folds)]
    elapsed = (samples.s * samples.duration[:, None]).reshape(*samples.batch, -1)
    errors = []
    for count in candidates:
        square, weight = torch.zeros((), dtype=torch.float64), 0
        for held in folds:
            kept = (samples.mask & ~held).reshape(*samples.batch, -1)
            with warnings.catch_warnings():
                # Too many functions for the samples: that is what is to be found out.
                warnings.simplefilter("ignore", UserWarning)
                dmp = JointDMP.fit(time, position, count, mask=kept, **fit_arguments)
            with torch.no_grad():
                reproduction = dmp.rollout(elapsed).position.mT.reshape(samples.position.shape)
                miss = (reproduction - samples.position).double() / samples.span.amax()
            square = square + miss.mT[held].square().sum()
            weight += int(held.sum()) * miss.shape[1]
        errors.append((square / weight).sqrt())
    error = torch.stack(errors)
    good = error <= TOLERANCE * error.min()
    count = min(n for n, is_good in zip(candidates, good.tolist(), strict=True) if is_good)
    return BasisSelection(count=count, candidates=tuple(candidates), error=error)


def _held_out(mask: Tensor, fold: int, n_folds: int) -> Tensor:
    """Every n-th of the samples that count, ends excepted."""
    order = mask.long().cumsum(-1)
    inner = (order > 1) & (order < order[..., -1:])
    return mask & inner & (order % n_folds == fold)
