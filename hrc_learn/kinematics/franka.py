"""Franka's arms, the Panda (FER) and the Research 3: geometry, limits, inverse, capsules.

Both arms have the same published geometry and differ in their limits.

The inverse is He and Liu 2021, "Analytical inverse kinematics for Franka Emika Panda", as
implemented by `frankik`: about 2 us a pose. It never returns the branch of the elbow with
q4 > -0.467 rad, where the forearm folds to the other side. In one pose of 300, it misses a
valid solution at the shoulder singularity (q2 = 0). This module checks its results.

For the Research 3, `frankik` also misses most solutions outside the Panda's range (q6 > 3.7525
rad, |q7| > 2.8973, |q2| > 1.7628). Exceptions are solutions with all joints within the range
that Franka gives for constant velocity limits. Among the Research 3's configurations with
q4 < -0.467, the inverse finds 81 % in the whole range, and 99.8 % within the Panda's range.

Franka's meshes of the two arms agree to 2 mm. They protrude from the capsules by at most 30 mm
at the links (link 2), 46 mm at the base and 9 mm at the gripper: clearances must cover this.
"""

from functools import partial
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics.arm import TCP_OFFSET, Arm, ArmShape, hand_capsules
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import link_capsules
from hrc_learn.kinematics.description import pseudo_inertia
from hrc_learn.kinematics.limits import JointLimits
from hrc_learn.store import read_toml


def _limits(vintage: str, **rows: list[float]) -> JointLimits:
    table = {name: torch.tensor(row, dtype=torch.float64) for name, row in rows.items()}
    return JointLimits(vintage=vintage, **table)


_TABLES = read_toml(Path(__file__).with_name("franka_links.toml"))
PANDA_LIMITS = _limits(**_TABLES["panda_limits"])
"""Franka's "Robot and interface specifications", control-parameters-joint-fer.csv."""

FR3_LIMITS = _limits(**_TABLES["fr3_limits"])
"""The strictest limits of the tables that `vintage` names, which every Research 3 accepts: the
innermost position limits, and the smallest velocity offsets whose velocity curves lie below the
curves of all tables. A robot itself uses the values of the URDF that it sends to its driver;
these values depend on its system image."""

_FLANGE_OFFSET = 0.107  # along z of joint 7 [m]
_HAND_ANGLE = -pi / 4  # rotation of the mounted hand about z of the flange [rad]


# A branch is dropped if its forward kinematics misses the pose by more than this [m, and 1 for
# entries of the rotation matrix].
_TOLERANCE = 1e-6


def franka_branches(
    arm: SerialChain,
    pose: Pose,
    q7: Float[Tensor, "*#batch"] | float,
    ranges: tuple[bool, ...] = (False,),
) -> Float[Tensor, "*batch 4 7"]:
    """All solutions within the limits for a position of joint 7, followed by rows of NaN.

    Args:
        arm: Chain with Franka's geometry.
        pose: Poses of the tool centre point in the base frame.
        q7: Position of joint 7 [rad].
        ranges: Joint ranges, each for one call of frankik, which drops branches outside the
            range. False is the Panda's range. True is the narrow range of the FR3 in which
            velocity limits are constant. Neither contains the full range of the FR3; both
            together lose the fewest branches.
    """
    import frankik  # only here: the rest of the package works without it

    position = pose.position.detach().double().cpu()
    orientation = pose.orientation.detach().double().cpu()
    tip = Pose(position, orientation).matrix()
    flange = tip @ torch.linalg.inv(arm.tcp)
    q7 = torch.as_tensor(q7, dtype=torch.float64).cpu()
    # torch's broadcast_shapes imports sympy on its first call, which takes seconds.
    shape = np.broadcast_shapes(flange.shape[:-2], q7.shape)
    flanges = flange.expand(*shape, 4, 4).reshape(-1, 4, 4).numpy()
    angles = q7.expand(shape).reshape(-1).tolist()
    # frankik uses the default posture only where a joint position is indeterminate.
    branches = np.full((len(flanges), 4, 7), np.nan)
    for is_fr3 in ranges:
        for row, T, angle in zip(branches, flanges, angles, strict=True):
            # A branch has the same row in both results, or is NaN in one of them.
            found = frankik.ik_full(T, frankik.kQDefault, angle, is_fr3)
            np.copyto(row, found, where=np.isnan(row))
    q = torch.from_numpy(branches).reshape(*shape, 4, 7)
    return _valid_first(arm, q, tip.expand(*shape, 4, 4)).to(pose.position)


def _valid_first(
    arm: SerialChain, q: Float[Tensor, "*batch 4 7"], tip: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 4 7"]:
    """Valid branches first; branches outside the limits or at another pose become NaN."""
    reached = arm.forward(q).matrix()
    error = (reached - tip[..., None, :, :]).abs().flatten(-2).amax(-1)
    good = arm.limits.contain(q) & (error < _TOLERANCE)  # False for rows of NaN
    q = torch.where(good[..., None], q, torch.nan)
    order = torch.argsort(~good, dim=-1, stable=True)
    return torch.take_along_dim(q, order[..., None], dim=-2)


def _craig(a: float, d: float, s: int) -> Tensor:
    """Frame of a joint at zero in the previous joint's frame: Rx(alpha) Tx(a) Tz(d).

    Here s = sin(alpha), and alpha is a multiple of a right angle.
    """
    c = 1 - abs(s)  # cos(alpha); alpha is never 180 degrees
    rows = [[1, 0, 0, a], [0, c, -s, -s * d], [0, s, c, c * d], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


def _along_z(distance: float, angle: float = 0.0) -> Tensor:
    c, s = cos(angle), sin(angle)
    rows = [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, distance], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


TOOL_LINK = 9
"""Number of the tool centre point's frame, on which the hand is mounted."""

LINK_CAPSULES = link_capsules(_TABLES["capsules"])
"""Capsules of the links of both arms; the simulated arm has the same capsules."""


def _inertias() -> tuple[Float[np.ndarray, "4 4"] | None, ...]:
    """Pseudo-inertias of base, links, flange and gripper."""
    found = []
    for mass, row in zip(_TABLES["masses"], _TABLES["inertia"], strict=True):
        x, y, z, xx, xy, xz, yy, yz, zz = row
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        found.append(pseudo_inertia(mass, (x, y, z), inertia))
    to_tool = np.eye(4)
    to_tool[2, 3] = -TCP_OFFSET
    return (None, *found[:-1], np.zeros((4, 4)), to_tool @ found[-1] @ to_tool.T)


def _franka(name: str, limits: JointLimits, ranges: tuple[bool, ...]) -> Arm:
    """One of Franka's arms with the Franka hand."""
    chain = SerialChain(
        joint_names=[f"{name}_joint{i}" for i in range(1, 8)],
        mounts=torch.stack([_craig(*row) for row in _TABLES["joints"]]),
        flange=_along_z(_FLANGE_OFFSET),
        tcp=_along_z(TCP_OFFSET, _HAND_ANGLE),
        limits=limits,
        ready=torch.tensor(
            [0, -pi / 4, 0, -3 * pi / 4, 0, pi / 2, pi / 4], dtype=torch.float64
        ),
    )
    *links, hand = _TABLES["masses"]
    return Arm(
        name=name,
        chain=chain,
        shape=ArmShape(masses=(None, *links, 0.0, hand), inertia=_inertias()),
        capsules=LINK_CAPSULES + hand_capsules(TOOL_LINK),
        overlapping=[(a, b) for a, b in _TABLES["overlapping"]],
        closed_form=partial(franka_branches, ranges=ranges),
    )


panda = _franka("panda", PANDA_LIMITS, (False,))
"""The Panda with its hand; Franka limits its tool to 1.7 m/s and 2.5 rad/s."""

fr3 = _franka("fr3", FR3_LIMITS, (False, True))
"""The Research 3 with its hand; Franka limits its tool to 3 m/s and 2.5 rad/s."""
