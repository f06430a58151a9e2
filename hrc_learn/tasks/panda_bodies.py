"""The Panda as bodies to be drawn, along joint positions."""

from collections import defaultdict

import numpy as np
import torch
from jaxtyping import Float

from ..kinematics import panda, panda_capsules
from ..viz import Body, Capsule
from ..viz.panda_meshes import panda_mesh


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
    for capsule in panda_capsules.capsules:
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
            mesh=panda_mesh(names[link]),
        )
        for link, capsules in shapes.items()
    )
