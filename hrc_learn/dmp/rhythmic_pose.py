"""Rhythms of an orientation and of a pose, about their mean."""

from hrc_learn.dmp.arrays import ArrayLike
from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.pose_columns import ERROR, demonstrated_columns
from hrc_learn.dmp.rhythmic import fit_rhythmic
from hrc_learn.dmp.rotation.demonstrated import centred_error
from hrc_learn.dmp.rotation.error import to_orientation
from hrc_learn.dmp.system.spring import SpringDamper


def fit_rhythmic_orientation(
    time: ArrayLike,
    orientation: ArrayLike,
    n_basis: int = 25,
    period: float | None = None,
    mask: ArrayLike | None = None,
    *,
    spring: SpringDamper | None = None,
    regularization: float = 1e-7,
) -> OrientationDMP:
    """Learn a rhythm of an orientation from each demonstration of one cycle or more.

    The error to the mean orientation swings as a `fit_rhythmic` primitive; the goal of the
    result is the centre of that. `duration` (or `speed`) and `amplitude` modulate it.

    Args:
        time: Stamps [s], (T,) or (*B, T).
        orientation: Unit quaternions (w, x, y, z), (*B, T, 4), within half a turn of their
            mean; signs may flip.
        n_basis: Basis functions a period.
        period: [s]; found from the motion unless given.
        mask: (*B, T), false where a sample does not count.
        spring: Gains; alpha = 25 per period, critically damped, unless given.
        regularization: Ridge, relative to the largest singular value.

    Raises:
        ValueError: Bad samples (says which), less than one period of them, or a motion that
            passes half a turn from its mean.
    """
    error, reference = centred_error(time, orientation, mask)
    motion = fit_rhythmic(
        time, error, n_basis, period, mask, spring=spring, regularization=regularization
    )
    return OrientationDMP(motion, to_orientation(motion.goal, reference))


def fit_rhythmic_pose(
    time: ArrayLike,
    position: ArrayLike,
    orientation: ArrayLike,
    n_basis: int = 25,
    body: ArrayLike | None = None,
    period: float | None = None,
    mask: ArrayLike | None = None,
    *,
    spring: SpringDamper | None = None,
    regularization: float = 1e-7,
) -> PoseDMP:
    """Learn a rhythm of a pose; arguments as for `PoseDMP.fit` and `fit_rhythmic`.

    All coordinates share one period, found from all of them unless it is given.
    """
    error, reference = centred_error(time, orientation, mask)
    columns = demonstrated_columns(time, position, error, body, mask)
    motion = fit_rhythmic(
        time,
        columns,
        n_basis,
        period,
        mask,
        units="m, rad, body",
        spring=spring,
        regularization=regularization,
    )
    goal = to_orientation(motion.goal[..., ERROR], reference.to(columns))
    return PoseDMP(motion, goal)
