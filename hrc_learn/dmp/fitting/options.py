"""What every kind of primitive can be told about its fit."""

from typing import TypedDict

from hrc_learn.dmp.system.basis import Basis
from hrc_learn.dmp.system.spring import SpringDamper


class FitOptions(TypedDict, total=False):
    """Options of `fit`, handed on unchanged to where they are used: `fit_motion`."""

    method: str
    """`"trajectory"` (default), least squares on the positions, the closest reproduction;
    `"ridge"`, regression on the force; `"lwr"`, the paper's."""
    robust: str | None
    """`"huber"` or `"tukey"`: how samples that lie far off are trusted less; see `robust.py`.
    None (default): all alike."""
    approach: float | int
    """Share of the motion, 0 to 1, along which a new start and goal are taken up, smoothly;
    0 (default): at once, as the paper has it."""
    basis: Basis | None
    """Shape of the forcing term; `n_basis` Gaussians unless given."""
    spring: SpringDamper | None
    """Gains; alpha = 25, critically damped, unless given."""
    regularization: float
    """Ridge, relative to the largest singular value; 1e-7 unless given."""
