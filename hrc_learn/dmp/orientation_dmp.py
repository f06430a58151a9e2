"""Movement primitive of an orientation."""

from typing import Any, Unpack

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._types import Mask, Quaternions, Times
from hrc_learn.dmp.fitting.motion_samples import FitReport, check_samples
from hrc_learn.dmp.fitting.solvers import FitOptions
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.dmp.orientation_coordinates import (
    OrientationCoordinates,
    OrientationState,
    OrientationTrajectory,
)
from hrc_learn.dmp.orientation_error import fitted_error, reference_of, to_orientation
from hrc_learn.dmp.ude_formulation import UdeCoordinates, follow_errors
from hrc_learn.model_files import SavedModel

FORMULATIONS: dict[str, type[OrientationCoordinates]] = {
    "log": OrientationCoordinates,
    "ude": UdeCoordinates,
}


class UnknownFormulationError(ValueError):
    """No formulation of that name."""


class OrientationDMP(AdaptedPrimitive[Quaternions, OrientationTrajectory, OrientationState]):
    """Movement primitive of an orientation.

    The error e to a reference, the goal unless said otherwise, is the state of a linear
    primitive, exact at all angles, or of that of Ude et al. 2014; see `formulation`. Both
    signs of any quaternion give the same motion. Values are unit quaternions (w, x, y, z),
    (*batch, 4); velocities and couplings are angular, in the base frame, (*batch, 3). A new
    start or goal is reached the way round that the demonstration took.
    """

    goal: Tensor
    motion: JointDMP
    formulation: str
    """`"log"` or `"ude"`: what forcing term and spring act on."""

    def __init__(
        self, motion: JointDMP, goal: Float[Tensor, "*batch 4"], formulation: str = "log"
    ):
        """Put a primitive together; `fit` is the usual way to one.

        Args:
            motion: Of the error [rad], D = 3. Where its own goal is not zero, the error is
                taken to the reference exp(that) * goal: as primitives of several goals need.
            goal: Unit quaternion (w, x, y, z) at which it ends.
            formulation: `"log"` or `"ude"`, what `motion` acts on.

        Raises:
            ValueError: No such formulation.
        """
        super().__init__()
        _check_formulation(formulation)
        self.formulation = formulation
        self.motion = motion
        self.register_buffer("goal", goal)

    @classmethod
    def fit(
        cls,
        time: Times,
        orientation: Quaternions,
        n_basis: int = 50,
        mask: Mask | None = None,
        *,
        formulation: str = "log",
        **options: Unpack[FitOptions],
    ) -> "OrientationDMP":
        """Learn one primitive from each demonstration.

        Args:
            time: Timestamps [s], (T,) or (*B, T).
            orientation: Unit quaternions (w, x, y, z), (*B, T, 4). Signs may flip; neighbours
                must be less than half a turn apart.
            n_basis: N, unless `basis` is given.
            mask: (*B, T), false where a sample does not count.
            formulation: `"log"`, exact, or `"ude"`, integrated and for turns of less than 360
                degrees.
            options: How to fit; see `FitOptions`.

        Raises:
            ValueError: Bad samples (says which), or no such formulation.
        """
        _check_formulation(formulation)
        error, goal = fitted_error(time, orientation, mask)
        motion = JointDMP.fit(time, error, n_basis, mask=mask, **options)
        if options.get("robust"):
            # What it found stands for samples that may be far off.
            error = motion.rollout().position.detach()
        if formulation == "ude":
            follow_errors(motion, check_samples(time, error, mask=mask))
        return cls(motion, goal, formulation)

    @property
    def adapter(self) -> OrientationCoordinates:
        """Errors to a reference."""
        return FORMULATIONS[self.formulation](self.goal)

    @property
    def start(self) -> Float[Tensor, "*batch 4"]:
        """Where the demonstration starts."""
        return to_orientation(self.motion.start, self.reference)

    @property
    def reference(self) -> Float[Tensor, "*batch 4"]:
        """What the error is taken to."""
        return reference_of(self.motion.goal, self.goal)

    @property
    def duration(self) -> Float[Tensor, "*batch"]:
        """Of the demonstration [s]."""
        return self.motion.duration

    @property
    def fit_report(self) -> FitReport | None:
        """Residuals of the error's components [rad]; they bound those of the angle."""
        return self.motion.fit_report

    def with_motion[S: "OrientationDMP"](
        self: S, motion: JointDMP, frame: Tensor | None = None
    ) -> S:
        """Around another motion of the error, to this reference or another."""
        reference = self.reference if frame is None else frame
        return type(self)(motion, to_orientation(motion.goal, reference), self.formulation)

    def _own_config(self) -> dict[str, Any]:
        return {"formulation": self.formulation}

    def _own_tensors(self) -> dict[str, Tensor]:
        return {"goal_orientation": self.goal}

    @classmethod
    def _restored[S: "OrientationDMP"](cls: type[S], saved: SavedModel) -> S:
        # Older files have no formulation: there was one only.
        name = saved.get("formulation", str) if "formulation" in saved.config else "log"
        try:
            return cls(JointDMP.restore(saved), saved.tensor("goal_orientation"), name)
        except UnknownFormulationError as error:
            raise saved.invalid_field("formulation", error) from None


def _check_formulation(name: str) -> None:
    if name not in FORMULATIONS:
        known = ", ".join(FORMULATIONS)
        raise UnknownFormulationError(f"unknown formulation {name!r}; there are {known}")
