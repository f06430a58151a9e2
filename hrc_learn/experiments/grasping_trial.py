"""One grasp in simulation, with a choice of image-Jacobian estimators."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.grasping_scene import GraspingScene
from hrc_learn.experiments.simulated_cell import (
    UNOBSERVED,
    Observer,
    grasping_allows_for,
    plan_checker,
    simulated_cell,
)
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from hrc_learn.sim import CameraKind, MotionLog, ObjectConfig, World, open_camera
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.grasping import Grasping, GraspingConfig, GraspResult
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import VisualServoSkill, from_learned, guessed_network
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import DrawnInterval, ScriptedDrawing
from hrc_learn.teleoperation.page import PageConfig

REACHED = 5.0
"""Distance of the marker from its true target that counts as reached [px]."""


@dataclass(frozen=True)
class Variant:
    """An initial image Jacobian, and a law that adapts it."""

    label: str
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator]
    """Makes the estimator from the learned image Jacobian."""
    claim: str = ""
    """Claim of the paper."""


def _from_guess(
    law: type[ImageJacobianEstimator],
) -> Callable[[RBFImageJacobian], ImageJacobianEstimator]:
    """The law, started from the paper's initial image Jacobian."""
    return lambda _: law(guessed_network())


DEFAULT = "learned"

VARIANTS: Mapping[str, Variant] = {
    DEFAULT: Variant("Kalman filter from the learned Jacobian", from_learned),
    "kalman": Variant(
        "Kalman filter from the paper's guess", lambda _: from_learned(guessed_network())
    ),
    "composite": Variant(
        "composite law from the paper's guess", _from_guess(CompositeEstimator)
    ),
    "paper": Variant(
        "the paper's law from its guess",
        _from_guess(PaperEstimator),
        claim="reaches the target, faster than without adaptation (Experiment 2)",
    ),
    "fixed": Variant(
        "the paper's guess, not adapted",
        _from_guess(FixedEstimator),
        claim="reaches the target, slower (Experiment 2)",
    ),
    "unadapted": Variant(
        "the learned Jacobian, not adapted",
        # Estimators work in double precision; the copy leaves the network of the skill as is.
        lambda learned: FixedEstimator(copy.deepcopy(learned).double()),
    ),
}
"""Estimators to compare, the default first."""


@dataclass(frozen=True, kw_only=True)
class SimulatedGrasp:
    """One grasp, successful or not."""

    scene: GraspingScene
    world: World
    """World in the state that the run left."""
    cell: WorkCell
    motion: MotionLog
    item: ObjectConfig
    result: GraspResult | None
    """Report of the task; None if it failed."""
    failure: str = ""
    """Reason of a failure; empty after a success."""


def simulate_grasp(
    aiming: VisualServoSkill,
    scene: GraspingScene,
    *,
    estimator: ImageJacobianEstimator | None = None,
    known_target: bool = False,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    access: ArmAccess = SIMULATED,
    drawings: Sequence[DrawnInterval] = (),
    page: PageConfig | None = None,
    observer: Observer = UNOBSERVED,
) -> SimulatedGrasp:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        scene: Initial conditions.
        estimator: Estimator of the image Jacobian; by default that of `Grasping`.
        known_target: Give the controller the true target pixel, which no real one can know.
            Estimators then differ only in the path to it.
        camera: Kind of camera that watches.
        config: Configuration of the grasp.
        rng: Source of image noise and of lost images.
        access: Access to the arm.
        drawings: Regions and targets that a scripted person draws, in the time of the run.
        page: Serves a page on which people draw and pull the arm too, in real time; None: no
            page.
        observer: Live dashboard and messages.
    """
    workplace = scene.workplace.approached(aiming.approach)
    scene = replace(scene, workplace=workplace)
    world = scene.world()
    item, sizes = workplace.scene.objects[0], world.imperfections.sizes
    eye = open_camera(world, camera, rng=rng, noise=sizes.camera_noise)
    config = grasping_allows_for(config or GraspingConfig(), access.declared(sizes))
    above = scene.above()

    def true_target(
        pixel, jacobian, orientation: Float[Tensor, "4"], further: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "2"]:
        target = scene.true_target(world, Pose(above.position, orientation))
        return target + jacobian[:, :3] @ further

    result, failure = None, ""
    with simulated_cell(
        world,
        human=ScriptedDrawing(drawings),
        sensor=MarkerSensor(eye, workplace.scene.marker_ids),
        access=access,
        page=page,
        title="Grasping",
        observer=observer,
        rng=rng,
    ) as simulated:
        task = Grasping(
            simulated.cell,
            workplace,
            aiming,
            config,
            estimator=estimator,
            target=true_target if known_target else None,
            check=plan_checker(world),
        )
        try:
            result = task.grasp(item)
            task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedGrasp(
        scene=scene,
        world=world,
        cell=simulated.cell,
        motion=simulated.motion,
        item=item,
        result=result,
        failure=failure,
    )


@dataclass(frozen=True, kw_only=True)
class GraspingRun:
    """Grasps of the same object from the same start, seen by the same camera."""

    grasp: SimulatedGrasp
    """Grasp by the default variant without knowledge of the target: this one must succeed."""
    compared: Mapping[str, SimulatedGrasp]
    """Grasps by variant, each with the known target pixel."""
