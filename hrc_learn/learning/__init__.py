"""From datasets to models: movement primitives, image Jacobians, metrics, tuning.

Names are imported when they are first used: looking at the package loads no fit and no viewer.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hrc_learn.learning.channels import CHANNELS as CHANNELS
    from hrc_learn.learning.channels import Motions as Motions
    from hrc_learn.learning.channels import load_primitive as load_primitive
    from hrc_learn.learning.primitive_fitting import FittedPrimitives as FittedPrimitives
    from hrc_learn.learning.primitive_fitting import fit_contextual as fit_contextual
    from hrc_learn.learning.primitive_fitting import fit_primitives as fit_primitives
    from hrc_learn.learning.primitive_fitting import fit_streamed as fit_streamed
    from hrc_learn.learning.reproduction_metrics import ReproductionError as ReproductionError
    from hrc_learn.learning.reproduction_metrics import reproduction_error as reproduction_error
    from hrc_learn.learning.tuning import TuningState as TuningState
    from hrc_learn.learning.tuning import with_gains as with_gains
    from hrc_learn.learning.visual_servo_fitting import fit_visual_servo as fit_visual_servo

_HOME = {
    **dict.fromkeys(("CHANNELS", "Motions", "load_primitive"), "channels"),
    **dict.fromkeys(
        ("FittedPrimitives", "fit_contextual", "fit_primitives", "fit_streamed"),
        "primitive_fitting",
    ),
    "fit_visual_servo": "visual_servo_fitting",
    **dict.fromkeys(("ReproductionError", "reproduction_error"), "reproduction_metrics"),
    **dict.fromkeys(("TuningState", "with_gains"), "tuning"),
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(_HOME)
