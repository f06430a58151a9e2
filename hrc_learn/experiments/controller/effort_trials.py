"""Null-space force trials: how far the tool moves while a person pushes the elbow."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import FixedEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda
from hrc_learn.sim.closed_loop import (
    Imperfections,
    PinholeCamera,
    VirtualCamera,
    simulate_closed_loop,
)

ELBOW = 4
"""Joint that is pushed."""


@dataclass(frozen=True, kw_only=True)
class EffortConfig:
    """How the person pushes while the arm servoes on its target."""

    count: int = 60
    seed: int = 0
    force: float = 6.0
    """Of the person; the elbow's Jacobian maps it to the null-space input d [N]."""
    away: float = 7.0
    """Time of pushing one way, as in the paper [s]."""
    back: float = 4.0
    """Time of pushing back [s]."""
    dt: float = 0.001
    """Control step [s]."""
    noise: float = 0.0
    """Standard deviation of each pixel coordinate [px]."""
    controller: ControllerConfig = field(default_factory=ControllerConfig)


@dataclass(frozen=True, kw_only=True)
class EffortResult:
    """Largest values of each trial."""

    elbow: Float[Tensor, "trials"]
    """Displacement of the elbow [m]."""
    deviation: Float[Tensor, "trials"]
    """Displacement of the tool, on target at the start [m]."""
    turn: Float[Tensor, "trials"]
    """Turn of the tool [rad]."""

    def summary(self) -> dict[str, float]:
        """Medians and 95th percentiles in mm and degrees."""
        deviation, turn = 1e3 * self.deviation, torch.rad2deg(self.turn)
        return {
            "elbow_mm": 1e3 * self.elbow.median().item(),
            "deviation_mm": deviation.median().item(),
            "deviation_p95_mm": deviation.quantile(0.95).item(),
            "turn_deg": turn.median().item(),
            "turn_p95_deg": turn.quantile(0.95).item(),
        }


def run_effort_trials(config: EffortConfig) -> EffortResult:
    """Push the elbow of many arms, each servoing on a target where its tool already is."""
    rng = torch.Generator().manual_seed(config.seed)
    noise = torch.randn(config.count, 7, generator=rng, dtype=torch.float64)
    # 0.2 rad on each joint: postures that differ, all within the limits and off the table.
    q = panda.ready + 0.2 * noise
    tool, elbow = panda.forward(q), _elbow(q)
    one = torch.ones(config.count, dtype=torch.float64)
    camera = PinholeCamera.above(
        tool.position,
        height=one,
        roll=0.5 * noise[:, 0],
        tilt=0.2 * one,
        bearing=6.28 * noise[:, 1],
        marker=tool.position.new_tensor((0.05, 0.0, -0.08)),
    )
    network = RBFImageJacobian.from_jacobian(
        camera.image_jacobian(tool).mean(0), paper_grid(), 0.1
    )
    goals = Goals.at(tool.position, tool.orientation, camera.project(tool)[0])
    controller = AdaptiveController(
        panda, FixedEstimator(network), goals, config=config.controller
    )
    way = _self_motion(q)
    largest = torch.zeros(3, config.count, dtype=torch.float64)

    def force(step: int, q: Tensor) -> Tensor:
        sign = 1.0 if step * config.dt < config.away else -1.0
        J = panda.joint_jacobian(q, ELBOW)[:, :3]
        return torch.linalg.vecdot(J, sign * config.force * way.unsqueeze(-1), dim=-2)

    def watch(step: int, q: Tensor, *_: object) -> None:
        now = panda.forward(q)
        moved = torch.stack([_elbow(q) - elbow, now.position - tool.position])
        turn = quaternion.angle(now.orientation, tool.orientation)
        values = torch.cat([torch.linalg.vector_norm(moved, dim=-1), turn[None]])
        torch.maximum(largest, values, out=largest)

    with torch.inference_mode():
        simulate_closed_loop(
            controller,
            VirtualCamera(
                camera=camera,
                imperfections=Imperfections(noise=config.noise),
                generator=rng,
            ),
            q,
            steps=round((config.away + config.back) / config.dt),
            dt=config.dt,
            nullspace_input=force,
            on_step=watch,
        )
    return EffortResult(elbow=largest[0], deviation=largest[1], turn=largest[2])


def _elbow(q: Tensor) -> Tensor:
    return panda.link_poses(q).position[..., ELBOW - 1, :]


def _self_motion(q: Tensor) -> Tensor:
    """Direction in which the elbow can move with the tool at rest."""
    null = torch.linalg.svd(panda.jacobian(q)).Vh[..., -1, :]
    motion = torch.linalg.vecdot(panda.joint_jacobian(q, ELBOW)[..., :3, :], null.unsqueeze(-2))
    return motion / torch.linalg.vector_norm(motion, dim=-1, keepdim=True)
