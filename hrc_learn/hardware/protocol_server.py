"""Serve the simulated workplace over the network protocol of a Franka arm.

A driver for the real arm connects over sockets and controls the simulated arm in cycles of
1 ms. The package franky-sim implements the protocol, and `World` simulates the physics. The
server identifies itself as a Franka Research 3 (server version 10), but the simulated arm is a
Panda with our limits. This does not affect joint velocities and positions, whose limits the
driver enforces. Poses are those of the Research 3 model; dynamics are not reported, and torque
commands have no effect.
"""

import random
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any, final

import numpy as np
from jaxtyping import Float

from hrc_learn.hardware.driver_process import imported
from hrc_learn.hardware.franka_settings import CYCLE
from hrc_learn.protocols import ArmState
from hrc_learn.sim.world import World

_LATE = 0.01
"""Longest wait for the driver's answer in a cycle [s]: ten times the usual delay on a busy
machine.
"""
_SIGN_OF_LIFE = 0.05
"""Period of cycles while `advance` is not called [s]: a driver that receives nothing for 1 s
assumes that its connection is lost (libfranka)."""
_BRIDGED = 20
"""Cycles without an answer, in a row, after which a control box stops the arm (libfranka,
network requirements)."""


class ArmServer:
    """Server that steps a world in cycles of the arm's protocol.

        with serve_world(world) as server:
            arm = FrankyArm(server.address, FrankyConfig(realtime=False))
            with server.running():
                arm.command(velocity)
            server.advance(0.01)

    Time is simulated: within `advance`, each cycle waits for the driver's answer. Outside
    `advance`, the world stands still so that it can be inspected; only rare cycles keep the
    connection alive. Use `running` around driver calls that may wait for the next cycle.

    In a cycle without an answer, the arm keeps its acceleration, as with a real control box and
    velocity commands.

    Attributes:
        world: The world.
        address: Network address of the arm, for its driver.
        robot: The arm, as a robot of franky-sim.
        link: Server of the protocol, from franky-sim.
        cycles: Number of cycles so far.
        missed: Number of cycles of a motion that the driver did not answer in time.
    """

    def __init__(self, world: World):
        """Listen; `serve_world` calls this and closes the server.

        Args:
            world: The world. Its physics runs in steps of a cycle from now on.

        Raises:
            ImportError: The package franky-sim is not installed.
        """
        self.world = world
        self.cycles = self.missed = self._gap = 0
        served = imported(
            "hrc_learn.hardware.served_robot",
            "franky-sim speaks the protocol of the arm: pip install 'hrc-learn[hardware]'",
        )
        self.robot = served.ServedRobot(world)
        self.link = served.PunctualServer(self.robot, loopback_addresses())
        self.link.init()
        self.address: str = self.link.hostname
        self.link.process_commands()  # there are none yet, but a step requires this call
        self._due = world.time
        # World time until which the thread may advance; None: no limit, during driver calls.
        self._until: float | None = world.time
        self._sent = 0
        self._error: BaseException | None = None
        self._closed = False
        self._turn = threading.Condition()
        self._thread = threading.Thread(target=self._serve, name="arm server", daemon=True)
        self._thread.start()

    @property
    def clock_offset(self) -> float:
        """World time minus the arm's time, which starts at 0 with each connection [s]."""
        # Cycles are numbered from 0; the number of the last one is the driver's time.
        return self.world.time - (self._sent - 1) * CYCLE

    def begin(self) -> None:
        """Count the time of `advance` from now on, so that the time for connecting is left
        out.
        """
        self._due = self.world.time

    def advance(self, duration: float) -> None:
        """Advance the world until `duration` after the end of the previous call [s].

        World time that passed during driver calls in between is a part of this duration, as in
        a loop with a fixed rate.

        Raises:
            PhysicsError: The simulation diverged.
        """
        # A loop that is late by more than a period does not catch up.
        self._due = max(self._due + duration, self.world.time)
        with self._turn:
            self._until = self._due
            self._turn.notify_all()
            self._turn.wait_for(self._has_paused)
        self._raise_error()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Let the world advance while the driver is called, at most in real time."""
        with self._turn:
            self._until = None
            self._turn.notify_all()
        try:
            yield
        finally:
            with self._turn:
                self._until = self.world.time
                self._turn.notify_all()
        self._raise_error()

    def close(self) -> None:
        """End all connections; the world stays as it is."""
        with self._turn:
            self._closed = True
            self._turn.notify_all()
        self._thread.join()
        self._hang_up()

    def _hang_up(self) -> None:
        self.link.cleanup()
        self.link.reset_state()
        self.link.gripper_server.reset_state()

    def _has_paused(self) -> bool:
        return self._error is not None or (self._until is not None and not self._may_go_on())

    def _may_go_on(self) -> bool:
        # Times are sums of rounded cycles.
        return self._until is None or self.world.time < self._until - CYCLE / 2

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _serve(self) -> None:
        while True:
            started = time.monotonic()
            with self._turn:
                self._turn.wait_for(lambda: self._closed or self._may_go_on(), _SIGN_OF_LIFE)
                if self._closed:
                    return
                try:
                    self._cycle()
                except Exception as error:  # from the physics, or an unsupported motion
                    self._error = error
                in_real_time = self._until is None
                self._turn.notify_all()
                if self._error is not None:
                    self._hang_up()  # otherwise its driver would wait for a minute
                    return
            if in_real_time:
                time.sleep(max(0.0, CYCLE - (time.monotonic() - started)))

    def _cycle(self) -> None:
        """Step the physics, and send the new state to the driver. The driver's answer counts in
        the next cycle.
        """
        robot = self.robot
        robot.step()
        robot.begin_cycle()
        connected = self.link.udp_connected
        self.link.send_state()
        self.cycles += 1
        self._sent = self._sent + 1 if connected else 0
        self._await_answer()
        if self.link.current_motion_id:
            self._gap = 0 if robot.answered else self._gap + 1
            if not robot.answered and self._gap <= _BRIDGED:
                robot.go_on()

    def _await_answer(self) -> None:
        give_up = time.monotonic() + _LATE
        while True:
            self.link.process_commands()
            if self.robot.answered or not self.link.current_motion_id:
                return
            if time.monotonic() > give_up:
                self.missed += 1
                return
            time.sleep(0)


@final
class ServedArm:
    """Driver of an arm that an `ArmServer` serves; the world stands still between calls.

    Times are those of the world's clock.
    """

    def __init__(self, arm: Any, server: ArmServer):
        """Wrap a driver.

        Args:
            arm: An `Arm` and a `Gripper` that is connected to the server.
            server: The server.
        """
        self._arm, self._server = arm, server
        server.begin()

    def read(self) -> ArmState:
        """Return the newest state."""
        with self._server.running():
            state = self._arm.read()
        offset = self._server.clock_offset
        return ArmState(**(vars(state) | {"time": state.time + offset}))

    def command(self, joint_velocity: Float[np.ndarray, " joints"]) -> None:
        """Set the joint velocities to hold [rad/s]."""
        with self._server.running():
            self._arm.command(joint_velocity)

    def move(self, width: float) -> None:
        """Set the opening of the gripper [m]."""
        with self._server.running():
            self._arm.move(width)

    def close(self) -> None:
        """Bring the arm to rest and disconnect."""
        with self._server.running():
            self._arm.close()


def loopback_addresses() -> list[str]:
    """Random loopback addresses of this machine, so that servers do not collide."""
    chance = random.Random()
    return [
        f"127.{chance.randrange(1, 255)}.{chance.randrange(256)}.{chance.randrange(1, 255)}"
        for _ in range(50)
    ]


@contextmanager
def serve_world(world: World) -> Iterator[ArmServer]:
    """Serve a world's arm until the block ends.

    Args:
        world: The world, at rest; it must not be reset within the block. Within the block, its
            physics runs in steps of 1 ms.

    Raises:
        ImportError: The package franky-sim is not installed.
    """
    step = world.model.opt.timestep
    world.model.opt.timestep = CYCLE
    try:
        with closing(ArmServer(world)) as server:
            yield server
    finally:
        world.model.opt.timestep = step
