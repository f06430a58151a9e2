"""Errors of servoing without markers, part by part, against the truth of the simulator.

Each scene has its own clutter, lamp, shadows, distractors, object pose, imperfections of the
laboratory, and a camera moved since the demonstrations. The object is looked for from home.
Then the tool visits poses over the table; their images teach the camera, as servoing does. At
last it stands right above the object: the distance of the learned target from the tool that is
found there is where servoing would end. Control errors are not part of it: `hrc run grasping
--markerless --trials` has them.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from hrc_learn import cli
from hrc_learn.experiments.grasping_trial import GraspingScene, GraspingSceneConfig
from hrc_learn.experiments.metric_table import wilson_interval
from hrc_learn.experiments.surroundings import unmarked_for
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraEstimator, Measurement
from hrc_learn.kinematics import ArmChoice, UnreachableError
from hrc_learn.sim import Imperfections, World, open_camera
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import UNMARKED
from hrc_learn.skills.marker_sensor import FeatureSensor, feature_sensor
from hrc_learn.skills.servo_target import ServoTarget, VisualServoConfig
from hrc_learn.skills.visual_skill import VisualServoSkill

# Distances of the visited poses from above the middle of the table [m], and tilts [rad].
_REACH, _HIGHER, _TILT = (0.10, 0.08), 0.06, 0.03
# Offset from the object that the grasping experiment wants [mm].
_WANTED = 6.0


@dataclass(frozen=True, kw_only=True)
class Args:
    aiming: Path
    """Folder of `hrc fit image-jacobian --markerless`."""
    robot: str = "panda"
    """Arm by name."""
    scenes: int = 20
    """Scenes, each with another seed."""
    seed: int = 100
    """First of these seeds."""
    visits: int = 10
    """Poses of the tool that teach the camera."""
    still: bool = False
    """Leave the camera where it was."""
    ideal: bool = False
    """No imperfections of arm and calibration."""
    json: Path | None = None


class _Scene(NamedTuple):
    """Errors in one scene; NaN where something was not found."""

    tool: list[float]
    """Distances of the found from the true tool [px]."""
    looked: int
    """Images in which the tool was looked for."""
    item: bool
    """True if the object was found."""
    turn: float
    """Error of the gripper's turn for the object [deg]."""
    offset: float
    """Distance from above the object at which servoing would end [mm]."""
    predicted: float
    """Standard deviation of that as predicted [mm]."""


def main(args: Args) -> None:
    skill, start = VisualServoSkill.load(args.aiming), process_time()
    seeds = range(args.seed, args.seed + args.scenes)
    scenes = [_scene(args, skill, seed) for seed in track(seeds, description="Scenes")]
    tool = np.concatenate([one.tool for one in scenes])
    offset = np.array([one.offset for one in scenes])
    near = int((offset < _WANTED).sum())
    low, high = wilson_interval(near, len(scenes))
    known = offset[np.isfinite(offset)]
    figures = {
        "scenes": float(len(scenes)),
        "tool seen": len(tool) / sum(one.looked for one in scenes),
        "tool, median [px]": _quantile(tool, 0.5),
        "tool, p95 [px]": _quantile(tool, 0.95),
        "objects found": float(sum(one.item for one in scenes)),
        "turn, p95 [deg]": _quantile(np.array([one.turn for one in scenes]), 0.95),
        "offset, median [mm]": _quantile(known, 0.5),
        "offset, p95 [mm]": _quantile(known, 0.95),
        "offset predicted, median [mm]": _quantile(
            np.array([one.predicted for one in scenes]), 0.5
        ),
        f"within {_WANTED:g} mm": near / len(scenes),
    }
    console = Console()
    for name, value in figures.items():
        console.print(f"{name:32s} {value:8.3f}")
    console.print(
        f"within {_WANTED:g} mm: {near} of {len(scenes)} ({100 * low:.0f} to {100 * high:.0f} "
        f"%); {(process_time() - start) / len(scenes):.1f} s CPU a scene"
    )
    if args.json is not None:
        cli.write_json(args.json, figures)


def _quantile(values: Float[np.ndarray, " n"], q: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, q)) if len(values) else math.nan


def _scene(args: Args, skill: VisualServoSkill, seed: int) -> _Scene:
    rng = np.random.default_rng(seed)
    workplace = Workplace.of(ArmChoice(args.robot).work_arm())
    workplace = unmarked_for(workplace, skill, UnmarkedLook(), seed)
    sizes = Imperfections.ideal() if args.ideal else Imperfections.nominal()
    drawn = GraspingSceneConfig(random_camera=not args.still)
    scene = GraspingScene.draw(workplace, drawn, rng, "synthetic", sizes)
    scene = replace(scene, workplace=scene.workplace.approached(skill.approach))
    return _Looks(skill, scene, rng).errors(args.visits)


class _Looks:
    """A scene, its camera and what is found there."""

    def __init__(self, skill: VisualServoSkill, scene: GraspingScene, rng: np.random.Generator):
        self._skill, self._scene, self._rng = skill, scene, rng
        self._world: World = scene.world()
        self._workplace, self._model = scene.workplace, scene.workplace.scene.camera
        noise = self._world.imperfections.sizes.camera_noise
        self._item = scene.workplace.scene.objects[0]
        self._sensor: FeatureSensor = feature_sensor(
            open_camera(self._world, "egl", rng=rng, noise=noise),
            skill.landmarks,
            self._workplace.tool_marker,
            [self._item.marker.id],
        )
        self._tool_errors: list[float] = []
        self._looked = 0

    def errors(self, visits: int) -> _Scene:
        workplace, skill = self._workplace, self._skill
        self._place(workplace.home_joints())
        number = self._item.marker.id
        item = self._sensor.features([number]).get(number)
        if item is None or skill.target is None:
            return _Scene([], 0, False, math.nan, math.nan, math.nan)
        estimator = CameraEstimator(copy.deepcopy(skill.jacobian).double(), UNMARKED)
        state = estimator.initial_state()
        for pose in self._visits(visits):
            measured, pixel = self._look(pose)
            if measured is not None and np.isfinite(pixel).all():
                state = estimator.update(state, _measurement(measured, pixel))
        above = workplace.hover()
        target = ServoTarget(
            config=VisualServoConfig(),
            above=above,
            posture=None,
            visual=skill.target,
            item=item.pixel,
            angle=item.angle,
            turn_range=workplace.hover_turns,
        )
        turn = 0.0
        if skill.angle is not None and math.isfinite(item.angle):
            heading = target.heading(state.best)
            assert heading is not None
            turn = skill.angle.turn(heading, above.orientation, 0.0, target.turn_range, None)
        about = quaternion.exp(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
        target = replace(target, orientation=quaternion.multiply(about, above.orientation))
        yaw = math.atan2(self._scene.object_pose[1, 0], self._scene.object_pose[0, 0])
        off = (turn - yaw + math.pi / 2) % math.pi - math.pi / 2
        position = above.position.clone()
        position[:2] = torch.from_numpy(self._scene.object_pose[:2, 3])
        measured, pixel = self._look(Pose(position, target.tool_orientation))
        if measured is None or not np.isfinite(pixel).all():
            return _Scene(
                self._tool_errors, self._looked, True, math.degrees(off), math.nan, math.nan
            )
        wanted = target.pixel(state.best, measured)
        J = self._model.image_jacobian(self._world.marker_poses()[workplace.tool_marker][:3, 3])
        offset = np.linalg.solve(J[:, :2], wanted - pixel)
        learned = estimator.jacobian(state, measured).numpy()
        predicted = target.uncertainty(state.spread(), learned)
        return _Scene(
            self._tool_errors,
            self._looked,
            True,
            math.degrees(off),
            1e3 * float(np.linalg.norm(offset)),
            1e3 * predicted,
        )

    def _visits(self, number: int) -> list[Pose]:
        """Poses over the table in all turns, the last one near its middle."""
        above, rng = self._workplace.hover(), self._rng
        size, poses = self._workplace.robot.hand_size, []
        for _ in range(number):
            shift = rng.uniform(-1, 1, 3) * (*_REACH, _HIGHER / 2) + (0, 0, _HIGHER / 2)
            turn = np.append(
                rng.uniform(-_TILT, _TILT, 2), rng.uniform(*self._workplace.hover_turns)
            )
            about = quaternion.exp(torch.from_numpy(turn))
            orientation = quaternion.multiply(about, above.orientation)
            poses.append(Pose(above.position + torch.from_numpy(size * shift), orientation))
        return poses

    def _look(self, pose: Pose) -> tuple[Pose | None, Float[np.ndarray, "2"]]:
        """Measured pose and found pixel of a tool that truly is at a pose; None: not seen."""
        robot, unseen = self._workplace.robot, np.full(2, np.nan)
        try:
            q = robot.inverse(pose, near=self._workplace.hover_joints())
        except UnreachableError:
            return None, unseen
        # Base and tool are truly elsewhere: one step back lands the true tool at the pose.
        self._place(q)
        q = robot.inverse(_corrected(pose, self._true_tool()), near=q)
        self._place(q)
        marker = self._workplace.tool_marker
        true = self._model.project(self._world.marker_poses()[marker][:3, 3])
        inside = (true > 80).all() and (true < np.array([1360, 1000])).all()
        if not inside:
            return None, unseen
        self._looked += 1
        found = self._sensor.features([marker]).get(marker)
        if found is None:
            return None, unseen
        self._tool_errors.append(float(np.linalg.norm(found.pixel - true)))
        measured = self._world.arm.read().joint_position
        return robot.chain.forward(torch.from_numpy(measured)), found.pixel

    def _place(self, q: Float[torch.Tensor, " joints"]) -> None:
        self._world.reset(q.numpy(), {self._item.name: self._scene.object_pose})

    def _true_tool(self) -> Pose:
        matrix = torch.from_numpy(self._world.arm.tcp_pose())
        return Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))


def _corrected(wanted: Pose, reached: Pose) -> Pose:
    """The pose to ask for, if asking for `wanted` led to `reached`."""
    turn = quaternion.multiply(wanted.orientation, quaternion.conjugate(reached.orientation))
    return Pose(
        2 * wanted.position - reached.position, quaternion.multiply(turn, wanted.orientation)
    )


def _measurement(pose: Pose, pixel: Float[np.ndarray, "2"]) -> Measurement:
    zero = torch.zeros(2, dtype=torch.float64)
    return Measurement(
        pose=pose,
        feature=torch.from_numpy(pixel),
        valid=torch.tensor(True),
        dt=0.04,
        xi_x=zero,
        xi_r=torch.zeros(6, dtype=torch.float64),
    )


if __name__ == "__main__":
    cli.run(main, Args)
