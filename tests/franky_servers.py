"""Simulators of a Franka arm's network protocol for tests, and a driver connected to them."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace

from hrc_learn.hardware import FrankyArm, FrankyConfig
from hrc_learn.hardware.protocol_server import ServedArm, loopback_addresses, serve_world
from hrc_learn.kinematics import panda
from hrc_learn.sim import SceneConfig, World

READY = panda.ready.numpy()


@contextmanager
def simulated_arm() -> Iterator[SimpleNamespace]:
    """franky-sim's own arm in MuJoCo, which goes on in real time as far as the machine does.

    `server.running`, set to False, is a cable pulled out; `plug_in()` puts it back.
    """
    from franky_sim import SimulationServer
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator() as simulator:
        robot = simulator.add_robot()
        with SimulationServer(simulator, loopback_addresses()) as server:
            server.run_async()

            def pull_out() -> None:
                server.running = False
                assert server.async_thread is not None
                server.async_thread.join()

            yield SimpleNamespace(
                ip=robot.hostname,
                robot=robot,
                server=server,
                pull_out=pull_out,
                plug_in=server.run_async,
            )


@contextmanager
def served_world(
    world: World | None = None, config: FrankyConfig | None = None, **serving
) -> Iterator[SimpleNamespace]:
    """A world of ours, at rest, with franky connected to its arm.

    Time passes by `server.advance` only, so that a slow machine makes no difference. `serving`
    goes to `serve_world`.
    """
    if world is None:
        world = World(SceneConfig(objects=()))
        world.reset(READY)
    config = config or FrankyConfig(realtime=False, dynamics=1.0)
    with serve_world(world, **serving) as server:
        with server.running():
            driver = FrankyArm(server.address, config)
        with closing(ServedArm(driver, server)) as arm:
            yield SimpleNamespace(world=world, server=server, driver=driver, arm=arm)
