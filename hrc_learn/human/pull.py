"""Pulling a link: what a person does to the arm's body, as effort d on the joints."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from ..kinematics import SerialChain
from ..protocols import ArmState, HumanInput

PullMapping = Literal["transpose", "pinv"]


def pull_effort(
    chain: SerialChain,
    joint_position: Float[np.ndarray, " joints"],
    joint: int,
    pull: Float[np.ndarray, "3"],
    mapping: PullMapping = "transpose",
    point: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, " joints"]:
    """Effort d on the joints from a pull at one of them, or at the link that it moves.

    With "transpose", d = J_joint^T f: the torques of a force, which never move the joint
    against the pull, not even after the projection into the null space of the task. The
    paper's "pinv", d = J_joint^+ v, can (its section VII).

    Args:
        chain: The arm.
        joint_position: Joint positions [rad].
        joint: Which joint is pulled, counted from 1.
        pull: Force [N] or velocity [m/s], in the base frame.
        mapping: How it acts on the joints.
        point: Where the link is pulled, in the base frame [m]; the joint's origin if None.

    Raises:
        ValueError: If the arm has no such joint.
    """
    q = torch.as_tensor(joint_position, dtype=torch.float64)
    linear, angular = chain.joint_jacobian(q, joint).split(3)
    J = linear
    if point is not None:
        lever = torch.as_tensor(point) - chain.link_poses(q).position[joint - 1]
        J = linear + torch.linalg.cross(angular, lever[:, None], dim=0)
    f = torch.as_tensor(pull, dtype=torch.float64)
    if mapping == "transpose":
        return (J.mT @ f).numpy()
    # The first joints of an arm cannot move their own origin in all directions.
    return (torch.linalg.pinv(J, rtol=1e-6) @ f).numpy()


@dataclass(frozen=True, kw_only=True)
class PullSpell:
    """One pull at a joint towards a point, with soft start and end."""

    start: float
    """[s]"""
    duration: float
    """[s]"""
    towards: tuple[float, float, float]
    """Where the person's hand is, in the base frame [m]."""
    stiffness: float = 100.0
    """Force for each metre between the joint and the hand [N/m]."""
    strongest: float = 25.0
    """Largest force [N]."""
    joint: int = 4
    """Which joint is pulled, counted from 1."""
    ramp: float = 0.4
    """Time to full strength, and back to none [s]."""

    @property
    def end(self) -> float:
        """[s]"""
        return self.start + self.duration

    def strength(self, time: float) -> float:
        """Share of full strength at a time, 0 to 1."""
        edge = min(time - self.start, self.end - time) / self.ramp
        s = min(max(edge, 0.0), 1.0)
        return s * s * (3.0 - 2.0 * s)

    def force(self, time: float, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Force at a time on a joint whose origin is there now [N]."""
        pull = self.stiffness * (np.array(self.towards) - origin)
        size = float(np.linalg.norm(pull))
        return pull * self.strength(time) * min(1.0, self.strongest / max(size, 1e-12))


class ScriptedPuller:
    """A person who pulls at the arm's body at given times, and does nothing else."""

    def __init__(
        self, chain: SerialChain, spells: Sequence[PullSpell], begin: float | None = 0.0
    ):
        """Prepare the script.

        Args:
            chain: The arm.
            spells: When and where it is pulled.
            begin: Time from which the spells' times count [s]; None: not before `begin`.
        """
        self._chain = chain
        self.spells = tuple(spells)
        self._begin = begin

    def begin(self, time: float) -> None:
        """Start the script now [s]."""
        self._begin = time

    def read(self, state: ArmState) -> HumanInput:
        """The effort of all spells that are on."""
        effort = np.zeros(len(self._chain.joint_names))
        if self._begin is None:
            return HumanInput(effort=effort, twist=np.zeros(6))
        time = state.time - self._begin
        active = [spell for spell in self.spells if spell.strength(time) > 0.0]
        if active:
            q = torch.from_numpy(state.joint_position)
            origins = self._chain.link_poses(q).position.numpy()
            for spell in active:
                force = spell.force(time, origins[spell.joint - 1])
                effort += pull_effort(self._chain, state.joint_position, spell.joint, force)
        return HumanInput(effort=effort, twist=np.zeros(6))
