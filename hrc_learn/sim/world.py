"""The workplace in motion: MuJoCo behind the `Arm` and `Gripper` protocols."""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState
from hrc_learn.sim.contacts import ContactMonitor, Touch
from hrc_learn.sim.imperfections import CommandChannel, DrawnImperfections, Imperfections
from hrc_learn.sim.panda_model import FINGER_STROKE
from hrc_learn.sim.scene import HAND_MARKER, SceneConfig, build_scene

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


_ARM_BODIES = ("link1",)  # the tree from link 1 on, hand and fingers included


class World:
    """A workplace that can be reset, advanced in time, looked at and asked about contacts.

    Attributes:
        config: What stands in it.
        arm: The arm and its gripper.
        cabinet_contacts: Touches of the arm or its hand with the cabinet or an obstacle.
        object_contacts: Touches of objects with them.
        table_contacts: Touches of the arm or its hand with the table.
        self_contacts: Touches of the arm with itself.
    """

    def __init__(
        self, config: SceneConfig | None = None, imperfections: DrawnImperfections | None = None
    ):
        """Build it.

        Args:
            config: What stands in it, as it is believed to.
            imperfections: How what there is departs from that; None: in nothing.
        """
        self.config = config or SceneConfig()
        self.imperfections = imperfections or Imperfections().draw(np.random.default_rng(0))
        self.config = self.imperfections.real_scene(self.config)
        spec = build_scene(self.config)
        self.imperfections.apply(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.arm = MujocoArm(self.model, self.data, self.imperfections)
        obstacles = [box.name for box in self.config.obstacles]
        cabinet = [box.name for box in self.config.cabinet.boxes()] + obstacles
        self.cabinet_contacts = ContactMonitor(self.model, _ARM_BODIES, cabinet)
        objects = [item.name for item in self.config.objects]
        self.object_contacts = ContactMonitor(self.model, objects, cabinet)
        self.table_contacts = ContactMonitor(self.model, _ARM_BODIES, [self.config.table.name])
        self.self_contacts = ContactMonitor(self.model, _ARM_BODIES, _ARM_BODIES)
        self._monitors = (
            self.cabinet_contacts,
            self.object_contacts,
            self.table_contacts,
            self.self_contacts,
        )

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.data.time

    @property
    def table_top(self) -> float:
        """Height of the table's top [m]."""
        table = self.config.table
        return table.centre[2] + table.half_size[2]

    def reset(
        self,
        joint_position: Float[np.ndarray, "7"],
        objects: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
        gripper_width: float = 2 * FINGER_STROKE,
    ) -> None:
        """Put everything at rest at time zero.

        Args:
            joint_position: Joints of the arm [rad].
            objects: Poses of objects in the base frame; those not named keep their initial one.
            gripper_width: Opening of the gripper [m].

        Raises:
            KeyError: If there is no object of a given name.
        """
        mujoco.mj_resetData(self.model, self.data)
        self.arm.place(joint_position, gripper_width)
        for name, pose in (objects or {}).items():
            joint = self.data.joint(name)
            joint.qpos[:3] = pose[:3, 3]
            mujoco.mju_mat2Quat(joint.qpos[3:7], np.ascontiguousarray(pose[:3, :3]).ravel())
        mujoco.mj_forward(self.model, self.data)
        for monitor in self._monitors:
            monitor.clear()

    def advance(self, duration: float) -> None:
        """Run the physics for a while, the arm following its last command [s]."""
        for _ in range(max(1, round(duration / self.model.opt.timestep))):
            self.arm.drive()
            mujoco.mj_step(self.model, self.data)
            for monitor in self._monitors:
                monitor.update(self.data)
        # A step leaves the poses of bodies as they were before it: bring them up to date.
        mujoco.mj_kinematics(self.model, self.data)

    def hold(self, name: str, joint_position: Float[np.ndarray, "7"]) -> None:
        """Reset with an object between the fingers, the grip settled.

        Args:
            name: The object.
            joint_position: Joints of the arm [rad].
        """
        width = 2 * self._object(name).half_size[0]
        self.reset(joint_position, gripper_width=width + 0.002)
        tcp = self.arm.tcp_pose()
        # The object's x lies along the fingers' line of closing, its top towards the gripper.
        in_hand = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
        self.reset(joint_position, {name: tcp @ in_hand}, gripper_width=width + 0.002)
        self.arm.move(0.0)
        self.advance(0.5)
        self.data.time = 0.0

    def move_obstacle(
        self, name: str, centre: tuple[float, float, float] | Float[np.ndarray, "3"]
    ) -> None:
        """Put an obstacle, or the occluder, somewhere at once; `NOWHERE` takes it away.

        Args:
            name: Of the obstacle.
            centre: In the base frame [m].
        """
        self.data.mocap_pos[self.model.body(name).mocapid[0]] = centre
        mujoco.mj_kinematics(self.model, self.data)

    def _object(self, name: str):
        for item in self.config.objects:
            if item.name == name:
                return item
        known = ", ".join(item.name for item in self.config.objects)
        raise KeyError(f"no object named {name!r}; there are: {known}")

    def object_pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object's centre in the base frame."""
        self._object(name)
        return _pose(self.data.body(name))

    def holds(self, name: str) -> bool:
        """Whether both finger pads touch an object."""
        touching = set()
        target = self.model.geom(name).id
        for geoms in self.data.contact.geom[self.data.contact.dist < 1e-4]:
            if target in geoms:
                touching.update(self.model.geom(int(g)).name for g in geoms)
        return {"finger_left_pad", "finger_right_pad"} <= touching

    def rests_on(self, name: str, board: str) -> bool:
        """Whether an object touches a piece of furniture and nothing of the arm."""
        target, support = self.model.geom(name).id, self.model.geom(board).id
        partners = set()
        for geoms in self.data.contact.geom[self.data.contact.dist < 1e-4]:
            if target in geoms:
                partners.update(int(g) for g in geoms)
        furniture = {self.model.geom(box.name).id for box in self.config.boxes()}
        return support in partners and partners <= furniture | {target}

    def marker_poses(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Pose of every marker's face in the base frame, by ArUco number."""
        poses = {
            item.marker.id: _pose(self.data.site(f"{item.name}_marker"))
            for item in self.config.objects
        }
        if self.config.arm.marker is not None:
            poses[HAND_MARKER] = _pose(self.data.site("hand_marker"))
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
        self, path: Float[np.ndarray, "steps 7"], carried: str | None = None
    ) -> list[Touch]:
        """Touches of arm and cabinet, table or itself along a path of joint positions.

        Purely geometric: nothing is simulated and the world stays as it is. Times in the
        touches are sample numbers.

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
        boxes = [box.name for box in (*self.config.boxes(), *self.config.obstacles)]
        movers = _ARM_BODIES if carried is None else (*_ARM_BODIES, carried)
        monitors = [
            ContactMonitor(self.model, movers, boxes),
            ContactMonitor(self.model, _ARM_BODIES, _ARM_BODIES),
        ]
        for k, q in enumerate(path):
            data.qpos[self.arm.joints] = q
            mujoco.mj_kinematics(self.model, data)
            if in_hand is not None:
                pose = self.arm.tcp_pose(data) @ in_hand
                joint = data.joint(carried)
                joint.qpos[:3] = pose[:3, 3]
                mujoco.mju_mat2Quat(joint.qpos[3:7], np.ascontiguousarray(pose[:3, :3]).ravel())
                mujoco.mj_kinematics(self.model, data)
            mujoco.mj_collision(self.model, data)
            data.time = float(k)
            for monitor in monitors:
                monitor.update(data)
        return [touch for monitor in monitors for touch in monitor.touches]


class MujocoArm:
    """The simulated Panda as an `Arm` and a `Gripper`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        imperfections: DrawnImperfections | None = None,
    ):
        self._errors = imperfections or Imperfections().draw(np.random.default_rng(0))
        self._channel = CommandChannel(self._errors, panda.limits.acceleration.numpy())
        self._model = model
        self._data = data
        names = panda.joint_names
        self.joints = np.array([model.joint(n).qposadr[0] for n in names])
        self._velocities = np.array([model.joint(n).dofadr[0] for n in names])
        self._position_servos = np.array([model.actuator(f"{n}_position").id for n in names])
        self._velocity_servos = np.array([model.actuator(f"{n}_velocity").id for n in names])
        fingers = ("finger_left", "finger_right")
        self._fingers = np.array([model.joint(n).qposadr[0] for n in fingers])
        self._finger_servos = np.array([model.actuator(n).id for n in fingers])
        self._reference = np.zeros(len(names))
        # Position errors [rad] from which on the servos pull no harder.
        strongest = model.actuator_forcerange[self._position_servos, 1]
        self._reach = strongest / model.actuator_gainprm[self._position_servos, 0]

    def read(self) -> ArmState:
        """Return the present state, as the arm's own sensors have it."""
        return ArmState(
            time=self._data.time,
            joint_position=self._errors.encoders(self._data.qpos[self.joints]),
            joint_velocity=self._data.qvel[self._velocities].copy(),
            gripper_width=float(self._data.qpos[self._fingers].sum()),
            external_torque=self._errors.torques(self._data.qfrc_constraint[self._velocities]),
        )

    def command(self, joint_velocity: Float[np.ndarray, "7"]) -> None:
        """Set the joint velocities to hold from now on [rad/s]."""
        if not np.isfinite(joint_velocity).all():
            raise ValueError(f"joint_velocity must be finite, but is {joint_velocity}.")
        self._channel.send(self._data.time, joint_velocity)

    def move(self, width: float) -> None:
        """Open or close the gripper to a width [m]; 0 squeezes what is between the fingers."""
        self._data.ctrl[self._finger_servos] = np.clip(width / 2, 0.0, FINGER_STROKE)

    def place(self, joint_position: Float[np.ndarray, "7"], gripper_width: float) -> None:
        """Set the joints at once, at rest. For resets, not for control."""
        self._reference = np.array(joint_position, dtype=float)
        self._channel.rest()
        self._data.qpos[self.joints] = self._reference
        self._data.qvel[self._velocities] = 0.0
        self._data.qpos[self._fingers] = gripper_width / 2
        self.move(gripper_width)
        self.drive()

    def drive(self) -> None:
        """Advance the servos' reference by one physics step.

        It waits for joints that are held up by a contact: what they missed is not made up for
        once they come free.
        """
        q = self._data.qpos[self.joints]
        dt = self._model.opt.timestep
        velocity = self._channel.advance(self._data.time, dt)
        self._reference = np.clip(
            self._reference + velocity * dt, q - self._reach, q + self._reach
        )
        self._data.ctrl[self._position_servos] = self._reference
        self._data.ctrl[self._velocity_servos] = velocity

    def tcp_pose(self, data: mujoco.MjData | None = None) -> Float[np.ndarray, "4 4"]:
        """True pose of the tool centre point in the base frame."""
        return _pose((data or self._data).site("tcp"))


def _pose(thing) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3] = thing.xmat.reshape(3, 3)
    pose[:3, 3] = thing.xpos
    return pose
