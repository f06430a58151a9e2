"""How a run leads the arm of its world: directly, or by the driver of the real one.

    access = through_franky(FrankyConfig(dynamics=0.3, realtime="ignore"))
    simulate_collaboration(aiming, placing, shelves, access=access)

By the driver the same task goes through all that stands before a real arm: its package, its
sockets, and the 1 ms cycles of its protocol, which the world answers.
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
"""Puts the arm of a world behind its protocol, as `serve_world` does."""

FRANKY_DELAY = 0.003
"""From a command to franky until the arm's servos have it [s]: two cycles of the protocol, and
one that the state read before is old. Measured with commands every 10 ms."""


@dataclass(frozen=True, kw_only=True)
class ArmAccess:
    """How a run leads the arm of its world."""

    open: Callable[[World], AbstractContextManager[OpenedArm]]
    """Connects to the arm of a world that is at rest, until the run ends."""
    delay: float = 0.0
    """From a command until the arm's servos have it [s]."""
    dynamics: float = 1.0
    """Fraction of the arm's acceleration that the driver uses."""

    def told(self, sizes: Imperfections) -> Imperfections:
        """What a controller has to be told of the arm: its imperfections and the driver's."""
        return replace(
            sizes,
            command_delay=sizes.command_delay + self.delay,
            slowness=max(sizes.slowness, 1 - self.dynamics),
        )


SIMULATED = ArmAccess(open=lambda world: nullcontext(world.opened_arm))
"""The simulated arm itself."""


def through_franky(config: FrankyConfig | None = None, serve: Serve = serve_world) -> ArmAccess:
    """Over the network protocol, by the driver package franky.

    Args:
        config: How the driver leads the arm; None: as a real one, but for real time, which a
            server that waits for each answer does not need, and the grip of the simulated hand.
        serve: Puts the arm behind its protocol.
    """
    config = config or FrankyConfig(realtime="ignore", grip_force=40.0)
    return through_protocol(
        partial(FrankyArm, config=config),
        delay=FRANKY_DELAY,
        dynamics=config.dynamics,
        serve=serve,
    )


def through_franka(
    chain: SerialChain, config: FrankaConfig | None = None, serve: Serve = serve_world
) -> ArmAccess:
    """Over the network protocol, by our loop at 1 kHz.

    Args:
        chain: The arm.
        config: How the arm is driven; None: as for `through_franky`, and in lockstep with the
            server.
        serve: Puts the arm behind its protocol.
    """
    config = config or FrankaConfig(realtime=False, lockstep=True)
    return through_protocol(
        partial(FrankaArm, chain=chain, config=config),
        delay=FRANKY_DELAY,
        dynamics=config.acceleration,
        serve=serve,
    )


ArmDriver = Literal["sim", "franky", "franka"]
"""What leads an arm: the simulator itself, or a driver of the real one."""


def access_by(driver: ArmDriver, robot: Arm) -> ArmAccess:
    """How a driver leads the arm of a world.

    Args:
        driver: Its name.
        robot: The arm.

    Raises:
        ValueError: The driver is of other arms.
    """
    if driver == "sim":
        return SIMULATED
    if not robot.is_franka:
        raise ValueError(
            f"--arm {driver} drives Franka's arms, not the {robot.name}: leave it out, and the "
            "simulated arm is led without a driver."
        )
    return through_franky() if driver == "franky" else through_franka(robot)


def through_protocol(
    open_driver: Callable[[str], Any],
    *,
    delay: float,
    dynamics: float,
    serve: Serve = serve_world,
) -> ArmAccess:
    """Over the network protocol, by any driver.

    Args:
        open_driver: Connects to the arm at an address: an `Arm` and a `Gripper` with `close`.
        delay: From a command until the arm's servos have it [s].
        dynamics: Fraction of the arm's acceleration that the driver uses.
        serve: Puts the arm behind its protocol.
    """

    @contextmanager
    def open_arm(world: World) -> Iterator[OpenedArm]:
        with serve(world) as server:
            with server.running():
                driver = open_driver(server.address)
            with closing(ServedArm(driver, server)) as arm:
                yield OpenedArm(arm=arm, gripper=arm, advance=server.advance)

    return ArmAccess(open=open_arm, delay=delay, dynamics=dynamics)
