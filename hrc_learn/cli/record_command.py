"""`hrc record`: demonstrations by a scripted expert in simulation, or by a leader arm."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from rich.progress import Progress, track

from hrc_learn.cli._run import with_settings, write_values
from hrc_learn.cli.arguments import Record, refuse_of_others
from hrc_learn.demos import DatasetWriter
from hrc_learn.deploy import Rate
from hrc_learn.experiments.real_arm import ArmSite, opened_arm
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.hardware import ending_at_rest
from hrc_learn.hardware.driver_process import StoppableArm
from hrc_learn.hardware.lerobot_device import GRIPPER, LeaderArm
from hrc_learn.kinematics import Arm, ArmChoice
from hrc_learn.sim import CameraKind, PhysicsError, World, open_camera
from hrc_learn.sim.scene import UnmarkedLook, unmarked
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import PositionServo, PositionServoConfig
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import (
    ANGLE_FEATURE,
    ANGLE_FEATURE_NAMES,
    OBJECT_FEATURE,
    OBJECT_FEATURE_NAMES,
)
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.store import DATASET, replacing
from hrc_learn.teleoperation.hand_guiding import Frame
from hrc_learn.teleoperation.scripted_demonstrations import (
    FILM,
    PlacingDemonstrationConfig,
    ServoDemonstrationConfig,
    demonstrate_placing,
    demonstrate_servoing,
    film_servoing,
)
from hrc_learn.vision.camera_model import IMAGE_SIZE

_DEFAULTS = {"placing": (3, 0), "servoing": (8, 1), "expert": (10, 0), "leader": (5, 0)}
"""Number of episodes and seed by kind of demonstration."""
_APPLIES = {
    "shelf": ("placing", "expert"),
    "scenario": ("expert",),
    "overwrite": ("placing", "servoing"),
    "seed": ("placing", "servoing", "expert"),
}
"""Kinds of demonstrations to which each option applies."""


@dataclass(frozen=True, kw_only=True)
class _Settings[Config]:
    """Settings of the demonstrations."""

    demonstration: Config
    camera: CameraKind = "synthetic"
    """Camera for servoing: "egl" renders, "synthetic" only draws markers."""


def record(args: Record) -> int:
    """Record the demonstrations of a scenario; exit status 1 if the expert fails."""
    usual_episodes, usual_seed = _DEFAULTS[args.demonstration]
    episodes = usual_episodes if args.episodes is None else args.episodes
    seed = usual_seed if args.seed is None else args.seed
    if episodes < 1:
        raise ValueError(f"--episodes must be at least 1, but is {episodes}.")
    if seed < 0:
        raise ValueError(f"--seed must not be negative, but is {seed}.")
    refuse_of_others(args, _APPLIES, args.demonstration, "hrc record")
    args = replace(args, episodes=episodes, seed=seed)
    recorders = {
        "placing": _record_placing,
        "servoing": _record_servoing,
        "expert": _record_expert,
        "leader": _record_leader,
    }
    try:
        recorders[args.demonstration](args, episodes, seed)
    except (TaskFailedError, PhysicsError, RuntimeError, ConnectionError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    return 0


def _record_placing(args: Record, episodes: int, seed: int) -> None:
    """Record placing on a shelf: motion of end effector and null-space posture."""
    settings = _Settings(demonstration=PlacingDemonstrationConfig())
    config = with_settings(args.config, settings).demonstration
    workplace, world, rng = _work_cell(args, seed)
    goal = workplace.shelf(args.shelf).position.numpy()
    discarded, errors = 0, []

    def demonstrate() -> list[Frame]:
        nonlocal discarded
        frames, contacts = demonstrate_placing(world, workplace, args.shelf, config, rng)
        discarded += contacts
        errors.append(1e3 * float(np.linalg.norm(frames[-1]["position"] - goal)))
        return frames

    _write(args, workplace, demonstrate, f"place the box on the {args.shelf} shelf", config.fps)
    print(f"{episodes} demonstrations in {args.out} ({discarded} discarded)")
    values = {"episodes": episodes, "discarded": discarded, "final_error_mm_max": max(errors)}
    write_values(args.json, values)


def _record_servoing(args: Record, episodes: int, seed: int) -> None:
    """Record visual servoing to an object with an uncalibrated camera."""
    settings = with_settings(args.config, _Settings(demonstration=ServoDemonstrationConfig()))
    config = settings.demonstration
    if config.markerless:
        _film_servoing(args, config, episodes, seed)
        return
    workplace, world, rng = _work_cell(args, seed)
    camera = open_camera(world, settings.camera, rng=rng)
    sensor = MarkerSensor(camera, workplace.scene.marker_ids)
    visible = []

    def demonstrate() -> list[Frame]:
        frames = demonstrate_servoing(world, workplace, sensor, config, rng)
        visible.append(float(np.mean([bool(f["feature_visible"]) for f in frames])))
        return frames

    features = {OBJECT_FEATURE: OBJECT_FEATURE_NAMES, ANGLE_FEATURE: ANGLE_FEATURE_NAMES}
    _write(args, workplace, demonstrate, "servo to the box", config.fps, features)
    seen = 100 * min(visible)
    print(f"{episodes} demonstrations in {args.out}, marker visible in {seen:.0f} %")
    write_values(args.json, {"episodes": episodes, "marker_seen_min": min(visible)})


def _film_servoing(
    args: Record, config: ServoDemonstrationConfig, episodes: int, seed: int
) -> None:
    """Record visual servoing without markers: joints, poses and the camera's video."""
    workplace, _, rng = _work_cell(args, seed)
    workplace = replace(workplace, scene=unmarked(workplace.scene, UnmarkedLook(seed=seed)))
    world = World(workplace.scene)
    sensor = MarkerSensor(open_camera(world, "synthetic", rng=rng), workplace.scene.marker_ids)
    camera = open_camera(world, "egl", rng=rng)
    # The markerless search needs fewer images than a marker tracker.
    config = replace(config, record_every=2 * config.record_every)

    cameras = {FILM: (IMAGE_SIZE[1], IMAGE_SIZE[0])}  # height and width
    demonstrate = partial(film_servoing, world, workplace, sensor, camera, config, rng)
    _write(args, workplace, demonstrate, "servo to the box", config.fps, cameras=cameras)
    print(f"{episodes} demonstrations with video in {args.out}")
    write_values(args.json, {"episodes": episodes})


def _work_cell(args: Record, seed: int) -> tuple[Workplace, World, np.random.Generator]:
    workplace = Workplace.of(ArmChoice(args.robot).work_arm())
    return workplace, World(workplace.scene), np.random.default_rng(seed)


def _write(
    args: Record,
    workplace: Workplace,
    demonstrate: Callable[[], Iterable[Mapping[str, Any]]],
    task: str,
    fps: float,
    features: Mapping[str, Sequence[str]] | None = None,
    cameras: Mapping[str, tuple[int, int]] | None = None,
) -> None:
    """Record the demonstrations into the dataset, one after another."""
    assert args.episodes is not None
    robot = workplace.robot
    with (
        replacing(args.out, DATASET, args.overwrite) as folder,
        DatasetWriter.of(robot, folder, fps, features=features, cameras=cameras) as writer,
    ):
        for _ in track(
            range(args.episodes), description=f"Demonstrations of {args.demonstration}"
        ):
            writer.start_episode(task)
            for frame in demonstrate():
                writer.add_frame(**frame)
            writer.save_episode()


def _record_expert(args: Record, episodes: int, seed: int) -> None:
    """Record the scripted expert in simulation, with the columns that lerobot-record writes."""
    from hrc_learn.lerobot.episode_recording import record_expert
    from hrc_learn.lerobot.mujoco_arm import MujocoArmRobotConfig

    if args.out.exists():
        raise FileExistsError(f"{args.out} exists: give another --out")

    @dataclass(frozen=True, kw_only=True)
    class Settings:
        robot: MujocoArmRobotConfig

    default = MujocoArmRobotConfig(
        arm=args.robot,
        scenario=args.scenario,
        shelf=args.shelf,
        fps=20.0,
        pixels=args.scenario == "grasping",
        seed=seed,
    )
    config = with_settings(args.config, Settings(robot=default)).robot
    # Camera motion is detected by comparing the marker with the tool's pose: a recorded marker
    # needs the pose as well.
    config = replace(config, hand=config.hand or config.marker)
    failed = 0
    with Progress(transient=True) as progress:
        task = progress.add_task(f"Demonstrations of {args.scenario}", total=episodes)
        for written, succeeded in record_expert(args.out, config, episodes):
            failed += not succeeded
            progress.update(task, completed=written)
    print(f"{episodes} demonstrations in {args.out} ({failed} discarded)")
    write_values(args.json, {"episodes": episodes, "discarded": failed})


@dataclass(frozen=True, kw_only=True)
class _LeaderConfig:
    """Settings of demonstrations by a leader arm."""

    task: str = "follow the leader"
    """Task in words."""
    duration: float = 20.0
    """Duration of a demonstration [s]; Ctrl-C ends the recording and keeps the saved
    demonstrations."""
    pause: float = 5.0
    """Time before each demonstration, in which the arm already follows [s]."""
    fps: int = 50
    """Frames per second, which is also the rate of the loop."""

    def __post_init__(self) -> None:
        check_settings(self, positive=["duration", "fps"], not_negative=["pause"])


@dataclass(frozen=True, kw_only=True)
class _LeaderSettings:
    demonstration: _LeaderConfig = field(default_factory=_LeaderConfig)
    site: ArmSite = field(default_factory=ArmSite)


def _record_leader(args: Record, episodes: int, seed: int) -> None:
    """Let a real arm follow a leader; record the arm's positions, gripper and commands."""
    settings = with_settings(args.config, _LeaderSettings())
    config = settings.demonstration
    frames = round(config.duration * config.fps)
    if frames < 2:
        raise ValueError(f"demonstration.duration={config.duration:g} has less than two frames")
    site = replace(settings.site, driver="lerobot")
    robot = ArmChoice(args.robot).arm()
    names, lerobot = robot.chain.joint_names, site.lerobot
    features = {"action": (*(f"{name}.pos" for name in names), GRIPPER)}
    kind = str(site.device.get("type", robot.name))
    writer = DatasetWriter.of(robot, args.out, config.fps, robot_type=kind, features=features)
    with (
        writer,
        closing(
            LeaderArm(site.leader, names, lerobot.unit, lerobot.zeros, lerobot.reversed)
        ) as leader,
        opened_arm(site, robot.chain) as arm,
        ending_at_rest(arm.stop),
    ):
        follow = _follower(robot, arm, leader, site, 1 / config.fps)
        rate = Rate(1 / config.fps)
        for episode in range(episodes):
            print(
                f"demonstration {episode + 1} of {episodes} in {config.pause:g} s", flush=True
            )
            for _ in range(round(config.pause * config.fps)):
                follow()
                rate.wait()
            print(f"recording for {config.duration:g} s", flush=True)
            writer.start_episode(config.task)
            for _ in range(frames):
                writer.add_frame(**follow())
                rate.wait()
            writer.save_episode()
    print(f"{episodes} demonstrations in {args.out}")
    figures = {"episodes": episodes, "frames": episodes * frames, "missed_ticks": rate.missed}
    write_values(args.json, figures)


def _follower(
    robot: Arm, arm: StoppableArm, leader: LeaderArm, site: ArmSite, dt: float
) -> Callable[[], dict[str, Any]]:
    """Function that moves the arm one step towards the leader and returns the frame."""
    servo_config = PositionServoConfig(safety=site.cell_config().safety)
    servo = PositionServo(robot.chain, arm, dt, servo_config)
    opening = site.lerobot.opening

    def follow() -> dict[str, Any]:
        wanted, share = leader.read()
        state, sent = servo.follow(wanted)
        arm.move(share * opening)
        tool = robot.forward(torch.from_numpy(state.joint_position))
        return {
            "joint_position": state.joint_position,
            "gripper": state.gripper_width,
            "position": tool.position.numpy(),
            "orientation": tool.orientation.numpy(),
            "action": np.append(sent, share * opening),
        }

    return follow
