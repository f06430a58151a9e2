"""What an arm tells the person who leads it: what it feels, and why it does not follow."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import INTERVENTIONS, SafetyReport
from hrc_learn.kinematics import GraspedBox, SerialChain
from hrc_learn.protocols import ArmState, Feedback, Hindrance, Reason

# Share of a motion above which it counts as followed: late servos and the bend of the null
# space leave no more of it either.
_FOLLOWED = 0.97
# Null-space part of a push, relative to the push, below which what is asked is a motion of the
# end effector: the tenth part of it is all that could be followed.
_ACROSS = 0.1
# Distance from a joint's limit that is told [rad]: pushes end 0.12 rad before it, by the margin
# of the safety filter and the room that is left to the task.
_NEAR_LIMIT = 0.15
# Time from one look at contacts and joint limits to the next [s]: no device shows them more
# often.
_LOOK_EVERY = 0.1
# Pace below which an arm waits rather than slows down.
_WAITING = 0.05

type Detail = float | int | str
"""A number or words that a reason is told with."""

_TEXTS: Mapping[Hindrance, str] = {
    "joint_limit": "joint {joint} is at its limit",
    "singularity": "the arm would get stretched: a singularity is ahead",
    "obstacle": "something is {distance:.0f} cm away",
    "speed": "the arm may not be led faster",
    "task": "that way the end effector would have to move",
    "narrow_path": "the path leads through a singularity: nobody can push the arm off it here",
    "too_far": "the arm is led so far aside that it might not find back",
    "task_waits": "the task waits until you let go",
    "person": "{somebody}",
    "stopped": "the safety filter brakes the arm",
}

# What an intervention of the safety filter takes from a push, the more telling ones first.
# Limits of acceleration and jerk are left out: they only delay it.
_INTERVENTIONS: Mapping[str, Hindrance] = {
    "invalid": "stopped",
    "stopped": "stopped",
    "separation": "person",
    "position": "joint_limit",
    "velocity": "speed",
    "tcp_speed": "speed",
}


class Hindrances:
    """What kept an arm from following the person who leads it, collected over one step.

    Each cause leaves a share of what those before it have left: the product of all shares is
    what is followed.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._kept: dict[Hindrance, float] = {}
        self._details: dict[Hindrance, dict[str, Detail]] = {}
        self._followed = 1.0

    def note(self, cause: Hindrance, kept: float, **details: Detail) -> None:
        """Note a cause.

        Args:
            cause: Why.
            kept: Share of the motion that it leaves, 0 to 1.
            details: For its words.
        """
        self._followed *= kept
        if kept < _FOLLOWED:
            self._add(cause, kept, details)

    def mention(self, cause: Hindrance, **details: Detail) -> None:
        """Note a cause that takes nothing from the motion, or that others account for."""
        self._add(cause, 1.0, details)

    def note_limits(
        self,
        before: Float[Tensor, " joints"],
        after: Float[Tensor, " joints"],
        velocity: Float[Tensor, " joints"],
        bounds: tuple[Float[Tensor, " joints"], Float[Tensor, " joints"]],
    ) -> None:
        """Note what the joints' limits take from a null-space motion, and which joint's.

        Args:
            before: The motion [rad/s].
            after: What is left of it [rad/s].
            velocity: Of the joints without the limits [rad/s].
            bounds: Their lowest and highest velocities [rad/s].
        """
        kept = share_kept(before, after)
        if kept < 1:
            self.note("joint_limit", kept, joint=limiting_joint(velocity, *bounds) + 1)

    def note_across(
        self, asked: Float[Tensor, " joints"], null: Float[Tensor, " joints"]
    ) -> None:
        """Note a push that is hardly one in the null space.

        Args:
            asked: Joint velocity that is asked for [rad/s].
            null: Its part in the null space [rad/s].
        """
        # Of an orthogonal projection, |N w|^2 = w^T N w.
        size, inside = float(asked @ asked), max(float(asked @ null), 0.0)
        if size > 0 and (kept := math.sqrt(inside / size)) < _ACROSS:
            self.note("task", kept)

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()
        self._details.clear()
        self._followed = 1.0

    @property
    def followed(self) -> float:
        """Share of the motion that is left."""
        return self._followed

    @property
    def any(self) -> bool:
        """Whether there is a cause worth telling."""
        return bool(self._kept)

    def reasons(self, **details: Detail) -> tuple[Reason, ...]:
        """Why less than all is left, what takes the most first.

        Args:
            details: For the words of those noted without.
        """
        return tuple(
            Reason(
                hindrance=cause,
                kept=kept,
                text=_TEXTS[cause].format(**(details | self._details[cause])),
            )
            for cause, kept in sorted(self._kept.items(), key=lambda item: item[1])
        )

    def _add(self, cause: Hindrance, kept: float, details: dict[str, Detail]) -> None:
        self._kept[cause] = self._kept.get(cause, 1.0) * kept
        self._details[cause] = details


def share_kept(before: Float[Tensor, " joints"], after: Float[Tensor, " joints"]) -> float:
    """Share of a motion that is left of it, 0 to 1, along its direction; 1 of none."""
    size = float(before @ before)
    if size < 1e-12:  # below a microradian a second
        return 1.0
    return min(max(float(before @ after) / size, 0.0), 1.0)


def limiting_joint(
    velocity: Float[Tensor, " joints"],
    lower: Float[Tensor, " joints"],
    upper: Float[Tensor, " joints"],
) -> int:
    """The joint, from 0, whose bounds allow the smallest share of a velocity.

    Args:
        velocity: Of the joints [rad/s].
        lower: Lowest [rad/s].
        upper: Highest [rad/s].
    """
    bound = torch.where(velocity > 0, upper, lower)
    share = torch.where(velocity == 0, math.inf, bound / velocity)
    return int(share.argmin())


def filter_hindrance(report: SafetyReport) -> Hindrance | None:
    """Why a safety filter may have taken something from a motion; None: at most a delay."""
    flags = report.flags.tolist()
    if True in flags:
        for kind, hindrance in _INTERVENTIONS.items():
            if flags[INTERVENTIONS.index(kind)]:
                return hindrance
    return None


def contact_force(
    jacobian: Float[Tensor, "6 joints"], state: ArmState
) -> Float[np.ndarray, "3"] | None:
    """Force at the end effector that comes nearest to the external torques [N].

    A contact elsewhere, friction and an unknown load are in it too.

    Args:
        jacobian: Of the end effector.
        state: Reading of the arm.

    Returns:
        The force; None if the arm tells no torques.
    """
    if state.external_torque is None:
        return None
    return np.linalg.lstsq(jacobian.mT.numpy(), state.external_torque, rcond=None)[0][:3]


class PersonFeedback:
    """Makes at each step what the person who leads an arm is told of it.

    Attributes:
        hindrances: Of this step; whoever takes something from a push notes it there.
    """

    def __init__(self, chain: SerialChain):
        """Begin with an arm that feels nothing.

        Args:
            chain: Kinematics of the arm.
        """
        self._chain, self.hindrances = chain, Hindrances()
        self._lower, self._upper = chain.limits.lower.numpy(), chain.limits.upper.numpy()
        self._force: np.ndarray | None = None
        self._near: tuple[str, ...] = ()
        self._nearest = 1  # joint to its limit, counted from 1
        self._looked, self._load, self._width = -math.inf, None, 0.0

    _load: GraspedBox | None

    def told(
        self,
        state: ArmState,
        jacobian: Float[Tensor, "6 joints"] | None = None,
        *,
        pushed: bool,
        person_distance: float | None = None,
        pace: float = 1.0,
        load: GraspedBox | None = None,
        contact_expected: bool = False,
    ) -> Feedback:
        """What is told of this step; the next one begins without hindrances.

        Args:
            state: Of the arm.
            jacobian: Of its end effector there; None: it is computed where it is needed.
            pushed: Whether the person asks for a motion.
            person_distance: Of the nearest person [m], NaN while it is not known; None: nobody
                watches for them.
            pace: Share of its speed that people near it leave the task.
            load: What the gripper holds; None: nothing.
            contact_expected: Whether the task feels its way.
        """
        # A clock that is set back is that of a simulation that begins anew.
        if not 0 <= state.time - self._looked < _LOOK_EVERY:
            self._look(state, jacobian)
        if load is not self._load:
            self._load, self._width = load, state.gripper_width
        followed, reasons = 1.0, ()
        if pushed:
            if person_distance is not None and pace < _FOLLOWED:
                self.hindrances.mention("person")
            followed = self.hindrances.followed
            if self.hindrances.any:
                somebody = _somebody(person_distance, pace)
                reasons = self.hindrances.reasons(joint=self._nearest, somebody=somebody)
        self.hindrances.clear()
        return Feedback(
            pushed=pushed,
            followed=followed,
            reasons=reasons,
            contact_force=self._force,
            near_limits=self._near,
            person_distance=person_distance,
            pace=pace,
            slip=0.0 if load is None else abs(state.gripper_width - self._width),
            contact_expected=contact_expected,
        )

    def _look(self, state: ArmState, jacobian: Float[Tensor, "6 joints"] | None) -> None:
        """See which joints are near their limits, and what the arm is in contact with."""
        q, names = state.joint_position, self._chain.joint_names
        room = np.minimum(q - self._lower, self._upper - q)
        self._nearest = int(room.argmin()) + 1
        self._near = tuple(names[k] for k in (room < _NEAR_LIMIT).nonzero()[0])
        if jacobian is None:
            jacobian = self._chain.jacobian(torch.from_numpy(q))
        self._force = contact_force(jacobian, state)
        self._looked = state.time


def _somebody(distance: float | None, pace: float) -> str:
    """What people near an arm do to its motion, in words."""
    does = "keeps its distance" if pace >= _FOLLOWED else "slows down"
    does = "waits" if pace < _WAITING else does
    if distance is None or math.isnan(distance):
        return f"nobody knows where people are: the arm {does}"
    return f"somebody is {max(distance, 0.0):.1f} m away: the arm {does}"
