"""Demonstrations and fits as recordings for Rerun, and the report of a fit."""

from collections.abc import Mapping, Sequence
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.jacobian import EvidenceResult, RBFCenters
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.franka import panda_bodies
from hrc_learn.learning.primitive_fitting import FittedPrimitives
from hrc_learn.learning.visual_servo_fitting import Demonstrations, feature_trajectories
from hrc_learn.log import JointRanges
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.viz import (
    DemonstrationsRecording,
    DemonstrationTrace,
    ErrorMap,
    FitRecording,
    LearningRecording,
)
from hrc_learn.viz.figures import fit_joints_figure, residual_figure
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions


def demonstrations_recording(
    demos: DemonstrationSet,
    title: str,
    images: Mapping[int, Mapping[str, tuple[np.ndarray, tuple[bytes, ...]]]] | None = None,
) -> DemonstrationsRecording:
    """Recording of demonstrations. A Panda is drawn, with the path of its end effector.

    Args:
        demos: Demonstrations of one robot.
        title: Title of the recording.
        images: Times [s] and JPEG files by episode and camera.
    """
    images = images or {}
    names = demos[0].joint_names
    known = names == panda.joint_names
    limits = panda.limits
    return DemonstrationsRecording(
        title=title,
        joint_names=names,
        demonstrations=tuple(
            _shown(demo, known, images.get(demo.episode, {})) for demo in demos
        ),
        joint_limits=JointRanges(lower=limits.lower.numpy(), upper=limits.upper.numpy())
        if known
        else None,
        notes=tuple(str(note) for note in demos.notes),
    )


def _shown(demo: Demonstration, is_panda: bool, images: Mapping) -> DemonstrationTrace:
    q, position = demo.joint_position, demo.position
    bodies = ()
    if is_panda and q is not None:
        bodies = panda_bodies(q)
        if position is None:
            position = panda.forward(torch.from_numpy(q)).position.numpy()
    feature = demo.feature
    if feature is not None and demo.feature_visible is not None:
        feature = np.where(demo.feature_visible[:, None], feature, np.nan)
    return DemonstrationTrace(
        episode=demo.episode,
        task=demo.task,
        time=demo.time,
        joint_position=q,
        position=position,
        feature=feature,
        human_effort=demo.human_effort,
        gripper=demo.gripper,
        bodies=bodies,
        images=images,
    )


def fit_recording(fitted: FittedPrimitives, title: str) -> FitRecording:
    """Recording of demonstrations and reproductions, of the joints or else the position.

    Args:
        fitted: Primitives of the demonstrations.
        title: Title of the recording.

    Raises:
        ValueError: Neither joints nor positions were learned.
    """
    channel = next((k for k in ("joint", "position", "pose") if k in fitted.each), None)
    if channel is None:
        raise ValueError("orientations alone cannot be shown: learn the pose or positions.")
    motions, lengths = fitted.motions, fitted.demonstrations.length.tolist()
    shown, made = motions.position(channel), motions.own(fitted.each[channel]).position
    assert made is not None

    def cut(padded: Tensor) -> tuple[np.ndarray, ...]:
        return tuple(
            values[:n].double().numpy() for values, n in zip(padded, lengths, strict=True)
        )

    limits, paths, reproduced = None, (), ()
    if channel != "joint":
        paths, reproduced = cut(shown), cut(made)
    elif motions.joint_names == panda.joint_names:
        limits = JointRanges(lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy())
        paths = cut(panda.forward(shown.double()).position)
        reproduced = cut(panda.forward(made.double()).position)
    residual = {}
    if (selection := fitted.selection) is not None:
        residual = dict(zip(selection.candidates, selection.error.tolist(), strict=True))
    return FitRecording(
        title=title,
        joint_names=motions.joint_names if channel == "joint" else ("x", "y", "z"),
        time=cut(motions.demos.time),
        demos=cut(shown),
        reproductions=cut(made),
        joint_limits=limits,
        n_basis=fitted.n_basis,
        demo_paths=paths,
        reproduction_paths=reproduced,
        residual=residual,
        unit="rad" if channel == "joint" else "m",
    )


def fit_report(
    fit: FitRecording,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Report of a fit: measured values and reproductions.

    Args:
        fit: Recording of demonstrations and reproductions.
        table: Measured values.
        configuration: Options of the fit.
        command: Command line that repeats the fit.
    """
    moved = "joints" if fit.unit == "rad" else "position"
    caption = "The first four demonstrations and their reproductions."
    figures = [Picture(moved, fit_joints_figure(fit), caption)]
    if fit.residual:
        caption = "Held-out error by number of basis functions, and the selected number."
        figures.append(Picture("n_basis", residual_figure(fit), caption))
    sections = [Section(heading="Reproductions", figures=figures)]
    basis = "" if fit.n_basis is None else f" of {fit.n_basis} basis functions"
    return Report(
        title=fit.title,
        summary=f"A movement primitive{basis} for each demonstration, and their mean.",
        table=table,
        sections=sections,
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )


_MOST_PATHS = 30
"""Largest number of paths drawn, as more hide each other."""
_BELOW = 0.03
"""Distance of the error map below the lowest path, so that both are visible [m]."""


def learning_recording(
    skill: VisualServoSkill,
    demos: Demonstrations,
    title: str,
) -> LearningRecording:
    """Recording of the fit of an image Jacobian.

    Args:
        skill: Skill that was just fitted.
        demos: Its demonstrations, of which the first are drawn.
        title: Title of the recording.

    Raises:
        ValueError: The skill was loaded, and its held-out errors are unknown.
    """
    measured, cells = skill.metrics(), skill.cells
    assert cells is not None  # or there would be no metrics
    x, y = cells.edges.mT.numpy()
    shown = islice(feature_trajectories(demos), _MOST_PATHS)
    paths = tuple(watched.pose.position.numpy() for watched in shown)
    height = float(np.mean([path[:, 2].mean() for path in paths]))
    learned = skill.learned
    return LearningRecording(
        title=title,
        measured=measured,
        curves={} if learned is None else _curves(learned),
        best=0 if learned is None else learned.best,
        centers=np.zeros((1, 0, 3))
        if learned is None
        else np.stack([_places(state.neurons, height) for state in learned.rounds]),
        paths=paths,
        errors=ErrorMap(
            x=x,
            y=y,
            z=min(float(path[:, 2].min()) for path in paths) - _BELOW,
            relative_error=cells.relative.numpy(),
        ),
    )


def _curves(learned: EvidenceResult) -> dict[str, np.ndarray]:
    rounds, configs = learned.rounds, [state.config for state in learned.rounds]
    return {
        "Error on held-out demonstrations [px]": np.array([s.held_out_error for s in rounds]),
        "Negative log evidence per pair [-]": np.array([s.evidence for s in rounds]),
        "Width of the neurons [m, rad]": np.array([float(s.neurons.width) for s in rounds]),
        "Noise of the camera [px]": np.array([c.pixel_noise for c in configs]),
        "Prior deviation, common part [px/m]": np.array([c.bias_std for c in configs]),
        "Prior deviation, weights [px/m]": np.array([c.weight_std for c in configs]),
    }


def _places(neurons: RBFCenters, height: float) -> np.ndarray:
    """Positions of the neurons [m]; coordinates that they do not use are set to a mean."""
    centers, places = neurons.centers.numpy(), np.zeros((len(neurons.centers), 3))
    places[:, 2] = height
    for column, component in enumerate(neurons.input_indices):
        if component < 3:
            places[:, component] = centers[:, column]
    return places
