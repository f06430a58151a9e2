"""The simulated Panda as a LeRobot robot."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Pose
from hrc_learn.lerobot.panda_features import DOWN, PIXELS
from hrc_learn.lerobot.robots.config_mujoco_panda import MujocoPandaConfig
from hrc_learn.lerobot.robots.panda_robot import PandaRobot
from hrc_learn.protocols import Arm
from hrc_learn.teleoperation.scenarios import make_scenario

if TYPE_CHECKING:
    from hrc_learn.teleoperation.scenarios import ScenarioRun

CAMERA = "front"


class MujocoPanda(PandaRobot):
    """The Panda in our MuJoCo workplace, for lerobot-record, -replay, -teleoperate, -rollout.

    Simulated time passes by 1/fps with every action, whatever the clock says: a loop that is
    late records the same frames, only later.

    Attributes:
        run: The scenario under way, while connected.
    """

    config_class = MujocoPandaConfig
    name = "mujoco_panda"
    run: ScenarioRun

    def __init__(self, config: MujocoPandaConfig):
        super().__init__(
            config, config.action_space, velocity=config.velocity, hand=config.hand
        )
        self.config = config
        self.dt = 1.0 / config.fps
        self._began = 0.0

    @property
    def observation_features(self) -> dict[str, Any]:
        images = self.config.images
        features = super().observation_features
        if self.config.pixels:
            features |= dict.fromkeys(PIXELS, float)
        if images.kind != "none":
            features[CAMERA] = (images.height, images.width, 3)
        return features

    @property
    def arm(self) -> Arm:
        return self.run.world.arm

    def _open(self) -> None:
        from hrc_learn.teleoperation.scenarios import ScenarioRun, ScenarioView

        config, images = self.config, self.config.images
        scenario = make_scenario(config.scenario, config.shelf)
        self.run = ScenarioRun(scenario, config.fps, seed=config.seed)
        if images.kind != "none":
            self.cameras = {
                CAMERA: ScenarioView(self.run, images.width, images.height, images.kind)
            }

    def _close(self) -> None:
        self.cameras = {}

    def get_observation(self) -> dict[str, Any]:
        self._need_connection()
        self._begin_anew_in_time()
        values = super().get_observation()
        for name, camera in self.cameras.items():
            values[name] = camera.read()
        return values

    def _begin_anew_in_time(self) -> None:
        """With the recorder's next episode.

        It ends one at the first frame that would come late, and takes longer than a frame to
        save it: so much may be allowed for a last frame, whatever else the machine has to do.
        """
        now, length = time.monotonic(), self.config.episode_time
        if not self.run.commands:
            self._began = now
        elif length and now - self._began > length + self.dt:
            self.begin(self.run.seed + 1)
            self._began = now

    def begin(self, seed: int) -> None:
        """Put everything in place as a seed has it."""
        self.run.begin(seed)
        self.beginnings += 1
        self._rotation = DOWN

    def _further_values(self) -> dict[str, float]:
        if not self.config.pixels:
            return {}
        return dict(zip(PIXELS, map(float, self.run.object_pixel()), strict=True))

    def _joints_at(self, pose: Pose) -> Float[np.ndarray, "7"]:
        return self.run.servo.joints_at(pose)

    def _command(self, joints: Float[np.ndarray, "7"], width: float) -> Float[np.ndarray, "7"]:
        return self.run.command(joints, width)
