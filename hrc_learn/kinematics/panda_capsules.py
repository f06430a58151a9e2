"""The Panda as capsules, to about a centimetre of the published link shapes."""

from hrc_learn.kinematics.capsules import Capsule, CapsuleArm
from hrc_learn.kinematics.franka import panda

_TCP = 9
"""Number of the tool centre point's frame, on which the hand is mounted."""

# (link, start [m], end [m], radius [m]) in the frame of the link.
LINK_CAPSULES = tuple(
    Capsule(link=link, start=start, end=end, radius=radius)
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
"""Of the links; the simulated arm is built from the same."""

# The hand is a box of 60 x 200 x 66 mm, which this contains, and so are the open fingers.
_HAND_CAPSULES = (
    Capsule(link=_TCP, start=(0.0, -0.08, -0.0704), end=(0.0, 0.08, -0.0704), radius=0.05),
    Capsule(link=_TCP, start=(0.0, -0.035, -0.01), end=(0.0, 0.035, -0.01), radius=0.028),
)
# Links whose capsules overlap by design although they are no neighbours. The flange (8) has
# none, so the hand follows link 7.
OVERLAPPING = ((0, 2), (1, 3), (3, 5), (5, 7), (6, _TCP), (7, _TCP))

panda_capsules = CapsuleArm(panda, LINK_CAPSULES + _HAND_CAPSULES, OVERLAPPING)
"""The Panda with its hand."""
