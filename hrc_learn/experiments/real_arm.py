"""Tasks of the experiments on a real arm with a real camera.

The task code is the same as in the simulated work cell. True poses are unknown here: results
are the robot's own measurements. A simulated world of the assumed surroundings checks the plans
for collisions, and mirrors the arm for the recording.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hrc_learn.deploy import Rate
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.experiment import Experiment
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.placing_experiment import PlacingExperiment
from hrc_learn.experiments.run_recorder import record
from hrc_learn.experiments.simulated_cell import CellRun
from hrc_learn.experiments.surroundings import workplace_for
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware import (
    ArmProcess,
    CameraError,
    FrankaArm,
    FrankaConfig,
    FrankyArm,
    FrankyConfig,
    LeRobotArm,
    LeRobotConfig,
    Ros2Arm,
    Ros2Config,
)
from hrc_learn.hardware.driver_process import StoppableArm
from hrc_learn.hardware.ros2_topics import ros2_origin
from hrc_learn.kinematics import Arm, SerialChain, fr3, panda
from hrc_learn.protocols import Camera
from hrc_learn.sim import MotionLog, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import Grasping, GraspJob, as_load, joint_plan
from hrc_learn.skills.marker_sensor import LatencyConfig, MarkerSensor
from hrc_learn.skills.pick_and_place import HOME, PickAndPlace, place_along
from hrc_learn.skills.placing import PlacingSkill, Plan, check_plan
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import TaskFailedError, WorkCell, WorkCellConfig
from hrc_learn.store import new_folder, write_json
from hrc_learn.teleoperation import ScriptedPerturbation, Touch
from hrc_learn.viz.run_dashboard import record_run

Driver = Literal["franky", "franka", "lerobot", "ros2"]
"""Driver of a real arm: the package franky, our loop at 1 kHz through pylibfranka, a robot of
LeRobot, or topics of ROS 2."""

_SILENCE = 0.15
"""Time without commands after which the arm is stopped [s], as in `franka_panda`."""
_DELAY = 0.03
"""Delay from reading the joints to the motion of the arm [s]. It is not measured, but taken
from `Imperfections.nominal`."""
_SERVO_DELAY = 0.08
"""The same delay for position servos on a bus that is read at 50 Hz [s]; not measured."""
_REDUCED_SPEED = 0.25
"""Speed of the tool near people [m/s] (ISO 10218-1:2025, reduced speed)."""


@dataclass(frozen=True, kw_only=True)
class ArmSite:
    """Arm, camera and speed of a task on a real robot."""

    driver: Driver = "franky"
    """Driver of the arm."""
    ip: str = ""
    """Address of the control box."""
    robot: Literal["panda", "fr3"] = "panda"
    """Franka arm, for its kinematics and limits."""
    device: dict[str, Any] = field(default_factory=dict)
    """LeRobot's settings of the robot, which `--robot.NAME=VALUE` sets: type, port, id."""
    leader: dict[str, Any] = field(default_factory=dict)
    """LeRobot's settings of the teleoperator, which `--teleop.NAME=VALUE` sets."""
    lerobot: LeRobotConfig = field(default_factory=LeRobotConfig)
    """Settings of hrc_learn's driver for a robot of LeRobot."""
    ros2: Ros2Config = field(default_factory=Ros2Config)
    """Topics of an arm in ROS 2."""
    camera_delay: float = 0.0
    """Delay from exposure to arrival of an image [s]; `hrc_learn.hardware.measure_delay`
    measures it."""
    realtime: bool = True
    """Refuse a kernel without real-time scheduling."""
    dynamics: float = 0.3
    """Fraction of the arm's acceleration limits that is used."""
    speed: float = 1.0
    """Speed of all paths as a fraction of the planned speed: 0.1 for a first run."""
    touch: bool = True
    """React to touch: a push at the elbow moves the arm in its null space, a push at the end
    effector pauses the task."""

    def __post_init__(self) -> None:
        check_settings(self, fraction=("dynamics", "speed"))

    @property
    def chain(self) -> Arm:
        """Kinematics and limits of the arm."""
        return {"panda": panda, "fr3": fr3}[self.robot]

    def cell_config(self) -> WorkCellConfig:
        """Configuration of the loop on this arm."""
        config = WorkCellConfig()
        delay = _SERVO_DELAY if self.driver == "lerobot" else _DELAY
        safety = replace(
            config.safety, braking=self.dynamics, delay=delay, tcp_speed=_REDUCED_SPEED
        )
        return replace(
            config,
            safety=safety,
            command_delay=delay,
            speed=self.speed,
            latency=LatencyConfig(delay=self.camera_delay),
        )


@contextmanager
def opened_arm(site: ArmSite, chain: SerialChain | None = None) -> Iterator[StoppableArm]:
    """Connect to the arm; it is at rest when the block ends, also after an error.

    Args:
        site: Arm and driver.
        chain: Kinematics of the arm; None: those of the site's Franka arm.

    Raises:
        ValueError: If the site has no address.
        DriverError: If the arm cannot be reached; the message gives the reason.
    """
    opened: Callable[[], StoppableArm]
    chain = chain or site.chain
    if site.driver == "lerobot":
        opened = partial(LeRobotArm, site.device, chain, site.lerobot)
    elif site.driver == "ros2":
        print(ros2_origin(), file=sys.stderr)
        opened = partial(Ros2Arm, chain, site.ros2)
    elif not site.ip:
        raise ValueError("ip is empty: give the address of the control box of the arm.")
    # Only one driver is imported: both register the same types, and that fails the second time.
    elif site.driver == "franka":
        loop = FrankaConfig(dynamics=site.dynamics, timeout=_SILENCE, realtime=site.realtime)
        with FrankaArm(site.ip, chain, loop) as arm:
            yield arm
        return
    else:
        config = FrankyConfig(dynamics=site.dynamics, timeout=_SILENCE, realtime=site.realtime)
        opened = partial(FrankyArm, site.ip, config)
    with ArmProcess(opened, timeout=_SILENCE) as arm:
        yield arm


type Task = Callable[[WorkCell, Callable[[Plan], None]], str]
"""Function that carries out a task, given the cell and a check of plans; returns the reason of
a failure, or an empty string."""


@dataclass(frozen=True, kw_only=True)
class ArmRun(CellRun):
    """Result of a task on a real arm; its world models the assumed surroundings."""

    @property
    def duration(self) -> float:
        """Duration of the run [s]."""
        return float(np.ptp(self.log["time"])) if len(self.log) else 0.0

    def save(self, folder: Path, title: str, configuration: dict[str, Any]) -> None:
        """Write `run.rrd`, `log.npz` and `result.json`.

        Args:
            folder: Folder of the run; an existing folder is replaced.
            title: Title of the recording.
            configuration: Configuration to save with the run.
        """
        log = self.cell.log
        result = {
            "failure": self.failure,
            "duration": self.duration,
            "phases": [{"phase": event.text, "start": event.time} for event in log.events],
            "remarks": [{"text": said.text, "time": said.time} for said in self.cell.remarks],
        }
        with new_folder(folder, configuration, overwrite=True) as part:
            log.save(part / "log.npz")
            if len(log):  # a task may fail before the first step
                record_run(part / "run.rrd", record(title, self.cell, self.world, self.motion))
            write_json(part / "result.json", result)


def placing_task(skill: PlacingSkill, workplace: Workplace, shelf: str, speed: float) -> Task:
    """Task that carries the object in the gripper home and to a shelf, and releases it there.

    Args:
        skill: Learned placing motion.
        workplace: Workplace with the shelf.
        shelf: Name of the shelf.
        speed: Speed relative to the demonstration.
    """
    goal, item = workplace.shelf(shelf), workplace.scene.objects[0]

    def task(cell: WorkCell, check: Callable[[Plan], None]) -> str:
        cell.load = as_load(item)
        home = joint_plan(cell, cell.joints, workplace.home_joints())
        cell.begin_phase(HOME)
        check(home)
        cell.follow_path(home.path)
        plan = skill.plan(cell.joints, goal, space="pose", dt=cell.config.dt, speed=speed)
        check(plan)
        lowering, size = workplace.lowering(item.half_size), workplace.robot.hand_size
        place_along(cell, plan, goal, lowering, size)
        return ""

    return task


def task_of(experiment: Experiment[Any], shelf: str) -> tuple[Workplace, Task]:
    """Workplace and task of an experiment on a real Panda.

    Args:
        experiment: Placing, grasping or collaboration.
        shelf: Shelf for the object, in the case of placing.
    """
    if isinstance(experiment, PlacingExperiment):
        workplace = Workplace()
        skill = PlacingSkill.load(experiment.placing, workplace.robot)
        return workplace, placing_task(skill, workplace, shelf, experiment.speed)
    assert isinstance(experiment, GraspingExperiment | CollaborationExperiment)
    servoing = VisualServoSkill.load(experiment.aiming)
    if isinstance(experiment, GraspingExperiment):
        workplace = Workplace().approached(servoing.approach)

        def grasp(cell: WorkCell, check: Callable[[Plan], None]) -> str:
            grasping = Grasping(cell, workplace, servoing, experiment.config, check=check)
            grasping.grasp(GraspJob(item=workplace.scene.objects[0]))
            grasping.go_home()
            return ""

        return workplace, grasp
    skill = PlacingSkill.load(experiment.placing, panda)
    workplace = workplace_for(experiment.shelves, panda).approached(servoing.approach)

    def collaborate(cell: WorkCell, check: Callable[[Plan], None]) -> str:
        job = PickAndPlace(cell, workplace, servoing, skill, check, experiment.config)
        orders = zip(workplace.scene.objects, experiment.shelves, strict=True)
        return "; ".join(done.failure for done in job.run(list(orders)) if done.failure)

    return workplace, collaborate


def run_on_arm(
    site: ArmSite,
    workplace: Workplace,
    task: Task,
    *,
    camera: Camera | None = None,
    on_phase: Callable[[str, float], None] = lambda phase, time: None,
) -> ArmRun:
    """Connect to the arm and carry out a task.

    The arm is at rest afterwards, also after an error.

    Args:
        site: Arm and driver.
        workplace: Assumed surroundings.
        task: Task to carry out.
        camera: Camera; None for tasks without one.
        on_phase: Called with name and start time [s] of each phase.

    Raises:
        DriverError: If the arm cannot be reached, or was stopped.
    """
    believed, failure = World(workplace.scene), ""
    with torch.inference_mode(), opened_arm(site) as arm:
        believed.follow(arm.read())
        config = site.cell_config()
        # The arm's clock times the loop: a simulator may be slower than real time.
        rate = Rate(config.dt, clock=lambda: arm.read().time)
        held: str | None = None
        trips = getattr(arm, "trips", 0)

        def take_up() -> None:
            """Put the object that the cell holds into the hand of the simulated arm."""
            nonlocal held
            before, held = held, _held(cell, workplace)
            if held is not None and before is None:
                believed.put_in_hand(held)

        def advance(duration: float) -> None:
            nonlocal trips
            rate.wait()
            take_up()
            believed.follow(arm.read(), held)
            if trips != (trips := getattr(arm, "trips", 0)):
                # The driver's process has stopped the arm: the next command starts from rest.
                safety, still = cell.loop_state.safety, torch.zeros_like(cell.joints)
                safety = replace(safety, velocity=still, acceleration=still)
                cell.loop_state = replace(cell.loop_state, safety=safety)

        def check(plan: Plan) -> None:
            take_up()
            check_plan(plan, believed, held)

        motion = MotionLog(believed, advance)
        cell = WorkCell(
            chain=site.chain,
            arm=arm,
            gripper=arm,
            sensor=None if camera is None else MarkerSensor(camera, workplace.scene.marker_ids),
            human=Touch(site.chain) if site.touch else ScriptedPerturbation(site.chain, ()),
            advance=motion.advance,
            config=config,
            on_phase=on_phase,
            clearance=workplace.arm_clearance,
        )
        try:
            failure = task(cell, check)
        except (TaskFailedError, CameraError) as error:
            failure = str(error)
    return ArmRun(cell=cell, world=believed, motion=motion, failure=failure)


def _held(cell: WorkCell, workplace: Workplace) -> str | None:
    """Name of the held object, identified by its size; None without one."""
    if cell.load is None:
        return None
    items = workplace.scene.objects
    return next((item.name for item in items if as_load(item) == cell.load), items[0].name)
