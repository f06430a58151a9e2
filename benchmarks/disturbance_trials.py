"""Disturbance trials: deviation of the tool while a person pushes, and limits under stress.

The controller runs in batches of closed loops. In the first kind of trials, a person's
null-space force acts on the elbow; in the second kind, goals, cameras, null-space inputs and
faults are random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from closed_loop import (
    Imperfections,
    VirtualCamera,
    guessed_network,
    simulate_closed_loop,
)
from grasp_trials import MARKER
from jaxtyping import Bool, Float, Int
from limit_monitor import LimitMonitor
from pinhole_camera import PinholeCamera
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller import AdaptiveController, Goals, Observation
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics import panda

ELBOW = 4
"""Joint that is pushed, counted from 1."""


@dataclass(frozen=True, kw_only=True)
class EffortConfig:
    """Pushes of the person while the arm servoes to its target."""

    count: int = 60
    seed: int = 0
    force: float = 6.0
    """Force of the person [N]; the elbow's Jacobian maps it to the null-space input d."""
    away: float = 7.0
    """Time of pushing in one direction, as in the paper [s]."""
    back: float = 4.0
    """Time of pushing back [s]."""
    dt: float = 0.001
    """Control step [s]."""
    noise: float = 0.0
    """Standard deviation of each pixel coordinate [px]."""


@dataclass(frozen=True, kw_only=True)
class EffortResult:
    """Largest values of each trial."""

    elbow: Float[Tensor, "trials"]
    """Displacement of the elbow [m]."""
    deviation: Float[Tensor, "trials"]
    """Displacement of the tool, which is at its target at the start [m]."""
    turn: Float[Tensor, "trials"]
    """Rotation of the tool [rad]."""

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
    """Push the elbow of many arms, each servoing to a target that its tool has reached."""
    rng = torch.Generator().manual_seed(config.seed)
    noise = torch.randn(config.count, 7, generator=rng, dtype=torch.float64)
    # 0.2 rad on each joint: different postures, all within the limits and above the table.
    q = panda.ready + 0.2 * noise

    def elbow_position(q: Tensor) -> Tensor:
        return panda.link_poses(q).position[..., ELBOW - 1, :]

    tool, elbow = panda.forward(q), elbow_position(q)
    one = torch.ones(config.count, dtype=torch.float64)
    camera = PinholeCamera.above(
        tool.position,
        height=one,
        roll=0.5 * noise[:, 0],
        tilt=0.2 * one,
        bearing=6.28 * noise[:, 1],
        marker=tool.position.new_tensor(MARKER),
    )
    network = RBFImageJacobian.from_jacobian(
        camera.image_jacobian(tool).mean(0), paper_grid(), 0.1
    )
    goals = Goals.at(tool.position, tool.orientation, camera.project(tool)[0])
    controller = AdaptiveController(panda, FixedEstimator(network), goals)
    way = _self_motion(q)
    largest = torch.zeros(3, config.count, dtype=torch.float64)

    def force(step: int, q: Tensor) -> Tensor:
        sign = 1.0 if step * config.dt < config.away else -1.0
        J = panda.joint_jacobian(q, ELBOW)[:, :3]
        return torch.linalg.vecdot(J, sign * config.force * way.unsqueeze(-1), dim=-2)

    def watch(step: int, q: Tensor, *_: object) -> None:
        now = panda.forward(q)
        moved = torch.stack([elbow_position(q) - elbow, now.position - tool.position])
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


def _self_motion(q: Tensor) -> Tensor:
    """Direction in which the elbow can move with the tool at rest."""
    null = torch.linalg.svd(panda.jacobian(q)).Vh[..., -1, :]
    motion = torch.linalg.vecdot(panda.joint_jacobian(q, ELBOW)[..., :3, :], null.unsqueeze(-2))
    return motion / torch.linalg.vector_norm(motion, dim=-1, keepdim=True)


Fault = Literal["none", "nan", "late", "lost"]
"""Faults of a trial. "nan": NaN in 1 % of images and joint readings. "late": images are delayed
by 100 ms, and joint states are missing for 100 ms. "lost": the marker is covered every other
second, for up to 3 s."""

_FRAME = 0.03  # period of images [s]
_LATE = 0.1  # delay of images, and time for which joint states are missing [s]
_EFFORT_TIME = 0.4  # time after which the null-space input is drawn again [s]


@dataclass(frozen=True, kw_only=True)
class StressConfig:
    """Distribution of the trials."""

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

    beyond: Int[Tensor, "trials 5"]
    """Steps beyond the limits of position, velocity, acceleration, jerk and tool speed."""
    unknown: Int[Tensor, "trials"]
    """Steps with a NaN in command or state."""
    interventions: Int[Tensor, "trials kinds"]
    """Steps in which the safety filter acted, by kind."""

    def summary(self) -> dict[str, float]:
        """Totals by name."""
        return {
            **ticks_beyond(self.beyond),
            "nan": float(self.unknown.sum()),
        }


def ticks_beyond(beyond: Int[Tensor, "trials kinds"]) -> dict[str, float]:
    """Number of trials, and number of ticks beyond each kind of limit, by name."""
    names = ("position", "velocity", "acceleration", "jerk", "speed")
    totals = zip(names, beyond.sum(0).tolist(), strict=False)
    return {
        "rollouts": float(len(beyond)),
        **{f"beyond_{name}": float(total) for name, total in totals},
    }


def run_stress_trials(config: StressConfig) -> StressResult:
    """Run all trials: starts anywhere within the limits, at rest."""
    rng = torch.Generator().manual_seed(config.seed)
    limits, count = panda.limits, config.count
    q = limits.lower + (limits.upper - limits.lower) * uniform(rng, count, 7)
    controller, camera = random_controller(count, rng)
    virtual = VirtualCamera(camera=camera, imperfections=config.imperfections(), generator=rng)
    state = controller.initial_state(q)
    cap = controller.config.safety.tcp_speed
    watch = LimitMonitor(limits, state.safety.velocity, config.dt, cap)
    beyond = torch.zeros(count, 5, dtype=torch.int64)
    unknown = torch.zeros(count, dtype=torch.int64)
    joints = _JointReadings(config, rng)
    with torch.inference_mode():
        for k in range(round(config.duration / config.dt)):
            if k % round(_EFFORT_TIME / config.dt) == 0:
                # Far beyond what a person applies (6 N in the force trials).
                effort = 20 * torch.randn(count, 7, generator=rng, dtype=torch.float64)
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
            points = panda.jacobian(q)[:, None, :3]
            beyond += watch.violations(q, command.joint_velocity, points)
            unknown += ~all_finite((q, command, state))
    return StressResult(beyond=beyond, unknown=unknown, interventions=state.safety.counts)


def all_finite(everything: object) -> Bool[Tensor, "trials"]:
    """True for trials in which all tensors of a tree are finite; trials are their first
    dimension.
    """
    leaves = [leaf for leaf in _pytree.tree_leaves(everything) if leaf.dim() > 1]
    return torch.stack([leaf.isfinite().flatten(1).all(-1) for leaf in leaves]).all(0)


def uniform(rng: torch.Generator, *shape: int) -> Tensor:
    """Random numbers from 0 to 1."""
    return torch.rand(shape, generator=rng, dtype=torch.float64)


def random_controller(
    count: int,
    rng: torch.Generator,
    estimator: Callable[[RBFImageJacobian], ImageJacobianEstimator] = CompositeEstimator,
) -> tuple[AdaptiveController, PinholeCamera]:
    """Controller with cameras above the workspace and goals anywhere, in reach or not."""
    turn = 2 * torch.pi * uniform(rng, count)
    middle = torch.tensor((0.3, 0.4, 0.3), dtype=torch.float64)
    camera = PinholeCamera.above(
        middle.expand(count, 3),
        height=0.8 + 0.6 * uniform(rng, count),
        roll=turn,
        tilt=0.5 * uniform(rng, count),
        bearing=turn,
        marker=middle.new_tensor(MARKER),
    )
    position, orientation = (
        torch.randn(count, size, generator=rng, dtype=torch.float64) for size in (3, 4)
    )
    target = 100 + 800 * uniform(rng, count, 2)
    goals = Goals.at(position, quaternion.normalize(orientation), target)
    return AdaptiveController(panda, estimator(guessed_network()), goals), camera


class _JointReadings:
    """Joint positions as read by the controller, and flags of stale readings."""

    def __init__(self, config: StressConfig, rng: torch.Generator):
        self.fault, self.dt, self.rng = config.fault, config.dt, rng
        self.away = torch.zeros(config.count, dtype=torch.float64)

    def read(
        self, q: Float[Tensor, "trials n"]
    ) -> tuple[Float[Tensor, "trials n"], Bool[Tensor, "trials"] | None]:
        if self.fault == "nan":
            broken = uniform(self.rng, *q.shape) < 0.01 / q.shape[-1]
            return torch.where(broken, torch.nan, q), None
        if self.fault == "late":
            begins = uniform(self.rng, len(q)) < 0.5 * self.dt
            self.away = torch.where(begins, _LATE, self.away - self.dt)
            return q, self.away > 0
        return q, None
