"""Learn robot arm motions from a few demonstrations and work safely near people.

This module exports the names of the core; demonstrations, simulation, vision and dashboards are
imported from their own packages: `hrc_learn.demos`, `.sim`, `.vision`, `.viz`. Names are
imported on first use, so that `hrc --help` need not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hrc_learn.controller import AdaptiveController as AdaptiveController
    from hrc_learn.controller import SafetyFilter as SafetyFilter
    from hrc_learn.dmp import JointDMP as JointDMP
    from hrc_learn.dmp import OrientationDMP as OrientationDMP
    from hrc_learn.dmp import PoseDMP as PoseDMP
    from hrc_learn.geometry import Pose as Pose
    from hrc_learn.geometry import quaternion as quaternion
    from hrc_learn.jacobian import RBFImageJacobian as RBFImageJacobian
    from hrc_learn.kinematics import SerialChain as SerialChain
    from hrc_learn.kinematics import panda as panda

_NAMES = {
    "controller": ("AdaptiveController", "SafetyFilter"),
    "dmp": ("JointDMP", "OrientationDMP", "PoseDMP"),
    "geometry": ("Pose", "quaternion"),
    "jacobian": ("RBFImageJacobian",),
    "kinematics": ("SerialChain", "panda"),
}
_PACKAGES = {name: package for package, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _PACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PACKAGES[name]}"), name)
    globals()[name] = value  # later accesses do not call this function
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PACKAGES})
