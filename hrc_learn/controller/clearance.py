"""How far the arm is from itself and from what stands in the workplace of the trials."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics import panda_capsules

TABLE = ((0.26, 0.54, -0.02), (0.42, 0.34, 0.02))
"""Centre and half edges of the table [m], as simulated."""
PEDESTAL = ((-0.03, 0.0, -0.36), (0.12, 0.12, 0.36))
"""The same of what the arm stands on [m]."""


def clearance(q: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch"]:
    """Distance of the Panda from itself, the table and the pedestal [m]; negative in contact.

    Args:
        q: Joint position [rad].
    """
    distance = panda_capsules.self_distance(q)
    for box in (TABLE, PEDESTAL):
        centre, half_size = q.new_tensor(box)
        distance = torch.minimum(distance, panda_capsules.box_distance(q, centre, half_size))
    return distance
