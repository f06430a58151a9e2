"""Recorded orientations, checked and as errors."""

from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.fitting.samples import check_samples, demo_label
from hrc_learn.dmp.rotation.error import demonstrated_error, held, to_error
from hrc_learn.dmp.rotation.mean import mean_along
from hrc_learn.geometry import quaternion

NORM_TOLERANCE = 1e-2
"""How far from one the norm of a recorded quaternion may be before it is called broken."""


def fitted_error(
    time: ArrayLike, orientation: ArrayLike, mask: ArrayLike | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors and goals of demonstrations that end."""
    return demonstrated_error(*_checked(time, orientation, mask))


def centred_error(
    time: ArrayLike, orientation: ArrayLike, mask: ArrayLike | None
) -> tuple[Float[Tensor, "*B T 3"], Float[Tensor, "*B 4"]]:
    """Errors of demonstrations to their mean orientation, and that.

    Raises:
        ValueError: Bad samples, or some half a turn or more from the mean.
    """
    q, mask = _checked(time, orientation, mask)
    q = held(q, mask)
    centre = mean_along(q, mask)
    error = to_error(q, centre[..., None, :])
    # Past half a turn the logarithm jumps to the other side, which unwrapping undoes.
    far = (quaternion.unwrap_log(error) - error).norm(dim=-1) > 1
    if far.any():
        i, k = far.reshape(-1, far.shape[-1]).nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, far.shape[:-1])}orientation passes half a turn from its mean at "
            f"sample {k}: a rhythm must stay within 180 degrees of its centre"
        )
    return error, centre


def _checked(
    time: ArrayLike, orientation: ArrayLike, mask: ArrayLike | None
) -> tuple[Float[Tensor, "*B T 4"], Bool[Tensor, "*B T"]]:
    """Unit quaternions and which of them count."""
    samples = check_samples(time, orientation, mask=mask, name="orientation")
    if samples.position.shape[-2] != 4:
        raise ValueError(
            f"orientation must be quaternions (w, x, y, z), shape (..., T, 4), "
            f"got {tuple(to_tensor(orientation).shape)}"
        )
    norm = samples.position.norm(dim=-2)
    broken = samples.mask & ((norm - 1).abs() > NORM_TOLERANCE)
    if broken.any():
        i, k = broken.nonzero()[0].tolist()
        raise ValueError(
            f"{demo_label(i, samples.batch)}orientation has norm {norm[i, k].item():.4f} at "
            f"sample {k}: not a unit quaternion. Interpolating across a sign flip does this."
        )
    unit = samples.columns / norm.masked_fill(~samples.mask, 1).reshape(*samples.batch, -1, 1)
    return unit, samples.mask.reshape(unit.shape[:-1])
