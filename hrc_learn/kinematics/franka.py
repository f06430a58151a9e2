"""Franka's arms, the Panda (FER) and the Research 3: their published geometry, which is the
same, their inverse kinematics in closed form, and the capsules that stand for their links.
`franka_limits` has what differs, the limits.

The inverse is He and Liu 2021, "Analytical inverse kinematics for Franka Emika Panda", as
`frankik` implements it: about 2 us a pose. It does not return the branch of the elbow with
q4 > -0.467 rad, where the forearm folds to the other side, nor, in one pose of 300, a valid
answer at the shoulder singularity (q2 = 0). What it returns is checked here.

Of the Research 3 it returns none outside the Panda's range besides (q6 > 3.7525 rad,
|q7| > 2.8973, |q2| > 1.7628), unless all joints are within the one that Franka gives for
velocity limits alike at all positions: of configurations drawn from all of its range with
q4 < -0.467, 81 % are found again, and of those within the Panda's 99.8 %.

Franka's meshes of both arms, alike to 2 mm, stick out of the capsules by 30 mm at most (that of
link 2), those of the base by 46 mm, of the hand by 9 mm: distances to keep have to cover it.
"""

from math import cos, pi, sin

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm, LinkCapsule
from hrc_learn.kinematics.franka_limits import FR3_LIMITS, PANDA_LIMITS
from hrc_learn.kinematics.interchange import to_urdf
from hrc_learn.kinematics.limits import JointLimits

# Craig's modified Denavit-Hartenberg parameters, as published in Franka's "Robot and interface
# specifications": a [m], d [m], alpha [rad].
_JOINTS = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -pi / 2),
    (0.0, 0.316, pi / 2),
    (0.0825, 0.0, pi / 2),
    (-0.0825, 0.384, -pi / 2),
    (0.0, 0.0, pi / 2),
    (0.088, 0.0, pi / 2),
)
_FLANGE_OFFSET = 0.107  # along z of joint 7 [m]
_HAND_ANGLE = -pi / 4  # the hand is bolted on turned about z of the flange [rad]
_TCP_OFFSET = 0.1034  # fingertips of the Franka hand, along z of the flange [m]


# A returned branch whose own forward kinematics is further off than this [m, rad] is wrong.
_TOLERANCE = 1e-6


class UnreachableError(ValueError):
    """No joint configuration within limits reaches a pose with the wanted joint 7."""


class FrankaChain(SerialChain):
    """A Franka arm with the Franka hand: a serial chain with a closed-form inverse."""

    def __init__(self, name: str, limits: JointLimits):
        """Describe an arm.

        Args:
            name: With which those of its joints begin.
            limits: Of its joints.
        """
        super().__init__(
            joint_names=[f"{name}_joint{i}" for i in range(1, 8)],
            mounts=torch.stack([_craig(*row) for row in _JOINTS]),
            flange=_along_z(_FLANGE_OFFSET),
            tcp=_along_z(_TCP_OFFSET, _HAND_ANGLE),
            limits=limits,
            ready=torch.tensor(
                [0, -pi / 4, 0, -3 * pi / 4, 0, pi / 2, pi / 4], dtype=torch.float64
            ),
        )
        self.name = name
        # frankik drops branches outside the Panda's range or, asked for the FR3, outside the
        # narrow one that Franka gives for velocity limits alike at all positions. The FR3's own
        # is in neither: together they leave out least.
        self._frankik_ranges = (False,) if name == "panda" else (False, True)

    def inverse(
        self,
        pose: Pose,
        q7: Float[Tensor, "*#batch"] | float,
        near: Float[Tensor, "*#batch 7"] | None = None,
    ) -> Float[Tensor, "*batch 7"]:
        """Joint positions that put the tool centre point at a pose, in closed form.

        Seven joints leave one degree of freedom, which the position of joint 7 settles; up to
        four branches remain, of which the nearest to `near` is returned. The elbow branch
        with q4 > -0.467 rad is never returned. Not differentiable; batches are solved in turn.

        Args:
            pose: Of the tool centre point in the base frame.
            q7: Position of joint 7 [rad].
            near: Configuration to stay close to [rad]; the ready posture if None.

        Raises:
            UnreachableError: No branch within joint limits; names the first such pose.
        """
        q = self.inverse_all(pose, q7)
        near = self.ready if near is None else near
        distance = (q - near.to(q)[..., None, :]).square().sum(-1)
        best = torch.where(distance.isnan(), torch.inf, distance).min(-1)
        if bool(best.values.isinf().any()):
            raise UnreachableError(_explain(pose, q7, best.values.isinf()))
        return torch.take_along_dim(q, best.indices[..., None, None], dim=-2).squeeze(-2)

    def inverse_all(
        self, pose: Pose, q7: Float[Tensor, "*#batch"] | float
    ) -> Float[Tensor, "*batch 4 7"]:
        """All branches of `inverse` within limits [rad], then rows of NaN.

        Args:
            pose: Of the tool centre point in the base frame, in any batch shape.
            q7: Position of joint 7 [rad].
        """
        import frankik  # only here: the rest of the package works without it

        position = pose.position.detach().double().cpu()
        orientation = pose.orientation.detach().double().cpu()
        tip = Pose(position, orientation).matrix()
        flange = tip @ torch.linalg.inv(self.tcp)
        q7 = torch.as_tensor(q7, dtype=torch.float64).cpu()
        # Not torch's: that one imports sympy when it is first called, which takes seconds.
        shape = np.broadcast_shapes(flange.shape[:-2], q7.shape)
        flanges = flange.expand(*shape, 4, 4).reshape(-1, 4, 4).numpy()
        angles = q7.expand(shape).reshape(-1).tolist()
        # The default only selects among branches when a joint is indeterminate.
        branches = np.full((len(flanges), 4, 7), np.nan)
        for is_fr3 in self._frankik_ranges:
            for row, T, angle in zip(branches, flanges, angles, strict=True):
                # A branch is in the same row of either answer, or NaN.
                found = frankik.ik_full(T, frankik.kQDefault, angle, is_fr3)
                np.copyto(row, found, where=np.isnan(row))
        q = torch.from_numpy(branches).reshape(*shape, 4, 7)
        return self._keep_true_ones(q, tip.expand(*shape, 4, 4)).to(pose.position)

    def _keep_true_ones(
        self, q: Float[Tensor, "*batch 4 7"], tip: Float[Tensor, "*batch 4 4"]
    ) -> Float[Tensor, "*batch 4 7"]:
        """Blank branches outside limits or at another pose, and move them to the end."""
        reached = self.forward(q).matrix()
        error = (reached - tip[..., None, :, :]).abs().flatten(-2).amax(-1)
        good = self.limits.contain(q) & (error < _TOLERANCE)  # False for rows of NaN
        q = torch.where(good[..., None], q, torch.nan)
        order = torch.argsort(~good, dim=-1, stable=True)
        return torch.take_along_dim(q, order[..., None], dim=-2)

    def urdf(self) -> str:
        """URDF text with the links, joints and limits of this arm, without meshes."""
        return to_urdf(self, name=self.name)


def _explain(pose: Pose, q7: Tensor | float, missing: Tensor) -> str:
    first = tuple(missing.nonzero()[0].tolist())
    shape = missing.shape
    position = pose.position.expand(*shape, 3)[first].tolist()
    orientation = pose.orientation.expand(*shape, 4)[first].tolist()
    angle = torch.as_tensor(q7).expand(shape)[first].item()
    which = f"pose {list(first)} of {list(shape)}" if shape else "the pose"
    return (
        f"{which}, position ({_join(position)}) m, quaternion wxyz ({_join(orientation)}), "
        f"has no solution within joint limits with joint 7 at {angle:.4f} rad. "
        "Try other values of q7 (the range within limits, in steps of 0.1 rad, finds most "
        "solutions), or move the pose closer to the base."
    )


def _join(values: list[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


def _craig(a: float, d: float, alpha: float) -> Tensor:
    """Rx(alpha) Tx(a) Tz(d): a joint frame at zero in the frame before it."""
    c, s = _exact_cos_sin(alpha)
    return torch.tensor(
        [[1, 0, 0, a], [0, c, -s, -s * d], [0, s, c, c * d], [0, 0, 0, 1]], dtype=torch.float64
    )


def _along_z(distance: float, angle: float = 0.0) -> Tensor:
    c, s = cos(angle), sin(angle)
    return torch.tensor(
        [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, distance], [0, 0, 0, 1]], dtype=torch.float64
    )


def _exact_cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of a multiple of a right angle without the 6e-17 of rounding."""
    return float(round(cos(angle))), float(round(sin(angle)))


panda = FrankaChain("panda", PANDA_LIMITS)
"""The Panda with its hand; a Cartesian limit of 1.7 m/s and 2.5 rad/s is the controller's."""

fr3 = FrankaChain("fr3", FR3_LIMITS)
"""The Research 3 with its hand; the Cartesian limits are 3 m/s and 2.5 rad/s."""

_ARMS = {arm.name: arm for arm in (panda, fr3)}


def franka_chain(name: str) -> FrankaChain:
    """One of Franka's arms by its name, `panda` or `fr3`.

    Raises:
        ValueError: There is no such arm.
    """
    if name not in _ARMS:
        raise ValueError(f"no arm {name!r}; Franka's are {', '.join(_ARMS)}")
    return _ARMS[name]


TOOL_LINK = 9
"""Number of the tool centre point's frame, on which the hand is mounted."""

# (link, start [m], end [m], radius [m]) in the frame of the link.
LINK_CAPSULES = tuple(
    LinkCapsule(link=link, start=start, end=end, radius=radius)
    for link, start, end, radius in (
        (0, (-0.06, 0.0, 0.05), (0.0, 0.0, 0.07), 0.07),
        (1, (0.0, 0.0, -0.19), (0.0, 0.0, -0.02), 0.06),
        (1, (0.0, -0.05, 0.0), (0.0, 0.03, 0.0), 0.06),
        (2, (0.0, -0.02, 0.0), (0.0, -0.12, 0.0), 0.06),
        (2, (0.0, 0.0, -0.04), (0.0, 0.0, 0.04), 0.06),
        (3, (0.0, 0.0, -0.16), (0.0, 0.0, -0.07), 0.06),
        (3, (0.0825, -0.03, 0.0), (0.0825, 0.03, 0.0), 0.055),
        (4, (0.0, 0.0, -0.04), (0.0, 0.0, 0.04), 0.06),
        (4, (-0.0825, 0.03, 0.0), (-0.0825, 0.10, 0.0), 0.055),
        (5, (0.0, 0.0, -0.26), (0.0, 0.0, -0.19), 0.06),
        (5, (0.0, 0.08, -0.17), (0.0, 0.09, -0.02), 0.03),
        (6, (0.0, 0.0, -0.06), (0.0, 0.0, 0.02), 0.05),
        (6, (0.088, 0.0, 0.0), (0.088, 0.05, 0.0), 0.045),
        (7, (0.0, 0.0, -0.02), (0.0, 0.0, 0.062), 0.045),
    )
)
"""Of the links of either arm; the simulated one is built from the same."""

LINK_MASSES = (4.97, 0.65, 3.23, 3.59, 1.23, 1.67, 0.74)
"""Of links 1 to 7 [kg], from franka_description."""
HAND_MASS = 0.73
"""Of the hand without its fingers [kg], from the same."""

# The hand is a box of 60 x 200 x 66 mm, which this contains, and so are the open fingers.
HAND_CAPSULES = (
    LinkCapsule(
        link=TOOL_LINK, start=(0.0, -0.08, -0.0704), end=(0.0, 0.08, -0.0704), radius=0.05
    ),
    LinkCapsule(
        link=TOOL_LINK, start=(0.0, -0.035, -0.01), end=(0.0, 0.035, -0.01), radius=0.028
    ),
)
# Links whose capsules overlap by design although they are no neighbours. The flange (8) has
# none, so the hand follows link 7.
OVERLAPPING = ((0, 2), (1, 3), (3, 5), (5, 7), (6, TOOL_LINK), (7, TOOL_LINK))

panda_capsules = CapsuleArm(panda, LINK_CAPSULES + HAND_CAPSULES, OVERLAPPING)
"""The Panda with its hand."""

panda_body = CapsuleArm(panda, LINK_CAPSULES, OVERLAPPING)
"""Without the hand, which a task takes near to things on purpose."""

fr3_capsules = CapsuleArm(fr3, LINK_CAPSULES + HAND_CAPSULES, OVERLAPPING)
"""The Research 3 with its hand."""
