"""The workplace in motion: a MuJoCo world to reset, to step, and to query for contacts."""

import math
from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.protocols import ArmState, OpenedArm, Touch
from hrc_learn.sim.arm_model import FINGER_STROKE, MujocoArm, frame_of
from hrc_learn.sim.imperfections import DrawnImperfections, Imperfections
from hrc_learn.sim.scene import (
    HAND_MARKER,
    WORKER_BODIES,
    WORKER_ITEM,
    SceneConfig,
    build_scene,
)
from hrc_learn.sim.step_checks import ContactMonitor, PhysicsWatch

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

_PADS = ("finger_left_pad", "finger_right_pad")
# Bodies count as touching if they are less than this apart [m].
_TOUCHING = 1e-4
# Cosine of the largest angle between the normals of a contact and of a flat face: 3 degrees.
_FLAT = math.cos(math.radians(3.0))
# Orientation of an object in the tool's frame: its x axis is parallel to the closing direction
# of the fingers, and its top points to the gripper.
_IN_HAND = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
# Number of latest touches that `touched_since` searches: more than can begin in one control
# step.
_REMEMBERED = 64
_ARM_BODIES = ("link1",)  # the tree from link 1 on, hand and fingers included


class World:
    """A simulated workplace that can be reset, advanced in time and queried for contacts.

    Attributes:
        config: Scene.
        arm: The arm and its gripper.
        cabinet_contacts: Touches of the arm or its hand with the cabinet or an obstacle.
        object_contacts: Touches of objects with the cabinet or an obstacle.
        table_contacts: Touches of the arm or its hand with the table.
        self_contacts: Touches of the arm with itself, its pedestal or the floor.
        worker_contacts: Touches of the arm, and of objects, with the worker.
    """

    def __init__(
        self, config: SceneConfig | None = None, imperfections: DrawnImperfections | None = None
    ):
        """Build the world.

        Args:
            config: Nominal scene.
            imperfections: Deviations from the nominal scene; None: none.
        """
        nominal = config or SceneConfig()
        self.imperfections = imperfections or Imperfections.ideal().draw(
            np.random.default_rng(0), nominal.arm.robot.joints
        )
        self.config = _as_it_is(nominal, self.imperfections)
        self.model = self.describe().compile()
        self.data = mujoco.MjData(self.model)
        self._watch = PhysicsWatch(self.model, self.data)
        self.arm = MujocoArm(self.model, self.data, self.config.arm.robot, self.imperfections)
        cabinet = [b.name for b in (*self.config.cabinet.boxes(), *self.config.obstacles)]
        self.cabinet_contacts = ContactMonitor(self.model, _ARM_BODIES, cabinet)
        objects = [item.name for item in self.config.objects]
        self.object_contacts = ContactMonitor(self.model, objects, cabinet)
        self.table_contacts = ContactMonitor(self.model, _ARM_BODIES, [self.config.table.name])
        # The tree from link 0 on is the whole arm; "world" has pedestal and floor.
        self.self_contacts = ContactMonitor(self.model, _ARM_BODIES, ("link0", "world"))
        workers = WORKER_BODIES if self.config.worker is not None else ()
        self.worker_contacts = ContactMonitor(self.model, (*_ARM_BODIES, *objects), workers)
        self._monitors = [x for x in vars(self).values() if isinstance(x, ContactMonitor)]
        self._pads = {self.model.geom(pad).id for pad in _PADS}
        self._watched = np.logical_or.reduce([monitor.watched for monitor in self._monitors])
        self._worker = np.array([self.model.body(name).mocapid[0] for name in workers], int)
        self._item = self.model.body(WORKER_ITEM).mocapid[0] if workers else None

    def describe(self) -> mujoco.MjSpec:
        """Description of the true scene, errors included; `compile()` makes the model."""
        spec = build_scene(self.config)
        self.imperfections.apply(spec)
        return spec

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.data.time

    @property
    def opened_arm(self) -> OpenedArm:
        """The simulated arm, commanded without a driver."""
        return OpenedArm(arm=self.arm, gripper=self.arm, advance=self.advance)

    @property
    def table_top(self) -> float:
        """Height of the table's top [m]."""
        table = self.config.table
        return table.centre[2] + table.half_size[2]

    def reset(
        self,
        joint_position: Float[np.ndarray, " joints"],
        objects: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
        gripper_width: float = 2 * FINGER_STROKE,
    ) -> None:
        """Put everything at rest at time zero.

        Args:
            joint_position: Joints of the arm [rad].
            objects: Poses of objects in the base frame; other objects keep their initial pose.
            gripper_width: Opening of the gripper [m].

        Raises:
            KeyError: If there is no object of a given name.
        """
        mujoco.mj_resetData(self.model, self.data)
        self.arm.place(joint_position, gripper_width)
        for name, pose in (objects or {}).items():
            _put(self.model, self.data, name, pose)
        mujoco.mj_forward(self.model, self.data)
        self._watch.restart()
        for monitor in self._monitors:
            monitor.clear()

    def touched_since(self, time: float) -> tuple[str, ...]:
        """Texts about unwanted contacts of the arm since a time [s]: contacts with cabinet,
        table, itself or the worker.
        """
        monitors = (m for m in self._monitors if m is not self.object_contacts)
        met = [
            f"{touch.first} touched {touch.second}"
            for monitor in monitors
            for touch in monitor.touches[-_REMEMBERED:]
            if touch.end >= time
        ]
        return tuple(dict.fromkeys(met))

    def advance(self, duration: float) -> None:
        """Run the physics for a duration [s], while the arm follows its last command.

        Raises:
            PhysicsError: The simulation diverged, or was reset without `reset`.
        """
        for _ in range(max(1, round(duration / self.model.opt.timestep))):
            self.arm.drive()
            mujoco.mj_step(self.model, self.data)
            self._watch.after_step()
            self._look_at_contacts()
        self._watch.check()
        # After a step, MuJoCo's poses of bodies are still the old ones: bring them up to date.
        mujoco.mj_kinematics(self.model, self.data)

    def _look_at_contacts(self) -> None:
        """Pass the contacts of one step to the monitors; most steps have no watched contact."""
        geoms = self.data.contact.geom
        watched = self._watched[geoms[:, 0], geoms[:, 1]].any()
        for monitor in self._monitors:
            if watched:
                monitor.update(self.data)
            else:
                monitor.pause()

    def hold(self, name: str, joint_position: Float[np.ndarray, " joints"]) -> None:
        """Reset the world with an object between the fingers, and let the grip settle.

        Args:
            name: The object.
            joint_position: Joints of the arm [rad].
        """
        width = 2 * self._object(name).half_size[0]
        self.reset(joint_position, gripper_width=width + 0.002)
        in_hand = self.arm.tcp_pose() @ _IN_HAND
        self.reset(joint_position, {name: in_hand}, gripper_width=width + 0.002)
        self.arm.move(0.0)
        self.advance(0.5)
        self.data.time = 0.0
        self._watch.restart()

    def follow(self, state: ArmState, carried: str | None = None) -> None:
        """Show the state of an arm that is controlled elsewhere, without physics.

        Args:
            state: State of that arm.
            carried: Object that moves along, at its present pose in the gripper.
        """
        in_hand = None
        if carried is not None:
            in_hand = np.linalg.inv(self.arm.tcp_pose()) @ self.object_pose(carried)
        # An arm without a gripper reports NaN as its width.
        self.arm.place(state.joint_position, float(np.nan_to_num(state.gripper_width)))
        self.data.time = state.time
        mujoco.mj_kinematics(self.model, self.data)
        if carried is not None and in_hand is not None:
            _put(self.model, self.data, carried, self.arm.tcp_pose() @ in_hand)

    def put_in_hand(self, name: str) -> None:
        """Put an object between the fingers, where `hold` puts it, without simulating a grasp.

        Raises:
            KeyError: If there is no object of that name.
        """
        self.carry(name, self.arm.tcp_pose() @ _IN_HAND)

    def carry(self, name: str, pose: Float[np.ndarray, "4 4"]) -> None:
        """Place an object at rest, as a person does by hand.

        Raises:
            KeyError: There is no object of that name.
        """
        self._object(name)
        self.data.joint(name).qvel[:] = 0.0
        _put(self.model, self.data, name, pose)

    def move_obstacle(
        self, name: str, centre: tuple[float, float, float] | Float[np.ndarray, "3"]
    ) -> None:
        """Put an obstacle, or the occluder, at a new position.

        Args:
            name: Name of the obstacle.
            centre: Centre in the base frame [m]; `NOWHERE`: out of the scene.
        """
        self.data.mocap_pos[self.model.body(name).mocapid[0]] = centre
        mujoco.mj_kinematics(self.model, self.data)

    def move_worker(
        self, ends: Float[np.ndarray, "parts 2 3"], item: Float[np.ndarray, "3"] | None = None
    ) -> None:
        """Put the worker's body at new positions.

        Args:
            ends: Ends of the axes of the worker's capsules, in the order of `PARTS` [m].
            item: Position of the object put on the table [m]; None: unchanged.

        Raises:
            ValueError: If there is no worker in the scene.
        """
        if not len(self._worker):
            raise ValueError("there is no worker in this scene: give it a WorkerConfig.")
        axes = ends[:, 1] - ends[:, 0]
        self.data.mocap_pos[self._worker] = ends.mean(axis=1)
        for mocap, axis in zip(self._worker, axes, strict=True):
            mujoco.mju_quatZ2Vec(self.data.mocap_quat[mocap], axis)
        if item is not None:
            self.data.mocap_pos[self._item] = item
        mujoco.mj_kinematics(self.model, self.data)

    def _object(self, name: str):
        found = {item.name: item for item in self.config.objects}
        if name not in found:
            raise KeyError(f"no object named {name!r}; there are: {', '.join(found)}")
        return found[name]

    def object_pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object's centre in the base frame."""
        self._object(name)
        return frame_of(self.data.body(name))

    def holds(self, name: str) -> bool:
        """True if both finger pads touch an object."""
        return self._touched(name) >= self._pads

    def held(self) -> tuple[str, ...]:
        """Names of the objects that both finger pads touch."""
        return tuple(item.name for item in self.config.objects if self.holds(item.name))

    def holds_flat(self, name: str) -> bool:
        """True if the pads press on the two faces of an object that are normal to its x axis,
        not on edges or other faces.
        """
        item, axis = self.model.geom(name).id, self.object_pose(name)[:3, 0]
        pads = {self.model.geom(pad).id: set() for pad in _PADS}
        for contact in self.data.contact:
            pair = contact.geom.tolist()
            if item not in pair or contact.dist >= _TOUCHING:
                continue
            (other,) = {*pair} - {item}
            if other in pads:
                # MuJoCo's normals point from the first geom to the second.
                out = 1 if pair[0] == item else -1
                along = out * float(contact.frame[:3] @ axis)
                pads[other].add(0 if abs(along) < _FLAT else int(math.copysign(1, along)))
        return sorted(tuple(faces) for faces in pads.values()) == [(-1,), (1,)]

    def rests_on(self, name: str, board: str) -> bool:
        """True if an object touches a piece of furniture, and nothing else but furniture."""
        partners = {self.model.geom(g).name for g in self._touched(name)}
        return board in partners and partners <= {box.name for box in self.config.boxes()}

    def _touched(self, name: str) -> set[int]:
        """Numbers of the geoms that touch the geom of an object."""
        target, contact = self.model.geom(name).id, self.data.contact
        # Contacts with the worker are excluded: they exert no force.
        touching = (contact.dist < _TOUCHING) & (contact.exclude == 0)
        touching &= (contact.geom == target).any(axis=-1)
        return {*contact.geom[touching].ravel().tolist()} - {target}

    def marker_poses(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Pose of every marker's face in the base frame, by ArUco number."""
        poses = {
            item.marker.id: frame_of(self.data.site(f"{item.name}_marker"))
            for item in self.config.objects
        }
        if self.config.arm.marker is not None:
            poses[HAND_MARKER] = frame_of(self.data.site("hand_marker"))
        return poses

    def hand_marker_offset(self) -> Float[np.ndarray, "3"]:
        """Centre of the end effector's marker in the frame of the tool centre point [m].

        Raises:
            ValueError: If the end effector carries no marker.
        """
        if self.config.arm.marker is None:
            raise ValueError("this scene's hand carries no marker: give its arm a Plate.")
        to_tool = np.linalg.inv(self.arm.tcp_pose())
        marker = self.marker_poses()[HAND_MARKER]
        return (to_tool @ marker)[:3, 3]

    def collisions_along(
        self, path: Float[np.ndarray, "steps joints"], carried: str | None = None
    ) -> list[Touch]:
        """Touches of the arm with cabinet, table, obstacles, base, pedestal, floor or itself
        along a path of joint positions.

        The test is purely geometric: nothing is simulated, and the world does not change. Times
        in the touches are sample numbers.

        Args:
            path: Joint positions [rad].
            carried: An object to carry along, at its present pose in the gripper.
        """
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.data.qpos
        data.mocap_pos[:] = self.data.mocap_pos
        in_hand = None
        if carried is not None:
            in_hand = np.linalg.inv(self.arm.tcp_pose()) @ self.object_pose(carried)
        boxes = ["world", *(b.name for b in (*self.config.boxes(), *self.config.obstacles))]
        movers = _ARM_BODIES if carried is None else (*_ARM_BODIES, carried)
        monitors = [
            ContactMonitor(self.model, movers, boxes),
            ContactMonitor(self.model, _ARM_BODIES, ("link0",)),
        ]
        for k, q in enumerate(path):
            data.qpos[self.arm.joints] = q
            mujoco.mj_kinematics(self.model, data)
            if carried is not None and in_hand is not None:
                _put(self.model, data, carried, self.arm.tcp_pose(data) @ in_hand)
            mujoco.mj_collision(self.model, data)
            data.time = float(k)
            for monitor in monitors:
                monitor.update(data)
        return [touch for monitor in monitors for touch in monitor.touches]


def _put(
    model: mujoco.MjModel, data: mujoco.MjData, name: str, pose: Float[np.ndarray, "4 4"]
) -> None:
    """Move a free object to a pose."""
    joint = data.joint(name)
    joint.qpos[:3] = pose[:3, 3]
    mujoco.mju_mat2Quat(joint.qpos[3:7], np.ascontiguousarray(pose[:3, :3]).ravel())
    mujoco.mj_kinematics(model, data)


def _as_it_is(believed: SceneConfig, errors: DrawnImperfections) -> SceneConfig:
    """The scene with the true heights of table and objects."""
    x, y, z = believed.table.centre
    table = replace(believed.table, centre=(x, y, z + errors.table_height))
    objects = []
    for item, taller in zip(believed.objects, errors.object_heights, strict=False):
        a, b, c = item.half_size
        objects.append(replace(item, half_size=(a, b, c + float(taller) / 2)))
    return replace(believed, table=table, objects=tuple(objects))
