"""One grasp in simulation, with a choice of image-Jacobian estimators."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from hrc_learn.experiments.live_view import LiveView, no_live_view
from hrc_learn.experiments.pose_randomization import GraspingScene
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from hrc_learn.kinematics import panda
from hrc_learn.sim import CameraKind, MotionLog, ObjectConfig, World, open_camera
from hrc_learn.skills.grasping import Grasping, GraspingConfig, GraspResult
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.placing import Plan, check_plan
from hrc_learn.skills.visual_skill import VisualServoSkill, from_learned, guessed_network
from hrc_learn.skills.work_cell import TaskFailedError, WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation


@dataclass(frozen=True, kw_only=True)
class Variant:
    """An initial image Jacobian, and a law that adapts it."""

    label: str
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator]
    """From the learned image Jacobian."""
    claim: str = ""
    """What the paper says about it."""


DEFAULT = "learned"

VARIANTS: Mapping[str, Variant] = {
    DEFAULT: Variant(label="Kalman filter from the learned Jacobian", estimator=from_learned),
    "kalman": Variant(
        label="Kalman filter from the paper's guess",
        estimator=lambda _: KalmanEstimator(guessed_network()),
    ),
    "composite": Variant(
        label="composite law from the paper's guess",
        estimator=lambda _: CompositeEstimator(guessed_network()),
    ),
    "paper": Variant(
        label="the paper's law from its guess",
        claim="reaches the target, faster than without adaptation (Experiment 2)",
        estimator=lambda _: PaperEstimator(guessed_network()),
    ),
    "fixed": Variant(
        label="the paper's guess, not adapted",
        claim="reaches the target, slower (Experiment 2)",
        estimator=lambda _: FixedEstimator(guessed_network()),
    ),
    "unadapted": Variant(
        label="the learned Jacobian, not adapted",
        # Estimators work in double precision, and the skill keeps its own network.
        estimator=lambda learned: FixedEstimator(copy.deepcopy(learned).double()),
    ),
}
"""What can be compared, the default first."""


@dataclass(frozen=True, kw_only=True)
class SimulatedGrasp:
    """One grasp, successful or not."""

    scene: GraspingScene
    world: World
    """As the run left it."""
    cell: WorkCell
    motion: MotionLog
    item: ObjectConfig
    result: GraspResult | None
    """What the task reports; None if it failed."""
    failure: str = ""
    """Why it failed."""


def simulate_grasp(
    aiming: VisualServoSkill,
    scene: GraspingScene,
    *,
    estimator: ImageJacobianEstimator | None = None,
    told_target: bool = False,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    view: LiveView = no_live_view,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
) -> SimulatedGrasp:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        scene: Initial conditions.
        estimator: Of the image Jacobian; None: that of `Grasping`.
        told_target: Tell the controller the target pixel, which no real one can know:
            estimators are then compared on nothing but how they get there.
        camera: Which kind of camera watches.
        config: How objects are grasped.
        rng: Source of image noise.
        view: Dashboard of the run while it goes on.
        on_phase: Told the name of each phase of the task, and when it begins [s].
    """
    workplace = scene.workplace.approached(aiming.approach)
    scene = replace(scene, workplace=workplace)
    world = scene.world()
    item, motion = workplace.scene.objects[0], MotionLog(world)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    result, failure = None, ""
    with torch.inference_mode():
        cell = WorkCell(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            sensor=MarkerSensor(
                open_camera(world, camera, rng=rng), workplace.scene.marker_ids
            ),
            human=ScriptedPerturbation(panda, (), begin=None),
            advance=motion.advance,
            on_phase=on_phase,
        )
        target = scene.true_target(world)
        task = Grasping(
            cell,
            workplace,
            aiming,
            config,
            estimator=estimator,
            target=(lambda pixel, jacobian: target) if told_target else None,
            check=check,
        )
        try:
            with view(cell, world, motion):
                result = task.grasp(item)
                task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedGrasp(
        scene=scene,
        world=world,
        cell=cell,
        motion=motion,
        item=item,
        result=result,
        failure=failure,
    )


@dataclass(frozen=True, kw_only=True)
class GraspingRun:
    """Grasps of the same object from the same start, seen by the same camera."""

    grasp: SimulatedGrasp
    """By the default, told nothing: this is what has to succeed."""
    compared: Mapping[str, SimulatedGrasp]
    """By variant, each told the target pixel."""
