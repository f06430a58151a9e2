"""Experiment 2 of the paper: one setting, grasped by several ways to know the camera."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.grasping.trial import (
    GraspingSetting,
    GraspingSettingConfig,
    GraspOutcome,
    SimulatedGrasp,
    simulate_grasp,
)
from hrc_learn.experiments.run_recording import Watch, unwatched
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
)
from hrc_learn.kinematics import panda
from hrc_learn.sim import CameraKind
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.visual_servoing import VisualServoSkill, from_learned, guessed_network

# Image Jacobians that a grasp can start from, learned or guessed, and laws to adapt them.


@dataclass(frozen=True, kw_only=True)
class GraspingVariant:
    """One way to know the image Jacobian."""

    says: str
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator]
    """From the learned image Jacobian."""
    claim: str = ""
    """What the paper states about it."""


DEFAULT = "learned"

VARIANTS: Mapping[str, GraspingVariant] = {
    DEFAULT: GraspingVariant(
        says="Kalman filter from the learned Jacobian", estimator=from_learned
    ),
    "kalman": GraspingVariant(
        says="Kalman filter from the paper's guess",
        estimator=lambda _: KalmanEstimator(guessed_network()),
    ),
    "composite": GraspingVariant(
        says="composite law from the paper's guess",
        estimator=lambda _: CompositeEstimator(guessed_network()),
    ),
    "paper": GraspingVariant(
        says="the paper's law from its guess",
        claim="reaches the target, faster than without adaptation (Experiment 2)",
        estimator=lambda _: PaperEstimator(guessed_network()),
    ),
    "fixed": GraspingVariant(
        says="the paper's guess, not adapted",
        claim="reaches the target, slower (Experiment 2)",
        estimator=lambda _: FixedEstimator(guessed_network()),
    ),
    "unadapted": GraspingVariant(
        says="the learned Jacobian, not adapted",
        estimator=lambda learned: FixedEstimator(copy.deepcopy(learned).double()),
    ),
}
"""What can be compared, the default first."""

# A grasp as one trial of many, each with a setting of its own.

_TIMEOUT = 20.0  # with a variant that is only compared [s]


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
        servo = replace(self.config.servo, probe=0.0, timeout=_TIMEOUT)
        config = replace(self.config, servo=servo, attempts=1)
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
        skill, rng = VisualServoSkill.load(self.aiming), np.random.default_rng(seed)
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


# Experiment 2: one setting, grasped by several ways to know the camera.

REACHED = 5.0
"""Distance of the marker from where it truly should be that counts as there [px]."""


@dataclass(frozen=True, kw_only=True)
class GraspingExperiment:
    """Grasps of the same object from the same start, seen by the same camera."""

    trials: GraspingTrials
    grasp: SimulatedGrasp
    """By the default, all of it: this is what has to succeed."""
    compared: Mapping[str, SimulatedGrasp]
    """By variant, each told where to aim."""

    @classmethod
    def run(
        cls,
        trials: GraspingTrials,
        seed: int,
        variants: Sequence[str],
        on_run: Callable[[str], None] = lambda what: None,
        watch: Watch = unwatched,
    ) -> "GraspingExperiment":
        """Grasp, then compare.

        Args:
            trials: How.
            seed: Of the setting.
            variants: What to compare.
            on_run: Told of each run as it begins.
            watch: Watches the grasp from the side.
        """
        on_run("the whole grasp")
        grasp, compared = trials.run(seed, watch), {}
        for variant in dict.fromkeys(variants):
            on_run(VARIANTS[variant].says)
            compared[variant] = trials.compare(seed, variant)
        return cls(trials=trials, grasp=grasp, compared=compared)

    @cached_property
    def outcome(self) -> GraspOutcome:
        """What came of the grasp."""
        return GraspOutcome.of(self.grasp)

    @property
    def target(self) -> Float[np.ndarray, "2"]:
        """Where the hand's marker truly should be [px]."""
        return self.grasp.setting.true_target(self.grasp.world)

    def arrival(self, variant: str) -> float:
        """From when the camera took over until the marker was there for good [s].

        Infinite if it never was.
        """
        log = self.compared[variant].cell.log
        led = np.flatnonzero(log["vision_activation"] > 0)
        if not len(led):
            return math.inf
        error = np.linalg.norm(log["feature"] - self.target, axis=1)
        aimed = np.flatnonzero(np.isfinite(log["target"]).all(axis=1))
        within = ~(error[aimed] > REACHED)  # a marker covered for a moment has not gone away
        if not within[-1]:
            return math.inf
        since = aimed[int(np.flatnonzero(~within)[-1]) + 1] if (~within).any() else aimed[0]
        return float(max(log["time"][since] - log["time"][led[0]], 0.0))

    def jacobian_error(self) -> tuple[float, float]:
        """Of the linear part, relative, as the camera takes over and as the hand goes down."""
        world, log = self.grasp.world, self.grasp.cell.log
        rows = np.flatnonzero(log["vision_activation"] > 0)
        if not len(rows):
            return math.nan, math.nan
        ends = rows[[0, -1]]
        hand = panda.forward(torch.from_numpy(log["joint_position"][ends]))
        marker = hand.apply(torch.from_numpy(world.hand_marker_offset())).numpy()
        true = world.config.camera.image_jacobian(marker)[..., :3]
        wrong = np.linalg.norm(log["image_jacobian"][ends, :, :3] - true, axis=(1, 2))
        first, last = wrong / np.linalg.norm(true, axis=(1, 2))
        return float(first), float(last)
