"""What a run leaves to be measured and looked at, from its log and from the simulator.

Quantities that several experiments measure, the recording of a run, and its dashboard in the
browser while it goes on.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.path_distance import path_distance
from hrc_learn.geometry import Box, Pose, quaternion
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import CameraRecording, JointRanges, LoggedSteps, RunRecording
from hrc_learn.sim import MotionLog, Touch, World
from hrc_learn.skills.pick_and_place import INTERACT, TRANSFER
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.work_cell import HINDRANCE_COLUMNS, SAFETY_COLUMNS, WorkCell
from hrc_learn.vision import CameraModel

ELBOW, TOOL = 3, -1
"""Frames of the elbow and of the tool among the links."""


def spans(log: LoggedSteps, phase: str) -> list[tuple[float, float]]:
    """Start and end of each time a phase was entered [s]; infinite is the end of the last."""
    events = log.events
    return [
        (event.time, math.inf if following is None else following.time)
        for event, following in zip(events, [*events[1:], None], strict=True)
        if event.text == phase
    ]


def span(log: LoggedSteps, phase: str) -> tuple[float, float]:
    """Start and end of the first time a phase was entered [s]; empty if it never was."""
    return (spans(log, phase) or [(0.0, 0.0)])[0]


def true_image_jacobian(
    log: LoggedSteps, world: World, cameras: Sequence[tuple[float, CameraModel]]
) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the gripper's marker wherever the controller used its estimate.

    Args:
        log: The run's.
        world: Knows where the marker is on the gripper.
        cameras: The true ones, and from when on each watched [s].
    """
    used = np.isfinite(log["image_jacobian"]).all(axis=(1, 2))
    jacobian = np.full_like(log["image_jacobian"], np.nan)
    poses = link_poses(log, world.arm.robot.chain)
    offset = torch.from_numpy(world.hand_marker_offset())
    ends = [*(start for start, _ in cameras[1:]), math.inf]
    for (start, camera), end in zip(cameras, ends, strict=True):
        rows = used & (log["time"] >= start) & (log["time"] < end)
        tool = poses[torch.from_numpy(rows), TOOL]
        marker = tool.apply(offset).numpy()
        jacobian[rows] = camera.image_jacobian(marker, tool.position.numpy())
    return jacobian


def true_tool(motion: MotionLog, world: World, steps: int) -> Pose:
    """Poses of the tool as the simulator knows them, whatever the encoders say, (time,)."""
    hand = body_poses(motion, "hand", steps)
    # The hand itself may be mounted askew; the tool centre point lies along its axis.
    return Pose(hand.apply(torch.from_numpy(world.arm.tool_offset)), hand.orientation)


def body_poses(motion: MotionLog, name: str, steps: int) -> Pose:
    """Poses of a link or an object in the first steps of a run, (time,)."""
    (body,) = (body for body in motion.bodies(steps) if body.name == name)
    return Pose(torch.from_numpy(body.position), torch.from_numpy(body.orientation))


def link_poses(log: LoggedSteps, chain: SerialChain) -> Pose:
    """Poses of the joint frames, the flange and the tool at every step, (time, links)."""
    return chain.link_poses(torch.from_numpy(log["joint_position"]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """How far end effector and elbow moved while a person pushed; NaN otherwise."""

    position: Float[np.ndarray, " time"]
    """Of the end effector [m]."""
    rotation: Float[np.ndarray, " time"]
    """Of the end effector [rad]."""
    elbow: Float[np.ndarray, " time"]
    """Of the elbow [m]."""

    @classmethod
    def of(cls, log: LoggedSteps, motion: MotionLog, world: World) -> "Deviation":
        """From the first null-space force until the time left to the person is over.

        Args:
            log: The run's.
            motion: Poses of everything that moved in it.
            world: That it ran in.
        """
        time = log["time"]
        start, end = span(log, INTERACT)
        within = (time >= start) & (time < end)
        pushed = within & (np.abs(log["nullspace_input"]).max(axis=1) > 0)
        first = int(pushed.argmax()) if pushed.any() else 0
        rows = within & (np.arange(len(time)) >= first) & bool(pushed.any())
        tool = true_tool(motion, world, len(time))
        # The frame of joint 4 is where the elbow is.
        elbow = body_poses(motion, f"link{ELBOW + 1}", len(time))

        def distance(pose: Pose) -> Float[np.ndarray, " time"]:
            away = (pose.position - pose.position[first]).norm(dim=-1).numpy()
            return np.where(rows, away, np.nan)

        angle = quaternion.angle(tool.orientation, tool.orientation[first]).numpy()
        return cls(
            position=distance(tool),
            rotation=np.where(rows, angle, np.nan),
            elbow=distance(elbow),
        )

    @classmethod
    def beside_path(cls, log: LoggedSteps, chain: SerialChain) -> "Deviation":
        """From the path, as the encoders have it, while the arm follows one and is pushed.

        Args:
            log: The run's.
            chain: The arm.
        """
        joints, path = (
            torch.from_numpy(log[name]) for name in ("joint_position", "path_joints")
        )
        pushed = (log["nullspace_input"] != 0).any(axis=1)
        hand = chain.forward(joints).position.numpy()
        off = path_distance(hand, log["goal_position"], log["time"])
        elbow, planned = (chain.joint_origins(q)[:, ELBOW] for q in (joints, path))
        aside = (elbow - planned).norm(dim=-1).numpy()
        return cls(
            position=np.where(pushed, off, np.nan),
            rotation=np.full_like(off, np.nan),
            elbow=np.where(pushed, aside, np.nan),
        )


def limit_violations(cell: WorkCell) -> int:
    """Steps in which a joint was measured outside its range of position or velocity."""
    if not len(cell.log):
        return 0
    q = torch.from_numpy(cell.log["joint_position"])
    v = torch.from_numpy(cell.log["joint_velocity"])
    limits = cell.chain.limits
    outside = (q < limits.lower) | (q > limits.upper) | (v.abs() > limits.velocity)
    return int(outside.any(dim=-1).sum())


def unwanted_contacts(
    world: World, log: LoggedSteps, released: Mapping[str, float] | None = None
) -> dict[str, tuple[Touch, ...]]:
    """Contacts of the arm and of what it carried, by what was met.

    The fingertips may touch the table while the arm feels how high it is.

    Args:
        world: As the run left it.
        log: The run's.
        released: When each object was let go on its shelf [s]: what it touches from then on is
            wanted.
    """
    released = released or {}
    carried = [
        touch
        for touch in world.object_contacts.touches
        if touch.start < released.get(touch.first, math.inf)
    ]
    grasps = spans(log, "grasp")
    hit = (
        touch
        for touch in world.table_contacts.touches
        if not (
            touch.first.startswith("finger")
            and any(start <= touch.start < end for start, end in grasps)
        )
    )
    return {
        "cabinet": (*world.cabinet_contacts.touches, *carried),
        "table": tuple(hit),
        "arm itself": tuple(world.self_contacts.touches),
    }


def drawn_limits(chain: SerialChain) -> JointRanges:
    """Limits of an arm, to be drawn beside its joint positions."""
    limits = chain.limits
    return JointRanges(
        lower=limits.lower.numpy(),
        upper=limits.upper.numpy(),
        velocity=limits.velocity.numpy(),
    )


_PUSHED = 4
"""Joint, from 1, whose frame is at the elbow of an arm of seven joints: there a person takes
hold (paper, Experiment 3)."""
_NOTHING = 0.5  # input below which nobody pushes [N m]
_ARROW = 0.45  # length of the arrow of a push [m]


def pushes(
    chain: SerialChain,
    joint_position: Float[np.ndarray, "time joints"],
    nullspace_input: Float[np.ndarray, "time joints"],
) -> Float[np.ndarray, "time 2 3"]:
    """The elbow, and a point in the direction in which a person pushes it; NaN without a push.

    Args:
        chain: The arm.
        joint_position: [rad]
        nullspace_input: Of the person, on each joint [N m].
    """
    points = np.full((len(joint_position), 2, 3), np.nan)
    rows = np.abs(nullspace_input).max(axis=1, initial=0.0) > _NOTHING
    if len(chain.joint_names) < _PUSHED or not rows.any():
        return points
    q, d = torch.from_numpy(joint_position[rows]), torch.from_numpy(nullspace_input[rows])
    asked = null_projection(chain.jacobian(q), d)
    way = (chain.joint_jacobian(q, _PUSHED)[..., :3, :] @ asked[..., None])[..., 0]
    elbow = chain.joint_origins(q)[..., _PUSHED - 1, :]
    tip = elbow + _ARROW * torch.nn.functional.normalize(way, dim=-1)
    points[rows] = torch.stack([elbow, tip], dim=-2).numpy()
    return points


def record(
    title: str,
    cell: WorkCell,
    world: World,
    motion: MotionLog,
    *,
    plans: Sequence[Plan] = (),
    cameras: Sequence[tuple[float, CameraModel]] = (),
    region: Box | None = None,
    demonstration: Demonstration | None = None,
) -> RunRecording:
    """Record a run of a work cell, finished or still going on.

    Args:
        title: Of the recording.
        cell: The work cell that ran it.
        world: The world that it ran in; knows what only a simulator can know.
        motion: Poses of everything that moved.
        plans: Motions to the shelves, one for each transfer that was begun.
        cameras: The true cameras, and from when on each watched [s]; the world's when none.
        region: Box above the table in which the vision region takes over.
        demonstration: One that the motion was learned from.
    """
    # Another thread may ask while the loop goes on: take the steps that both logs have.
    log = cell.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(cell.images)
    if spans(log, INTERACT):
        deviation = Deviation.of(log, motion, world)
    else:
        deviation = Deviation.beside_path(log, cell.chain)
    # The end effector backs out of a shelf the way it went in.
    paths = [plan.tool_pose.position.numpy() for plan in plans]
    plan_paths = [np.vstack([path, path[::-1]]) for path in paths]
    cameras = cameras or ((-math.inf, world.config.camera),)
    return RunRecording(
        title=title,
        time=time,
        joint_names=cell.chain.joint_names,
        joint_position=log["joint_position"],
        joint_velocity=log["joint_velocity"],
        joint_limits=drawn_limits(cell.chain),
        demo_joint_position=_matching_demonstration(log, plans, demonstration),
        position=true_tool(motion, world, len(log)).position.numpy(),
        demo_path=None if demonstration is None else demonstration.position,
        plan_path=np.concatenate(plan_paths) if plan_paths else None,
        bodies=motion.bodies(len(log)),
        boxes=tuple(world.config.boxes()),
        region=region,
        active_region=log["region"],
        drawn=log["drawn"],
        camera=CameraRecording(
            model=cameras[-1][1],
            feature=log["feature"],
            target=log["target"],
            image_time=np.array([kept.time for kept in images]),
            images=tuple(kept.image for kept in images),
        ),
        image_jacobian=log["image_jacobian"],
        true_image_jacobian=true_image_jacobian(log, world, cameras),
        weight_norm=log["weight_norm"],
        potentials={"task space": log["potential"]},
        potential_rate=log["potential_rate"],
        nullspace_input=log["nullspace_input"],
        push=pushes(cell.chain, log["joint_position"], log["nullspace_input"]),
        followed=log["followed"],
        hindered={name: log["hindered"][:, i] for i, name in enumerate(HINDRANCE_COLUMNS)},
        elbow_motion=deviation.elbow,
        position_deviation=deviation.position,
        rotation_deviation=deviation.rotation,
        **_worker(motion, log),
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
        remarks=tuple(cell.remarks),
    )


def worker_distance(motion: MotionLog, steps: int) -> Float[np.ndarray, " time"]:
    """True smallest distance between worker and robot in the first steps [m]; none: no rows."""
    return np.array([pair.distance for pair in motion.nearest(steps)])


def _worker(motion: MotionLog, log: LoggedSteps) -> dict[str, Any]:
    """Fields of a recording about the worker, if there was one."""
    nearest = motion.nearest(len(log))
    if not nearest:
        return {}
    distance = {"true": worker_distance(motion, len(log))}
    if "person_distance" in log:
        distance["seen by the robot"] = log["person_distance"]
        distance["to be kept"] = log["protective_distance"]
    points = np.stack([pair.points for pair in nearest])
    return {"worker_distance": distance, "worker_nearest": points}


def _matching_demonstration(
    log: LoggedSteps, plans: Sequence[Plan], demonstration: Demonstration | None
) -> Float[np.ndarray, "time joints"] | None:
    """Demonstrated joints at the same fraction of the transfer, NaN elsewhere [rad]."""
    if not plans or demonstration is None or demonstration.joint_position is None:
        return None
    time = log["time"]
    matching = np.full_like(log["joint_position"], np.nan)
    for plan, (start, end) in zip(plans, spans(log, TRANSFER), strict=False):
        rows = (time >= start) & (time < end)
        fraction = (time[rows] - start) / plan.duration
        matching[rows] = demonstrated_joints(demonstration, fraction)
    return matching


def demonstrated_joints(
    demonstration: Demonstration, fraction: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, "samples joints"]:
    """Demonstrated joint positions at fractions of the motion, 0 to 1 [rad]."""
    assert demonstration.joint_position is not None
    time = demonstration.time[0] + fraction * demonstration.duration
    columns = demonstration.joint_position.T
    return np.column_stack([np.interp(time, demonstration.time, joint) for joint in columns])


type LiveView = Callable[[WorkCell, World, MotionLog], AbstractContextManager[None]]
"""Entered once a cell is ready to start, and left when the run is over."""


def no_live_view(*_: object) -> AbstractContextManager[None]:
    """Nobody watches."""
    return nullcontext()


@dataclass(frozen=True, kw_only=True)
class LiveViewConfig:
    """Where the dashboard of a run is served while it goes on."""

    port: int = 9090
    """Port of the page."""
    data_port: int = 9876
    """Port from which the page, or `rerun rerun+http://HOST:PORT/proxy`, gets the data."""
    period: float = 0.25
    """How often new data are sent [s]."""


def live_view(title: str, config: LiveViewConfig, on_open: Callable[[str], None]) -> LiveView:
    """Serve the dashboard of a run on a page of its own.

    The loop pays for its log only: another thread makes and sends recordings of the run so
    far. A page that is open when the run ends keeps what it shows.

    Args:
        title: Of the dashboard.
        config: Where.
        on_open: Told the address of the page.
    """

    @contextmanager
    def watch(cell: WorkCell, world: World, motion: MotionLog) -> Iterator[None]:
        # rerun takes a second to import.
        from hrc_learn.viz.run_dashboard import live_dashboard, serve_stream

        def snapshot() -> RunRecording | None:
            return record(title, cell, world, motion) if len(motion) else None

        with serve_stream(config.port, config.data_port) as server:
            on_open(server.viewer)
            with live_dashboard(server.stream, snapshot, period=config.period):
                yield

    return watch
