"""Movement primitive of a pose together with body coordinates, such as an arm angle."""

from dataclasses import dataclass
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Mask, Points, Quaternions, Times, finite
from hrc_learn.dmp.forcing_scale import find_scaling
from hrc_learn.dmp.joint_dmp import FitOptions, JointDMP
from hrc_learn.dmp.orientation_dmp import (
    OrientationState,
    OrientationTrajectory,
    OrientedPrimitive,
)
from hrc_learn.dmp.orientation_error import fitted_error, to_orientation
from hrc_learn.dmp.samples import check_samples, padded
from hrc_learn.geometry import Pose

POSITION, ERROR, BODY = slice(0, 3), slice(3, 6), slice(6, None)
"""Columns of a pose: position [m], orientation error [rad], and body coordinates."""


class PoseColumns:
    """Access to pose and body in the columns of a trajectory or of a state."""

    motion: Any

    @property
    def position(self) -> Float[Tensor, "*batch 3"]:
        """Position [m]."""
        return self.motion.position[..., POSITION]

    @property
    def pose(self: Any) -> Pose:
        """Position and orientation, (*batch)."""
        return Pose(self.position, self.orientation)

    @property
    def velocity(self) -> Float[Tensor, "*batch 3"]:
        """Linear velocity [m/s]."""
        return self.motion.velocity[..., POSITION]

    @property
    def twist(self: Any) -> Float[Tensor, "*batch 6"]:
        """Twist (linear [m/s], angular [rad/s]) in the base frame."""
        return torch.cat([self.velocity, self.angular_velocity], dim=-1)

    @property
    def body(self) -> Float[Tensor, "*batch K"]:
        """Body coordinates; K = 0 if none were learned."""
        return self.motion.position[..., BODY]

    @property
    def body_velocity(self) -> Float[Tensor, "*batch K"]:
        """Velocity of the body coordinates, per second."""
        return self.motion.velocity[..., BODY]


class PoseTrajectory(PoseColumns, OrientationTrajectory):
    """Pose over time; each output is computed on first access."""

    outputs = (
        *("time", "position", "orientation", "velocity", "angular_velocity"),
        *("acceleration", "angular_acceleration", "body", "body_velocity"),
    )
    error_columns: ClassVar[slice] = ERROR

    @property
    def acceleration(self) -> Float[Tensor, "*batch T 3"]:
        """Linear acceleration [m/s^2]."""
        return self.motion.acceleration[..., POSITION]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseState(PoseColumns, OrientationState):
    """State of a pose primitive in closed loop."""

    error_columns: ClassVar[slice] = ERROR


torch.export.register_dataclass(PoseState, serialized_type_name="hrc_learn.dmp.PoseState")


class PoseDMP(OrientedPrimitive[Pose, PoseTrajectory, PoseState]):
    """Discrete movement primitive of a pose, with one phase for all columns.

    Position, orientation error (see `orientation_error`) and, if given, K body coordinates are
    columns of one linear primitive. The body, such as a redundant joint or an arm angle, moves
    as demonstrated when the pose moves to another goal.

    Values are `Pose`s, and velocities are twists (linear [m/s], angular [rad/s]), (*batch, 6).
    A coupling is an acceleration of the position [m/s^2], (*batch, 3), or of the pose,
    (*batch, 6). Angular parts are in the base frame. `rollout`, `initial_state` and
    `with_boundary` also take `start_body` and `goal_body`, (*batch, K); `step` takes
    `goal_body`.

    The fit report has residuals by column: position [m], orientation error [rad], body. The
    residuals of the error's components bound the residual of the angle. `nrmse` divides by the
    largest range, although the units of the columns differ.
    """

    error_columns: ClassVar[slice] = ERROR
    options: ClassVar[frozenset[str]] = frozenset({"start_body", "goal_body"})
    state_type: ClassVar[type] = PoseState
    trajectory_type: ClassVar[type] = PoseTrajectory

    @classmethod
    def fit(
        cls,
        time: Times,
        position: Points,
        orientation: Quaternions,
        n_basis: int | None = None,
        body: Points | None = None,
        mask: Mask | None = None,
        *,
        scaling: str = "none",
        **options: Unpack[FitOptions],
    ) -> "PoseDMP":
        """Fit one primitive to each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            position: Positions [m], (*B, T, 3). The primitive has the floating-point dtype of
                the positions.
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4); signs may flip.
            n_basis: Number N of basis functions, unless `basis` is given; None as for
                `JointDMP.fit`.
            body: Body coordinates, (*B, T, K), or (T,) for one.
            mask: Mask (*B, T), false at samples to ignore.
            scaling: Scaling of the position's forcing term, as for `JointDMP.fit`;
                `"rotation"` turns and scales the path with the displacement.
            options: Options of the fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (the message names them), or a motion for which the scaling
                is singular.
        """
        time, mask, (position, orientation, body) = padded(
            time, mask, position, orientation, body
        )
        error, goal = fitted_error(time, orientation, mask)
        columns = pose_columns(time, position, error, body, mask)
        motion = JointDMP.fit(
            time,
            columns,
            n_basis,
            mask=mask,
            units="m, rad, body",
            scaling=find_scaling(scaling, columns=POSITION.stop),
            **options,
        )
        return cls(motion, goal.to(columns))

    @property
    def start(self) -> Pose:
        """Pose at the start of the demonstration."""
        rotation = to_orientation(self.motion.start[..., ERROR], self.reference)
        return Pose(self.motion.start[..., POSITION], rotation)

    @property
    def goal(self) -> Pose:
        """Pose at the end of the demonstration."""
        return Pose(self.motion.goal[..., POSITION], self.goal_orientation)

    def _parts(self, name: str, value: Any) -> tuple[Tensor | None, Any]:
        if value is None:
            return None, None
        if not isinstance(value, Pose):
            raise ValueError(
                f"{name} of a pose primitive must be a Pose, got {type(value).__name__}: "
                "Pose(position, orientation), (..., 3) and (..., 4) as (w, x, y, z)"
            )
        if name != "value":  # NaN leaves parts of a via point free
            finite(f"position of {name}", value.position)
            finite(f"orientation of {name}", value.orientation)
        return value.position, value.orientation


def pose_columns(
    time: Times, position: Points, error: Tensor, body: Points | None, mask: Mask | None
) -> Float[Tensor, "*B T columns"]:
    """Checked samples of position, error and body in one tensor, in the dtype of the position.

    Raises:
        ValueError: Bad samples; the message names them.
    """
    checked = check_samples(time, position, mask=mask)
    if checked.position.shape[-2] != 3:
        raise ValueError(f"position must have 3 columns, got {checked.position.shape[-2]}")
    columns = [checked.columns, error.to(checked.position)]
    if body is not None:
        columns.append(check_samples(time, body, mask=mask, name="body").columns)
    try:
        return torch.cat(columns, dim=-1)
    except RuntimeError:
        shapes = ", ".join(str(tuple(column.shape)) for column in columns)
        raise ValueError(f"position, orientation error and body differ: {shapes}") from None
