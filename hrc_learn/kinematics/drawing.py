"""Drawing of arms: meshes of each link, and bodies along recorded joint positions."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Body, MeshFile, Pose, quaternion
from hrc_learn.kinematics.arm import TCP_OFFSET, Arm, FingerJoint
from hrc_learn.kinematics.collision import LinkCapsule

_MESHES = "cmeel.prefix/share/example-robot-data/robots/panda_description/meshes/visual"
_PARTS = {
    **{f"link{i}": {"file": f"link{i}"} for i in range(8)},
    "hand": {"file": "hand"},
    "tool": {"file": "hand", "position": (0.0, 0.0, -TCP_OFFSET)},
    "finger_left": {"file": "finger"},
    "finger_right": {"file": "finger", "orientation": (0.0, 0.0, 0.0, 1.0)},
}
# `_FRANKA_STROKE`: travel of each finger of the Franka hand [m]. `_FRANKA_GUIDE`: distance of
# the fingers from the origin of the hand, along z [m]. Both are from franka_description.
_FRANKA_STROKE, _FRANKA_GUIDE = 0.04, 0.0584


def panda_meshes(body: str) -> tuple[MeshFile, ...]:
    """Meshes of a link, the hand or a finger of the Panda; empty without the extra `meshes`.

    Args:
        body: link0 to link7, hand, finger_left or finger_right; tool is the hand in the frame
            of the tool centre point. Other names have no meshes.
    """
    folder = _mesh_folder()
    if folder is None or body not in _PARTS:
        return ()
    place: dict[str, Any] = dict(_PARTS[body])
    return (MeshFile(path=folder / f"{place.pop('file')}.dae", **place),)


@cache
def _mesh_folder() -> Path | None:
    try:
        folder = Path(str(distribution("example-robot-data").locate_file(_MESHES)))
    except PackageNotFoundError:
        return None
    return folder if folder.is_dir() else None


def arm_meshes(robot: Arm, body: str) -> tuple[MeshFile, ...]:
    """Meshes of a link, the gripper or a finger of an arm; empty if unknown.

    Franka's arms have the same meshes, and all arms of the work cell carry the same gripper.

    Args:
        robot: The arm.
        body: link0, link1, ..., hand, finger_left or finger_right.
    """
    if body in ("hand", "finger_left", "finger_right"):
        size = (robot.hand_size,) * 3
        return tuple(replace(mesh, scale=size) for mesh in panda_meshes(body))
    if robot.is_franka:
        return panda_meshes(body)
    return tuple(robot.shape.meshes.get(body, ()))


def arm_bodies(
    robot: Arm,
    joint_position: Float[np.ndarray, "time joints"],
    opening: Float[np.ndarray, " time"] | None = None,
) -> tuple[Body, ...]:
    """Links, hand and fingers of an arm along a motion: meshes, or capsules without meshes.

    Args:
        robot: The arm.
        joint_position: Joint positions along the motion [rad].
        opening: Opening of the gripper, 0 (closed) to 1; None draws it open.
    """
    poses = robot.link_poses(joint_position)
    meshes = {f"link{i}": arm_meshes(robot, f"link{i}") for i in range(robot.joints + 1)}
    meshes["tool"] = panda_meshes("tool") if robot.is_franka else robot.shape.hand
    # Capsules of an arm from a file are fitted on first use, which takes seconds.
    capsules = () if any(meshes.values()) and not robot.is_franka else robot.whole.capsules
    still = Pose(torch.zeros(3).double(), torch.tensor([1.0, 0, 0, 0]).double())
    bodies = []
    for link, frame in enumerate([*meshes][:-1]):
        place = poses[:, link - 1] if link else still
        bodies.append(_body(frame, place, len(joint_position), meshes[frame], capsules, link))
    tool = poses[:, robot.joints + 1]
    bodies.append(
        _body("tool", tool, len(tool.position), meshes["tool"], capsules, robot.joints + 2)
    )
    opening = np.ones(len(joint_position)) if opening is None else opening.clip(0, 1)
    bodies += (
        _franka_fingers(tool, opening) if robot.is_franka else _fingers(robot, tool, opening)
    )
    return tuple(body for body in bodies if body.meshes or body.capsules)


def _body(
    name: str,
    pose: Pose,
    count: int,
    meshes: tuple[MeshFile, ...],
    capsules: tuple[LinkCapsule, ...] = (),
    link: int = -1,
) -> Body:
    return Body(
        name=name,
        position=pose.position.expand(count, 3).numpy(),
        orientation=pose.orientation.expand(count, 4).numpy(),
        capsules=tuple(c for c in capsules if c.link == link),
        meshes=meshes,
    )


def _franka_fingers(tool: Pose, opening: Float[np.ndarray, " time"]) -> Iterator[Body]:
    for side, sign in (("left", 1.0), ("right", -1.0)):
        way = torch.zeros(len(opening), 3, dtype=torch.float64)
        way[:, 1] = torch.from_numpy(sign * _FRANKA_STROKE * opening)
        way[:, 2] = _FRANKA_GUIDE - TCP_OFFSET
        place = Pose(tool.apply(way), tool.orientation)
        name = f"finger_{side}"
        yield _body(name, place, len(opening), panda_meshes(name))


def _fingers(robot: Arm, tool: Pose, opening: Float[np.ndarray, " time"]) -> Iterator[Body]:
    """Fingers of a gripper from a description; coupled fingers move with their leaders."""
    fingers = {finger.name: finger for finger in robot.shape.gripper}
    places: dict[str, Pose] = {}
    for finger in robot.shape.gripper:  # carriers come before what they carry
        carrier = tool if finger.carrier is None else places[finger.carrier]
        moved = _moved(finger, torch.from_numpy(_positions(finger, fingers, opening)))
        places[finger.name] = carrier @ Pose.from_matrix(finger.mount) @ moved
        yield _body(f"finger_{finger.name}", places[finger.name], len(opening), finger.meshes)


def _positions(
    finger: FingerJoint, fingers: dict[str, FingerJoint], opening: Float[np.ndarray, " time"]
) -> Float[np.ndarray, " time"]:
    """Positions of a finger's joint [rad, m]."""
    if finger.follows is not None and (leader := fingers.get(finger.follows[0])):
        _, factor, offset = finger.follows
        return factor * _positions(leader, fingers, opening) + offset
    return finger.closed + opening * (finger.opened - finger.closed)


def _moved(finger: FingerJoint, value: torch.Tensor) -> Pose:
    """Motion of a finger about or along its axis."""
    axis = torch.tensor(finger.axis, dtype=torch.float64)
    still = torch.zeros(len(value), 3, dtype=torch.float64)
    if finger.kind == "prismatic":
        return Pose(value[:, None] * axis, quaternion.exp(still))
    return Pose(still, quaternion.exp(value[:, None] * axis))
