"""A Panda without some of its joints, as an unknown arm."""

import torch

from hrc_learn.kinematics import Arm, JointLimits, LinkCapsule, SerialChain, panda
from hrc_learn.kinematics.arm import ArmShape


def bare(left_out=(2,), name="cut", slides=()):
    """What a description would give: its joints but for those left out, and thin capsules.

    Joints of the numbers `slides`, from 0, slide along their axes instead of turning.
    """
    keep = [i for i in range(7) if i not in left_out]
    mounts, carried = [], torch.eye(4, dtype=torch.float64)
    for i in range(7):
        carried = carried @ panda.mounts[i]
        if i in keep:
            mounts.append(carried)
            carried = torch.eye(4, dtype=torch.float64)
    limits = {
        field: getattr(panda.limits, field)[keep]
        for field in ("lower", "upper", "velocity", "acceleration", "jerk", "torque")
    }
    chain = SerialChain(
        joint_names=[f"{name}_{i}" for i in keep],
        mounts=torch.stack(mounts),
        flange=carried @ panda.flange,
        tcp=torch.eye(4, dtype=torch.float64),
        limits=JointLimits(**limits, vintage="test"),
        ready=panda.ready[keep],
        kinds=["prismatic" if i in slides else "revolute" for i in range(len(keep))],
    )
    n = len(keep)
    capsules = [
        LinkCapsule(link=link, start=(0.0, 0.0, -0.02), end=(0.0, 0.0, 0.02), radius=0.01)
        for link in (*range(n + 1), n + 2)
    ]
    masses = (3.0, *(2.0,) * n, 0.0, 0.7)
    return Arm(
        name=name,
        chain=chain,
        shape=ArmShape(masses=masses),
        capsules=capsules,
        overlapping=[(0, 2)],
    )
