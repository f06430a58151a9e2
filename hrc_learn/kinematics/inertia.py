"""Mass matrix of an arm, from the masses, centres and inertias of its description.

With the pseudo-inertia P of each body (`description.pseudo_inertia`) and the derivative D_j of
its frame with respect to joint j, the mass matrix is M_jk = sum over bodies of tr(D_j P D_k^T).
"""

from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import Constant
from hrc_learn.kinematics.arm import Arm
from hrc_learn.kinematics.description import pseudo_inertia


@final
class MassMatrix:
    """Mass matrix of an arm with its gripper and a held load.

    If the description gives no inertia of a body, the body's mass is spread evenly over the
    axes of its capsules.
    """

    def __init__(self, arm: Arm, rotor_inertia: float = 0.0):
        """Collect the bodies.

        Args:
            arm: The arm, with the gripper as its last body.
            rotor_inertia: Inertia of motor and gear at each joint [kg m^2]; descriptions rarely
                give it.
        """
        self._arm = arm
        count = arm.joints + 3
        # The base is omitted, because it does not move.
        bodies = np.stack([_inertia(arm, link) for link in range(1, count)])
        self._bodies = Constant(torch.from_numpy(bodies))
        self._rotors = Constant(rotor_inertia * torch.eye(arm.joints, dtype=torch.float64))
        number = torch.arange(1, count)[:, None]
        self._moved = Constant((torch.arange(arm.joints) < number)[..., None, None].double())
        slides = torch.tensor([kind == "prismatic" for kind in arm.kinds])
        self._turns = Constant((~slides)[:, None, None].double())

    def __call__(
        self, q: Float[Tensor, "*batch joints"], load: Float[Tensor, "*#batch"] | float = 0.0
    ) -> Float[Tensor, "*batch joints joints"]:
        """Mass matrix at joint positions [kg m^2]; rows of sliding joints are in kg and kg m.

        Args:
            q: Joint positions [rad].
            load: Mass held at the tool centre point [kg].
        """
        frames, n = self._arm.link_frames(q), self._arm.joints
        axis, origin = frames[..., :n, :, 2], frames[..., :n, :, 3]
        # Derivatives of frames with respect to joints: at a point p, z x (p - o) for a joint
        # that turns about the axis z through o, and z for a joint that slides along z.
        about = frames.unsqueeze(-3) - _at_last(origin)[..., None, :, :, :]
        turned = torch.linalg.cross(axis[..., None, :, :, None], about, dim=-2)
        slid = _at_last(axis)[..., None, :, :, :].expand_as(turned)
        D = self._moved.like(q) * torch.lerp(slid, turned, self._turns.like(q))
        bodies = self._bodies.like(q).expand(*frames.shape[:-2], 4, 4).clone()
        bodies[..., -1, 3, 3] = bodies[..., -1, 3, 3] + load
        M = torch.einsum("...ijab,...ibc,...ikac->...jk", D, bodies, D)
        return M + self._rotors.like(q)


def _at_last(vector: Tensor) -> Float[Tensor, "*batch 3 4"]:
    """Matrices (0 | v) with the given vectors v as their last columns."""
    return torch.nn.functional.pad(vector.unsqueeze(-1), (3, 0))


def _inertia(arm: Arm, link: int) -> Float[np.ndarray, "4 4"]:
    """Pseudo-inertia of a link from the description, or else from its mass and its capsules."""
    given, mass = arm.shape.inertia, arm.masses[link]
    if given and (known := given[link]) is not None and abs(known[3, 3] - mass) <= 0.01 * mass:
        return known
    capsules = [capsule for capsule in arm.whole.capsules if capsule.link == link]
    found = pseudo_inertia(0.0 if capsules else mass, (0.0, 0.0, 0.0), np.zeros((3, 3)))
    for capsule in capsules:
        start, end = np.array(capsule.start), np.array(capsule.end)
        # Three point masses with the inertia of a thin rod: a sixth of the mass at each end,
        # the rest in the middle.
        for part, point in ((1 / 6, start), (2 / 3, (start + end) / 2), (1 / 6, end)):
            found += pseudo_inertia(part * mass / len(capsules), point, np.zeros((3, 3)))
    return found
