"""From what a station logged, and what the simulator knows, to a recording to look at."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from .. import viz
from ..geometry import quaternion
from ..kinematics import panda
from ..sim import World
from ..sim.contacts import body_geoms
from .placing import Plan
from .station import SAFETY_COLUMNS, Station

ELBOW, TOOL = 3, 8
"""Frames of the elbow and of the tool among the logged links."""


class WorldLog:
    """Remembers where everything that moves was after each step of the station."""

    def __init__(self, world: World):
        self._world = world
        model = world.model
        movers = ["link0", *(item.name for item in world.config.objects)]
        geoms = body_geoms(model, movers)
        self._bodies = sorted({int(b) for b in model.geom_bodyid[geoms]})
        self._positions: list[np.ndarray] = []
        self._orientations: list[np.ndarray] = []

    def advance(self, duration: float) -> None:
        """Note where everything is, then let the world go on [s]."""
        data = self._world.data
        self._positions.append(data.xpos[self._bodies].copy())
        self._orientations.append(data.xquat[self._bodies].copy())
        self._world.advance(duration)

    def bodies(self) -> tuple[viz.Body, ...]:
        """Everything that moved, as it is to be drawn."""
        positions, orientations = np.stack(self._positions), np.stack(self._orientations)
        return tuple(
            viz.Body(
                name=self._world.model.body(body).name,
                position=positions[:, i],
                orientation=orientations[:, i],
                **_shapes(self._world.model, body),
            )
            for i, body in enumerate(self._bodies)
        )


def _shapes(model: mujoco.MjModel, body: int) -> dict[str, tuple]:
    """Capsules and boxes of a body in its own frame."""
    capsules, boxes = [], []
    for g in np.flatnonzero(model.geom_bodyid == body):
        kind, size, centre = model.geom_type[g], model.geom_size[g], model.geom_pos[g]
        colour = tuple(float(c) for c in model.geom_rgba[g])
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[g])
        R = R.reshape(3, 3)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = size[1] * R[:, 2]
            capsules.append(
                viz.Capsule(
                    start=tuple((centre - half).tolist()),
                    end=tuple((centre + half).tolist()),
                    radius=float(size[0]),
                    colour=colour,
                )
            )
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            # All boxes of ours are turned by multiples of a quarter turn.
            half_size = np.abs(R @ size)
            boxes.append(
                viz.Box(
                    centre=tuple(centre.tolist()),
                    half_size=tuple(half_size.tolist()),
                    colour=colour,
                )
            )
    return {"capsules": tuple(capsules), "boxes": tuple(boxes)}


def record(
    title: str,
    station: Station,
    world: World,
    moved: WorldLog,
    interaction: tuple[float, float],
    plan: Plan,
    demo_path: Float[np.ndarray, "samples 3"] | None = None,
) -> viz.RunRecording:
    """Everything worth looking at in a run of the collaboration.

    Args:
        title: What it was.
        station: That ran it.
        world: That it ran in; tells what only a simulator knows.
        moved: Where everything was.
        interaction: Start and end of the time left to the person [s].
        plan: The way to the shelf.
        demo_path: Hand along a demonstration [m].
    """
    log = station.log
    time = log["time"]
    deviation = Deviation.of(station, interaction)
    feature, safety = log["feature"], log["safety"]
    limits = panda.limits
    return viz.RunRecording(
        title=title,
        time=time,
        joint_names=panda.joint_names,
        joint_position=log["joint_position"],
        joint_limits=viz.JointLimits(lower=limits.lower.numpy(), upper=limits.upper.numpy()),
        position=log["link_position"][:, TOOL],
        demo_path=demo_path,
        plan_path=plan.hand.position.numpy(),
        bodies=moved.bodies(),
        boxes=tuple(
            viz.Box(name=box.name, centre=box.centre, half_size=box.half_size, colour=box.rgba)
            for box in world.config.boxes()
        ),
        camera=viz.CameraRecording(
            model=world.config.camera,
            feature=feature,
            target=log["target"],
            image_time=np.array([kept.time for kept in station.images]),
            images=tuple(kept.image for kept in station.images),
        ),
        image_jacobian=log["image_jacobian"],
        true_image_jacobian=true_image_jacobian(station, world),
        weight_norm=log["weight_norm"],
        potentials={"task space": log["potential"]},
        human_effort=log["human_effort"],
        elbow_motion=deviation.elbow,
        position_deviation=deviation.position,
        rotation_deviation=deviation.rotation,
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
    )


def true_image_jacobian(station: Station, world: World) -> Float[np.ndarray, "time 2 6"]:
    """True image Jacobian of the hand's marker wherever the controller used its estimate."""
    log = station.log
    used = np.isfinite(log["image_jacobian"]).all(axis=(1, 2))
    jacobian = np.full_like(log["image_jacobian"], np.nan)
    tool = log["link_position"][used, TOOL]
    turn = torch.from_numpy(log["link_orientation"][used, TOOL])
    offset = torch.from_numpy(world.hand_marker_offset())
    marker = tool + quaternion.rotate(turn, offset.expand(len(tool), 3)).numpy()
    jacobian[used] = world.config.camera.image_jacobian(marker, tool)
    return jacobian


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """How far hand and elbow were from where the person found them; NaN at other times."""

    position: Float[np.ndarray, " time"]
    """Of the hand [m]."""
    rotation: Float[np.ndarray, " time"]
    """Of the hand [rad]."""
    elbow: Float[np.ndarray, " time"]
    """Of the elbow [m]."""

    @classmethod
    def of(cls, station: Station, interaction: tuple[float, float]) -> "Deviation":
        """From the first pull at the body on, until the time left to the person is over.

        Args:
            station: That ran the task.
            interaction: Start and end of the time left to the person [s].
        """
        log = station.log
        time = log["time"]
        within = (time >= interaction[0]) & (time < interaction[1])
        pulled = within & (np.abs(log["human_effort"]).max(axis=1) > 0)
        first = int(pulled.argmax()) if pulled.any() else 0
        rows = within & (np.arange(len(time)) >= first) & bool(pulled.any())

        def distance(link: int) -> Float[np.ndarray, " time"]:
            position = log["link_position"][:, link]
            return np.where(rows, np.linalg.norm(position - position[first], axis=1), np.nan)

        turn = torch.from_numpy(log["link_orientation"][:, TOOL])
        angle = quaternion.angle(turn, turn[first]).numpy()
        return cls(
            position=distance(TOOL),
            rotation=np.where(rows, angle, np.nan),
            elbow=distance(ELBOW),
        )

    def most(self, name: str) -> float:
        """Largest value of one of the fields; 0 if nobody pulled."""
        values = getattr(self, name)
        return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
