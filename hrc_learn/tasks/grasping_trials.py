"""A grasp as one trial of many, each with a setting of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
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
from .workplace import Workplace


@dataclass(frozen=True, kw_only=True)
class GraspingTrials:
    """Called with a seed, grasps once and tells what came of it."""

    aiming: Path
    """Folder of the learned image Jacobian and visual target."""
    variant: str = DEFAULT
    """Name in `VARIANTS`."""
    setting: GraspingSettingConfig = field(
        default_factory=lambda: GraspingSettingConfig(random_camera=True)
    )
    camera: CameraKind = "synthetic"
    config: GraspingConfig = field(default_factory=GraspingConfig)

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Measured values, and `failure` if it was no success."""
        outcome = GraspOutcome.of(self.run(seed))
        return outcome.values() | ({"failure": outcome.failure} if outcome.failure else {})

    def run(self, seed: int, variant: str | None = None) -> SimulatedGrasp:
        """One grasp, by another variant if told.

        One that is not the default aims but once, at the pixel that it is told.
        """
        variant = variant or self.variant
        skill, rng = AimingSkill.load(self.aiming), np.random.default_rng(seed)
        setting = GraspingSetting.draw(Workplace(), self.setting, rng, self.camera)
        return simulate_grasp(
            skill,
            setting,
            estimator=VARIANTS[variant].estimator(skill.jacobian),
            told_target=variant != DEFAULT,
            camera=self.camera,
            config=self.config,
            rng=np.random.default_rng([seed, 1]),
        )
