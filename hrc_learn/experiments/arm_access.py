"""Access of a run to the arm of its world: directly, or through the driver of the real arm.

    access = through_franky(FrankyConfig(dynamics=0.3, realtime="ignore"))
    simulate_collaboration(aiming, placing, shelves, access=access)

A driver takes the same task through everything in front of a real arm: the driver package, its
sockets, and the 1 ms cycles of the protocol, which the world answers.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from hrc_learn.hardware import FrankaArm, FrankaConfig, FrankyArm, FrankyConfig
from hrc_learn.kinematics import Arm, SerialChain
from hrc_learn.protocols import OpenedArm
from hrc_learn.sim import Imperfections, World
from hrc_learn.sim.protocol_server import ArmServer, ServedArm, serve_world

type Serve = Callable[[World], AbstractContextManager[ArmServer]]
"""Function that serves the arm of a world over its network protocol, such as `serve_world`."""

FRANKY_DELAY = 0.003
"""Delay from a command to franky until the servos have it [s]: two cycles of the protocol, and
one because the state read before it is one cycle old. Measured with commands every 10 ms."""


@dataclass(frozen=True, kw_only=True)
class ArmAccess:
    """Connection to the arm of a world, with the delay and dynamics of its driver."""

    open: Callable[[World], AbstractContextManager[OpenedArm]]
    """Connects to the arm of a world at rest, until the run ends."""
    delay: float = 0.0
    """Delay from a command until the servos of the arm have it [s]."""
    dynamics: float = 1.0
    """Fraction of the acceleration of the arm that the driver uses."""

    def declared(self, sizes: Imperfections) -> Imperfections:
        """Imperfections that a controller must allow for: those of arm and driver."""
        return replace(
            sizes,
            command_delay=sizes.command_delay + self.delay,
            slowness=max(sizes.slowness, 1 - self.dynamics),
        )


SIMULATED = ArmAccess(open=lambda world: nullcontext(world.opened_arm))
"""Direct access to the simulated arm."""


def through_franky(config: FrankyConfig | None = None, serve: Serve = serve_world) -> ArmAccess:
    """Access over the network protocol through the driver package franky.

    Args:
        config: Configuration of the driver. By default that of a real arm without the real-time
            check, which a server that waits for each answer does not need, and with the grip
            force of the simulated gripper.
        serve: Serves the arm over its protocol.
    """
    config = config or FrankyConfig(realtime="ignore", grip_force=40.0)
    driver = partial(FrankyArm, config=config)
    return through_protocol(driver, delay=FRANKY_DELAY, dynamics=config.dynamics, serve=serve)


def through_franka(
    chain: SerialChain, config: FrankaConfig | None = None, serve: Serve = serve_world
) -> ArmAccess:
    """Access over the network protocol through our own loop at 1 kHz.

    Args:
        chain: Kinematics of the arm.
        config: Configuration of the loop. By default as for `through_franky`, in lockstep with
            the server.
        serve: Serves the arm over its protocol.
    """
    config = config or FrankaConfig(realtime=False, lockstep=True)
    driver = partial(FrankaArm, chain=chain, config=config)
    return through_protocol(
        driver, delay=FRANKY_DELAY, dynamics=config.acceleration, serve=serve
    )


ArmDriver = Literal["sim", "franky", "franka"]
"""Driver of a simulated arm: the simulator itself, or a driver of the real arm."""


def access_by(driver: ArmDriver, robot: Arm) -> ArmAccess:
    """Access to the arm of a world through a named driver.

    Args:
        driver: Name of the driver.
        robot: Arm of the world.

    Raises:
        ValueError: If the driver does not support the arm.
    """
    if driver == "sim":
        return SIMULATED
    if not robot.is_franka:
        raise ValueError(
            f"--arm {driver} drives Franka arms only, not the {robot.name}: leave it out to "
            "simulate without a driver."
        )
    return through_franky() if driver == "franky" else through_franka(robot)


def through_protocol(
    open_driver: Callable[[str], Any],
    *,
    delay: float,
    dynamics: float,
    serve: Serve = serve_world,
) -> ArmAccess:
    """Access over the network protocol through any driver.

    Args:
        open_driver: Connects to the arm at an address; returns an `Arm` and `Gripper` with
            a method `close`.
        delay: Delay from a command until the servos of the arm have it [s].
        dynamics: Fraction of the acceleration of the arm that the driver uses.
        serve: Serves the arm over its protocol.
    """

    @contextmanager
    def open_arm(world: World) -> Iterator[OpenedArm]:
        with serve(world) as server:
            with server.running():
                driver = open_driver(server.address)
            with closing(ServedArm(driver, server)) as arm:
                yield OpenedArm(arm=arm, gripper=arm, advance=server.advance)

    return ArmAccess(open=open_arm, delay=delay, dynamics=dynamics)
