"""The Panda as a MuJoCo model: our kinematics, primitive geoms, two actuators a joint.

Body frames come from `hrc_learn.kinematics.panda`, so that simulator and controller share
one table of numbers. Capsules and boxes follow the published link shapes to about a
centimetre: they render ten times faster than meshes without a GPU and give clean contacts.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import LINK_CAPSULES, panda
from hrc_learn.sim.marker_plates import Plate, add_plate

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
_BOX = mujoco.mjtGeom.mjGEOM_BOX

_HIDDEN = 4  # sites of this group are not drawn
_WHITE = (0.92, 0.93, 0.95, 1.0)
_GREY = (0.35, 0.37, 0.40, 1.0)

FINGER_STROKE = 0.04
"""Travel of one finger [m]; the gripper opens to twice this."""


@dataclass(frozen=True, kw_only=True)
class PandaModelConfig:
    """How the arm is built and driven."""

    stiffness: tuple[float, ...] = (2e4, 2e4, 1.5e4, 1.5e4, 6e3, 6e3, 4e3)
    """Position gain of the joint servos [N m/rad]."""
    damping: tuple[float, ...] = (600.0, 600.0, 450.0, 450.0, 150.0, 150.0, 80.0)
    """Velocity gain of the joint servos [N m s/rad]."""
    grip_force: float = 40.0
    """Largest force of a finger [N] (the end effector's continuous rating is 70 N)."""
    marker: Plate | None = None
    """ArUco plate on the end effector, in the gripper's frame."""


# Masses of links 1 to 7 [kg], from franka_description.
_MASSES = (4.97, 0.65, 3.23, 3.59, 1.23, 1.67, 0.74)

# Neighbours whose primitives overlap by design (a static parent is not filtered by MuJoCo).
_OVERLAPPING = (
    ("link0", "link1"),
    ("link0", "link2"),
    ("link1", "link3"),
    ("link3", "link5"),
    ("link5", "link7"),
    ("link6", "hand"),
    ("link7", "hand"),
    ("finger_left", "finger_right"),
)


def add_panda(spec: mujoco.MjSpec, config: PandaModelConfig) -> None:
    """Add the arm, its hand and its servos to a model, with the base at the world's origin.

    Joints are named as in `panda.joint_names`, fingers `finger_left` and `finger_right`.
    """
    base = spec.worldbody.add_body(name="link0")
    _add_capsules(base, 0, mass=None)
    frames = panda.link_poses(torch.zeros(7, dtype=torch.float64)).matrix().numpy()
    body = base
    parent_frame = np.eye(4)
    for i, name in enumerate(panda.joint_names):
        body = _add_body(body, f"link{i + 1}", np.linalg.inv(parent_frame) @ frames[i])
        parent_frame = frames[i]
        _add_joint(spec, body, name, i, config)
        _add_capsules(body, i + 1, mass=_MASSES[i])
    # The end effector's frame: at the flange, turned as the tool.
    flange, tool = frames[7], frames[8]
    hand_frame = np.linalg.inv(parent_frame) @ tool
    hand_frame[:3, 3] = (np.linalg.inv(parent_frame) @ flange)[:3, 3]
    hand = _add_body(body, "hand", hand_frame)
    hand.add_site(
        name="tcp", pos=(0, 0, np.linalg.norm(tool[:3, 3] - flange[:3, 3])), group=_HIDDEN
    )
    _add_hand(spec, hand, config)
    for a, b in _OVERLAPPING:
        spec.add_exclude(bodyname1=a, bodyname2=b)


def _add_body(parent, name: str, transform: np.ndarray):
    orientation = quaternion.from_matrix(torch.from_numpy(transform[:3, :3].copy())).numpy()
    body = parent.add_body(name=name, pos=transform[:3, 3], quat=orientation)
    body.gravcomp = 1.0  # the real arm compensates its own weight
    return body


def _add_capsules(body, link: int, mass: float | None) -> None:
    capsules = [capsule for capsule in LINK_CAPSULES if capsule.link == link]
    for k, capsule in enumerate(capsules):
        geom = body.add_geom(
            name=f"link{link}_{k}" if mass else f"link{link}",
            type=_CAPSULE,
            fromto=(*capsule.start, *capsule.end),
            size=(capsule.radius, 0, 0),
            rgba=_WHITE,
        )
        if mass is not None:
            geom.mass = mass / len(capsules)


def _add_joint(spec: mujoco.MjSpec, body, name: str, i: int, config: PandaModelConfig) -> None:
    limits = panda.limits
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, 0, 1),
        range=(float(limits.lower[i]), float(limits.upper[i])),
        armature=0.1,
    )
    torque = float(limits.torque[i])
    # Position and velocity servo together follow a moving reference without lag, as the
    # arm's own velocity interface does.
    position = spec.add_actuator(name=f"{name}_position", target=name)
    position.trntype = mujoco.mjtTrn.mjTRN_JOINT
    position.set_to_position(kp=config.stiffness[i])
    velocity = spec.add_actuator(name=f"{name}_velocity", target=name)
    velocity.trntype = mujoco.mjtTrn.mjTRN_JOINT
    velocity.set_to_velocity(kv=config.damping[i])
    for actuator in (position, velocity):
        actuator.forcelimited = True
        actuator.forcerange = (-torque, torque)


def _add_hand(spec: mujoco.MjSpec, hand, config: PandaModelConfig) -> None:
    hand.add_geom(
        name="hand",
        type=_BOX,
        pos=(0, 0, 0.033),
        size=(0.03, 0.1, 0.033),
        mass=0.73,
        rgba=_GREY,
    )
    if config.marker is not None:
        add_plate(spec, hand, "hand_marker", config.marker)
    for name, side in (("finger_left", 1.0), ("finger_right", -1.0)):
        finger = hand.add_body(name=name, pos=(0, 0, 0.0584))
        finger.gravcomp = 1.0
        finger.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(0, side, 0),
            range=(0, FINGER_STROKE),
            armature=0.1,
            damping=5.0,
        )
        finger.add_geom(
            name=name,
            type=_BOX,
            pos=(0, side * 0.012, 0.018),
            size=(0.009, 0.008, 0.016),
            mass=0.01,
            rgba=_GREY,
        )
        finger.add_geom(
            name=f"{name}_pad",
            type=_BOX,
            pos=(0, side * 0.004, 0.045),
            size=(0.010, 0.004, 0.012),
            mass=0.005,
            # Torsional friction keeps a held box from turning about the pads' axis.
            friction=(1.5, 0.02, 0.001),
            condim=4,
            solref=(0.004, 1.0),
            solimp=(0.97, 0.99, 0.0005, 0.5, 2),
            rgba=(0.1, 0.1, 0.1, 1.0),
        )
        servo = spec.add_actuator(name=name, target=name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=2000.0, kv=60.0)
        servo.forcelimited = True
        servo.forcerange = (-config.grip_force, config.grip_force)
    # One motor drives both fingers of the real hand.
    coupling = spec.add_equality(name="fingers", name1="finger_left", name2="finger_right")
    coupling.type = mujoco.mjtEq.mjEQ_JOINT
    coupling.objtype = mujoco.mjtObj.mjOBJ_JOINT
    coupling.data[:5] = (0.0, 1.0, 0.0, 0.0, 0.0)
