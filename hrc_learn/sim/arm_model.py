"""An arm in MuJoCo: model, gripper, marker plate and driver.

Body frames come from the arm's own chain, so that simulator and controller use the same
numbers. Capsules and boxes approximate the shapes of the links within a few centimetres: they
are faster to simulate than meshes and make clean contacts.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Capsule, quaternion
from hrc_learn.kinematics import Arm, CapsuleArm, LinkCapsule
from hrc_learn.protocols import ArmState
from hrc_learn.sim.imperfections import CommandChannel, DrawnImperfections
from hrc_learn.vision import Marker, marker_texture

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


_SHORTEST = 1e-6  # capsules with a shorter axis are modelled as spheres [m]

_HIDDEN = 4  # sites of this group are not drawn
_WHITE = (0.92, 0.93, 0.95, 1.0)
_GREY = (0.35, 0.37, 0.40, 1.0)

FIRM = {"condim": 4, "solref": (0.004, 1.0), "solimp": (0.97, 0.99, 0.0005, 0.5, 2)}
"""Contact settings for grasps: torsional friction, and a fifth of MuJoCo's default time
constant.
"""

FINGER_STROKE = 0.04
"""Travel of one finger [m]; the gripper opens to twice this width."""


_THICKNESS = 0.002  # thickness of a marker plate [m]
_TEXELS = 400  # texels along a plate's edge: a whole number for each of the 8 modules


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A square plate that carries one marker, facing +z of its own frame."""

    marker: Marker
    """Marker and the edge length of its black square [m]."""
    position: tuple[float, float, float]
    """Centre of the plate's face in the frame of the body that carries it [m]."""
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the plate's frame (wxyz): x along the marker's top edge, y up its side."""
    solid: bool = True
    """True if the plate collides with objects; a sticker on a box does not."""
    printed: bool = True
    """False: the plate is left out, but its frame stays as ground truth for measurements."""


def add_plate(spec: mujoco.MjSpec, body, name: str, plate: Plate) -> None:
    """Add a plate to a body: geom `name` (picture), site `name` (frame of the marker)."""
    half = plate.marker.plate_size / 2
    pose = {"pos": plate.position, "quat": plate.orientation}
    body.add_site(name=name, group=4, **pose)  # groups above 2 are not drawn
    if not plate.printed:
        return
    add_picture(
        spec, name, np.repeat(marker_texture(plate.marker.id, _TEXELS)[..., None], 3, 2)
    )
    mesh = spec.add_mesh(name=name)
    mesh.uservert = [-half, -half, 0, half, -half, 0, half, half, 0, -half, half, 0]
    mesh.userface = mesh.userfacetexcoord = [0, 1, 2, 0, 2, 3]
    mesh.usertexcoord = [0, 1, 1, 1, 1, 0, 0, 0]
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
        mass=0.0,
        **pose,
    )
    if plate.solid:
        normal = np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), np.array(plate.orientation))
        add_box(
            body,
            f"{name}_plate",
            (half, half, _THICKNESS / 2),
            (0.9, 0.9, 0.9, 1.0),
            # The box lies just below the picture: in the same plane, both would flicker.
            pos=np.array(plate.position) - 0.75 * _THICKNESS * normal,
            quat=plate.orientation,
            mass=0.02,
        )


def add_box(body, name: str, half_size, colour, **more):
    """Add a box to a body, by half edges [m] and colour (RGBA)."""
    return body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half_size, rgba=colour, **more
    )


def add_capsule(body, name: str, capsule: Capsule, colour):
    """Add a capsule to a body, or a sphere if the length is zero: MuJoCo refuses such
    capsules.
    """
    is_ball = math.dist(capsule.start, capsule.end) < _SHORTEST
    along = {"pos": capsule.start} if is_ball else {"fromto": (*capsule.start, *capsule.end)}
    kind = mujoco.mjtGeom.mjGEOM_SPHERE if is_ball else mujoco.mjtGeom.mjGEOM_CAPSULE
    return body.add_geom(
        name=name, type=kind, size=(capsule.radius, 0, 0), rgba=colour, **along
    )


def add_picture(spec: mujoco.MjSpec, name: str, pixels: np.ndarray) -> None:
    """Add a material that shows an RGB picture."""
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=pixels.shape[1],
        height=pixels.shape[0],
        nchannel=3,
    )
    texture.data = pixels.tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


@dataclass(frozen=True, kw_only=True)
class ArmModelConfig:
    """Construction of the simulated arm."""

    robot: Arm
    """Kinematics, limits and shape of the arm."""
    grip_force: float = 40.0
    """Largest force of a finger [N] (the end effector's continuous rating is 70 N)."""
    marker: Plate | None = None
    """ArUco plate on the end effector, in the gripper's frame."""

    def servo(self, joint: int) -> tuple[float, float]:
        """Position gain [N m/rad] and velocity gain [N m s/rad] of a joint, counted from 0."""
        if self.robot.name in _SERVOS:
            stiffness, damping = _SERVOS[self.robot.name]
            return stiffness[joint], damping[joint]
        stiffness = _STIFFNESS * self.torque(joint)
        return stiffness, _DAMPING * stiffness

    def torque(self, joint: int) -> float:
        """Largest torque of a joint [N m]; 50 if the description states none."""
        torque = float(self.robot.limits.torque[joint])
        return torque if math.isfinite(torque) else 50.0

    def armature(self, joint: int) -> float:
        """Inertia of the motor and its gear, at the joint [kg m^2]."""
        torque = self.torque(joint)
        # Small motors have lighter rotors; at 50 N m and above, the Panda's inertia is assumed.
        return 0.1 * min(1.0, torque / 50.0) if self.robot.name not in _SERVOS else 0.1


_SERVOS = dict.fromkeys(
    ("panda", "fr3"),
    ((2e4, 2e4, 1.5e4, 1.5e4, 6e3, 6e3, 4e3), (600.0, 600.0, 450.0, 450.0, 150.0, 150.0, 80.0)),
)
"""Position gains [N m/rad] and velocity gains [N m s/rad] of the joints of Franka's arms."""
_STIFFNESS, _DAMPING = 230.0, 0.03
"""Servo gains of other arms, scaled from the Panda's strongest joint: stiffness per torque
[1/rad] and damping per stiffness [s].
"""
_HAND = "hand"


def add_arm(spec: mujoco.MjSpec, config: ArmModelConfig) -> None:
    """Add the arm, its hand and its servos to a model, with the base at the world's origin.

    Bodies of links are named link0, link1, ...; joints have the names of the chain; fingers
    are named `finger_left` and `finger_right`.
    """
    robot, n = config.robot, config.robot.joints
    base = spec.worldbody.add_body(name="link0")
    _add_capsules(base, robot, 0, mass=None)
    still = torch.zeros(n, dtype=torch.float64)
    frames = robot.link_poses(still).matrix().numpy()
    body = base
    parent_frame = np.eye(4)
    for i, name in enumerate(robot.joint_names):
        body = _add_body(body, f"link{i + 1}", np.linalg.inv(parent_frame) @ frames[i])
        parent_frame = frames[i]
        _add_joint(spec, body, name, i, config)
        _add_capsules(body, robot, i + 1, mass=robot.masses[i + 1])
    # The hand's frame has its origin at the flange and the orientation of the tool.
    flange, tool = frames[n], frames[n + 1]
    hand_frame = np.linalg.inv(parent_frame) @ tool
    hand_frame[:3, 3] = (np.linalg.inv(parent_frame) @ flange)[:3, 3]
    hand = _add_body(body, _HAND, hand_frame)
    hand.add_site(
        name="tcp", pos=(0, 0, np.linalg.norm(tool[:3, 3] - flange[:3, 3])), group=_HIDDEN
    )
    _add_hand(spec, hand, config)
    names = {link: f"link{link}" for link in range(n + 1)} | {n + 2: _HAND}
    # MuJoCo ignores contacts between neighbouring bodies, except with a static parent such as
    # link0.
    for a, b in ((0, 1), *robot.whole.overlapping):
        if a in names and b in names:
            spec.add_exclude(bodyname1=names[a], bodyname2=names[b])
        if a == 0 and b in names:
            # The pedestal continues the base: links that overlap the base may touch it.
            spec.add_exclude(bodyname1="world", bodyname2=names[b])
    spec.add_exclude(bodyname1="finger_left", bodyname2="finger_right")


# Number of parallel capsules that cover a plate. They protrude by a sixth of the plate's edge.
_STRIPS = 3


def whole_arm(config: ArmModelConfig) -> CapsuleArm:
    """Capsules that contain the whole simulated arm: links, hand, fingers and plate.

    The fingers are within the hand's capsules at any opening. Geoms of the simulator protrude
    from the capsules by 0.1 mm at most. Conversely, capsules extend beyond the hand by up to
    30 mm, beyond closed fingers by up to 43 mm and beyond the plate by 11 mm.
    """
    plate, robot = config.marker, config.robot
    if plate is None or not plate.printed:
        return robot.whole
    R = quaternion.to_matrix(torch.tensor(plate.orientation, dtype=torch.float64)).numpy()
    half = plate.marker.plate_size / 2
    across = half / _STRIPS
    radius = float(np.hypot(across, _THICKNESS))
    # Transform from the gripper's frame, at the flange, to the frame of the tool.
    centre = np.array(plate.position) - [0.0, 0.0, float(robot.tcp[:3, 3].norm())]
    capsules = []
    for k in range(_STRIPS):
        x = -half + (2 * k + 1) * across
        start, end = (tuple((centre + R @ [x, y, -_THICKNESS]).tolist()) for y in (-half, half))
        capsules.append(LinkCapsule(link=robot.joints + 2, start=start, end=end, radius=radius))
    return robot.whole.with_capsules(capsules)


def _add_body(parent, name: str, transform: np.ndarray):
    orientation = quaternion.from_matrix(torch.from_numpy(transform[:3, :3].copy())).numpy()
    body = parent.add_body(name=name, pos=transform[:3, 3], quat=orientation)
    body.gravcomp = 1.0  # the real arm compensates its own weight
    return body


def _add_capsules(body, robot: Arm, link: int, mass: float | None) -> None:
    capsules = [capsule for capsule in robot.body.capsules if capsule.link == link]
    if not capsules and mass is not None:
        # A link without a shape keeps its mass, in a sphere of 4 cm radius without contacts.
        body.add_geom(
            name=f"link{link}_0",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(0.04, 0, 0),
            mass=mass,
            contype=0,
            conaffinity=0,
            group=_HIDDEN,
        )
    for k, capsule in enumerate(capsules):
        geom = add_capsule(
            body, f"link{link}_{k}" if mass or k else f"link{link}", capsule, _WHITE
        )
        if mass is not None:
            geom.mass = mass / len(capsules)


def _add_joint(spec: mujoco.MjSpec, body, name: str, i: int, config: ArmModelConfig) -> None:
    chain, limits = config.robot, config.robot.limits
    slides = chain.kinds[i] == "prismatic"
    stiffness, damping = config.servo(i)
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, 0, 1),
        range=(float(limits.lower[i]), float(limits.upper[i])),
        armature=config.armature(i),
    )
    torque = config.torque(i)
    # Position and velocity servo together follow a moving reference without lag, as the
    # arm's own velocity interface does.
    position = _add_servo(spec, f"{name}_position", name, torque)
    position.set_to_position(kp=stiffness)
    velocity = _add_servo(spec, f"{name}_velocity", name, torque)
    velocity.set_to_velocity(kv=damping)


def _add_servo(spec: mujoco.MjSpec, name: str, joint: str, strongest: float):
    """An actuator of a joint, with a bound on its torque [N m] or force [N]."""
    servo = spec.add_actuator(name=name, target=joint)
    servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
    servo.forcelimited = True
    servo.forcerange = (-strongest, strongest)
    return servo


def _add_hand(spec: mujoco.MjSpec, hand, config: ArmModelConfig) -> None:
    size = config.robot.hand_size

    def scaled(*lengths: float) -> tuple[float, ...]:
        return tuple(size * length for length in lengths)

    add_box(
        hand,
        _HAND,
        scaled(0.03, 0.1, 0.033),
        _GREY,
        pos=scaled(0.0, 0.0, 0.033),
        mass=0.73 * size**3,
    )
    if config.marker is not None:
        add_plate(spec, hand, "hand_marker", config.marker)
    for name, side in (("finger_left", 1.0), ("finger_right", -1.0)):
        finger = hand.add_body(name=name, pos=scaled(0.0, 0.0, 0.0584))
        finger.gravcomp = 1.0
        finger.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(0, side, 0),
            range=(0, size * FINGER_STROKE),
            armature=0.1,
            damping=5.0,
        )
        place = scaled(0.0, side * 0.012, 0.018)
        add_box(finger, name, scaled(0.009, 0.008, 0.016), _GREY, pos=place, mass=0.01)
        add_box(
            finger,
            f"{name}_pad",
            scaled(0.010, 0.004, 0.012),
            (0.1, 0.1, 0.1, 1.0),
            pos=scaled(0.0, side * 0.004, 0.045),
            mass=0.005,
            # Torsional friction keeps a held box from turning about the pads' axis.
            friction=(1.5, 0.02 * size, 0.001 * size),
            **FIRM,
        )
        _add_servo(spec, name, name, size * config.grip_force).set_to_position(
            kp=2000.0, kv=60.0
        )
    # One motor drives both fingers of the real hand.
    coupling = spec.add_equality(name="fingers", name1="finger_left", name2="finger_right")
    coupling.type = mujoco.mjtEq.mjEQ_JOINT
    coupling.objtype = mujoco.mjtObj.mjOBJ_JOINT
    coupling.data[:5] = (0.0, 1.0, 0.0, 0.0, 0.0)


class MujocoArm:
    """A simulated arm that implements the protocols `Arm` and `Gripper`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: Arm,
        imperfections: DrawnImperfections,
    ):
        """Look up the arm's joints and servos in the model.

        Args:
            model: Model with the arm of `add_arm`.
            data: State of the model.
            robot: The arm's kinematics and limits.
            imperfections: Errors of encoders, driver and joints.
        """
        self.robot = robot
        self._errors = imperfections
        self._channel = CommandChannel(self._errors, robot.limits.acceleration.numpy())
        self._model = model
        self._data = data
        names = robot.joint_names
        self.joints = np.array([model.joint(n).qposadr[0] for n in names])
        self._velocities = np.array([model.joint(n).dofadr[0] for n in names])
        self._position_servos = np.array([model.actuator(f"{n}_position").id for n in names])
        self._velocity_servos = np.array([model.actuator(f"{n}_velocity").id for n in names])
        fingers = ("finger_left", "finger_right")
        self._fingers = np.array([model.joint(n).qposadr[0] for n in fingers])
        self._finger_servos = np.array([model.actuator(n).id for n in fingers])
        self._reference = np.zeros(len(names))
        # Uncompensated mass of each of the arm's bodies [kg]: an unknown load, and errors of
        # the link masses that the arm assumes.
        own = model.body_rootid == model.body("link0").id
        self._unknown = np.where(own, model.body_mass * (1.0 - model.body_gravcomp), 0.0)
        # Filtered estimate of the external torques [N m]; None: the filter has no value yet.
        self._felt: np.ndarray | None = None
        # Position errors at which the servos' torques saturate [rad].
        strongest = model.actuator_forcerange[self._position_servos, 1]
        self._reach = strongest / model.actuator_gainprm[self._position_servos, 0]

    def read(self) -> ArmState:
        """Return the present state, as measured by the arm's own sensors."""
        return ArmState(
            time=self._data.time,
            joint_position=self._errors.encoders(self._data.qpos[self.joints]),
            joint_velocity=self._data.qvel[self._velocities].copy(),
            gripper_width=float(self._data.qpos[self._fingers].sum()),
            external_torque=self._errors.torques(
                self._external_torque() if self._felt is None else self._felt
            ),
        )

    def _external_torque(self) -> Float[np.ndarray, " joints"]:
        """External torque as estimated from joint torque sensors [N m].

        The estimate contains contacts, external forces, joint friction (which real arms do not
        model well) and weights that are unknown to the arm.
        """
        data = self._data
        torque = data.qfrc_constraint + data.qfrc_applied
        force = data.xfrc_applied[:, :3] + self._unknown[:, None] * self._model.opt.gravity
        moment = data.xfrc_applied[:, 3:]
        for body in np.flatnonzero(force.any(axis=1) | moment.any(axis=1)):
            at = data.xipos[body]
            mujoco.mj_applyFT(self._model, data, force[body], moment[body], at, body, torque)
        return torque[self._velocities]

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities to hold from now on [rad/s]."""
        if not np.isfinite(joint_velocity).all():
            raise ValueError(f"joint_velocity must be finite, but is {joint_velocity}.")
        self._channel.send(self._data.time, joint_velocity)

    def move(self, width: float) -> None:
        """Open or close the gripper to a width [m]; 0 squeezes what is between the fingers."""
        self._data.ctrl[self._finger_servos] = np.clip(
            width / 2, 0.0, self.robot.hand_size * FINGER_STROKE
        )

    def place(self, joint_position: Float[np.ndarray, " joints"], gripper_width: float) -> None:
        """Put the joints at given positions, at rest; for resets, not for control."""
        self._reference = np.array(joint_position, dtype=float)
        self._channel.rest()
        self._felt = None
        self._data.qpos[self.joints] = self._reference
        self._data.qvel[self._velocities] = 0.0
        stroke = self.robot.hand_size * FINGER_STROKE
        self._data.qpos[self._fingers] = min(gripper_width / 2, stroke)
        self.move(gripper_width)
        self.drive()

    def drive(self) -> None:
        """Advance the servos' reference by one physics step.

        The reference is ahead of each joint by at most the error at which the joint's servo
        saturates. A joint that was blocked by a contact therefore does not catch up on the
        missed motion.
        """
        q = self._data.qpos[self.joints]
        dt = self._model.opt.timestep
        velocity = self._channel.advance(self._data.time, dt)
        reference = self._reference + velocity * dt
        self._reference = np.clip(reference, q - self._reach, q + self._reach)
        self._data.ctrl[self._position_servos] = self._reference
        self._data.ctrl[self._velocity_servos] = velocity
        self._feel(dt)

    def _feel(self, dt: float) -> None:
        """Filter the external torques of the last physics step."""
        lag, torque = self._errors.sizes.torque_lag, self._external_torque()
        fraction = 1.0 if self._felt is None or lag == 0 else -math.expm1(-dt / lag)
        self._felt = (
            torque if self._felt is None else self._felt + fraction * (torque - self._felt)
        )

    @property
    def encoder_offset(self) -> Float[np.ndarray, " joints"]:
        """Encoder offsets, unknown to the controller [rad]."""
        return self._errors.encoder_offset

    @property
    def tool_offset(self) -> Float[np.ndarray, "3"]:
        """Position of the tool centre point in the hand's frame [m]."""
        return self._model.site("tcp").pos.copy()

    def tcp_pose(self, data: mujoco.MjData | None = None) -> Float[np.ndarray, "4 4"]:
        """True pose of the tool centre point in the world frame (the nominal base frame)."""
        return frame_of((data or self._data).site("tcp"))


def frame_of(thing) -> Float[np.ndarray, "4 4"]:
    """Pose of a MuJoCo site or body in the world frame (the nominal base frame)."""
    pose = np.eye(4)
    pose[:3, :3] = thing.xmat.reshape(3, 3)
    pose[:3, 3] = thing.xpos
    return pose
