"""Shared control: a policy moves the end effector while a person moves the body of the arm."""

import math
from collections import deque
from dataclasses import fields, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import SafetyConfig
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmLoopState,
    ArmReading,
    FollowPath,
)
from hrc_learn.controller.joint_path import NARROW, DirectReturn, JointPaths
from hrc_learn.controller.null_space_motion import (
    Clearance,
    YieldingConfig,
    smallest_singular_value,
)
from hrc_learn.kinematics import JointLimits, SerialChain
from hrc_learn.protocols import ArmState, Human
from hrc_learn.skills.arm_motion import joints_near
from hrc_learn.skills.step_report import PersonFeedback

# Longest step of the loop between two actions of the policy [s].
_STEP = 0.01
# A push ends at this distance from a joint limit [rad]. Only the policy may move closer.
_LIMIT_MARGIN = 0.05
# Fraction of the limits of acceleration and jerk that the loop uses. The rest is for the
# correction of the end effector at the end of each step.
_EFFORT = 0.9
# If the joints cannot return in the null space, they return directly after this time [s].
_DIRECT_RETURN_AFTER = 5.0
# Joints within this distance of the policy's posture count as being in that posture [rad].
_SAME = 1e-6
# If the policy's newest posture is within this distance of its present posture, the postures
# queued between them are skipped [rad].
_MET_AGAIN = 0.02
# Reduction of the clearance in one step that counts as rounding [m].
_ROUNDING = 1e-3


class ComplementaryMotion:
    """Combines a policy that moves the end effector with a person that moves the null space.

    The policy requests joint positions, called its posture. Without a push, they are passed on
    unchanged. While a person pushes the joints aside, the end effector keeps the pose that it
    has in the policy's posture, and the arm stays within its joint limits and clear of
    obstacles. `ArmLoop` computes this motion for an ideal arm. After the push, the joints
    return to the policy's posture, or stay aside (`YieldingConfig.after_push`). Where an arm
    that was pushed aside cannot follow the policy, the motion waits, and later continues.

    Attributes:
        human: Person that pushes the arm.
        posture: Present joint positions of the policy [rad]; None before the first step.
        joints: Commanded joint positions [rad]; None before the first step.
        offset_velocity: Rate of change of `offset` [rad/s].
    """

    posture: Float[Tensor, " joints"] | None
    joints: Float[Tensor, " joints"] | None

    def __init__(
        self,
        chain: SerialChain,
        human: Human,
        dt: float,
        limits: JointLimits,
        config: YieldingConfig | None = None,
        clearance: Clearance | None = None,
    ):
        """Begin at the first step.

        Args:
            chain: Kinematics of the arm.
            human: Person that pushes the arm.
            dt: Time between two steps [s].
            limits: Limits within which the arm follows the positions exactly.
            config: Response of the null space to a push.
            clearance: Function from joint positions [rad] to the distance of the arm from
                itself and its surroundings [m]; None: a push can move the arm anywhere within
                its limits.
        """
        self._chain, self.human, self._dt = chain, human, dt
        self._steps = max(1, math.ceil(dt / _STEP - 1e-9))
        config = config or YieldingConfig()
        yielding = {f.name: getattr(config, f.name) for f in fields(YieldingConfig)}
        loop_config = ArmLoopConfig(
            **yielding,
            dt=dt / self._steps,
            command_delay=0.0,
            limit_margin=_LIMIT_MARGIN,
            # The motion of a policy cannot be retraced.
            back_after=math.inf,
            direct_return_after=_DIRECT_RETURN_AFTER,
            # The policy may use the whole range within the limits.
            safety=SafetyConfig(
                margin=0.0, velocity_margin=0.0, braking=_EFFORT, tcp_speed=math.inf
            ),
        )
        self._loop = ArmLoop(chain.with_limits(limits), loop_config, clearance)
        self.restart()

    def restart(self) -> None:
        """Forget all motion; the next step is the first one, without a push."""
        still = torch.zeros(len(self._chain.joint_names), dtype=torch.float64)
        self._feedback = PersonFeedback(self._chain)
        self.posture = self.joints = None
        self.offset_velocity = still
        self._state = self._loop.initial_state(still)
        # Queue of the policy's postures and gripper openings; the present posture comes first.
        # While the motion waits, the queue grows.
        self._wishes: deque[tuple[Tensor, float]] = deque()
        self._progress = 0.0

    @property
    def nullspace_input(self) -> Float[np.ndarray, " joints"]:
        """Push of the person, smoothed [N m]."""
        return (self._loop.config.damping * self._state.null_velocity).numpy()

    @property
    def waits(self) -> bool:
        """True while the motion waits, or moves more slowly than the policy after a wait."""
        return float(self._state.path.rate) < 1.0

    @property
    def offset(self) -> Float[np.ndarray, " joints"]:
        """Commanded joint positions minus the policy's posture [rad]."""
        if self.posture is None or self.joints is None:
            return np.zeros(len(self._chain.joint_names))
        return (self.joints - self.posture).numpy()

    def next(
        self, state: ArmState, wish: Float[np.ndarray, " joints"], width: float = math.nan
    ) -> tuple[Float[np.ndarray, " joints"], float]:
        """Joint positions to be reached when the next step is due.

        Args:
            state: Newest reading of the arm, passed on to the person.
            wish: Joint positions that the policy requests for the next step [rad].
            width: Gripper opening that the policy requests for the next step [m]. If the motion
                waits, the gripper waits, too.

        Returns:
            Joint positions [rad] and opening of the gripper [m].
        """
        effort = self.human.read(state).effort(len(state.joint_position))
        push = torch.from_numpy(np.array(effort, dtype=float))
        pushed = bool(push.any())
        self._take(torch.from_numpy(np.array(wish, dtype=float)), width)
        if self.posture is None or self.joints is None:
            self.posture = self.joints = self._wished()[0]
            moving = torch.from_numpy(np.array(state.joint_velocity, dtype=float))
            self._state = self._loop.initial_state(self.joints, joint_velocity=moving)
            before = self.posture - self._dt * moving
        else:
            before = self.posture
        offset = self.joints - self.posture
        off = bool(offset.abs().max() > _SAME)
        if pushed or bool(self._state.pushed) or off or self.waits:
            self._yield(push)
        else:
            self._go_on(1.0)
            self.joints, self.posture = self._wished()[0], self._wished()[0]
            velocity = (self.posture - before) / self._dt
            self._state = self._loop.initial_state(self.joints, joint_velocity=velocity)
        posture, width = self._wished()
        self.offset_velocity = (self.joints - posture - offset) / self._dt
        self.posture = posture
        self.human.tell(self._feedback.end_step(state, pushed=pushed))
        return self.joints.numpy(), width

    def _take(self, wish: Float[Tensor, " joints"], width: float) -> None:
        """Add a posture [rad] and a gripper opening [m] of the policy to the queue."""
        behind = len(self._wishes) > 1 and not self.waits
        if behind and float((wish - self._wishes[0][0]).norm()) < _MET_AGAIN:
            # The policy has waited, too, or has ended: skip the queue.
            self._wishes, self._progress = deque([self._wished()]), 0.0
        self._wishes.append((wish, width))

    def _go_on(self, steps: float) -> None:
        """Advance in the queue of postures by a number of steps of the policy."""
        self._progress += steps
        while self._progress >= 1.0 and len(self._wishes) > 1:
            self._wishes.popleft()
            self._progress -= 1.0
        if len(self._wishes) == 1:
            self._progress = 0.0

    def _wished(self, ahead: float = 0.0) -> tuple[Float[Tensor, " joints"], float]:
        """Posture [rad] and gripper opening [m] of the policy, `ahead` policy steps ahead."""
        at = self._progress + ahead
        k = min(int(at), len(self._wishes) - 1)
        joints, width = self._wishes[k]
        if k + 1 < len(self._wishes) and at > k:
            joints = torch.lerp(joints, self._wishes[k + 1][0], at - k)
        return joints, width

    def _yield(self, push: Float[Tensor, " joints"]) -> None:
        """Take a step in which the joints leave the policy's posture or are already off it."""
        joints, state = self.joints, self._state
        assert joints is not None  # set by the first step
        request = self._request()
        path = replace(
            state.path,
            progress=torch.zeros_like(state.path.progress),
            last=torch.full_like(state.path.last, self._steps + 1.0),
        )
        state, q = replace(state, path=path), joints
        for k in range(self._steps):
            reading = self._reading(q, push, explain=k + 1 == self._steps)
            velocity, state, report = self._loop.act(state, reading, request)
            q = q + self._loop.config.dt * velocity
            reading = self._reading(q, push, explain=reading.explain)
            state, limitations = self._loop.observe(state, reading)
            self._feedback.note_step(report)
            self._feedback.note_limitations(limitations)
        queue = deque(self._wishes), self._progress
        self._go_on(float(state.path.progress) / self._steps)
        if not state.path.direct_return.active:
            # The loop corrects the end effector over several steps. For an ideal arm, the
            # correction can be exact.
            q = joints_near(self._chain, self._chain.forward(self._wished()[0]), q)
        if self._comes_too_near(joints, q):
            (self._wishes, self._progress), q = queue, joints
            state = self._stopped(state)
        if state.path.direct_return.blocked:
            # Try the return again later. Meanwhile the person can push the arm free.
            direct, none = DirectReturn.none(q), torch.zeros_like(state.path.waited)
            state = replace(state, path=replace(state.path, direct_return=direct, waited=none))
        back = float((q - self._wished()[0]).abs().max()) < _SAME and not state.aside
        self.joints, self._state = self._wished()[0] if back else q, state

    def _request(self) -> FollowPath:
        """Request to follow the policy's path during this step."""
        fractions = [k / self._steps for k in range(self._steps + 3)]
        position = torch.stack([self._wished(at)[0] for at in fractions])
        velocity = position.diff(dim=0) / self._loop.config.dt
        # A velocity is a difference of two postures, so the last posture has no velocity.
        position = position[:-1]
        ends = torch.stack([position[0], position[0] + 0.2 * velocity[0]])
        narrow, ahead = smallest_singular_value(self._chain, ends) < NARROW
        count = len(position)
        paths = JointPaths(
            position=position[None],
            velocity=velocity[None],
            narrow=narrow.expand(1, count),
            narrow_ahead=(narrow | ahead).expand(1, count),
            last=torch.tensor([count - 1]),
        )
        return FollowPath(paths=paths, path=torch.tensor(0))

    def _reading(
        self, joints: Float[Tensor, " joints"], push: Float[Tensor, " joints"], *, explain: bool
    ) -> ArmReading:
        pose, jacobian = self._chain.forward_and_jacobian(joints)
        return ArmReading(
            joint_position=joints,
            pose=pose,
            jacobian=jacobian,
            nullspace_input=push,
            pause=torch.tensor(False),
            explain=explain and bool(push.any()),
        )

    def _comes_too_near(
        self, joints: Float[Tensor, " joints"], reached: Float[Tensor, " joints"]
    ) -> bool:
        """True if a step reduces the clearance to less than the configured clearance.

        Args:
            joints: Joint positions before the step [rad].
            reached: Joint positions after the step [rad].
        """
        if self._loop.clearance is None:
            return False
        now, then = self._loop.clearance(torch.stack([joints, reached])).tolist()
        distance = 100 * now
        near = then < min(now, self._loop.config.clearance) - _ROUNDING
        if near:
            self._feedback.note("obstacle", 0.0, distance=distance)
        return near

    def _stopped(self, state: ArmLoopState) -> ArmLoopState:
        """The state with all velocities and accelerations set to zero."""
        still = torch.zeros_like(state.null_velocity)
        path = replace(state.path, rate=torch.zeros_like(state.path.rate))
        safety = replace(state.safety, velocity=still, acceleration=still)
        return replace(
            state, path=path, safety=safety, null_velocity=still, return_velocity=still
        )
