"""What an imperfect cell does to what is commanded and read, against first principles."""

import math
from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest

from hrc_learn.controller import SafetyConfig
from hrc_learn.kinematics import panda
from hrc_learn.sim import CommandChannel, Imperfections, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import ImageNoise

WORKPLACE = Workplace()
HOVER = WORKPLACE.hover_joints().numpy()
LIMIT = panda.limits.acceleration.numpy()


def draw(seed=0, **sizes):
    return replace(Imperfections.ideal(), **sizes).draw(np.random.default_rng(seed))


def world(seed=0, **sizes):
    made = World(WORKPLACE.scene, draw(seed, **sizes))
    made.reset(HOVER)
    return made


def channel(**sizes):
    return CommandChannel(draw(**sizes), LIMIT)


def velocities(made, command, steps=60, dt=0.002):
    made.send(0.0, command)
    return np.array([made.advance(k * dt, dt) for k in range(steps)])


def test_the_nominal_ones_have_at_least_the_sizes_that_were_asked_for():
    nominal = Imperfections.nominal()
    assert nominal.encoder_noise >= 1e-4
    assert nominal.encoder_offset >= 2e-3
    assert nominal.command_delay >= 0.020
    assert nominal.joint_friction >= 1.0
    assert nominal.image_delay >= 0.080
    assert nominal.image_loss >= 0.20
    assert nominal.person_noise >= 0.01
    assert nominal.person_delay >= 0.080
    assert nominal.person_loss >= 0.20
    assert nominal.payload >= 0.5
    assert nominal.object_yaw == math.pi


def test_scaling_multiplies_all_but_keeps_fractions_and_turns_possible():
    nominal, twice = Imperfections.nominal(), Imperfections.nominal().scaled(2.0)
    capped = {"object_yaw"}
    for field in fields(Imperfections):
        value = getattr(nominal, field.name)
        assert value > 0
        expected = value if field.name in capped else 2 * value
        assert getattr(twice, field.name) == pytest.approx(expected)
    assert nominal.scaled(0.0) == Imperfections.ideal()
    assert nominal.scaled(9.0).image_loss == 0.9
    assert nominal.scaled(9.0).person_loss == 0.9
    assert nominal.scaled(9.0).slowness == 0.9


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("payload", -0.1),
        ("encoder_noise", math.nan),
        ("image_loss", 0.95),
        ("person_loss", 1.0),
        ("slowness", 1.0),
    ],
)
def test_impossible_sizes_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        Imperfections(**{name: value})


def test_an_ideal_arm_reads_what_it_is_and_follows_at_once():
    made = world()
    np.testing.assert_array_equal(made.arm.read().joint_position, HOVER)
    np.testing.assert_array_equal(velocities(channel(), np.full(7, 0.3))[0], np.full(7, 0.3))


def test_encoders_err_by_a_constant_and_by_noise():
    drawn = draw(encoder_noise=1e-4, encoder_offset=2e-3)
    readings = np.array([drawn.encoders(HOVER) for _ in range(4000)]) - HOVER
    offset = readings.mean(axis=0)
    assert np.abs(offset).max() <= 2e-3 + 1e-5
    assert np.abs(offset).min() > 1e-5  # each joint has its own
    np.testing.assert_allclose(readings.std(axis=0), 1e-4, rtol=0.1)


def test_a_command_arrives_late():
    seen = velocities(channel(command_delay=0.02), np.full(7, 0.3))
    first = int(np.flatnonzero(seen[:, 0])[0])
    assert first * 0.002 == pytest.approx(0.02)


def test_commands_never_overtake_each_other():
    made = channel(command_delay=0.02, command_jitter=0.02)
    followed = []
    for k in range(500):
        made.send(0.002 * k, np.full(7, float(k)))
        followed.append(made.advance(0.002 * k, 0.002)[0])
    assert (np.diff(followed) >= 0).all()
    assert len(np.unique(followed)) > 20


def test_servos_follow_with_their_time_constant():
    seen = velocities(channel(servo_lag=0.01), np.full(7, 1.0), steps=20)[:, 0]
    time = 0.002 * np.arange(1, 21)
    np.testing.assert_allclose(seen, 1 - np.exp(-time / 0.01), rtol=1e-9)


def test_a_slow_driver_uses_part_of_the_acceleration():
    seen = velocities(channel(slowness=0.7), np.full(7, 2.0))
    np.testing.assert_allclose(np.diff(seen, axis=0).max(axis=0) / 0.002, 0.3 * LIMIT)


def test_base_and_tool_stand_elsewhere_than_believed():
    ideal, made = world(), world(base_error=5e-3, base_turn=0.02)
    errors, turn = made.imperfections, made.imperfections.base_turn
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    expected = R @ ideal.arm.tcp_pose()[:3, 3] + errors.base_shift
    np.testing.assert_allclose(made.arm.tcp_pose()[:3, 3], expected, atol=1e-9)

    made = world(tool_error=5e-3)
    at = ideal.arm.tcp_pose()
    expected = at[:3, 3] + at[:3, :3] @ made.imperfections.tool_shift
    np.testing.assert_allclose(made.arm.tcp_pose()[:3, 3], expected, atol=1e-9)

    made = world(tool_turn=0.05)
    angle = np.linalg.norm(made.imperfections.tool_turn)
    between = at[:3, :3].T @ made.arm.tcp_pose()[:3, :3]
    assert math.acos((np.trace(between) - 1) / 2) == pytest.approx(angle, rel=1e-6)


def test_a_payload_weighs_on_the_joints_what_the_jacobian_says():
    ideal, made = world(), world(payload=2.0)
    mass = made.imperfections.payload
    assert 0 < mass <= 2.0
    at = ideal.data.body("hand").xpos + ideal.data.body("hand").xmat.reshape(3, 3)[:, 2] * 0.03
    J = np.zeros((3, ideal.model.nv))
    mujoco.mj_jac(ideal.model, ideal.data, J, None, at, ideal.model.body("hand").id)
    expected = J[2, :7] * mass * 9.81
    felt = (made.data.qfrc_bias - made.data.qfrc_passive)[:7]
    np.testing.assert_allclose(felt, expected, atol=1e-2)


def test_a_payload_touches_nothing():
    """It weighs on the joints only: an object may be where the load is, inside the palm."""
    made = world(payload=2.0)
    load, item = made.data.geom("payload"), made.config.objects[0].name
    pose = np.eye(4)
    pose[:3, 3] = load.xpos
    made.reset(HOVER, {item: pose})
    touching = made.data.contact.geom
    assert made.model.geom(item).id in touching  # the hand
    assert load.id not in touching


def test_the_arm_is_not_moved_by_less_than_its_friction():
    made = world(joint_friction=3.0)
    made.data.ctrl[:] = 0.0
    made.model.actuator_gainprm[:7] = 0.0
    made.model.actuator_biasprm[:7] = 0.0
    for torque, moves in ((2.5, False), (6.0, True)):
        made.reset(HOVER)
        for _ in range(50):
            made.data.qfrc_applied[0] = torque
            mujoco.mj_step(made.model, made.data)
        assert (abs(made.data.qpos[0] - HOVER[0]) > 1e-3) == moves
        made.data.qfrc_applied[0] = 0.0


def test_friction_brakes_however_hard_the_servos_do():
    made = world(joint_friction=1.0)
    made.reset(HOVER)
    made.arm.command(np.array([0.8, -0.8, 0.8, 0.8, 0.8, -0.8, 0.8]))
    made.advance(0.2)
    made.arm.command(np.zeros(7))
    data, dt = made.data, made.model.opt.timestep
    taken = given = 0.0
    for _ in range(100):
        velocity = data.qvel[:7].copy()
        made.advance(dt)
        rubs = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        work = data.efc_force[: data.nefc][rubs][:7] * velocity * dt
        taken -= work.clip(max=0.0).sum()
        given += work.clip(min=0.0).sum()
    # All of it 1 N m over the way of seven joints; a joint that turns within a step gets some.
    assert taken > 0.04
    assert given < 0.1 * taken


def test_table_and_objects_are_as_high_as_they_are():
    made = world(table_height=0.05, object_height=0.01)
    assert made.table_top == pytest.approx(made.imperfections.table_height)
    believed, real = WORKPLACE.scene.objects[0], made.config.objects[0]
    assert 0 < abs(real.half_size[2] - believed.half_size[2]) <= 0.005
    assert real.half_size[:2] == believed.half_size[:2]


def test_a_contact_is_felt_in_the_joints():
    made = World(replace(WORKPLACE.scene, objects=()), draw(torque_noise=0.1))
    made.reset(HOVER)
    free = made.arm.read().external_torque
    assert np.abs(free).max() < 1.0
    J = panda.jacobian(WORKPLACE.hover_joints()).numpy()
    down = np.linalg.pinv(J) @ np.array([0, 0, -0.05, 0, 0, 0])
    for _ in range(330):
        made.arm.command(down)
        made.advance(0.01)
    assert made.table_contacts.touches
    felt = made.arm.read().external_torque
    force = np.linalg.lstsq(J.T, felt, rcond=None)[0][2]
    assert force > 20.0  # pushed up, away from the table


def test_what_is_drawn_fills_its_range_to_both_sides_and_no_more():
    """Of each quantity, and of each of its components, in 300 runs."""
    sizes = {
        "encoder_offset": 0.4,
        "gravity_error": 0.5,
        "base_shift": 0.6,
        "base_turn": 0.7,
        "tool_shift": 0.8,
        "tool_turn": 0.9,
        "table_height": 1.1,
        "object_heights": 1.2,
    }
    # The quantities that are drawn have names of their own.
    named = {"base_shift": "base_error", "tool_shift": "tool_error"}
    named |= {"object_heights": "object_height"}
    given = Imperfections(
        payload=0.3, **{named.get(name, name): most for name, most in sizes.items()}
    )
    rng = np.random.default_rng(0)
    runs = [given.draw(rng) for _ in range(300)]
    for name, most in sizes.items():
        values = np.array([getattr(run, name) for run in runs])
        assert (np.abs(values) <= most).all(), name
        assert (values.max(axis=0) > 0.9 * most).all(), name
        assert (values.min(axis=0) < -0.9 * most).all(), name
    payloads = np.array([run.payload for run in runs])
    assert 0 <= payloads.min() < 0.03
    assert 0.27 < payloads.max() <= 0.3


def test_the_same_seed_draws_the_same():
    first, again = draw(3, encoder_offset=1e-3), draw(3, encoder_offset=1e-3)
    np.testing.assert_array_equal(first.encoder_offset, again.encoder_offset)
    assert (draw(4, encoder_offset=1e-3).encoder_offset != first.encoder_offset).all()


def test_a_safety_filter_is_told_what_the_driver_does():
    safety = SafetyConfig(tcp_speed=0.5)
    ideal = Imperfections.ideal().plant(safety)
    assert replace(ideal, separation=safety.separation) == safety
    told = Imperfections.nominal().plant(safety)
    assert (told.braking, told.tcp_speed) == (0.7, 0.5)
    # 20 ms, 3 deviations of 2 ms, and a lag of 10 ms.
    assert told.delay == pytest.approx(0.036)
    # It reacts to people as late, and 20 ms more until it brakes; where they are is known to
    # three deviations of 1 cm, and 5 cm of what capsules leave out.
    assert told.separation.reaction_time == pytest.approx(0.056)
    assert told.separation.clearance == pytest.approx(0.08)
    assert ideal.separation.reaction_time == pytest.approx(0.03)
    assert ideal.separation.clearance == pytest.approx(0.05)


def test_estimated_torques_are_those_that_the_servos_have_to_balance():
    """At rest: of a load and of weights that nobody entered, and of a push at the forearm."""
    made = World(replace(WORKPLACE.scene, objects=()), draw(payload=0.5, gravity_error=0.02))
    made.reset(HOVER)
    forearm = made.model.body("link4").id
    for push in ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (4.0, 20.0, -6.0, 0.0, 0.5, 0.0)):
        made.data.xfrc_applied[forearm] = push
        made.advance(1.0)
        felt = made.arm.read().external_torque
        np.testing.assert_allclose(felt, -made.data.qfrc_actuator[:7], atol=2e-3)
    assert np.abs(felt[:4]).min() > 0.3


def test_estimated_torques_come_through_a_filter_of_the_first_order():
    made = World(replace(WORKPLACE.scene, objects=()), draw(torque_lag=0.05))
    made.reset(HOVER)
    made.advance(0.1)
    made.data.xfrc_applied[made.model.body("link4").id, 1] = 20.0
    made.advance(0.5)
    made.data.xfrc_applied[:] = 0.0
    whole = made.arm.read().external_torque[0]
    made.advance(0.05)
    assert made.arm.read().external_torque[0] == pytest.approx(whole / np.e, rel=0.05)


def test_heights_and_loads_are_in_proportion_to_the_hand():
    sizes = Imperfections.nominal()
    whole, half = (sizes.draw(np.random.default_rng(3), 5, size) for size in (1.0, 0.5))
    assert half.table_height == pytest.approx(whole.table_height / 2)
    np.testing.assert_allclose(half.object_heights, whole.object_heights / 2)
    assert half.payload == pytest.approx(whole.payload / 8)
    np.testing.assert_array_equal(half.encoder_offset, whole.encoder_offset)


def test_noise_and_blur_of_a_camera_come_on_top_of_its_own():
    own, ideal = ImageNoise(), Imperfections.ideal().camera_noise
    assert (ideal.noise, ideal.blur) == (own.noise, own.blur)
    worse = replace(Imperfections.ideal(), image_noise=2.0, image_blur=0.25).camera_noise
    assert worse.noise - own.noise == pytest.approx(2.0)
    assert worse.blur - own.blur == pytest.approx(0.25)
