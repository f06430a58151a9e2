"""Movement primitive of joints, or of any coordinates that add up like them."""

from collections.abc import Sequence
from typing import Any, Unpack

import torch
from torch import Tensor

from hrc_learn.dmp._system.response import Trajectory
from hrc_learn.dmp._types import Mask, Points, Times, Vectors, to_tensor
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.coordinate_adapter import CoordinateAdapter, Retargeted
from hrc_learn.dmp.fitting.motion_samples import check_samples
from hrc_learn.dmp.fitting.solvers import FitOptions, fit_motion
from hrc_learn.dmp.forcing_scale import Scaling, find_scaling
from hrc_learn.dmp.linear_primitive import ColumnEnds, LinearPrimitive, check_names
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel


class JointCoordinates(CoordinateAdapter[Vectors, Trajectory, DMPState]):
    """Joints are columns as they are; there is no frame."""

    def ends(
        self,
        motion: LinearPrimitive,
        start: Vectors | None,
        goal: Vectors | None,
        duration: Tensor,
        velocity: Vectors | None,
    ) -> tuple[ColumnEnds, None]:
        """As given."""
        return ColumnEnds(start, goal, velocity), None

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
        s: Tensor,
        position: Tensor,
        velocity: Tensor,
        value: Points | None,
        rate: Points | None,
    ) -> tuple[Tensor, Tensor]:
        """As given."""
        return given_points(value, position), given_points(rate, velocity, "velocity")


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
        n_basis: int = 50,
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
            position: (T, D) or (*B, T, D); of the shape of `time`, it is taken as D = 1. Its
                floating dtype is the primitive's; the fit itself runs in float64.
            n_basis: N, unless `basis` is given.
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
        recorded = check_samples(time, position, velocity, mask)
        check_names(joint_names, recorded.position.shape[1])
        fit = fit_motion(recorded, n_basis, **options)
        arguments = fit.arguments(scaling, joint_names)
        dmp = cls(**arguments, joint_names=joint_names, units=units)
        with torch.no_grad():
            dmp.fit_report = fit.report(dmp.rollout().position)
        return dmp

    def with_motion[S: "JointDMP"](self: S, motion: Any, frame: None = None) -> S:
        """The motion itself."""
        return motion

    @classmethod
    def _restored[S: "JointDMP"](cls: type[S], saved: SavedModel) -> S:
        return cls.restore(saved)


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
    return tensor.expand(torch.broadcast_shapes(tensor.shape, shape))
