"""A grasp in simulation: everything put together, run once, kept for evaluation."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..human import ScriptedPuller
from ..jacobian import ImageJacobianEstimator
from ..kinematics import panda
from ..sim import CameraKind, MotionLog, ObjectConfig, World, open_camera
from .eye import Eye
from .failure import TaskFailedError
from .fit_aiming import AimingSkill
from .grasping import Grasping, GraspingConfig, GraspResult
from .grasping_setting import GraspingSetting
from .placing import Plan, check_plan
from .station import Station
from .watching import Watch, unwatched


@dataclass(frozen=True, kw_only=True)
class SimulatedGrasp:
    """One run, successful or not."""

    setting: GraspingSetting
    world: World
    """As it was left."""
    station: Station
    motion: MotionLog
    item: ObjectConfig
    result: GraspResult | None
    """What the task reports; None if it failed."""
    failure: str = ""
    """Why it failed."""


def simulate_grasp(
    aiming: AimingSkill,
    setting: GraspingSetting,
    *,
    estimator: ImageJacobianEstimator | None = None,
    told_target: bool = False,
    camera: CameraKind = "auto",
    config: GraspingConfig | None = None,
    rng: np.random.Generator,
    watch: Watch = unwatched,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
) -> SimulatedGrasp:
    """Grasp an object and carry it home, in MuJoCo.

    Args:
        aiming: Learned image Jacobian and visual target.
        setting: Where it begins.
        estimator: Of the image Jacobian; None: that of `Grasping`.
        told_target: Tell the controller the pixel to aim at, which no real one can know:
            estimators are then compared on nothing but how they get there.
        camera: Which kind of camera watches.
        config: How objects are grasped.
        rng: Source of image noise.
        watch: Watches from the side, such as `serving` a dashboard.
        on_phase: Told the name of each phase of the task, and when it begins [s].
    """
    workplace = setting.workplace.approached(aiming.approach)
    setting = replace(setting, workplace=workplace)
    world = setting.world()
    item, motion = workplace.scene.objects[0], MotionLog(world)

    def check(plan: Plan) -> None:
        check_plan(plan, world, item.name if world.holds(item.name) else None)

    result, failure = None, ""
    with torch.inference_mode():
        station = Station(
            chain=panda,
            arm=world.arm,
            gripper=world.arm,
            eye=Eye.on(open_camera(world, camera, rng=rng), workplace.scene),
            human=ScriptedPuller(panda, (), begin=None),
            advance=motion.advance,
            on_phase=on_phase,
        )
        target = setting.true_target(world)
        task = Grasping(
            station,
            workplace,
            aiming,
            config,
            estimator=estimator,
            target=(lambda pixel, jacobian: target) if told_target else None,
            check=check,
        )
        try:
            with watch(station, world, motion):
                result = task.grasp(item)
                task.go_home()
        except TaskFailedError as error:
            failure = str(error)
    return SimulatedGrasp(
        setting=setting,
        world=world,
        station=station,
        motion=motion,
        item=item,
        result=result,
        failure=failure,
    )
