"""Experiment 2: one setting, grasped by several ways to know the camera."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float

from ..kinematics import panda
from .grasping_outcome import GraspOutcome
from .grasping_trials import GraspingTrials
from .grasping_variants import VARIANTS
from .simulated_grasp import SimulatedGrasp
from .watching import Watch, unwatched

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
        log = self.compared[variant].station.log
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
        world, log = self.grasp.world, self.grasp.station.log
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
