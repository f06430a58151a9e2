"""A grasp as one trial of many, each with a setting of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..sim import CameraKind
from .fit_aiming import AimingSkill
from .grasping import GraspingConfig
from .grasping_outcome import GraspOutcome
from .grasping_setting import GraspingSetting, GraspingSettingConfig
from .grasping_variants import DEFAULT, VARIANTS
from .simulated_grasp import SimulatedGrasp, simulate_grasp
from .watching import Watch, unwatched
from .workplace import Workplace

_PATIENCE = 20.0  # with a variant that is only compared [s]


@dataclass(frozen=True, kw_only=True)
class GraspingTrials:
    """Called with a seed, grasps once and tells what came of it."""

    aiming: Path
    """Folder of the learned image Jacobian and visual target."""
    setting: GraspingSettingConfig = field(
        default_factory=lambda: GraspingSettingConfig(random_camera=True)
    )
    camera: CameraKind = "synthetic"
    config: GraspingConfig = field(default_factory=GraspingConfig)

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Measured values, and `failure` if it was no success."""
        outcome = GraspOutcome.of(self.run(seed))
        return outcome.values() | ({"failure": outcome.failure} if outcome.failure else {})

    def run(self, seed: int, watch: Watch = unwatched) -> SimulatedGrasp:
        """One grasp, all of it, which somebody may watch."""
        return self._grasp(seed, DEFAULT, told_target=False, config=self.config, watch=watch)

    def compare(self, seed: int, variant: str) -> SimulatedGrasp:
        """The same by a variant in `VARIANTS`, for comparison.

        It is told the pixel to aim at, goes straight there, and tries but once.
        """
        aiming = replace(self.config.aiming, probe=0.0, patience=_PATIENCE)
        config = replace(self.config, aiming=aiming, attempts=1)
        return self._grasp(seed, variant, told_target=True, config=config)

    def _grasp(
        self,
        seed: int,
        variant: str,
        *,
        told_target: bool,
        config: GraspingConfig,
        watch: Watch = unwatched,
    ) -> SimulatedGrasp:
        skill, rng = AimingSkill.load(self.aiming), np.random.default_rng(seed)
        setting = GraspingSetting.draw(Workplace(), self.setting, rng, self.camera)
        return simulate_grasp(
            skill,
            setting,
            estimator=VARIANTS[variant].estimator(skill.jacobian),
            told_target=told_target,
            camera=self.camera,
            config=config,
            rng=np.random.default_rng([seed, 1]),
            watch=watch,
        )
