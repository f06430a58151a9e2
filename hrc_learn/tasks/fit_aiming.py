"""From demonstrations of aiming: the image Jacobian, and where in the image to aim."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..demos import Demonstration, DemonstrationSet
from ..geometry import Pose
from ..jacobian import RBFImageJacobian
from .visual_target import OBJECT_FEATURE, VisualTarget

_REST = 0.3
"""Time at the end of a demonstration in which the hand stands above the object [s]."""


@dataclass(frozen=True, kw_only=True)
class AimingSkill:
    """What was learned from demonstrations of aiming."""

    jacobian: RBFImageJacobian
    target: VisualTarget

    def save(self, folder: Path) -> None:
        """Write into `folder/jacobian` and `folder/visual_target.json`."""
        self.jacobian.save(folder / "jacobian")
        self.target.save(folder / "visual_target.json")

    @classmethod
    def load(cls, folder: Path) -> "AimingSkill":
        """Read what `training/fit_image_jacobian.py` wrote.

        Raises:
            FileNotFoundError: If there is no such folder or file.
            ValueError: If a file is not one of ours.
        """
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
            target=VisualTarget.load(folder / "visual_target.json"),
        )

    def metrics(self) -> dict[str, float]:
        """How well image motion is predicted, and how well aiming.

        Raises:
            ValueError: If the skill was loaded; its metrics are in metrics.json.
        """
        report = self.jacobian.report
        if report is None:
            raise ValueError("only a skill just fitted has metrics; see its metrics.json.")
        return {
            "pairs": float(report.pairs),
            "motion_px": report.motion,
            "fit_error_px": report.error,
            "held_out_error_px": report.held_out_error,
            "held_out_relative": report.held_out_error / report.motion,
            "target_error_px": self.target.error,
        }


def fit_aiming(
    demos: DemonstrationSet, centers: Float[Tensor, "K 2"], width: float
) -> AimingSkill:
    """Fit image Jacobian and visual target.

    Args:
        demos: With end-effector poses, image features, and the object's feature.
        centers: Of the neurons, in x and y [m].
        width: Of the neurons [m].

    Raises:
        ValueError: If a demonstration lacks a column; names it and the episode.
    """
    for demo in demos:
        _require(demo, demos.source)
    poses = [
        Pose(torch.from_numpy(demo.position), torch.from_numpy(demo.orientation))
        for demo in demos
    ]
    jacobian = RBFImageJacobian.fit(
        poses,
        [torch.from_numpy(demo.feature) for demo in demos],
        [torch.from_numpy(demo.feature_visible) for demo in demos],
        centers=centers,
        width=width,
    )
    ends = [_end(demo, demos.source) for demo in demos]
    target = VisualTarget.fit(
        np.array([objects for objects, _ in ends]), np.array([hands for _, hands in ends])
    )
    return AimingSkill(jacobian=jacobian, target=target)


def _require(demo: Demonstration, source: str) -> None:
    needed = ("position", "orientation", "feature", "feature_visible")
    missing = [name for name in needed if getattr(demo, name) is None]
    missing += [] if OBJECT_FEATURE in demo.extra else [OBJECT_FEATURE]
    if missing:
        raise ValueError(
            f"{source}, episode {demo.episode}: no {', '.join(missing)}. An image Jacobian "
            "needs the hand's pose and its marker's pixel in every frame, and the object's."
        )


def _end(demo: Demonstration, source: str) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the object and of the hand above it, at rest at the end of a demonstration."""
    assert demo.feature is not None
    assert demo.feature_visible is not None
    at_rest = demo.time > demo.time[-1] - _REST
    last = np.flatnonzero(demo.feature_visible & at_rest)
    if not len(last):
        raise ValueError(
            f"{source}, episode {demo.episode}: the hand's marker is not seen in the last "
            f"{_REST} s, where the hand stands above the object. Leave this episode out."
        )
    return demo.extra[OBJECT_FEATURE][last, :2].mean(axis=0), demo.feature[last].mean(axis=0)
