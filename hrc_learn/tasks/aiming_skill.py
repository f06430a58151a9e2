"""A learned visual servo: image Jacobian, visual target and approach direction."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..jacobian import CellErrors, Learned, RBFImageJacobian
from .approach import Approach
from .visual_target import OBJECT_FEATURE, VisualTarget


@dataclass(frozen=True, kw_only=True)
class AimingSkill:
    """What was learned from demonstrations of aiming."""

    jacobian: RBFImageJacobian
    target: VisualTarget | None
    """None where no object was watched."""
    approach: Approach | None = None
    """None where no object was watched."""
    learned: Learned | None = None
    """How neurons, noise and prior were learned; None where they were given."""
    cells: CellErrors | None = None
    """Held-out errors by place; None of a skill that was loaded."""

    def save(self, folder: Path) -> None:
        """Write `folder/jacobian`, `folder/visual_target.json`, `folder/approach.json`."""
        self.jacobian.save(folder / "jacobian")
        if self.target is not None:
            self.target.save(folder / "visual_target.json")
        if self.approach is not None:
            self.approach.save(folder / "approach.json")

    @classmethod
    def load(cls, folder: Path) -> "AimingSkill":
        """Read what `training/fit_image_jacobian.py` wrote.

        Raises:
            FileNotFoundError: If there is no such folder or file.
            ValueError: If a file is not one of ours.
        """
        target, approach = folder / "visual_target.json", folder / "approach.json"
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
            target=VisualTarget.load(target) if target.exists() else None,
            approach=Approach.load(approach) if approach.exists() else None,
        )

    def target_of(
        self, pixel: Float[np.ndarray, "2"], jacobian: Float[np.ndarray, "2 6"]
    ) -> Float[np.ndarray, "2"]:
        """Where the hand's marker should be, to stand above an object seen at a pixel.

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the hand's marker [px/m, px/rad].

        Raises:
            ValueError: If no object was watched in the demonstrations.
        """
        if self.target is None:
            raise ValueError(
                f"the aiming skill knows no visual target: its demonstrations lack "
                f"{OBJECT_FEATURE}."
            )
        return self.target.seen_by(pixel, jacobian)

    def metrics(self) -> dict[str, float]:
        """How well image motion is predicted, and how well aiming.

        Raises:
            ValueError: If the skill was loaded; its metrics are in metrics.json.
        """
        report = self.jacobian.report
        if report is None or self.cells is None:
            raise ValueError("only a skill just fitted has metrics; see its metrics.json.")
        known = self.cells.relative[self.cells.pairs > 0]
        values = {
            "pairs": float(report.pairs),
            "neurons": float(len(self.jacobian.centers)),
            "motion_px": report.motion,
            "fit_error_px": report.error,
            "held_out_error_px": report.held_out_error,
            "held_out_relative": report.held_out_error / report.motion,
            "held_out_relative_worst_cell": float(known.max()),
        }
        if self.learned is not None:
            first, best = self.learned.rounds[0], self.learned.rounds[self.learned.best]
            values |= {
                "pixel_noise_px": self.learned.config.pixel_noise,
                "width": float(self.learned.neurons.width),
                "learning_rounds": float(self.learned.best),
                "before_learning_error_px": first.held_out_error,
                "after_learning_error_px": best.held_out_error,
            }
        if self.target is not None:
            values["target_error_px"] = self.target.error
            values["target_error_by_offset_px"] = self.target.offset_error
        if self.approach is not None:
            values["approach_spread_deg"] = math.degrees(self.approach.spread)
            values["approach_turned_deg"] = math.degrees(self.approach.turned)
        return values
