"""Simulations that diverge, in the workplace and in a model of two bodies."""

import copy

import mujoco
import numpy as np
import pytest

from hrc_learn.sim import PhysicsError, World
from hrc_learn.sim.step_checks import PhysicsWatch
from hrc_learn.sim.workplace import Workplace

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs.


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into a file where it runs."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def world():
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    return world


def push(world: World, force: float) -> None:
    """A force on the box, upwards [N]."""
    world.data.body("box").xfrc_applied[2] = force


@pytest.mark.parametrize("force", [1e5, 1e9, 1e30, np.nan, np.inf])
def test_an_absurd_force_ends_the_run_with_time_and_body(world, force):
    world.advance(0.1)
    push(world, force)
    with pytest.raises(PhysicsError, match=r"physics failed at box at 0\.1") as caught:
        world.advance(0.1)
    assert caught.value.body == "box"
    assert 0.1 <= caught.value.time <= 0.13
    assert world.time > 0.09  # it was not put back to the start


def test_a_hard_knock_is_no_failure(world):
    push(world, 50.0)  # 42 times the box's weight
    world.advance(0.02)
    push(world, 0.0)
    world.advance(1.0)
    assert np.isfinite(world.data.qpos).all()


@pytest.mark.parametrize("values", ["qpos", "qvel"])
def test_a_state_that_is_no_number_is_found_and_named(world, values):
    joint = world.data.joint("box")
    getattr(joint, values)[1] = np.nan
    with pytest.raises(PhysicsError) as caught:
        world.advance(0.01)
    assert caught.value.body == "box"


def test_a_command_that_is_no_number_is_found(world):
    world.arm.move(np.nan)
    with pytest.raises(PhysicsError, match="huge value in CTRL"):
        world.advance(0.01)


@pytest.mark.parametrize("force", [1e9, np.nan])
def test_a_simulation_that_mujoco_puts_back_to_the_start_is_found(world, force):
    """As before the watch, when one went on from time zero in the first pose."""
    world.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    world.advance(0.1)
    push(world, force)
    with pytest.raises(PhysicsError):
        world.advance(0.1)


def test_time_that_goes_back_is_found_unless_it_was_asked_for(world):
    world.advance(0.2)
    world.reset(Workplace().home_joints().numpy())
    world.advance(0.1)
    mujoco.mj_resetData(world.model, world.data)
    with pytest.raises(PhysicsError, match=r"time went back from 0.100 s"):
        world.advance(0.05)


def test_a_world_can_be_used_again(world):
    push(world, 1e9)
    with pytest.raises(PhysicsError):
        world.advance(0.1)
    world.reset(Workplace().home_joints().numpy())
    world.advance(0.5)
    assert world.time == pytest.approx(0.5)


def test_the_first_body_is_named_though_all_of_them_are_gone():
    """A ball hangs on a stiff spring: alone it would be fine, its neighbour takes it along."""
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body name="first"><freejoint/><geom size="0.1"/></body>
          <body name="second" pos="1 0 0"><freejoint/><geom size="0.1"/></body>
        </worldbody>
        <equality><connect body1="first" body2="second" anchor="1 0 0"/></equality></mujoco>
    """)
    data = mujoco.MjData(model)
    watch = PhysicsWatch(model, data)
    data.qpos[7] = np.nan
    mujoco.mj_step(model, data)
    assert not np.isfinite(data.qvel[:6]).any()
    with pytest.raises(PhysicsError, match="physics failed at second"):
        watch.after_step()


def test_the_error_survives_the_way_between_processes():
    """A copy is made as what another process receives."""
    error = copy.copy(PhysicsError("it moves", 1.5, "box"))
    assert str(error) == "physics failed at box at 1.500 s: it moves"
    assert (error.time, error.body) == (1.5, "box")
