"""Run the whole job near a person over ROS 2 topics, and the same job without ROS.

An object is seen by the uncalibrated camera, grasped, carried and placed while a person pulls
the elbow. The task runs as in `hrc run collaboration --arm ros2`, with the driver in a process
of its own. Robot, gripper, camera, force sensor and person are in this process, and are reached
over topics only. Without ROS, the same task steps the same simulation in its own time. Arm,
calibration, camera and objects have the nominal imperfections of a laboratory.

    python benchmarks/bench_ros2_jobs.py --json topics.jsonl
    python benchmarks/bench_ros2_jobs.py --access direct --json direct.jsonl
    python benchmarks/bench_ros2_jobs.py --compare direct.jsonl topics.jsonl
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import array
import json
import multiprocessing
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from unittest import mock

import mujoco
import numpy as np
import torch
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.table import Table
from ros2_robot import Ros2Robot, stamp_at

from hrc_learn import cli
from hrc_learn.experiments import real_arm
from hrc_learn.experiments.collaboration_metrics import collaboration_metrics
from hrc_learn.experiments.collaboration_trial import NULL_SPACE_FORCES, CollaborationRun
from hrc_learn.experiments.real_arm import ArmSite, run_on_arm
from hrc_learn.experiments.surroundings import draw_object_poses, workplace_for
from hrc_learn.hardware import CameraError, DriverError
from hrc_learn.hardware.ros2_arm import Ros2Config
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, stamp_of
from hrc_learn.kinematics import panda
from hrc_learn.log import Event, LoggedSteps
from hrc_learn.protocols import ArmState, Human, HumanInput, TimedCamera
from hrc_learn.sim import Imperfections, MotionLog, World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import INTERACT
from hrc_learn.skills.pick_and_place import HOME, RELEASE, PickAndPlace, PickPlaceJob
from hrc_learn.skills.placing import PlacingSkill, Plan
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation
from hrc_learn.watchdog import WatchdogError

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

SHELF = "middle"
RATE = 250.0
"""Joint states a second."""
IMAGE, PUSH, PHASE = "/camera/image/compressed", "/person/push", "/task/phase"
"""Topics of camera and person, and of the phase of the task, which the person sees."""
FRAME = 10
"""Steps between two images: 25 images a second."""
QUALITY = 85
"""Quality of the JPEG images."""
MOVING = 0.05
"""Speed of a joint above which a command of zeros is a stop by the driver [rad/s]."""
LONGEST = 600.0
"""Longest duration of a job [s]."""
COUNTED = "contacts", "joint limit violations", "robot_violations", "stops"
"""Counts that are summed over the jobs."""
COMPARED = {
    "place error": "mm",
    "place tilt": "deg",
    "grasp offset": "mm",
    "pixel error at descent": "px",
    "servoing time": "s",
    "end effector deviation": "mm",
    "end effector rotation": "deg",
    "elbow moved": "mm",
    "cycle time": "s",
}
"""Measurements that are compared, with their units."""
PUSH_HOLDS = 0.25
"""Time for which a push holds without another one [s], as in `hrc serve --ros2`."""


@dataclass(frozen=True, kw_only=True)
class Args:
    models: Path = Path("outputs/demo")
    """Folder of `hrc demo`, with `aiming` and `placing`."""
    access: Literal["ros2", "direct"] = "ros2"
    """Access to the arm: over topics in real time, or without ROS in simulated time."""
    interface: Literal["velocity", "position", "trajectory"] = "velocity"
    """Commands over topics."""
    waits: float = 0.0
    """Longest time for which the robot's clock waits for a command [s]; 0: real time. On a busy
    machine, waiting keeps the loop from being late. Joint states may then be older."""
    first_seed: int = 7300
    """First seed of object places, images and imperfections."""
    jobs: int = 50
    """Number of jobs, with successive seeds."""
    json: Path | None = None
    """File that receives one row per job, immediately; seeds that it contains are not repeated.
    """
    compare: tuple[Path, ...] = ()
    """Two such files, without ROS and over topics, whose common seeds are compared."""


def site_of(interface: Any, waits: float = 0.0) -> ArmSite:
    """The arm over topics: as fast as the simulated arm, with its force sensor and gripper."""
    sizes = Imperfections.nominal()
    config = Ros2Config(
        interface=interface,
        wrench="/force_sensor",
        gripper="/gripper/commands",
        gripper_joint="finger_joint",
        silence=max(Ros2Config.silence, 40 * waits),
    )
    return ArmSite(
        driver="ros2",
        dynamics=1 - sizes.slowness,
        camera_delay=sizes.image_delay,
        touch=False,
        ros2=config,
    )


# The robot, its camera and the person.


class Surroundings:
    """World of a seed with its camera and person, and a record of all its steps.

    Attributes:
        workplace: Assumed workplace.
        world: True world.
        person: Person who pulls the elbow once the arm waits.
        images: Newest JPEG image, with the time of its exposure [s].
        held_flat: Objects that both pads held on opposite faces, by phase.
    """

    def __init__(self, workplace: Workplace, seed: int):
        """Draw everything from the seed, in the order of the simulated experiment."""
        sizes, robot = Imperfections.nominal(), workplace.robot
        self._rng = np.random.default_rng(seed)
        drawn = sizes.draw(self._rng, robot.joints, robot.hand_size)
        self.workplace, self.world = workplace, World(workplace.scene, drawn)
        poses = draw_object_poses(workplace, self.world, sizes.object_yaw, self._rng)
        self.world.reset(workplace.home_joints().numpy(), poses)
        self._loss = sizes.image_loss
        self._camera = open_camera(
            self.world, "synthetic", rng=self._rng, noise=sizes.camera_noise
        )
        self.person = ScriptedPerturbation(robot.chain, NULL_SPACE_FORCES, None)
        self._times: list[tuple[float, float]] = []
        self._joints: list[np.ndarray] = []
        self.held_flat: dict[str, set[str]] = {HOME: set(), RELEASE: set()}

    def keep(self, stamp: float) -> None:
        """Record the world at a time of the robot's clock [s]."""
        self._times.append((stamp, self.world.time))
        self._joints.append(self.world.data.qpos.copy())

    def expose(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """An image, if it is due and not lost."""
        if len(self._times) % FRAME or self._rng.random() < self._loss:
            return None
        return self._camera.read()

    def begin_phase(self, phase: str) -> None:
        """Let the person act, and look at the grasp."""
        if phase == INTERACT:
            self.person.begin(self.world.time)
        if phase in self.held_flat:
            items = self.workplace.scene.objects
            flat = {item.name for item in items if self.world.holds_flat(item.name)}
            self.held_flat[phase] |= flat

    def judged(self, done: Done, seed: int) -> CollaborationRun:
        """The run as the world saw it, in the world's time."""
        stamps, times = np.array(self._times).T
        at = np.clip(np.searchsorted(stamps, done.columns["time"] - 1e-6), 0, len(stamps) - 1)
        assert np.abs(stamps[at] - done.columns["time"]).max() < 1e-6, "an unknown state"
        replayed = Surroundings(self.workplace, seed).world
        motion = MotionLog(replayed, lambda duration: None)
        for step in at:
            replayed.data.qpos[:] = self._joints[step]
            mujoco.mj_kinematics(replayed.model, replayed.data)
            motion.advance(0.0)
        columns = done.columns | {"time": times[at]}
        events = [Event(float(np.interp(e.time, stamps, times)), e.text) for e in done.events]
        for job in done.jobs:
            job.span = tuple(np.interp(job.span, stamps, times).tolist())  # pyright: ignore
        forms = [(name, x.dtype, x.shape[1:]) for name, x in columns.items()]
        rows = np.zeros(len(at), dtype=forms)
        for name, column in columns.items():
            rows[name] = column
        site = site_of("velocity")
        cell: Any = SimpleNamespace(
            log=LoggedSteps([rows], len(rows), events),
            config=site.cell_config(),
            chain=site.chain,
            time=float(columns["time"][-1] - columns["time"][0]),
        )
        return CollaborationRun(
            world=self.world,
            cell=cell,
            motion=motion,
            failure=done.failure,
            workplace=self.workplace,
            picks=tuple(done.jobs),
            cameras=(),
            held_flat=frozenset(self.held_flat[HOME] & self.held_flat[RELEASE]),
        )


class JobRobot(Ros2Robot):
    """The robot, its camera and the person on topics.

    Attributes:
        lateness: Delay of each step behind real time [s].
        stops: Number of commands of zeros while a joint moved faster than `MOVING`.
    """

    def __init__(self, surroundings: Surroundings, config: Ros2Config, waits: float):
        """Publish everything."""
        from sensor_msgs.msg import CompressedImage
        from std_msgs.msg import Float64MultiArray, String

        self._around, self.lateness, self.stops = surroundings, list[float](), 0
        self._phases, self._exposed = queue.SimpleQueue[str](), queue.SimpleQueue[Any]()
        self._ready = threading.Event()
        super().__init__(surroundings.world, config, rate=RATE, waits=waits)
        node = self.session.node
        self._images = node.create_publisher(CompressedImage, IMAGE, quality(reliable=True))
        self._pushes = node.create_publisher(Float64MultiArray, PUSH, quality(reliable=True))
        node.create_subscription(
            String, PHASE, lambda m: self._phases.put(m.data), queued_quality()
        )
        self._sender = threading.Thread(target=self._send_images, name="camera", daemon=True)
        self._sender.start()
        self._ready.set()

    def _step(self) -> None:
        moving = np.abs(self.state.joint_velocity).max() > MOVING
        self.stops += bool(
            moving and self._velocity is not self._sent and not self._velocity.any()
        )
        super()._step()
        self._around.keep(self.now)
        self.lateness.append(self.late)
        if not self._ready.is_set():
            return
        while not self._phases.empty():
            self._around.begin_phase(self._phases.get())
        if (image := self._around.expose()) is not None:
            self._exposed.put((self.now, image))
        if len(self.lateness) % 5 == 0:
            self._push()

    def _push(self) -> None:
        from std_msgs.msg import Float64MultiArray

        # The person acts in the world's time.
        push = self._around.person.read(self.world.arm.read()).nullspace_input
        if push is not None and push.any():
            self._pushes.publish(Float64MultiArray(data=push.tolist()))

    def _send_images(self) -> None:
        from sensor_msgs.msg import CompressedImage

        while (one := self._exposed.get()) is not None:
            message = CompressedImage(format="jpeg", data=array.array("B", jpeg(one[1])))
            message.header.stamp = stamp_at(one[0])
            self._images.publish(message)

    def close(self) -> None:
        """Stop publishing."""
        self._exposed.put(None)
        self._sender.join()
        super().close()


def queued_quality() -> Any:
    """Quality of service that loses no message."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)


def jpeg(image: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """An image as JPEG, in shades of grey."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), options)[1].tobytes()


def decoded(data: Any) -> UInt8[np.ndarray, "height width 3"]:
    """An image from JPEG."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)


# The task, which knows the robot by its topics only.


@dataclass(frozen=True, kw_only=True)
class Done:
    """Result of a task, in the time of the robot's clock."""

    columns: dict[str, np.ndarray]
    """Columns of the log."""
    events: Sequence[Event]
    failure: str
    jobs: list[PickPlaceJob]
    images: int
    """Images that were used."""


class NewestImage(TimedCamera):
    """Camera with the newest image that has come.

    Attributes:
        images: Number of images that have come.
        clock: Time of the newest state of the arm [s].
    """

    def __init__(self, wait: Callable[[], None]):
        """Wait for images.

        Args:
            wait: Lets time pass until an image may have come.
        """
        self._wait, self.images, self._age = wait, 0, 0.0
        self.clock: Callable[[], float] = lambda: 0.0
        self._newest: tuple[float, Any] | None = None

    def take(self, stamp: float, data: Any) -> None:
        """Receive an image."""
        self._newest, self.images = (stamp, data), self.images + 1

    @property
    def age(self) -> float:
        """Age of the newest image when it was read [s]."""
        return self._age

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """The newest image.

        Raises:
            CameraError: The newest image is older than a second.
        """
        for _ in range(500):
            if self._newest is not None:
                break
            self._wait()
        if self._newest is None or self.clock() - self._newest[0] > 1.0:
            raise CameraError(f"no image on {IMAGE} for 1 s")
        stamp, data = self._newest
        # Negative if it was taken after the newest state.
        self._age = self.clock() - stamp
        return decoded(data)


class PushedOverTopic(Human):
    """A person whose pushes come as messages."""

    def __init__(self):
        """Begin without a push."""
        self.pushes, self._newest = 0, (-np.inf, np.zeros(panda.joints))

    def take(self, message: Any) -> None:
        """Receive a push."""
        self._newest, self.pushes = (time.monotonic(), np.array(message.data)), self.pushes + 1

    def read(self, state: ArmState) -> HumanInput:
        """The newest push, unless it is old."""
        at, push = self._newest
        fresh = time.monotonic() - at < PUSH_HOLDS
        return HumanInput(nullspace_input=push if fresh else 0 * push)


def skills_of(models: Path) -> tuple[VisualServoSkill, PlacingSkill, Workplace]:
    """Skills of `hrc demo`, and the workplace."""
    aiming = VisualServoSkill.load(models / "aiming")
    workplace = workplace_for((SHELF,), panda).approached(aiming.approach)
    return aiming, PlacingSkill.load(models / "placing", panda), workplace


def carried_out(
    models: Path, site: ArmSite, camera: NewestImage, person: Human, tell: Callable[[str], None]
) -> Done:
    """Carry out the task on an arm, as `hrc run collaboration` does."""
    aiming, placing, workplace = skills_of(models)
    jobs: list[PickPlaceJob] = []

    def task(cell: WorkCell, check: Callable[[Plan], None]) -> str:
        cell.human, camera.clock = person, lambda: cell.time
        job = PickAndPlace(cell, workplace, aiming, placing, check)
        try:
            done = job.run([(workplace.scene.objects[0], SHELF)])
        finally:
            jobs.extend(job.jobs)
        return "; ".join(one.failure for one in done if one.failure)

    run = run_on_arm(
        site, workplace, task, camera=camera, on_phase=lambda phase, at: tell(phase)
    )
    log = run.log
    columns = {name: log[name] for name in log.names}
    events, failure = log.events, run.failure
    return Done(
        columns=columns, events=events, failure=failure, jobs=jobs, images=camera.images
    )


def over_topics(models: Path, interface: str, waits: float) -> Done:
    """Carry out the task over topics, in a process of its own."""
    from sensor_msgs.msg import CompressedImage
    from std_msgs.msg import Float64MultiArray, String

    only_one_thread()
    session, person = Ros2Session("hrc_task"), PushedOverTopic()
    camera = NewestImage(lambda: time.sleep(0.02))
    node, form = session.node, quality(reliable=True)
    node.create_subscription(
        CompressedImage, IMAGE, lambda m: camera.take(stamp_of(m), m.data), form
    )
    node.create_subscription(Float64MultiArray, PUSH, person.take, form)
    phases = node.create_publisher(String, PHASE, queued_quality())
    try:
        site = site_of(interface, waits)
        return carried_out(
            models, site, camera, person, lambda x: phases.publish(String(data=x))
        )
    finally:
        session.close()


def topics_job(workers: ProcessPoolExecutor, seed: int, args: Args) -> dict[str, Any]:
    """Run the job of a seed over topics, and return its row."""
    around = Surroundings(skills_of(args.models)[2], seed)
    config = site_of(args.interface, args.waits).ros2
    with JobRobot(around, config, args.waits) as robot:
        given = args.models, args.interface, args.waits
        try:
            done = workers.submit(over_topics, *given).result(LONGEST)
        except (DriverError, WatchdogError) as error:
            done = None
            failed = {"seed": seed, "failure": f"driver: {error}", "missed": ["driver"]}
            failed["load"] = os.getloadavg()[0]
        late = 1e3 * np.array(robot.lateness)
    row = failed if done is None else row_of(around, done, seed)
    row |= {
        "held": robot.held,
        "stops": robot.stops,
        "robot_late_ms": np.percentile(late, [50, 99, 100]).tolist(),
    }
    return row | {"robot_violations": robot.violations, "robot_commands": robot.commands}


def direct_job(seed: int, args: Args) -> dict[str, Any]:
    """Run the job of a seed without ROS, and return its row."""
    around = Surroundings(skills_of(args.models)[2], seed)
    world = around.world
    camera = NewestImage(lambda: None)

    def turn() -> None:
        world.advance(1 / RATE)
        around.keep(world.time)
        if (image := around.expose()) is not None:
            camera.take(world.time, jpeg(image))

    class Rate:
        """Waits as in real time, for the first state at or after a tick."""

        def __init__(self, dt: float, *, clock: Callable[[], float]):
            self._dt, self._next = dt, clock() + dt

        def wait(self) -> None:
            while world.time < self._next - 1e-9:
                turn()
            self._next += self._dt

    @contextmanager
    def opened(site: ArmSite) -> Iterator[Any]:
        yield world.arm

    around.keep(world.time)
    while not camera.images:
        turn()
    with (
        mock.patch.object(real_arm, "Rate", Rate),
        mock.patch.object(real_arm, "opened_arm", opened),
    ):
        site = site_of(args.interface)
        done = carried_out(args.models, site, camera, around.person, around.begin_phase)
    return row_of(around, done, seed)


def row_of(around: Surroundings, done: Done, seed: int) -> dict[str, Any]:
    """Measurements of a job."""
    run = around.judged(done, seed)
    row: dict[str, Any] = {"seed": seed, "failure": run.failure}
    missed = []
    for metric in collaboration_metrics(1, 0.0):
        measured = metric.measure(run)
        if measured is not None:
            row[metric.name] = float(measured.value)
            missed += [metric.name] if measured.ok is False else []
    steps = 1e3 * np.diff(done.columns["time"])
    row |= {"missed": missed, "images": done.images, "steps": len(steps)}
    row |= {"step_ms": np.percentile(steps, [1, 50, 99, 100]).tolist()}
    row |= {"steps_over_15_ms": int((steps > 15).sum()), "load": os.getloadavg()[0]}
    row["phases"] = [(event.text, event.time) for event in run.log.events]
    return row


def compare(direct: list[dict[str, Any]], topics: list[dict[str, Any]]) -> None:
    """Print both results, and the paired differences of the seeds that both have."""
    both = [{row["seed"]: row for row in rows} for rows in (direct, topics)]
    seeds = sorted(both[0].keys() & both[1].keys())
    first, second = ([rows[seed] for seed in seeds] for rows in both)
    heads = "without ROS: median, p95, most", "over topics", "difference: mean, 95 % interval"
    table = Table("", *heads, title=f"{len(seeds)} jobs, seeds {seeds[0]} to {seeds[-1]}")
    met = [f"{sum(not missed_by(row) for row in rows)}" for rows in (first, second)]
    table.add_row("all targets met", *met, "")
    for name in COUNTED:
        sums = (f"{sum(row.get(name, 0) for row in rows):g}" for rows in (first, second))
        table.add_row(name, *sums, "")
    for name, unit in COMPARED.items():
        values = np.array([[row.get(name, np.nan) for row in rows] for rows in (first, second)])
        values = values[:, np.isfinite(values).all(axis=0)]
        if not values.size:
            continue
        cells = [", ".join(f"{x:.2f}" for x in spread(row)) for row in values]
        mean, low, high = interval(values[1] - values[0])
        text = f"{mean:+.2f} ({low:+.2f} to {high:+.2f}), n = {values.shape[1]}"
        table.add_row(f"{name} ({unit})", *cells, text)
    Console(width=140).print(table)
    step = np.array([row["step_ms"] for row in second if "step_ms" in row])
    p50, p99 = np.median(step, axis=0)[1:3]
    print(f"steps of the task [ms]: p50 {p50:.0f}, p99 {p99:.0f}, most {step.max():.0f}")
    if not any(row.get("held") for row in second):  # otherwise the clock waits
        late = np.array([row["robot_late_ms"] for row in second])
        p50, p99 = np.median(late, axis=0)[:2]
        print(f"robot late by [ms]: p50 {p50:.1f}, p99 {p99:.0f}, most {late.max():.0f}")
    print(f"load: {np.median([row.get('load', np.nan) for row in second]):.1f}")
    for place, rows in (("without ROS", first), ("over topics", second)):
        for row in rows:
            if missed := missed_by(row):
                print(f"{row['seed']} {place}: {missed}")


def missed_by(row: dict[str, Any]) -> str:
    """Failure of a job, or the targets that it missed; empty if all were met."""
    return row["failure"] or ", ".join(row["missed"])


def spread(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Median, 95th percentile and largest value."""
    return float(np.median(values)), float(np.percentile(values, 95)), float(values.max())


def interval(
    differences: Float[np.ndarray, " n"], draws: int = 10_000
) -> tuple[float, float, float]:
    """Mean, and its 95 % interval by resampling."""
    rng = np.random.default_rng(0)
    means = rng.choice(differences, (draws, len(differences))).mean(axis=1)
    return float(differences.mean()), *np.percentile(means, [2.5, 97.5]).tolist()


def only_one_thread() -> None:
    """Keep libraries from starting threads, which would take time from the other processes."""
    import cv2

    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def rows_in(path: Path | None) -> list[dict[str, Any]]:
    """Rows of a file; none if there is no file."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def main(args: Args) -> None:
    """Run the jobs one after another, or compare them."""
    if args.compare:
        compare(*map(rows_in, args.compare))
        return
    os.environ.setdefault("ROS_DOMAIN_ID", "97")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    only_one_thread()
    done = {row["seed"] for row in rows_in(args.json)}
    spawn = multiprocessing.get_context("spawn")
    # The memory of freed images is not returned: each job has a process of its own.
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as workers:
        for seed in range(args.first_seed, args.first_seed + args.jobs):
            if seed in done:
                continue
            begun = time.monotonic()
            if args.access == "ros2":
                row = topics_job(workers, seed, args)
            else:
                row = direct_job(seed, args)
            row["wall"] = time.monotonic() - begun
            print(row, flush=True)
            if args.json is not None:
                with args.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    cli.run(main, Args)
