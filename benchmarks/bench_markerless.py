"""Errors of servoing without markers, step by step, against the truth of the simulator.

Each scene has its own clutter, lamp, shadows, distractors, object pose and imperfections, and a
camera that was moved after the demonstrations. The object is searched for from home. Then the
tool visits poses over the table, and their images adapt the camera, as in servoing. Finally the
tool stands right above the object. Servoing would end at the learned target, so the distance
between this target and the detected tool is the error. Control errors are not included:
`hrc run grasping --markerless --trials` measures them.
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
from hrc_learn.demos import load_demos
from hrc_learn.experiments.grasping_experiment import compare_with_truth, held_out_grid
from hrc_learn.experiments.grasping_trial import GraspingScene, GraspingSceneConfig
from hrc_learn.experiments.metric_table import wilson_interval
from hrc_learn.experiments.surroundings import unmarked_for
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraConfig, CameraEstimator, Measurement
from hrc_learn.jacobian.perspective import MARKER
from hrc_learn.kinematics import ArmChoice, UnreachableError
from hrc_learn.sim import Imperfections, World, open_camera
from hrc_learn.sim.scene import UnmarkedLook
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import UNMARKED
from hrc_learn.skills.marker_sensor import FeatureSensor, SeenFeature, feature_sensor
from hrc_learn.skills.visual_servoing import ServoTarget, VisualServoConfig
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.vision.camera_model import IMAGE_SIZE

# Distances of the visited poses from the pose above the middle of the table [m], and tilts
# [rad].
_REACH, _HIGHER, _TILT = (0.10, 0.08), 0.06, 0.03
# Distance of the tool from the border of the image [px].
_BORDER = 80
# Offset from the object that the grasping experiment wants [mm].
_WANTED = 6.0


@dataclass(frozen=True, kw_only=True)
class Args:
    aiming: Path
    """Folder of `hrc fit image-jacobian --markerless`."""
    dataset: Path | None = None
    """Films that the skill was fitted to; on them, the image Jacobian is compared with the
    truth."""
    robot: str = "panda"
    """Arm by name."""
    scenes: int = 20
    """Number of scenes, each with its own seed."""
    seed: int = 100
    """Seed of the first scene."""
    visits: int = 18
    """Number of tool poses that adapt the camera."""
    still: bool = False
    """Keep the camera at its original pose."""
    ideal: bool = False
    """No imperfections of arm and calibration."""
    json: Path | None = None


class _Look(NamedTuple):
    """The tool in one image."""

    pose: Pose
    """Measured pose."""
    pixel: Float[np.ndarray, "2"]
    """Pixel at which the tool was detected [px]."""
    true: Float[np.ndarray, "2"]
    """True pixel of the tool [px]."""


class _Seen(NamedTuple):
    """All observations in one scene."""

    item: SeenFeature
    looks: list[_Look]
    last: _Look | None
    """The tool right above the object; None: not detected."""
    jacobian: Float[np.ndarray, "2 2"]
    """True derivative of the tool's pixel by its position in the horizontal plane, above the
    object [px/m]."""
    yaw: float
    """Rotation of the object on the table [rad]."""
    looked: int
    """Number of images in which the tool was searched for."""


class _Errors(NamedTuple):
    """Errors in one scene; NaN if the object or the tool was not found."""

    turn: float = math.nan
    """Error of the gripper's rotation relative to the object [deg]."""
    offset: float = math.nan
    """Distance between the point at which servoing would end and the point above the object
    [mm]."""
    predicted: float = math.nan
    """Predicted standard deviation of this distance [mm]."""
    found: float = math.nan
    """Part of this distance that is caused by detection errors of the tool [mm]."""


def main(args: Args) -> None:
    skill, start, console = VisualServoSkill.load(args.aiming), process_time(), Console()
    figures: dict[str, float] = {} if args.dataset is None else _jacobian(args, skill)
    seeds = range(args.seed, args.seed + args.scenes)
    scenes = [_looks(args, skill, seed) for seed in track(seeds, description="Scenes")]
    seen = [one for _, one in scenes if one is not None]
    found = [_Errors() if one is None else _errors(skill, w, one) for w, one in scenes]
    looks = [look for one in seen for look in (*one.looks, one.last) if look is not None]
    tool = np.array([np.linalg.norm(look.pixel - look.true) for look in looks])
    turn, offset, predicted, part = map(np.array, zip(*found, strict=True))
    near = int((offset < _WANTED).sum())
    low, high = wilson_interval(near, len(scenes))
    figures |= {
        "scenes": len(scenes),
        "objects found": len(seen),
        "tool seen": len(tool) / max(1, sum(one.looked for one in seen)),
        "tool, median, px": _quantile(tool, 0.5),
        "tool, p95, px": _quantile(tool, 0.95),
        "turn, p95, deg": _quantile(np.abs(turn), 0.95),
        "offset, median, mm": _quantile(offset, 0.5),
        "offset, p95, mm": _quantile(offset, 0.95),
        "offset, root mean square, mm": float(np.sqrt(np.nanmean(offset**2))),
        "offset by found pixels, root mean square, mm": float(np.sqrt(np.nanmean(part**2))),
        "the same, predicted, mm": float(np.sqrt(np.nanmean(predicted**2))),
        f"within {_WANTED:g} mm": near / len(scenes),
    }
    for name, value in figures.items():
        console.print(f"{name:46s} {value:8.4f}")
    console.print(
        f"within {_WANTED:g} mm: {near} of {len(scenes)} ({100 * low:.0f} to {100 * high:.0f} "
        f"%); {(process_time() - start) / len(scenes):.1f} s CPU a scene"
    )
    if args.json is not None:
        cli.write_json(args.json, figures)


def _quantile(values: Float[np.ndarray, " n"], q: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, q)) if len(values) else math.nan


def _jacobian(args: Args, skill: VisualServoSkill) -> dict[str, float]:
    """Relative errors of the image Jacobian between the demonstrations."""
    assert args.dataset is not None
    assert skill.jacobian.camera is not None
    demos = load_demos(args.dataset)
    shown = torch.cat([torch.from_numpy(d.position) for d in demos if d.position is not None])
    camera = Workplace.of(ArmChoice(args.robot).work_arm()).scene.camera
    place = skill.jacobian.camera[MARKER].numpy()
    poses = held_out_grid(shown.double())
    errors = compare_with_truth(skill.jacobian, poses, camera, place)
    return {"poses": len(poses.position)} | {f"J, {k}": v for k, v in errors.items()}


def _looks(args: Args, skill: VisualServoSkill, seed: int) -> tuple[Workplace, _Seen | None]:
    """Workplace of a scene, and the observations in it."""
    rng = np.random.default_rng(seed)
    workplace = Workplace.of(ArmChoice(args.robot).work_arm())
    workplace = unmarked_for(workplace, skill, UnmarkedLook(), seed)
    sizes = Imperfections.ideal() if args.ideal else Imperfections.nominal()
    drawn = GraspingSceneConfig(random_camera=not args.still)
    scene = GraspingScene.draw(workplace, drawn, rng, "synthetic", sizes)
    scene = replace(scene, workplace=scene.workplace.approached(skill.approach))
    return scene.workplace, _Camera(skill, scene, rng).seen(args.visits)


def _errors(
    skill: VisualServoSkill,
    workplace: Workplace,
    seen: _Seen,
    config: CameraConfig = UNMARKED,
) -> _Errors:
    """Errors at the point where servoing would end, with the camera adapted to the
    observations.
    """
    assert skill.target is not None
    estimator = CameraEstimator(copy.deepcopy(skill.jacobian).double(), config)
    state = estimator.initial_state()
    looks = seen.looks if seen.last is None else [*seen.looks, seen.last]
    for look in looks:
        state = estimator.update(state, _measurement(look.pose, look.pixel))
    target = ServoTarget(
        config=VisualServoConfig(),
        above=workplace.hover(),
        posture=None,
        visual=skill.target,
        item=seen.item.pixel,
        angle=seen.item.angle,
        turn_range=workplace.hover_turns,
    )
    turn = math.nan
    heading = target.heading(state.best)
    if skill.angle is not None and heading is not None:
        reference = target.above.orientation
        turn = skill.angle.turn(heading, reference, 0.0, target.turn_range, None)
        turn = math.degrees((turn - seen.yaw + math.pi / 2) % math.pi - math.pi / 2)
    if seen.last is None:
        return _Errors(turn=turn)
    target = replace(target, orientation=seen.last.pose.orientation)
    wanted = target.pixel(state.best, seen.last.pose)
    offset = np.linalg.solve(seen.jacobian, wanted - seen.last.pixel)
    learned = estimator.jacobian(state, seen.last.pose).numpy()
    predicted = target.uncertainty(state.spread(), learned)
    exact = estimator.initial_state()
    for look in looks:
        exact = estimator.update(exact, _measurement(look.pose, look.true))
    best = target.pixel(exact.best, seen.last.pose)
    part = offset - np.linalg.solve(seen.jacobian, best - seen.last.true)
    return _Errors(
        turn,
        1e3 * float(np.linalg.norm(offset)),
        1e3 * predicted,
        1e3 * float(np.linalg.norm(part)),
    )


class _Camera:
    """A scene, its camera, and the detections in its images."""

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
        self._looked = 0

    def seen(self, visits: int) -> _Seen | None:
        """Search for the object, then visit poses; None: the object was not found."""
        self._place(self._workplace.home_joints())
        number = self._item.marker.id
        item = self._sensor.features([number]).get(number)
        if item is None:
            return None
        looks = [self._look(pose) for pose in self._visits(visits)]
        above, pose = self._workplace.hover(), self._scene.object_pose
        yaw = math.atan2(pose[1, 0], pose[0, 0])
        low, high = self._workplace.hover_turns
        turned = low + (yaw - low) % math.pi if high - low >= math.pi - 1e-9 else yaw
        about = quaternion.exp(torch.tensor([0.0, 0.0, turned], dtype=torch.float64))
        position = above.position.clone()
        position[:2] = torch.from_numpy(pose[:2, 3])
        last = self._look(Pose(position, quaternion.multiply(about, above.orientation)))
        marker = self._world.marker_poses()[self._workplace.tool_marker][:3, 3]
        return _Seen(
            item=item,
            looks=[look for look in looks if look is not None],
            last=last,
            jacobian=self._model.image_jacobian(marker)[:, :2],
            yaw=yaw,
            looked=self._looked,
        )

    def _visits(self, number: int) -> list[Pose]:
        """Poses over the table with all rotations, the last one near its middle."""
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

    def _look(self, pose: Pose) -> _Look | None:
        """The tool detected in an image while its true pose is the given one; None: not
        detected.
        """
        robot = self._workplace.robot
        try:
            q = robot.inverse(pose, near=self._workplace.hover_joints())
            self._place(q)
            # Errors of base and tool displace the true tool: a correcting step brings it to the
            # pose.
            q = robot.inverse(_corrected(pose, self._true_tool()), near=q)
        except UnreachableError:
            return None
        self._place(q)
        marker = self._workplace.tool_marker
        true = self._model.project(self._world.marker_poses()[marker][:3, 3])
        if not ((true > _BORDER).all() and (true < np.array(IMAGE_SIZE) - _BORDER).all()):
            return None
        self._looked += 1
        found = self._sensor.features([marker]).get(marker)
        if found is None:
            return None
        measured = torch.from_numpy(self._world.arm.read().joint_position)
        return _Look(robot.chain.forward(measured), found.pixel, true)

    def _place(self, q: Float[torch.Tensor, " joints"]) -> None:
        self._world.reset(q.numpy(), {self._item.name: self._scene.object_pose})

    def _true_tool(self) -> Pose:
        matrix = torch.from_numpy(self._world.arm.tcp_pose())
        return Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))


def _corrected(wanted: Pose, reached: Pose) -> Pose:
    """Pose to command, if commanding `wanted` led to `reached`."""
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
