"""Force and pressure of every contact between an arm and a worker, from their recorded motion.

The evaluation is independent of the controller. Contacts, Jacobians and mass matrices come from
MuJoCo; velocities are differences of the recorded positions; the limits are entered separately
from the table. An impact is integrated as two masses with the spring of the body region between
them. Every step of a contact counts as a separate impact. A part of the body that furniture
supports cannot yield: the motion of the arm during the contact also compresses the spring.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.integrate import solve_ivp

from hrc_learn.sim import World
from hrc_learn.sim.scene import WORKER_BODIES, SceneConfig
from hrc_learn.sim.worker import WorkerConfig

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

# Force [N] and pressure [N/cm^2], both quasi-static, spring [N/mm] and mass [kg]: ISO/TS
# 15066:2016, tables A.2 and A.3, the strictest value of each region; zero: no contact is
# allowed.
LIMITS = {
    "head": (0, 0, 75, 4.4),
    "neck": (0, 0, 50, 1.2),
    "chest": (140, 120, 25, 40),
    "shoulders": (210, 160, 35, 40),
    "pelvis": (110, 140, 10, 40),
    "upper_arm": (150, 190, 30, 3),
    "forearm": (160, 180, 40, 2),
    "hand": (140, 190, 75, 0.6),
    "thigh": (220, 220, 50, 75),
    "shank": (130, 210, 60, 75),
    "foot": (130, 210, 60, 75),
}
# Speed below which a part of the arm counts as at rest, as servos creep [m/s].
_AT_REST = 0.01
# Gap behind a part of the body below which furniture supports it [m].
_BEHIND = 0.02
# Distance from the axis of the base within which a worker may touch the arm: no part of a Panda
# with its load is farther away [m].
_REACH = 1.2
# Pose of a grasped object in the frame of the tool.
_IN_HAND = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
# Time between two contacts of the same parts below which they count as one contact [s].
_SAME = 0.1


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Recorded motion of an arm and a worker, a row for each step."""

    dt: float
    """[s]"""
    joints: Float[np.ndarray, "steps joints"]
    """True joint positions [rad]."""
    holding: Bool[np.ndarray, " steps"]
    """True while the gripper holds the object."""
    ends: Float[np.ndarray, "steps parts 2 3"]
    """True ends of the worker's capsules, in the order of `PARTS` [m]."""


@dataclass(frozen=True, kw_only=True)
class Contact:
    """The moment of a contact with the largest force relative to its limit."""

    time: float
    """[s]"""
    arm: str
    """Link of the arm, or the object that it holds."""
    part: str
    """Part of the worker."""
    arm_speed: float
    """Speed of the arm towards the worker [m/s]; below 1 cm/s the arm counts as at rest."""
    speed: float
    """Relative speed [m/s]."""
    mass: float
    """Effective mass of the arm [kg]."""
    force: float
    """Peak force [N]."""
    of_limit: float
    """Peak force or pressure as a fraction of its limit; infinite if no contact is allowed."""
    clamped: bool
    """True if furniture supports the part."""

    @property
    def by_arm(self) -> bool:
        """True if the arm moves towards the worker; False if the worker moves into the arm."""
        return self.arm_speed > _AT_REST


def impact(speed: float, arm_mass: float, body_mass: float, stiffness: float) -> float:
    """Peak force of two masses that meet with a spring between them [N], integrated.

    Args:
        speed: Relative speed [m/s].
        arm_mass: [kg]
        body_mass: [kg]; infinite: held.
        stiffness: [N/m]
    """
    inverse = 1 / arm_mass + 1 / body_mass

    def parted(t: float, y: np.ndarray) -> float:
        return y[1]

    parted.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(
        lambda t, y: [y[1], -stiffness * y[0] * inverse],
        (0, 10 / np.sqrt(stiffness * inverse)),
        [0.0, speed],
        events=parted,
        rtol=1e-8,
        atol=1e-10,
    )
    return stiffness * float(found.y[0, -1])


def contacts(
    motion: Motion,
    scene: SceneConfig,
    worker: WorkerConfig,
    *,
    load: float = 0.0,
    area: float = 1.0,
    padding: float = np.inf,
    rows: Iterable[int] | None = None,
) -> list[Contact]:
    """All contacts of a recorded motion, each with its hardest moment.

    Args:
        motion: The recording.
        scene: Workplace, with the object that the arm carries first.
        worker: Size of the worker.
        load: Mass of the carried object [kg].
        area: Contact area [cm^2].
        padding: Stiffness of a padding of the arm [N/mm]; infinite: none.
        rows: Steps to look at; default: those in which the worker is within the arm's reach.
    """
    return _Replay(scene, worker, motion, load, area, padding).contacts(rows)


class _Replay:
    """The recorded motion, step by step in MuJoCo."""

    def __init__(
        self,
        scene: SceneConfig,
        worker: WorkerConfig,
        motion: Motion,
        load: float,
        area: float,
        padding: float,
    ):
        self._world = World(replace(scene, worker=worker))
        model = self._world.model
        self._motion, self._load, self._area = motion, load, area
        self._softness = 1 / padding
        self._item = scene.objects[0]
        self._worker = {model.geom(name).id: k for k, name in enumerate(WORKER_BODIES)}
        self._dofs = np.array(
            [model.joint(n).dofadr[0] for n in scene.arm.robot.joint_names], dtype=int
        )
        self._object = model.geom(self._item.name).id
        free = int(model.body(self._item.name).jntadr[0])
        at = int(model.jnt_qposadr[free])
        self._item_at = slice(at, at + 7)
        self._world.reset(motion.joints[0])
        # Coordinates without the object, which is out of the way.
        self._posture = self._world.data.qpos.copy()
        self._posture[self._item_at] = (0.0, 0.0, 9.0, 1.0, 0.0, 0.0, 0.0)
        self._boxes = [(np.array(b.centre), np.array(b.half_size)) for b in scene.boxes()]

    def contacts(self, rows: Iterable[int] | None) -> list[Contact]:
        hardest: dict[tuple[str, str], Contact] = {}
        advance: dict[tuple[str, str], float] = {}
        closed: list[Contact] = []
        dt, last = self._motion.dt, {}
        if rows is None:
            near = np.linalg.norm(self._motion.ends[..., :2], axis=-1).min((-2, -1)) < _REACH
            near[[0, -1]] = False
            rows = np.flatnonzero(near)
        for k in map(int, rows):
            for pair, found in self._touching(k, advance):
                if pair in last and (k - last[pair]) * dt > _SAME:
                    closed.append(hardest.pop(pair))
                    advance[pair] = 0.0
                last[pair] = k
                old = hardest.get(pair)
                if old is None or (found.by_arm, found.of_limit) > (old.by_arm, old.of_limit):
                    hardest[pair] = found
        return sorted([*closed, *hardest.values()], key=lambda contact: contact.time)

    def _touching(self, k: int, advance: dict[tuple[str, str], float]):
        """Pairs of parts that touch at a step, and the contact of each."""
        world, motion = self._world, self._motion
        model, data = world.model, world.data
        data.qpos[:] = self._posture
        data.qpos[world.arm.joints] = motion.joints[k]
        world.move_worker(motion.ends[k])
        if motion.holding[k]:
            tool = world.arm.tcp_pose() @ _IN_HAND
            turn = np.empty(4)
            mujoco.mju_mat2Quat(turn, tool[:3, :3].ravel())
            data.qpos[self._item_at] = [*tool[:3, 3], *turn]
        mujoco.mj_fwdPosition(model, data)
        contact = data.contact
        for c in np.flatnonzero(contact.dist <= 0):
            first, second = contact.geom[c].tolist()
            if (first in self._worker) == (second in self._worker):
                continue
            towards = 1.0 if second in self._worker else -1.0
            geom, part = (first, second) if towards > 0 else (second, first)
            body = self._arm_body(geom, motion.holding[k])
            if body is None:
                continue
            name = WORKER_BODIES[self._worker[part]].removeprefix("worker_")
            pair = (model.body(int(model.geom_bodyid[geom])).name, name)
            found = self._contact(
                k, body, pair, contact.pos[c], towards * contact.frame[c, :3], advance
            )
            yield pair, found

    def _contact(self, k, body, pair, point, normal, advance) -> Contact:
        motion, dt = self._motion, self._motion.dt
        rate = (motion.joints[k + 1] - motion.joints[k - 1]) / (2 * dt)
        J, M = self._kinematics(body, point, motion.holding[k])
        v = float(normal @ J @ rate)
        row = normal @ J
        inverse = float(row @ np.linalg.solve(M, row))
        relative = v - float(normal @ self._worker_velocity(k, pair[1], point))
        force, pressure, spring, mass = LIMITS[
            pair[1].removesuffix("_left").removesuffix("_right")
        ]
        stiffness = 1e3 / (1 / spring + self._softness)
        part = self._world.model.geom(f"worker_{pair[1]}")
        clamped = self._held(point, normal, 2 * float(part.size[0]) + _BEHIND)
        advance[pair] = advance.get(pair, 0.0) + max(v, 0.0) * dt
        if clamped:
            loose = impact(max(v, 0.0), 1 / inverse, np.inf, stiffness)
            peak, limit = (
                max(loose, stiffness * advance[pair]),
                min(force, pressure * self._area),
            )
        else:
            peak = impact(max(relative, 0.0), 1 / inverse, mass, stiffness)
            limit = 2 * min(force, pressure * self._area)
        return Contact(
            time=k * dt,
            arm=pair[0],
            part=pair[1],
            arm_speed=v,
            speed=relative,
            mass=1 / inverse,
            force=peak,
            of_limit=peak / limit if limit else np.inf,
            clamped=clamped,
        )

    def _arm_body(self, geom: int, holding: bool) -> int | None:
        """Body of the arm that a geom moves with; None for the base and for other objects."""
        model = self._world.model
        if geom == self._object:
            return model.body("hand").id if holding else None
        body = int(model.geom_bodyid[geom])
        root = int(model.body_rootid[body])
        return body if root == model.body("link0").id and body != root else None

    def _kinematics(self, body, point, holding) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian of a point, and mass matrix, of the arm's joints."""
        model, data = self._world.model, self._world.data
        J, M = np.zeros((3, model.nv)), np.zeros((model.nv, model.nv))
        mujoco.mj_jac(model, data, J, None, point, body)
        mujoco.mj_fullM(model, data, M)
        M = M[np.ix_(self._dofs, self._dofs)]
        if holding:
            L = np.zeros((3, model.nv))
            tip, hand = data.site("tcp").xpos, model.body("hand").id
            mujoco.mj_jac(model, data, L, None, tip, hand)
            M = M + self._load * L[:, self._dofs].T @ L[:, self._dofs]
        return J[:, self._dofs], M

    def _worker_velocity(self, k: int, part: str, point: np.ndarray) -> np.ndarray:
        """Velocity of the worker at a point of a part [m/s]."""
        number, dt = WORKER_BODIES.index(f"worker_{part}"), self._motion.dt
        first, second = self._motion.ends[k, number]
        axis = second - first
        along = np.clip((point - first) @ axis / (axis @ axis), 0.0, 1.0)
        ends = self._motion.ends[[k - 1, k + 1], number]
        before, after = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
        return (after - before) / (2 * dt)

    def _held(self, point: np.ndarray, normal: np.ndarray, reach: float) -> bool:
        """True if a ray from the contact through the part meets furniture within the gap."""
        for centre, half in self._boxes:
            with np.errstate(divide="ignore", invalid="ignore"):
                near = (centre - half - point) / normal
                far = (centre + half - point) / normal
            enter = np.nanmax(np.minimum(near, far))
            leave = np.nanmin(np.maximum(near, far))
            if max(enter, 0.0) <= min(leave, reach):
                return True
        return False
