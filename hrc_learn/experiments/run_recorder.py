"""Recording of a simulated run, and its film.

The film is rendered from the recording, or drawn on machines that cannot render. Its length,
and with it the computing time, is bounded.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.demos import Demonstration
from hrc_learn.experiments.run_measures import (
    Deviation,
    spans,
    true_image_jacobian,
    true_tool,
    worker_distance,
)
from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.geometry.shapes import Line
from hrc_learn.kinematics import SerialChain
from hrc_learn.log import CameraRecording, JointRanges, LoggedSteps, RunRecording
from hrc_learn.protocols import HINDRANCES
from hrc_learn.sim import MotionLog, RecordedWorld, RenderingUnavailableError, World
from hrc_learn.sim.cameras import OffscreenRenderer
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import INTERACT
from hrc_learn.skills.pick_and_place import HOME, RELEASE, TRANSFER
from hrc_learn.skills.placing import Plan
from hrc_learn.skills.visual_servoing import VisualServoConfig
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.store import read_toml
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated, camera_inset, draw_run, film_mp4
from hrc_learn.viz.report import Film

# Joint, counted from 1, whose frame is at the elbow of an arm with seven joints: the person
# grips the arm there (paper, Experiment 3).
_PUSHED = 4
# Null-space input below which no push is shown [N m], and length of a push's arrow [m].
_NO_PUSH, _ARROW = 0.5, 0.45

WIDTH, HEIGHT = 720, 450
"""Size of the pictures [px]."""
RATE = 15.0
"""Pictures per second [1/s]."""
LONGEST = 16.0
"""Longest film [s]; a longer run is shown faster."""

_EYE, _TOWARDS = (1.30, 1.25, 1.00), (0.06, 0.22, 0.30)  # [m]
_EXTENT = 0.8  # extent of a job [m]; the camera is nearer to smaller jobs, such as the SO-101's
_FOCAL = 1.15  # focal length over height: 47 degrees from top to bottom

_CAPTIONS: dict[str, str] = read_toml(Path(__file__).with_name("film_captions.toml"))
"""Captions of the phases."""

_CARRYING = (HOME, TRANSFER, RELEASE, "retreat")
_ABOVE = 0.15  # height of the arrow above the forearm [m]
_HAND = 0.04  # width of the person's forearm [m]
_NEAR = 1.0  # largest distance of a worker that is shown [m]
_TRAIL = 2.0  # duration for which the path of the tool stays in the picture [s]
_POINTS = 60  # points of a drawn path


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
    """Record a run of a work cell, finished or not.

    Args:
        title: Title of the recording.
        cell: Work cell of the run.
        world: World of the run, with everything that only a simulator knows.
        motion: True poses of everything that moved.
        plans: Planned motion to the shelf, for each transfer that began.
        cameras: True cameras, each with the time from which it was used [s]; by default the
            camera of the world.
        region: Box above the table inside which visual servoing takes over.
        demonstration: Demonstration that the motion was learned from.
    """
    # Another thread may call this while the loop runs: take the steps that both logs have.
    log = cell.log.snapshot(len(motion))
    time, safety = log["time"], log["safety"]
    images = tuple(cell.images)
    if spans(log, INTERACT):
        deviation = Deviation.of(log, motion, world)
    else:
        deviation = Deviation.from_path(log, cell.chain)
    # The end effector retreats from a shelf on the path of its approach.
    paths = [plan.tool_pose.position.numpy() for plan in plans]
    plan_paths = [np.vstack([path, path[::-1]]) for path in paths]
    cameras = cameras or ((-math.inf, world.config.camera),)
    return RunRecording(
        title=title,
        time=time,
        joint_names=cell.chain.joint_names,
        joint_position=log["joint_position"],
        joint_velocity=log["joint_velocity"],
        joint_limits=JointRanges.of(cell.chain.limits),
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
        push=push_arrows(cell.chain, log["joint_position"], log["nullspace_input"]),
        followed=log["followed"],
        hindered={name: log["hindered"][:, i] for i, name in enumerate(HINDRANCES)},
        elbow_motion=deviation.elbow,
        position_deviation=deviation.position,
        rotation_deviation=deviation.rotation,
        **_worker_fields(motion, log),
        safety={name: safety[:, i] for i, name in enumerate(INTERVENTIONS)},
        phases=tuple(log.events),
        remarks=tuple(cell.remarks),
    )


def region_of_vision(workplace: Workplace, servo: VisualServoConfig) -> Box:
    """Box above the table inside which visual servoing takes over."""
    x, y, z = workplace.hover().position.tolist()
    return Box(centre=(x, y, z), half_size=servo.half_size)


def push_arrows(
    chain: SerialChain,
    joint_position: Float[np.ndarray, "time joints"],
    nullspace_input: Float[np.ndarray, "time joints"],
) -> Float[np.ndarray, "time 2 3"]:
    """Arrows from the elbow in the direction of a person's push [m]; NaN without a push.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        nullspace_input: Null-space input of the person on each joint [N m].
    """
    points = np.full((len(joint_position), 2, 3), np.nan)
    rows = np.abs(nullspace_input).max(axis=1) > _NO_PUSH
    if len(chain.joint_names) < _PUSHED or not rows.any():
        return points
    q, d = torch.from_numpy(joint_position[rows]), torch.from_numpy(nullspace_input[rows])
    velocity = null_projection(chain.jacobian(q), d)
    direction = (chain.joint_jacobian(q, _PUSHED)[..., :3, :] @ velocity[..., None])[..., 0]
    elbow = chain.joint_origins(q)[..., _PUSHED - 1, :]
    tip = elbow + _ARROW * torch.nn.functional.normalize(direction, dim=-1)
    points[rows] = torch.stack([elbow, tip], dim=-2).numpy()
    return points


def _worker_fields(motion: MotionLog, log: LoggedSteps) -> dict[str, Any]:
    """Fields of a recording about the worker; none without a worker."""
    nearest = motion.nearest(len(log))
    if not nearest:
        return {}
    distance = {"true": worker_distance(motion, len(log))}
    if "person_distance" in log:
        distance["seen by the robot"] = log["person_distance"]
        distance["protective distance"] = log["protective_distance"]
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


def film(recording: RunRecording) -> Film:
    """Film of a run."""
    return Film(film_mp4(frames(recording), RATE), recording.title)


def frames(recording: RunRecording) -> Iterator[Picture]:
    """Pictures of the film, rendered if this machine can render, otherwise drawn."""
    job = np.vstack([recording.position, np.zeros(3)])  # includes the base of the arm
    size = float(np.clip(np.ptp(job, axis=0).max() / _EXTENT, 0.5, 1.0))
    towards = size * np.array(_TOWARDS) + (1.0 - size) * job.mean(axis=0)
    camera = CameraModel(
        width=WIDTH,
        height=HEIGHT,
        focal=(_FOCAL * HEIGHT, _FOCAL * HEIGHT),
        principal=((WIDTH - 1) / 2, (HEIGHT - 1) / 2),
    ).look_at(towards + size * (np.array(_EYE) - _TOWARDS), towards)
    begin, end = float(recording.time[0]), float(recording.time[-1])
    shown = min(end - begin, LONGEST)
    speed = (end - begin) / shown if shown else 1.0
    inset = None
    if recording.camera is not None and recording.camera.images:
        inset = camera_inset(recording.camera, WIDTH)
    with _painter(recording, camera) as paint:
        for time in np.linspace(begin, end, max(2, round(shown * RATE))):
            step = int(np.searchsorted(recording.time, time))
            lines, labels = _drawn_in(recording, step)
            yield annotated(
                paint(step, lines),
                caption(recording, float(time)),
                f"{time - begin:.0f} s" + (f"   {speed:.1f} ×" if speed > 1.05 else ""),
                labels,
                None if inset is None else inset(step, float(time)),
            )


def caption(recording: RunRecording, time: float) -> str:
    """Caption of the phase at a time [s]."""
    begun = ["", *(event.text for event in recording.phases if event.time <= time)]
    phase = begun[-1] if "grasp" in begun else begun[-1].replace("home", "approach")
    return _CAPTIONS.get(phase, phase.capitalize() or recording.title)


@contextmanager
def _painter(
    recording: RunRecording, camera: CameraModel
) -> Iterator[Callable[[int, list[Line]], Picture]]:
    """Function that makes the picture of a step with lines in it."""
    world = RecordedWorld(recording)
    try:
        renderer = OffscreenRenderer(world, WIDTH, HEIGHT)
    except RenderingUnavailableError:
        yield lambda step, lines: draw_run(recording, step, camera, lines)
        return
    with closing(renderer):

        def paint(step: int, lines: list[Line]) -> Picture:
            world.show(step)
            return renderer.render(camera, lines)

        yield paint


def _drawn_in(run: RunRecording, step: int) -> tuple[list[Line], list[tuple[str, str]]]:
    """Lines in the picture of a step, and the legend of their colours."""
    drawn: list[tuple[str, str, list[Line]]] = []
    phase = next((e.text for e in reversed(run.phases) if e.time <= run.time[step]), "")
    if run.plan_path is not None and phase in _CARRYING:
        path = _polyline(run.plan_path, palette.GREEN)
        drawn.append(("learned motion, planned", palette.GREEN, path))
    elif run.region is not None:
        edges = [_line(a, b, palette.YELLOW, width=0.004) for a, b in run.region.edges()]
        drawn.append(("region of visual servoing", palette.YELLOW, edges))
    first = int(np.searchsorted(run.time, run.time[step] - _TRAIL))
    trail = _polyline(run.position[first : step + 1], palette.BLUE)
    drawn.append(("path of the gripper", palette.BLUE, trail))
    if run.push is not None and np.isfinite(run.push[step]).all():
        # The forearm of the person, and an arrow above it.
        at, tip = run.push[step]
        above = np.array([0.0, 0.0, _ABOVE])
        arrow = _line(at + above, tip + above, palette.VERMILION, width=0.02, head=True)
        forearm = _line(at, tip, palette.PERSON, width=_HAND)
        drawn.append(("a person pulls the elbow", palette.PERSON, [arrow, forearm]))
    if run.worker_nearest is not None and np.isfinite(run.worker_nearest[step]).all():
        near, far = run.worker_nearest[step]
        distance = float(np.linalg.norm(far - near))
        if distance < _NEAR:
            gap = _line(near, far, palette.PURPLE, width=0.01)
            words = f"distance to the worker: {distance:.2f} m"
            drawn.append((words, palette.PURPLE, [gap]))
    lines = [line for *_, some in drawn for line in some]
    return lines, [(words, colour) for words, colour, _ in drawn]


def _polyline(points: Float[np.ndarray, "points 3"], colour: str) -> list[Line]:
    kept = points[np.unique(np.linspace(0, len(points) - 1, _POINTS).round().astype(int))]
    return [_line(a, b, colour) for a, b in pairwise(kept) if np.isfinite([a, b]).all()]


def _line(start: np.ndarray, end: np.ndarray, colour: str, **more: Any) -> Line:
    r, g, b, _ = palette.rgba(colour)
    return Line(start=start, end=end, colour=(r / 255, g / 255, b / 255, 1.0), **more)
