"""Recorded orientations, checked and as errors."""

from torch import Tensor

from hrc_learn.dmp.arrays import ArrayLike, to_tensor
from hrc_learn.dmp.fitting.samples import check_samples, demo_label
from hrc_learn.dmp.rotation import error as error_space

NORM_TOLERANCE = 1e-2
"""How far from one the norm of a recorded quaternion may be before it is called broken."""


def fitted_error(
    time: ArrayLike, orientation: ArrayLike, mask: ArrayLike | None
) -> tuple[Tensor, Tensor]:
    """Errors (*B, T, 3) and goals (*B, 4) of checked demonstrations (*B, T, 4)."""
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
    return error_space.demonstrated_error(unit, samples.mask.reshape(unit.shape[:-1]))
