"""Stress trials: random goals, cameras, null-space inputs and faults; do limits break?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller import INITIAL_IMAGE_JACOBIAN, AdaptiveController, Goals, Observation
from hrc_learn.controller.monitors import LimitMonitor
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import CompositeEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda
from hrc_learn.sim.closed_loop import Imperfections, PinholeCamera, VirtualCamera

Fault = Literal["none", "nan", "late", "lost"]
"""NaN in 1 % of images and of joint readings; images 100 ms late and joint states that stay
away for 100 ms; a marker covered every other second for up to 3 s."""

_FRAME = 0.03  # interval of images [s]
_LATE = 0.1  # delay of images, and for how long joint states stay away [s]
_EFFORT_TIME = 0.4  # after which the null-space input is drawn again [s]


@dataclass(frozen=True, kw_only=True)
class StressConfig:
    """How trials are drawn."""

    count: int = 1000
    seed: int = 0
    fault: Fault = "none"
    duration: float = 4.0
    """[s]"""
    dt: float = 0.01
    """Control step [s]."""

    def imperfections(self) -> Imperfections:
        """Imperfections of the camera's measurement."""
        frame_steps = max(1, round(_FRAME / self.dt))
        late = self.fault == "late"
        return Imperfections(
            frame_steps=frame_steps,
            noise=0.5,
            nan_fraction=0.01 if self.fault == "nan" else 0.0,
            latency_frames=round(_LATE / (frame_steps * self.dt)) if late else 0,
            loss_rate=0.5 if self.fault == "lost" else 0.0,
        )


@dataclass(frozen=True, kw_only=True)
class StressResult:
    """Results, one entry for each trial."""

    beyond: Int[Tensor, "trials 4"]
    """Steps beyond the limits of position, velocity, acceleration and jerk."""
    unknown: Int[Tensor, "trials"]
    """Steps with a NaN in command or state."""
    interventions: Int[Tensor, "trials kinds"]
    """Steps in which the safety filter acted, by kind."""

    def summary(self) -> dict[str, float]:
        """Totals by name."""
        names = ("position", "velocity", "acceleration", "jerk")
        totals = zip(names, self.beyond.sum(0).tolist(), strict=True)
        return {
            "rollouts": float(len(self.beyond)),
            **{f"beyond_{name}": float(total) for name, total in totals},
            "nan": float(self.unknown.sum()),
        }


def run_stress_trials(config: StressConfig) -> StressResult:
    """Run all trials: starts anywhere within the limits, at rest."""
    rng = torch.Generator().manual_seed(config.seed)
    limits, count = panda.limits, config.count
    q = limits.lower + (limits.upper - limits.lower) * _uniform(rng, count, 7)
    controller, camera = _controller(count, rng)
    virtual = VirtualCamera(camera=camera, imperfections=config.imperfections(), generator=rng)
    state = controller.initial_state(q)
    watch = LimitMonitor(limits, state.safety.velocity, config.dt)
    beyond = torch.zeros(count, 4, dtype=torch.int64)
    unknown = torch.zeros(count, dtype=torch.int64)
    joints = _JointReadings(config, rng)
    with torch.inference_mode():
        for k in range(round(config.duration / config.dt)):
            if k % round(_EFFORT_TIME / config.dt) == 0:
                # Far beyond what a person applies (6 N in the force trials).
                effort = 20 * _normal(rng, count, 7)
            measured, stale = joints.read(q)
            image: dict[str, Any] = virtual.observe(panda.forward(q), q, config.dt)
            observation = Observation(
                **image,
                joint_position=measured,
                joint_state_stale=stale,
                nullspace_input=effort,
                dt=config.dt,
            )
            command, state = controller.step(state, observation)
            q = q + config.dt * command.joint_velocity
            beyond += watch.violations(q, command.joint_velocity)
            unknown += _unknown((q, command, state))
    return StressResult(beyond=beyond, unknown=unknown, interventions=state.safety.counts)


def _unknown(everything: object) -> Bool[Tensor, "trials"]:
    """Where any tensor holds a NaN or an infinity."""
    leaves = [leaf for leaf in _pytree.tree_leaves(everything) if leaf.dim() > 1]
    return ~torch.stack([leaf.isfinite().flatten(1).all(-1) for leaf in leaves]).all(0)


def _uniform(rng: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=rng, dtype=torch.float64)


def _normal(rng: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def _controller(count: int, rng: torch.Generator) -> tuple[AdaptiveController, PinholeCamera]:
    """Cameras over the workspace, goals anywhere, within reach or not."""
    turn = 2 * torch.pi * _uniform(rng, count)
    middle = torch.tensor((0.3, 0.4, 0.3), dtype=torch.float64)
    camera = PinholeCamera.above(
        middle.expand(count, 3),
        height=0.8 + 0.6 * _uniform(rng, count),
        roll=turn,
        tilt=0.5 * _uniform(rng, count),
        bearing=turn,
        marker=middle.new_tensor((0.05, 0.0, -0.08)),
    )
    goals = Goals.at(
        _normal(rng, count, 3),
        quaternion.normalize(_normal(rng, count, 4)),
        100 + 800 * _uniform(rng, count, 2),
    )
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    return AdaptiveController(panda, CompositeEstimator(network), goals), camera


class _JointReadings:
    """Joint positions as the controller reads them, and which are stale."""

    def __init__(self, config: StressConfig, rng: torch.Generator):
        self.fault, self.dt, self.rng = config.fault, config.dt, rng
        self.away = torch.zeros(config.count, dtype=torch.float64)

    def read(
        self, q: Float[Tensor, "trials n"]
    ) -> tuple[Float[Tensor, "trials n"], Bool[Tensor, "trials"] | None]:
        if self.fault == "nan":
            broken = _uniform(self.rng, *q.shape) < 0.01 / q.shape[-1]
            return torch.where(broken, torch.nan, q), None
        if self.fault == "late":
            begins = _uniform(self.rng, len(q)) < 0.5 * self.dt
            self.away = torch.where(begins, _LATE, self.away - self.dt)
            return q, self.away > 0
        return q, None
