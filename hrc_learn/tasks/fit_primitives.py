"""From demonstrations to movement primitives, and what is to be said about them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from torch import Tensor

from ..demos import DemonstrationSet, PaddedDemonstrations
from ..dmp import (
    BasisSelection,
    JointDMP,
    PoseDMP,
    ProbabilisticDMP,
    mean_primitive,
    select_basis_count,
)
from ..kinematics import panda
from ..viz import FitRecording, JointLimits
from .kinds import Motions, Primitive, kinds_wanted
from .reproduction_error import reproduction_error

EACH = "each"
"""Folder of the primitives of single demonstrations, where they are kept."""


@dataclass(frozen=True, kw_only=True)
class FittedPrimitives:
    """Primitives of one motion, one for each demonstration and what they have in common."""

    motions: Motions
    each: Mapping[str, Primitive]
    """By kind: one for each demonstration, as a batch."""
    common: Mapping[str, Primitive]
    """By kind: their mean, without batch dimensions."""
    n_basis: int
    selection: BasisSelection | None = None
    """How the number of basis functions was chosen, if it was."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the fit."""

    @property
    def demonstrations(self) -> PaddedDemonstrations:
        """What they were fitted to."""
        return self.motions.demos

    @property
    def joint(self) -> JointDMP | None:
        """One for each demonstration; None if joints were not learned."""
        return cast(JointDMP | None, self.each.get("joint"))

    @property
    def pose(self) -> PoseDMP | None:
        """The same for the hand, the arm angle as its body shape if the arm is a Panda."""
        return cast(PoseDMP | None, self.each.get("pose"))

    def save(self, folder: Path, each: bool = False) -> None:
        """Write the common primitives into `folder/KIND`.

        Args:
            folder: Where.
            each: Keep those of single demonstrations too, in `folder/each/KIND`: what a
                `ProbabilisticDMP` is made of.
        """
        for kind, primitive in self.common.items():
            primitive.save(folder / kind)
        for kind, primitives in self.each.items() if each else ():
            primitives.save(folder / EACH / kind)

    def distribution(self, kind: str) -> ProbabilisticDMP:
        """Gaussian over the primitives of one kind.

        Raises:
            ValueError: Of fewer than two demonstrations, or scaled primitives.
        """
        return ProbabilisticDMP.fit(self.each[kind])

    def metrics(self) -> dict[str, float]:
        """How close the primitives come to their demonstrations.

        `mean_` is the common primitive, given start, goal and duration of each.
        """
        values = {"demonstrations": float(len(self.demonstrations.length))}
        values["basis_functions"] = float(self.n_basis)
        for kind in self.each:
            own = self.motions.own(self.each[kind])
            adapted = self.motions.adapted(kind, self.common[kind])
            values |= reproduction_error(kind, self.motions, own).summary(kind)
            values |= reproduction_error(kind, self.motions, adapted).summary(f"mean_{kind}")
        return values


def fit_primitives(
    demos: DemonstrationSet,
    n_basis: int | None = 60,
    method: str = "trajectory",
    *,
    kinds: Sequence[str] = (),
    candidates: Sequence[int] = (10, 15, 20, 30, 40, 60, 80, 100),
    **options: Any,
) -> FittedPrimitives:
    """Fit one primitive to each demonstration, and their mean.

    Joints are learned from any robot. The pose of the hand is learned where it was recorded,
    or where the joints are those of a Panda, whose arm angle is then learned along.

    Args:
        demos: Demonstrations of one motion.
        n_basis: Number of basis functions; None: the smallest of the candidates that
            predicts samples held out as well as the best (see `select_basis_count`).
        method: See `JointDMP.fit`.
        kinds: To learn; none: joints and pose, or what there is of them.
        candidates: Numbers of basis functions to choose from.
        options: Further options of the fit, such as `robust` or `scaling`.

    Raises:
        ValueError: If the demonstrations hold no motion, or not what a kind needs.
    """
    motions = Motions.of(demos)
    kinds = kinds_wanted(motions, kinds)
    options = {"method": method, **options}
    selection = None
    if n_basis is None:
        selection = _select(motions, kinds[0], candidates, options)
        n_basis = selection.count
    each = {kind: motions.fit(kind, n_basis, **options) for kind in kinds}
    return FittedPrimitives(
        motions=motions,
        each=each,
        common={kind: mean_primitive(cast(Any, each[kind])) for kind in kinds},
        n_basis=n_basis,
        selection=selection,
        options=options,
    )


def _select(
    motions: Motions, kind: str, candidates: Sequence[int], options: Mapping[str, Any]
) -> BasisSelection:
    """By the linear coordinates of a kind; orientations alone give none to choose by."""
    if kind == "orientation":
        raise ValueError(
            "the number of basis functions is chosen by joints or positions: name it for "
            "orientations alone."
        )
    shortest = int(motions.demos.length.min())
    possible = [count for count in candidates if 2 * count <= shortest]
    if not possible:
        raise ValueError(
            f"the shortest demonstration has {shortest} samples, too few to choose the number "
            f"of basis functions from {', '.join(map(str, candidates))}: name it."
        )
    return select_basis_count(
        motions.demos.time, motions.position(kind), possible, mask=motions.demos.mask, **options
    )


def fit_recording(fitted: FittedPrimitives, title: str) -> FitRecording:
    """Demonstrations beside their reproductions, to be looked at.

    Of the joints, or else of the position.

    Raises:
        ValueError: If neither was learned.
    """
    kind = next((k for k in ("joint", "position", "pose") if k in fitted.each), None)
    if kind is None:
        raise ValueError("orientations alone have no figure: learn the pose, or positions.")
    motions, lengths = fitted.motions, fitted.demonstrations.length.tolist()
    shown, made = motions.position(kind), motions.own(fitted.each[kind]).position
    assert made is not None

    def cut(padded: Tensor) -> tuple[np.ndarray, ...]:
        return tuple(
            values[:n].double().numpy() for values, n in zip(padded, lengths, strict=True)
        )

    limits, paths, reproduced = None, (), ()
    if kind != "joint":
        paths, reproduced = cut(shown), cut(made)
    elif motions.joint_names == panda.joint_names:
        limits = JointLimits(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())
        paths = cut(panda.forward(shown.double()).position)
        reproduced = cut(panda.forward(made.double()).position)
    residual = {}
    if (selection := fitted.selection) is not None:
        residual = dict(zip(selection.candidates, selection.error.tolist(), strict=True))
    return FitRecording(
        title=title,
        joint_names=motions.joint_names if kind == "joint" else ("x", "y", "z"),
        time=cut(motions.demos.time),
        demos=cut(shown),
        reproductions=cut(made),
        joint_limits=limits,
        n_basis=fitted.n_basis,
        demo_paths=paths,
        reproduction_paths=reproduced,
        residual=residual,
        unit="rad" if kind == "joint" else "m",
    )
