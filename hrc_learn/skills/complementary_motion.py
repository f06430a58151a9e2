"""A policy leads the end effector while a person leads the body: at the same time, without a
pause or a handover.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import MotionLimits, SerialChain
from hrc_learn.protocols import ArmState, Human
from hrc_learn.skills.arm_motion import joints_near, kept_clear, resolved_rate
from hrc_learn.skills.null_space_yielding import (
    CHANGE_OF_RATE,
    LEADS_BACK,
    LONGEST_RETURN,
    NARROW,
    NullSpaceYielding,
    YieldingConfig,
    changed_rate,
    may_not_find_back,
    share_of_push,
    smallest_singular_value,
    straightness,
)
from hrc_learn.skills.person_feedback import PersonFeedback, share_kept

# Of the limits of acceleration, what the null space may take: the path needs the rest.
_SHARE_OF_ACCELERATION = 0.4
# Fastest joint of a null-space motion [rad/s]: at 20 actions a second it turns by 0.05 rad in
# one, on a chord of whose arc an elbow of 0.3 m and a hand at 0.8 m are 0.3 mm off.
_FASTEST = 1.0
# In which a null-space motion stops before an obstacle [s]: joint 2, at its fastest, by the
# part of its acceleration that the null space may take, 3 rad/s^2.
_STOPPING = 0.33
# Distance kept from a joint limit, and decay rate of the remaining one [rad, 1/s]: within the
# margins of the servo, which would stop single joints and so move the end effector.
_FROM_LIMIT, _LIMIT_RATE = 0.05, 5.0
# Joints as far from their posture are on it [rad].
_SAME = 1e-6
# Deviation of the end effector, a radian counted as a decimetre, that no step leaves [m]; if
# one does, the arm aside cannot reach where the policy wants the end effector.
_REACHED, _METRES_PER_RADIAN = 5e-4, 0.1
# By which the arm may be nearer to what is around it than the policy's own posture [m]:
# rounding must not stop it.
_NO_NEARER = 1e-3
# Share of the room that is missing which has to be regained in the time looked ahead, or the
# motion waits: predictions err as much.
_REGAINED = 0.3
# Postures that are as near are the same, for a motion that waits [rad].
_MET_AGAIN = 0.02


Room = Callable[[Float[Tensor, "*batch joints"]], Float[Tensor, "*batch"]]


class ComplementaryMotion:
    """Joint positions with the end effector where a policy wants it, the body as a person does.

    The policy, of any kind, asks for joint positions, its own posture. As long as nobody pushes
    they are handed on as they are. Pushed aside, the joints keep the end effector where the
    policy's posture has it and move in its null space, within their limits and clear of what
    is around them. When the person lets go they return to the policy's posture, or stay beside
    it (`YieldingConfig.after_push`). Where the arm, aside, cannot follow, the motion waits and
    goes on from there, as on planned paths (`follow_path`).

    Attributes:
        posture: Joint positions that the policy has now, as without the person [rad]; None
            before the first step.
        joints: Those commanded instead [rad].
        offset_velocity: How fast they part [rad/s].
        nullspace_input: What the person asks for, without jumps [N m].
        waits: Whether the motion waits, or has yet to regain its own speed.
    """

    posture: Float[Tensor, " joints"] | None
    joints: Float[Tensor, " joints"] | None
    _last: Float[Tensor, " joints"] | None

    def __init__(
        self,
        chain: SerialChain,
        human: Human,
        dt: float,
        limits: MotionLimits,
        config: YieldingConfig | None = None,
        clearance: Room | None = None,
    ):
        """Begin where the first step is.

        Args:
            chain: Kinematics of the arm.
            human: Who pushes it.
            dt: Time from one step to the next [s].
            limits: Within which whoever follows the positions can do so exactly.
            config: How the null space yields.
            clearance: Distance of an arm at given joint positions from itself and from what
                stands around [m]; None: people can push it anywhere within its limits.
        """
        self._chain, self._human, self._dt = chain, human, dt
        self._limits, self._clearance = limits, clearance
        self._config = config or YieldingConfig()
        self.restart()

    def restart(self) -> None:
        """Begin anew: nobody has pushed, and the next step is the first."""
        n = len(self._chain.joint_names)
        self._feedback = PersonFeedback(self._chain)
        self._yielding = NullSpaceYielding(
            self._chain, self._dt, self._config, self._feedback.hindrances
        )
        self.posture = self.joints = None
        self.offset_velocity = self._null = torch.zeros(n, dtype=torch.float64)
        self._last = None
        self._rate, self._waited = 1.0, 0.0
        # What the policy wants, from where the motion is; of more than one when it waits.
        self._wishes: deque[tuple[Tensor, float]] = deque()
        self._progress, self._width = 0.0, math.nan

    @property
    def nullspace_input(self) -> Float[np.ndarray, " joints"]:
        return self._yielding.nullspace_input

    @property
    def waits(self) -> bool:
        return self._rate < 1.0

    @property
    def offset(self) -> Float[np.ndarray, " joints"]:
        """From the policy's posture to the commanded joints [rad]."""
        if self.posture is None or self.joints is None:
            return np.zeros(len(self._chain.joint_names))
        return (self.joints - self.posture).numpy()

    def next(
        self, state: ArmState, wish: Float[np.ndarray, " joints"], width: float = math.nan
    ) -> tuple[Float[np.ndarray, " joints"], float]:
        """The joint positions to be reached when the next step is due.

        Args:
            state: Newest reading of the arm, for the person to see.
            wish: Joint positions that the policy wants then [rad].
            width: Opening of the gripper that it wants [m]; waits with the motion.

        Returns:
            Joint positions [rad] and opening of the gripper [m].
        """
        asked = self._human.read(state).nullspace_input
        self._yielding.feel(asked)
        was = deque(self._wishes), self._progress
        posture, width = self._followed(torch.from_numpy(np.array(wish, dtype=float)), width)
        if self.posture is None or self.joints is None:
            self.posture = self.joints = posture
        before = self.joints - self.posture
        joints, clear = posture, True
        if self._yielding.pushed or bool(before.any()):
            joints, clear = self._beside(posture, self.posture, self.joints)
        if joints is None:
            # Nothing else keeps it clear: stop at once, as if this step had not been asked for.
            distance = 100 * float(self._clear(self.joints))
            self._feedback.hindrances.note("obstacle", 0.0, distance=distance)
            (wishes, self._progress), newest = was, self._wishes[-1]
            self._wishes = deque([*wishes, newest])
            self._rate, self._null = 0.0, torch.zeros_like(self._null)
            posture, joints, width = self.posture, self.joints, self._width
        self._rate = float(changed_rate(self._rate, 1.0 if clear else 0.0, self._dt))
        if self._rate == 0:
            self._feedback.hindrances.mention("task_waits")
        moves = float((joints - self.joints).abs().max()) > _SAME
        held_back = self._rate == 0 and not (self._yielding.pushed or moves)
        self._waited = self._waited + self._dt if held_back else 0.0
        self.offset_velocity = (joints - posture - before) / self._dt
        self.posture, self.joints, self._width = posture, joints, width
        self._human.tell(self._feedback.told(state, pushed=bool(asked.any())))
        return joints.numpy(), width

    def _followed(
        self, wish: Float[Tensor, " joints"], width: float
    ) -> tuple[Float[Tensor, " joints"], float]:
        """The wish now followed: the newest, or of a motion that waited one from before."""
        wishes = self._wishes
        if wishes and float((wish - wishes[0][0]).norm()) < _MET_AGAIN and self._rate == 1.0:
            # The policy is where the motion is: it has waited too, or come to its end.
            wishes.clear()
        self._last = wishes[-1][0] if wishes else None
        wishes.append((wish, width))
        self._progress = self._progress + self._rate if len(wishes) > 1 else 0.0
        while self._progress >= 1.0 and len(wishes) > 1:
            wishes.popleft()
            self._progress -= 1.0
        joints, width = wishes[0]
        if self._progress and len(wishes) > 1:
            joints = torch.lerp(joints, wishes[1][0], self._progress)
        return joints, width

    def _beside(
        self,
        posture: Float[Tensor, " joints"],
        before: Float[Tensor, " joints"],
        joints: Float[Tensor, " joints"],
    ) -> tuple[Float[Tensor, " joints"] | None, bool]:
        """Joint positions beside the policy's posture, None if there are none that are clear,
        and whether the motion can go on.
        """
        dt, moved = self._dt, posture - before
        ahead = torch.stack([posture, posture + CHANGE_OF_RATE / dt * self._coming()])
        narrow = smallest_singular_value(self._chain, ahead) < NARROW
        goal = self._chain.forward(posture)
        here, J = self._chain.forward_and_jacobian(joints)
        error = before - joints
        back = self._yielding.way_back(
            joints, error, yields=not bool(narrow[0]), returns=self._rate == 0
        )
        if self._waited > LONGEST_RETURN:
            return self._straight_back(posture, joints), False
        task = resolved_rate(J, here.twist_to(goal) / dt, torch.zeros_like(joints))

        def feasible(velocity: Float[Tensor, " joints"]) -> Float[Tensor, " joints"]:
            null = self._gently(J, null_projection(J, moved / dt + velocity))
            return self._within_limits(joints, posture, task, null)

        coming = self._chain.jacobian(posture) @ self._coming() / dt
        going = resolved_rate(J, coming, torch.zeros_like(joints))
        away = null_projection(J, error)
        faster = _FASTEST / float(away.norm().clamp(min=1e-9))
        retreat = min(self._config.pose_gain, faster) * away
        wanted, straight = self._config.pose_gain * error, straightness(away, error)
        hindrances = self._feedback.hindrances
        if back is None:
            hindrances.note("narrow_path", 0.0)
        else:
            # While they push nothing pulls the joints back; but far aside, where the null space
            # may lead elsewhere than back, less and less is left of a push.
            yielding = self._yielding
            push = yielding.null_velocity if yielding.pushed else back
            share = float(share_of_push(push, away, straight))
            wanted = torch.lerp(retreat, push, share)
            hindrances.note_across(push, null_projection(J, push))
            hindrances.note("too_far", share)
        # Where the policy itself leads the arm nearer, people may as well.
        own = self._rooms(ahead).amin(0) - _NO_NEARER
        margins = own.clamp(max=self._config.clearance).tolist()
        margin = min(margins)
        null = led = feasible(wanted)
        waits = False
        # Each for itself: how fast the arm may near one says nothing of another.
        for room, least in zip(self._obstacles, margins, strict=True):
            clear = kept_clear(joints, going, led, room, least, _STOPPING)
            null = clear.null if share_kept(led, clear.null) < share_kept(led, null) else null
            waits |= bool(clear.waits)
        distance = float(self._clear(joints))
        if waits or float(straight) < LEADS_BACK:
            # Against the person, as the end effector would have to stop otherwise.
            null, waits = self._retreat(joints, going, feasible(retreat), led, margin)
        if self._yielding.pushed:
            # Of what is asked, not of what the arm has picked up of it by now.
            asked = null_projection(J, moved / dt + wanted)
            possible = self._within_limits(joints, posture, task, asked, told=True)
            if share_kept(led, null) < 1 and float(straight) >= LEADS_BACK:
                stretched = float(self._from_singularity(joints)) < distance
                cause = "singularity" if stretched else "obstacle"
                hindrances.note(cause, share_kept(possible, null), distance=100 * distance)
        # At a pose that stays the null space leads back as it led aside, further on maybe not.
        waits = waits or bool(may_not_find_back(error, straight))
        self._null = null
        reached = joints_near(self._chain, goal, joints + dt * (task + null))
        off = self._chain.forward(reached).twist_to(goal)
        far = float(off[:3].norm() + _METRES_PER_RADIAN * off[3:].norm()) > _REACHED
        if back is None and float((reached - posture).norm()) < _SAME:
            return posture, True
        now, then = self._clear(torch.stack([joints, reached])).tolist()
        if then < min(now, margin) - _NO_NEARER:
            return None, False
        return reached, not (waits or far or (back is not None and bool(narrow.any())))

    @property
    def _obstacles(self) -> tuple[Room, ...]:
        """Distances of the arm from all that it must not come near."""
        return self._clear, self._from_singularity, self._from_limits

    def _rooms(self, joints: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch 3"]:
        """Distances from each of these [m]."""
        return torch.stack([room(joints) for room in self._obstacles], dim=-1)

    def _room(self, joints: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance from the nearest of them [m]."""
        return self._rooms(joints).amin(-1)

    def _from_singularity(
        self, joints: Float[Tensor, "*batch joints"]
    ) -> Float[Tensor, "*batch"]:
        """Of the arm's singularities, obstacles that begin where it can no longer follow beside
        its path: smallest singular values count as metres.
        """
        return smallest_singular_value(self._chain, joints) - NARROW + self._config.clearance

    def _from_limits(self, joints: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Of the limits of the joints, which the task may near as well as the person: radians
        count as metres.
        """
        limits = self._limits
        room = torch.minimum(joints - limits.lower, limits.upper - joints).amin(-1)
        return room - _FROM_LIMIT + self._config.clearance

    def _clear(self, joints: Float[Tensor, "*batch joints"]) -> Float[Tensor, "*batch"]:
        """Distance of the arm from what it must not meet [m]."""
        if self._clearance is None:
            return torch.full_like(joints[..., 0], math.inf)
        return self._clearance(joints)

    def _coming(self) -> Float[Tensor, " joints"]:
        """How the policy's posture changes in a step at its own speed [rad]."""
        (first, _), (second, _) = self._wishes[0], self._wishes[min(1, len(self._wishes) - 1)]
        if len(self._wishes) > 1:
            return second - first
        return first - self._last if self._last is not None else torch.zeros_like(first)

    def _retreat(
        self,
        joints: Float[Tensor, " joints"],
        going: Float[Tensor, " joints"],
        back: Float[Tensor, " joints"],
        wanted: Float[Tensor, " joints"],
        margin: float,
    ) -> tuple[Float[Tensor, " joints"], bool]:
        """Null-space motion of an arm aside that would meet something, and whether it waits."""
        ahead = torch.stack([joints, joints + CHANGE_OF_RATE * (going + back)])
        now, then = self._room(ahead).tolist()
        if then >= min(now + _REGAINED * (margin - now), margin):
            return back, False
        still = torch.zeros_like(joints)
        # The way back may pass a singularity.
        null, *_ = kept_clear(joints, still, back, self._clear, margin)
        if not bool(null.any()):
            null, *_ = kept_clear(joints, still, wanted, self._room, margin)
        return null, True

    def _gently(
        self, J: Float[Tensor, "6 joints"], null: Float[Tensor, " joints"]
    ) -> Float[Tensor, " joints"]:
        """A null-space motion with a limited change since the last one.

        Scaled as a whole: joints that follow late, each in its own way, would move the end
        effector.
        """
        change = null - self._null
        most = _SHARE_OF_ACCELERATION * self._dt * self._limits.acceleration
        share = float((most / change.abs().clamp(min=1e-12)).min().clamp(max=1.0))
        return null_projection(J, self._null + share * change)

    def _within_limits(
        self,
        joints: Float[Tensor, " joints"],
        posture: Float[Tensor, " joints"],
        task: Float[Tensor, " joints"],
        null: Float[Tensor, " joints"],
        told: bool = False,
    ) -> Float[Tensor, " joints"]:
        """As much of a null-space motion as the limits of joints and their speeds leave.

        What they take from it is noted where the person is `told`.
        """
        limits, rate = self._limits, min(_LIMIT_RATE, 1 / self._dt)
        # Where the policy itself goes nearer to a limit, that is the limit.
        upper = torch.maximum(limits.upper - _FROM_LIMIT, posture)
        lower = torch.minimum(limits.lower + _FROM_LIMIT, posture)
        up = torch.minimum(rate * (upper - joints), limits.velocity) - task
        down = torch.maximum(rate * (lower - joints), -limits.velocity) - task
        room = torch.where(null > 0, up, down) / torch.where(null == 0, 1.0, null)
        share, joint = torch.where(null == 0, 1.0, room).clamp(0.0, 1.0).min(dim=0)
        slower = _FASTEST / null.abs().max().clamp(min=_FASTEST)
        if told and slower < share:
            self._feedback.hindrances.note("speed", float(slower))
        elif told:
            self._feedback.hindrances.note("joint_limit", float(share), joint=int(joint) + 1)
        return min(share, slower) * null

    def _straight_back(
        self, posture: Float[Tensor, " joints"], joints: Float[Tensor, " joints"]
    ) -> Float[Tensor, " joints"]:
        """A step to the policy's posture, where no motion of the null space leads there.

        Another posture for the same pose may lie between. The end effector leaves its path.
        """
        way = posture - joints
        longest = self._config.return_speed * self._dt
        following = joints + way * min(1.0, longest / max(float(way.norm()), 1e-12))
        now, then = self._clear(torch.stack([joints, following])).tolist()
        if then < min(now, self._config.clearance):
            return joints  # nothing is left but to be pushed clear
        if float((following - posture).norm()) < _SAME:
            self._yielding.aside, self._waited = False, 0.0
        return following
