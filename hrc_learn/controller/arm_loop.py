"""Control law of an arm near people, one control step at a time.

A step is a pure function `(state, reading, request) -> (command, state, report)`:

1. *Observe* a reading: the null-space push is smoothed, and the joint path advances, waits or
   is retraced, depending on people near the arm and on how well the arm tracks the path.
2. *Act* on a request: a joint path, a pose of the end effector, a joint velocity, or a command
   of the adaptive controller becomes a joint velocity. The null space yields to the push, and
   the safety filter has the last word. The pace of the task (`TaskPace`) drops by the fraction
   of the motion that people prevented.

States, readings and requests have any number of leading batch dimensions. Drivers, clocks, logs
and messages to people belong to the caller.
"""

from dataclasses import replace
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmLoopState,
    ArmReading,
    ArmReport,
    ArmRequest,
    FollowPath,
    Limitation,
    PathState,
    TrackPose,
    WantedMotion,
)
from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.controller.interface import Command, SafetyReport
from hrc_learn.controller.null_space_motion import (
    Clearance,
    EasedVelocity,
    eased_null_velocity,
    fraction_in_null_space,
    fraction_kept,
    guided_elbow_speed,
    limiting_joint,
)
from hrc_learn.controller.path_law import PathLaw, twist_of
from hrc_learn.controller.task_pace import TaskPace, capped_scale, closes_in, null_space_input
from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import everywhere, is_number, null_projection
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import apply_where

# A smaller reduction of the task's speed by the constraint layer counts as rounding.
_SLOWED = 1e-3
# Norm of the whole twist below which the task counts as at rest [m/s and rad/s mixed].
_AT_REST = 1e-3


@final
class ArmLoop:
    """Control law of an arm or a batch of identical arms; the caller passes in the state."""

    def __init__(
        self,
        chain: SerialChain,
        config: ArmLoopConfig | None = None,
        clearance: Clearance | None = None,
    ):
        """Put the parts together.

        Args:
            chain: Kinematics and limits of the arm.
            config: Settings of the loop.
            clearance: Function that returns the distance of the arm from itself and its
                surroundings; None: a push can move the arm anywhere within its limits.
        """
        self.chain, self.clearance = chain, clearance
        config = config or ArmLoopConfig()
        elbow_speed = min(config.elbow_speed, guided_elbow_speed(config.safety.tcp_speed))
        self.config = config = replace(config, elbow_speed=elbow_speed)
        self.path_law = PathLaw(chain, config, clearance)
        self.safety = self.path_law.safety

    def initial_state(
        self,
        joint_position: Float[Tensor, "*batch n"],
        time: float = 0.0,
        joint_velocity: Float[Tensor, "*batch n"] | None = None,
    ) -> ArmLoopState:
        """State of arms that follow no path.

        Args:
            joint_position: Joint positions [rad].
            time: Reading of the clock [s].
            joint_velocity: Measured joint velocities [rad/s]; None: at rest.
        """
        still = torch.zeros_like(joint_position)
        clock = still.new_full(still.shape[:-1], time)
        never = torch.zeros_like(clock, dtype=torch.bool)
        return ArmLoopState(
            safety=self.safety.initial_state(joint_position, joint_velocity),
            pace=TaskPace.begin(clock, self.config.speed),
            null_velocity=still,
            return_velocity=still,
            aside=never,
            lost=never,
            path=PathState.none(joint_position, self.chain.forward(joint_position)),
        )

    def step(
        self, state: ArmLoopState, reading: ArmReading, request: ArmRequest
    ) -> tuple[Float[Tensor, "*batch n"], ArmLoopState, ArmReport]:
        """One step of the loop.

        Args:
            state: State of the step before.
            reading: Newest reading.
            request: Motion that the task asks for.

        Returns:
            Joint velocity to send [rad/s], the next state, and a report.
        """
        state, limitations = self.observe(state, reading)
        command, state, report = self.act(state, reading, request)
        return command, state, report._replace(limitations=limitations + report.limitations)

    def observe(
        self, state: ArmLoopState, reading: ArmReading
    ) -> tuple[ArmLoopState, tuple[Limitation, ...]]:
        """First half of a step: process a reading.

        Args:
            state: State of the step before.
            reading: Newest reading.

        Returns:
            The state, and the limitations of the push.
        """
        reading = self._known(state, reading)
        null_velocity, limitations = self._eased_push(state, reading)
        pace = state.pace.overridden(reading.pause, self.config.dt)
        state = replace(state, null_velocity=null_velocity, pace=pace)
        return replace(state, path=self.path_law.go_on(state, reading)), limitations

    def act(
        self, state: ArmLoopState, reading: ArmReading, request: ArmRequest
    ) -> tuple[Float[Tensor, "*batch n"], ArmLoopState, ArmReport]:
        """Second half of a step: turn a request into a joint velocity.

        The argument `state` comes from `observe`; the other arguments and the results are those
        of `step`.
        """
        reading = self._known(state, reading)
        if isinstance(request, Command):
            return self._send(state, reading, request)
        if isinstance(request, FollowPath):
            wanted, state = self.path_law.follow(state, reading, request)
        elif isinstance(request, TrackPose):
            wanted, state = self._track(state, reading, request), _without_path(state)
        else:
            wanted, state = WantedMotion(request.joint_velocity), _without_path(state)
        return self._filtered(state, reading, wanted)

    def _known(self, state: ArmLoopState, reading: ArmReading) -> ArmReading:
        """The reading, with invalid values replaced and `stop` set where there were any. Joint
        positions that are not finite are replaced by the positions predicted from the commands;
        a push that is not finite is replaced by zero.
        """
        q, push = reading.joint_position, reading.nullspace_input
        located, felt = (is_number(x).all(-1, keepdim=True) for x in (q, push))
        if everywhere(located & felt):
            return reading
        q = torch.where(located, q, state.safety.position)
        push = torch.where(felt, push, 0.0)
        pose, J = self.chain.forward_and_jacobian(q)
        stop = ~(located & felt).squeeze(-1)
        stop = stop if reading.stop is None else stop | reading.stop
        measured = {"joint_position": q, "pose": pose, "jacobian": J, "nullspace_input": push}
        return replace(reading, **measured, stop=stop)

    # The push on the null space.

    def _eased_push(
        self, state: ArmLoopState, reading: ArmReading
    ) -> tuple[Tensor, tuple[Limitation, ...]]:
        """Null-space velocity for the present push [rad/s], and limitations of the push."""
        requested = self._requested_null_velocity(state, reading)
        acts = (requested.norm(dim=-1) > 0) | state.pushed
        if not bool(acts.any()):
            return requested, ()
        q, J = reading.joint_position, reading.jacobian
        config, bounds = self.config, self.path_law.task_margin.velocity_bounds(q)

        one = q.new_ones(q.shape[:-1])
        eased = apply_where(
            acts,
            lambda part: eased_null_velocity(self.chain, *part, dt=config.dt, config=config),
            (q, J, state.null_velocity, requested, bounds),
            EasedVelocity(requested, requested, one, one, requested, requested),
        )
        if not reading.explain:
            return eased.velocity, ()
        return eased.velocity, (
            Limitation("task", fraction_in_null_space(requested, eased.projected)),
            Limitation("speed", eased.slowdown),
            Limitation("singularity", eased.fade),
            Limitation(
                "joint_limit",
                fraction_kept(eased.unbounded, eased.bounded),
                joint=limiting_joint(eased.unbounded, *bounds),
            ),
        )

    def _requested_null_velocity(self, state: ArmLoopState, reading: ArmReading) -> Tensor:
        """Joint velocity requested by push and repulsion; only its null-space part acts."""
        config, still = self.config, torch.zeros_like(reading.nullspace_input)
        way, path = config.way_making, state.path
        push = reading.nullspace_input if way is None or way.expert else still
        own = null_space_input(None, _distances(reading), way, config.damping)
        if own is not None:
            # Way-making may last: it must not keep a path waiting.
            waits = path.followed & (path.rate < 1)
            push = push + own.masked_fill(waits.unsqueeze(-1), 0.0)
        return _scaled(push, reading) / config.damping

    # Poses of the end effector.

    def _track(
        self, state: ArmLoopState, reading: ArmReading, request: TrackPose
    ) -> WantedMotion:
        """Joint velocity that tracks the requested pose of the end effector [rad/s]."""
        every, push = torch.ones_like(state.aside), state.null_velocity
        tracked = self.path_law.track(
            state, reading, request.pose, request.twist, push, every, slows=False
        )
        limitations = tracked.limitations() if reading.explain else ()
        return WantedMotion(tracked.joint_velocity, limitations, request.pose)

    # The safety filter, and the pace of the task.

    def _filtered(
        self, state: ArmLoopState, reading: ArmReading, wanted: WantedMotion
    ) -> tuple[Tensor, ArmLoopState, ArmReport]:
        """Joint velocity after the safety filter [rad/s], the next state, and the report."""
        velocity = wanted.joint_velocity
        J, q, load = reading.jacobian, reading.joint_position, reading.load
        if (people := reading.people) is not None:
            scale = capped_scale(self.chain, q, J, velocity, people.speed_cap)
            people = replace(people, speed_scale=torch.minimum(scale, people.speed_scale))
            reading = replace(reading, people=people)
        sent, safety, filtered = self.safety.step(
            state.safety,
            q,
            _scaled(velocity, reading),
            self.config.dt,
            jacobian=J,
            load=None if load is None else quaternion.rotate(reading.pose.orientation, load),
            distances=_distances(reading),
            stop=reading.stop,
        )
        slowed = self._slowed_by_people(reading, sent, filtered)
        left = fraction_kept(twist_of(J, velocity), twist_of(J, sent), _AT_REST)
        pace = state.pace.limited(torch.where(slowed, left, 1.0), self.config.dt)
        report = ArmReport(filtered, *wanted[1:])
        if reading.explain:
            report = self._explained(reading, report, velocity, sent)
        return sent, replace(state, safety=safety, pace=pace), report

    def _send(
        self, state: ArmLoopState, reading: ArmReading, command: Command
    ) -> tuple[Tensor, ArmLoopState, ArmReport]:
        """Joint velocity of the adaptive controller's command, slowed to the pace of the task
        [rad/s], the next state, and the report.
        """
        J, q = reading.jacobian, reading.joint_position
        slowed = self._slowed_by_people(reading, command.joint_velocity, command.safety)
        left = fraction_kept(command.twist, twist_of(J, command.joint_velocity), _AT_REST)
        velocity = state.pace.speed_override.unsqueeze(-1) * command.joint_velocity
        pace = state.pace.limited(torch.where(slowed, left, 1.0), self.config.dt)
        change = (velocity - state.safety.velocity) / self.config.dt
        safety = replace(state.safety, position=q, velocity=velocity, acceleration=change)
        state = replace(_without_path(state), safety=safety, pace=pace)
        report = ArmReport(command.safety)
        if reading.explain:
            # The request includes the joint-space feedback, as in the law.
            push = state.null_velocity - command.xi_q / self.config.damping
            wanted, bounds = null_projection(J, push), self.safety.velocity_bounds(q)
            kept = fraction_kept(wanted, command.null_velocity)
            limit = Limitation("joint_limit", kept, joint=limiting_joint(wanted, *bounds))
            report = self._explained(
                reading, report, command.null_velocity, command.joint_velocity
            )._replace(limitations=(limit,))
        return velocity, state, report

    def _slowed_by_people(
        self, reading: ArmReading, sent: Tensor, report: SafetyReport
    ) -> Tensor:
        """True where people slow the arm down or stop it, or their distance is unknown."""
        slowed, people = reading.stop, reading.people
        if slowed is None:
            slowed = torch.zeros_like(reading.pause)
        if people is None:
            return slowed
        slowed = slowed | (people.speed_scale < 1)
        if (layer := report.constraints) is not None:
            # Slowing down for the arm's own limits does not count: otherwise a path could wait
            # forever.
            given_up = (layer.slowed > _SLOWED) & closes_in(
                people.distances, sent, self.safety.config
            )
            slowed = slowed | ~people.distances.known() | ~layer.solved | given_up
        return slowed

    def _explained(
        self, reading: ArmReading, report: ArmReport, velocity: Tensor, sent: Tensor
    ) -> ArmReport:
        """The report, with the null-space motion before and after the safety filter."""
        J, people, config = reading.jacobian, reading.people, self.safety.config
        slowed = torch.zeros_like(reading.pause)
        if people is not None:
            slowed = people.speed_scale < 1
            if config.constraints is not None:
                slowed = slowed | closes_in(people.distances, sent, config)
        motion = null_projection(J, velocity), null_projection(J, sent)
        return report._replace(slowed_by_people=slowed, null_motion=motion)


def _without_path(state: ArmLoopState) -> ArmLoopState:
    """The state of a loop that follows no path in this step."""
    return replace(state, path=replace(state.path, followed=torch.zeros_like(state.aside)))


def _distances(reading: ArmReading) -> Distances | None:
    return None if reading.people is None else reading.people.distances


def _scaled(velocity: Tensor, reading: ArmReading) -> Tensor:
    """A joint vector times the speed scale that people near the arm impose."""
    people = reading.people
    return velocity if people is None else people.speed_scale.unsqueeze(-1) * velocity
