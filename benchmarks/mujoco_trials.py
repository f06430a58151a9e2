"""Grasp trials in MuJoCo, with the starts, cameras and targets of `grasp_trials`.

The arm has servos and contacts, and the marker is detected in images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from closed_loop import VirtualCamera, simulate_closed_loop
from grasp_trials import (
    MARKER,
    Judge,
    TrialConfig,
    TrialResult,
    TrialScene,
    draw_scene,
    grasp_controller,
)
from jaxtyping import Bool, Float
from pinhole_camera import PinholeCamera
from torch import Tensor

from hrc_learn.controller import GRIPPER_DOWN
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import ImageJacobianEstimator, RBFImageJacobian
from hrc_learn.sim import SceneConfig, World, open_camera
from hrc_learn.sim.scene import HAND_MARKER, CabinetConfig
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.vision import CameraModel

# Arm, table and camera as in Experiment 2; the cabinet is out of reach.
_SCENE = SceneConfig(objects=(), cabinet=CabinetConfig(front=-3.0))


def run_mujoco_trials(
    make_estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator], config: TrialConfig
) -> TrialResult:
    """Run all trials of a configuration, in step.

    Contacts of the arm with the table and itself are those of the simulator.

    Args:
        make_estimator: Makes the estimator from the network with the paper's initial Jacobian.
        config: Distribution and duration of the trials. Its noise adds to that of the images.

    Raises:
        PhysicsError: A simulation diverged.
    """
    rng = torch.Generator().manual_seed(config.seed)
    plant, scene = build_plant(draw_scene(config, rng), config.seed)
    controller = grasp_controller(make_estimator, config, scene)
    judge = Judge(scene, controller, replace(config, contacts=False))
    with torch.inference_mode():
        simulate_closed_loop(
            controller,
            VirtualCamera(camera=plant, imperfections=config.imperfections, generator=rng),
            scene.start,
            steps=round(config.duration / config.dt),
            dt=config.dt,
            on_step=judge,
            advance=plant.advance,
        )
    return replace(judge.result(), touched=plant.touched())


def build_plant(scene: TrialScene, seed: int) -> tuple[Plant, TrialScene]:
    """A world for each trial at its start, and the trials with the marker of this hand."""
    worlds = [World(_SCENE) for _ in scene.start]
    for world, q in zip(worlds, scene.start.numpy(), strict=True):
        world.reset(q)
    marker = torch.from_numpy(worlds[0].hand_marker_offset())
    scene = replace(scene, camera=_moved_to(scene.camera, marker))
    return Plant(worlds, scene.camera, seed), scene


def _moved_to(camera: PinholeCamera, marker: Float[Tensor, "3"]) -> PinholeCamera:
    """The camera, moved so that this hand's marker appears as the marker of the other trials.

    With the gripper pointing down, the same tool pose then has the same pixel.
    """
    down = quaternion.normalize(marker.new_tensor(GRIPPER_DOWN))
    shift = quaternion.rotate(down, marker - marker.new_tensor(MARKER))
    pose = camera.pose
    return replace(camera, pose=Pose(pose.position + shift, pose.orientation), marker=marker)


class Plant:
    """Worlds that advance in step, as the arms and cameras of a batch."""

    def __init__(self, worlds: list[World], camera: PinholeCamera, seed: int):
        """Open a camera in each world.

        Args:
            worlds: Worlds at their starts.
            camera: Cameras of the worlds.
            seed: Seed of the noise of the images.
        """
        self._worlds, self._pinhole = worlds, camera
        pose = np.tile(np.eye(4), (len(worlds), 1, 1))
        pose[:, :3, :3] = quaternion.to_matrix(camera.pose.orientation).numpy()
        pose[:, :3, 3] = camera.pose.position.numpy()
        f = camera.focal_length
        self._sensors = []
        for k, world in enumerate(worlds):
            model = CameraModel(focal=(f, f), pose=pose[k])
            rng = np.random.default_rng([seed, k])
            images = open_camera(world, "synthetic", model, rng=rng)
            self._sensors.append(MarkerSensor(images, [HAND_MARKER]))

    def advance(self, q: Tensor, velocity: Tensor, dt: float) -> Float[Tensor, "trials 7"]:
        """Let the arms follow their commands for a step; returns the joint positions afterwards
        [rad].
        """
        for world, v in zip(self._worlds, velocity.numpy(), strict=True):
            world.arm.command(v)
            world.advance(dt)
        return torch.stack(
            [torch.from_numpy(w.arm.read().joint_position) for w in self._worlds]
        )

    def project(self, tool: Pose) -> tuple[Float[Tensor, "trials 2"], Bool[Tensor, "trials"]]:
        """Pixels of the marker, detected in new images [px]."""
        feature, inside = self._pinhole.project(tool)
        found = torch.zeros_like(inside)
        # a marker outside the image need not be searched for
        for k in inside.nonzero().flatten().tolist():
            pixel = self._sensors[k].detect().get(HAND_MARKER)
            if pixel is not None:
                feature[k], found[k] = torch.from_numpy(pixel), True
        return feature.masked_fill(~found.unsqueeze(-1), torch.nan), found

    def touched(self) -> Bool[Tensor, "trials"]:
        """Flags of arms that touched the table or themselves."""
        return torch.tensor(
            [
                bool(world.table_contacts.touches or world.self_contacts.touches)
                for world in self._worlds
            ]
        )
