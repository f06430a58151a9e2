"""The Panda as bodies to be drawn: real meshes where a package ships them, else capsules."""

from collections import defaultdict
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Body, Capsule, MeshFile
from hrc_learn.kinematics import Arm, panda

# Meshes of the Panda, where the package that ships them is installed (extra `meshes`).

_FOLDER = "cmeel.prefix/share/example-robot-data/robots/panda_description/meshes/visual"
_TCP = 0.1034  # from the hand's frame along z [m]
_PARTS = {
    **{f"link{i}": {"file": f"link{i}"} for i in range(8)},
    "hand": {"file": "hand"},
    "tool": {"file": "hand", "position": (0.0, 0.0, -_TCP)},
    "finger_left": {"file": "finger"},
    "finger_right": {"file": "finger", "orientation": (0.0, 0.0, 0.0, 1.0)},
}


def panda_meshes(body: str) -> tuple[MeshFile, ...]:
    """Meshes of a link, the hand or a finger of the Panda.

    Args:
        body: link0 to link7, hand, finger_left or finger_right; tool is the hand in the frame
            of the tool centre point.

    Returns:
        None for any other body, and where there are no meshes.
    """
    folder = _folder()
    if folder is None or body not in _PARTS:
        return ()
    place: dict[str, Any] = dict(_PARTS[body])
    return (MeshFile(path=folder / f"{place.pop('file')}.dae", **place),)


_HAND = ("hand", "finger_left", "finger_right")


def arm_meshes(robot: Arm, body: str) -> tuple[MeshFile, ...]:
    """Meshes of a link, the gripper or a finger of an arm; empty if unknown.

    Franka's arms share their meshes, and all arms of the work cell carry the same gripper.

    Args:
        robot: The arm.
        body: link0, link1, ..., hand, finger_left or finger_right.
    """
    if robot.is_franka or body in _HAND:
        return panda_meshes(body)
    return tuple(robot.meshes.get(body, ()))


@cache
def _folder() -> Path | None:
    try:
        folder = Path(str(distribution("example-robot-data").locate_file(_FOLDER)))
    except PackageNotFoundError:
        return None
    return folder if folder.is_dir() else None


# The Panda as bodies to be drawn, along joint positions.


def panda_bodies(joint_position: Float[np.ndarray, "time 7"]) -> tuple[Body, ...]:
    """Base, links and hand as the capsules that stand for them in planning.

    Args:
        joint_position: [rad].
    """
    poses = panda.link_poses(torch.from_numpy(joint_position))
    position, orientation = poses.position.numpy(), poses.orientation.numpy()
    # The base, which moves with no joint, comes first.
    position = np.concatenate([np.zeros_like(position[:, :1]), position], axis=1)
    upright = np.zeros_like(orientation[:, :1])
    upright[..., 0] = 1.0
    orientation = np.concatenate([upright, orientation], axis=1)
    shapes = defaultdict(list)
    for capsule in panda.whole.capsules:
        shapes[capsule.link].append(
            Capsule(start=capsule.start, end=capsule.end, radius=capsule.radius)
        )
    last = position.shape[1] - 1
    names = {link: "tool" if link == last else f"link{link}" for link in shapes}
    return tuple(
        Body(
            name=names[link],
            position=position[:, link],
            orientation=orientation[:, link],
            capsules=tuple(capsules),
            meshes=panda_meshes(names[link]),
        )
        for link, capsules in shapes.items()
    )
