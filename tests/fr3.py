"""An FR3 for tests of drivers: the geometry of the Panda, and limits of its own."""

import torch

from hrc_learn.kinematics import JointLimits, SerialChain, panda

_LOWER = (-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196)
_UPPER = (2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196)
_VELOCITY = (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26)
_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)


def _row(values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


FR3 = SerialChain(
    joint_names=[f"fr3_joint{i}" for i in range(1, 8)],
    mounts=panda.mounts,
    flange=panda.flange,
    tcp=panda.tcp,
    limits=JointLimits(
        lower=_row(_LOWER),
        upper=_row(_UPPER),
        velocity=_row(_VELOCITY),
        # libfranka's rate_limiting.h: 10 rad/s^2 and 5000 rad/s^3 for all joints.
        acceleration=_row((10.0,) * 7),
        jerk=_row((5000.0,) * 7),
        torque=_row(_TORQUE),
        vintage="franka_description of libfranka 0.21",
    ),
    ready=panda.ready,
)
