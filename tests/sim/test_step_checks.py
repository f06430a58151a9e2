"""Simulations that diverge, in the workplace and in a model of two bodies."""

import copy

import mujoco
import numpy as np
import pytest

from hrc_learn.sim import PhysicsError, World
from hrc_learn.sim.step_checks import FASTEST, ContactMonitor, PhysicsWatch
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


TOUCHING = """<mujoco><worldbody>
  <body name="mover"><freejoint/><geom name="mover" size="0.1" mass="1"/>
    <body name="tip" pos="0 0 0.3"><geom name="tip" size="0.05" mass="1"/></body></body>
  <body name="wall" pos="0.25 0 0"><geom name="wall" type="box" size="0.1 1 1"/></body>
  <body name="post" pos="0 0.25 0"><geom name="post" type="box" size="1 0.1 1"/></body>
</worldbody></mujoco>"""


def test_a_touch_lasts_from_its_first_to_its_last_step_and_knows_its_depth():
    model = mujoco.MjModel.from_xml_string(TOUCHING)
    data = mujoco.MjData(model)
    monitor = ContactMonitor(model, ["mover"], ["wall"])
    names = [model.geom(g).name for g in range(model.ngeom)]
    expected = np.zeros((4, 4), dtype=bool)
    for mover in ("mover", "tip"):  # what hangs on a mover moves along
        i, k = names.index(mover), names.index("wall")
        expected[i, k] = expected[k, i] = True
    np.testing.assert_array_equal(monitor.watched, expected)
    # Depths of the ball in the wall [m]; the wall begins at 0.15.
    for step, x in enumerate([0.0, 0.06, 0.08, 0.07, 0.0, 0.11, 0.09]):
        data.time, data.qpos[0], data.qpos[1] = float(step), x, 0.08  # in the post as well
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        monitor.update(data)
    first, third, second = sorted(monitor.touches, key=lambda touch: (touch.first, touch.start))
    for touch, (name, begin, end, depth) in zip(
        (first, third, second),
        (("mover", 1, 3, 0.03), ("mover", 5, 6, 0.06), ("tip", 5, 5, 0.01)),
        strict=True,
    ):
        assert (touch.first, touch.second) == (name, "wall")
        assert (touch.start, touch.end) == (begin, end)
        assert touch.depth == pytest.approx(depth, abs=1e-9)
    # After a pause the same contact is another touch.
    monitor.pause()
    monitor.update(data)
    assert len(monitor.touches) == 4
    monitor.clear()
    assert not monitor.touches
    monitor.update(data)
    assert len(monitor.touches) == 1


@pytest.mark.parametrize(("speed", "plausible"), [(0.999, True), (1.001, False)])
def test_a_body_may_move_as_fast_as_the_fastest(world, speed, plausible):
    dof = world.model.joint("box").dofadr[0] + 1
    world.data.qvel[dof] = -speed * FASTEST
    watch = PhysicsWatch(world.model, world.data)
    if plausible:
        watch.after_step()
    else:
        with pytest.raises(PhysicsError, match=r"it moves at .* m/s or rad/s") as caught:
            watch.after_step()
        assert caught.value.body == "box"


@pytest.mark.parametrize("values", ["qpos", "qvel", "qacc"])
@pytest.mark.parametrize("joint", ["panda_joint3", "finger_right", "box"])
def test_a_number_that_is_none_is_traced_to_its_body(world, values, joint):
    model = world.model
    start = model.joint(joint).qposadr if values == "qpos" else model.joint(joint).dofadr
    getattr(world.data, values)[start[0]] = np.nan
    body = model.body(model.joint(joint).bodyid[0]).name
    watch = PhysicsWatch(model, world.data)
    with pytest.raises(PhysicsError, match=f"{values} holds nan") as caught:
        watch.check()
    assert caught.value.body == body
