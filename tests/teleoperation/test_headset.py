"""The client for headsets, in Chromium with an emulated one, beside a scripted person."""

import json
from contextlib import contextmanager

import hostile_clients as wire
import numpy as np
import pytest
import torch
from headset_in_browser import headset, placed, settled, unplaced
from page_in_browser import PATIENCE, wait_until
from websockets.sync.client import connect

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.page import Page, PageConfig

pytestmark = [pytest.mark.browser, pytest.mark.long]

# Browsers tell poses in single precision.
GEOMETRY = 1e-6
STIFFNESS, RATE = 150.0, 2.0
"""Of gizmos, by their defaults [N/m], [1/s]: what a micrometre makes of them."""


@contextmanager
def still_page():
    """A page beside an arm that does not move: all that is asked can be computed again."""
    workplace = Workplace()
    world, q = World(workplace.scene), workplace.home_joints().numpy()
    world.hold(workplace.scene.objects[0].name, q)
    config = PageConfig(silence=PATIENCE, timeout=PATIENCE, meshes=False)
    with Page(world, config, task="lead it") as page:
        state = ArmState(
            time=0.0, joint_position=q, joint_velocity=np.zeros(7), gripper_width=0.05
        )
        page.human.read(state)
        yield page, state


@pytest.fixture(scope="module")
def still():
    with still_page() as (page, state):
        yield page, state


@pytest.fixture(scope="module")
def worn(still, tmp_path_factory):
    with headset(tmp_path_factory.mktemp("headset"), still[0], (320, 200)) as person:
        person.enter()
        yield person


@pytest.fixture(scope="module")
def placing(still, worn):
    """Yaw [rad] and position [m] of the arm in the room, placed by three touched points."""
    marks, yaw = np.array(still[0]._config.touch_points), -1.1
    stands = np.array([0.3, 0.7, -0.9])
    worn.press("Place the arm")
    # Fingers close on each point from a hand's breadth above.
    for mark in placed(marks, yaw, stands):
        worn.reach("right", mark)
        with worn.pinching("right"):
            closed = worn.hand("right") - mark
    return yaw, stands + closed  # all three are off alike, and so is the arm


def asked_by_wire(grips, region):
    """What a page beside the same arm asks for when a scripted person says the same."""
    with still_page() as (page, state):
        where = f"ws://127.0.0.1:{page.address.port}/session/a-scripted-person"
        offered = ["hrc", f"secret.{page.address.token}"]
        with connect(
            where, subprotocols=offered, origin=page.address.origin, proxy=None
        ) as socket:
            socket.send(wire.BEAT)
            socket.send(json.dumps({"type": "region", **region, "active": True}))
            # What is held from the beginning on moves nothing: hands come empty.
            for held in ([], grips):
                socket.send(json.dumps({"type": "hands", "grips": held}))

            def asked():
                socket.send(wire.BEAT)
                now = page.human.read(state)
                return now.region and now.twist.any() and now.effort(7).any()

            wait_until(asked, "the scripted person is heard", timeout=10)
            return page.human.read(state)


def test_three_touched_points_place_the_arm(worn, placing):
    yaw, stands = placing
    kept = json.loads(worn.tab.evaluate("localStorage['hrc-placing']"))["arm"]
    np.testing.assert_allclose(kept["position"], stands, atol=GEOMETRY)
    assert kept["yaw"] == pytest.approx(yaw, abs=GEOMETRY)
    assert "the points miss by 0 mm" in worn.tab.locator("#words").text_content()


@pytest.mark.slow
def test_both_hands_and_a_region_arrive_as_a_scripted_person_says_them(still, worn, placing):
    page, state = still
    links = panda.link_poses(torch.from_numpy(state.joint_position))
    yaw, stands = placing
    room = lambda point: placed(np.atleast_2d(point), yaw, stands)[0]  # noqa: E731

    # One hand pinches link 4 of the arm, the other leads the end effector from aside.
    base = lambda hand: unplaced(worn.hand(hand), yaw, stands)  # noqa: E731
    worn.reach("left", room(links[3].position.numpy()) - _closing(worn, "left"))
    worn.reach("right", [0.9, 1.5, 0.4])
    worn.pinch("left")
    taken = base("left")
    worn.pinch("right")
    led_from, tool = base("right"), links[-1].position.numpy()
    worn.reach("left", np.add(worn.hand("left"), [0.03, -0.02, 0.05]))
    worn.reach("right", np.add(worn.hand("right"), [-0.04, 0.03, 0.02]))
    grips = [
        {"hand": "left", "joint": 4, "start": [*taken], "pointer": [*base("left")]},
        {
            "hand": "right",
            "joint": None,
            "start": [*tool],
            "pointer": [*(tool + base("right") - led_from)],
        },
    ]
    heard = lambda: [  # noqa: E731
        held.pointer
        for hand in ("left", "right")
        if (held := page._held_gizmos.held().get(("headset", hand)))
    ]
    at = [grip["pointer"] for grip in grips]
    wait_until(
        lambda: np.shape(heard()) == (2, 3) and np.allclose(heard(), at, atol=2e-6), "the hands"
    )
    held = page._held_gizmos.held()
    for grip in grips:
        now = held["headset", grip["hand"]]
        assert now.joint == grip["joint"]
        np.testing.assert_allclose(now.pointer, grip["pointer"], atol=2 * GEOMETRY)
    # A busy machine may not be heard for a moment, which lets go.
    asks = lambda now: now.effort(7).any() and now.twist.any()  # noqa: E731
    settled(lambda: asks(page.human.read(state)), "both are asked for")
    both = page.human.read(state)

    # Meanwhile both hands are seen where they are.
    seen = page.hands
    for hand in ("left", "right"):
        np.testing.assert_allclose(seen[hand].position, base(hand), atol=GEOMETRY)
    worn.pinch("left", closed=False)
    worn.pinch("right", closed=False)
    settled(lambda: not page.human.read(state).twist.any(), "empty hands ask for nothing")
    assert not page.human.read(state).effort(7).any()

    # The right hand draws a region, and it is switched on.
    worn.press("Draw region")
    worn.reach("right", room([0.2, 0.5, 0.1]))
    worn.pinch("right")
    corner = base("right")
    worn.reach("right", np.add(worn.hand("right"), [0.21, 0.3, -0.25]))
    opposite = base("right")
    worn.pinch("right", closed=False)
    worn.press("Draw region")
    worn.press("Active")
    settled(lambda: page.human.read(state).region is not None, "a region")
    region = page.human.read(state).region
    np.testing.assert_allclose(region.centre, (corner + opposite) / 2, atol=GEOMETRY)
    half = np.abs(corner - opposite) / 2
    np.testing.assert_allclose(region.half_size, half, atol=GEOMETRY)

    box = {"centre": [*(corner + opposite) / 2], "half_size": [*half]}
    scripted = asked_by_wire(grips, box)
    d, twist = both.effort(7), both.twist
    # J of a point within a metre of its axes has singular values below 2.
    np.testing.assert_allclose(d, scripted.effort(7), atol=2 * GEOMETRY * STIFFNESS * 2, rtol=0)
    np.testing.assert_allclose(twist, scripted.twist, atol=2 * GEOMETRY * RATE, rtol=0)
    np.testing.assert_allclose(
        scripted.region.half_size, region.half_size, atol=GEOMETRY, rtol=0
    )


def test_the_region_is_moved_and_sized(still, worn, placing):
    page, _ = still
    yaw, stands = placing
    before = page._panel.editor.drawn
    closed = _closing(worn, "right")
    worn.press("Draw region")

    def pull(start, by):
        worn.reach("right", placed(np.atleast_2d(start), yaw, stands)[0] - closed)
        worn.pinch("right")
        first = unplaced(worn.hand("right"), yaw, stands)
        worn.reach("right", worn.hand("right") + by)
        last = unplaced(worn.hand("right"), yaw, stands)
        worn.pinch("right", closed=False)
        return last - first

    moved = pull(before.centre, [0.05, 0.1, 0.02])
    settled(lambda: page._panel.editor.drawn != before, "another place")
    after = page._panel.editor.drawn
    np.testing.assert_allclose(np.subtract(after.centre, before.centre), moved, atol=2e-6)
    assert after.half_size == before.half_size

    corner = np.add(after.centre, np.multiply(after.half_size, (1, -1, 1)))
    moved = pull(corner, [0.04, 0.03, 0.05])
    settled(lambda: page._panel.editor.drawn != after, "another size")
    sized = page._panel.editor.drawn
    still_there = np.subtract(after.centre, np.multiply(after.half_size, (1, -1, 1)))
    opposite = np.subtract(sized.centre, np.multiply(sized.half_size, (1, -1, 1)))
    np.testing.assert_allclose(opposite, still_there, atol=2e-6)
    grown = np.multiply(moved, (1, -1, 1)) / 2
    np.testing.assert_allclose(np.subtract(sized.half_size, after.half_size), grown, atol=2e-6)
    worn.press("Draw region")


def _closing(worn, hand) -> np.ndarray:
    """By how much the point between the fingers moves as they close."""
    start = worn.reach(hand, [0.9, 1.6, 0.5])  # far from everything
    with worn.pinching(hand):
        return worn.hand(hand) - start


def test_the_hand_turns_the_end_effector_by_its_own_turn(still, worn, placing):
    page, state = still
    yaw, _ = placing

    def take_back():
        # What the hand said before it opened may come late, and turns on.
        wait_until(lambda: not page._held_gizmos.turning, "the hand has let go")
        page._held_gizmos.clear_turn()
        wait_until(lambda: page.human.read(state).turn is None, "no turn is asked for")

    def turn_heard():
        asked = lambda: page.human.read(state).turn or (0.0, 0.0, 0.0)  # noqa: E731
        # Not what single precision makes of a hand that has not turned yet.
        wait_until(lambda: np.linalg.norm(asked()) > 0.1, "a turn")
        return asked()

    worn.press("Fine turn")
    worn.reach("right", [0.9, 1.5, 0.4])
    with worn.pinching("right"):
        worn.turn("right", (0.0, 1.0, 0.0), 0.3)  # about the vertical, which is z of the base
        turn = turn_heard()
    np.testing.assert_allclose(turn, (0.0, 0.0, 0.3), atol=1e-5)
    worn.turn("right", (0.0, 1.0, 0.0), 0.0)
    take_back()
    worn.reach("right", [0.9, 1.5, 0.4])
    # About the room's x axis, which the base sees turned by how it stands.
    with worn.pinching("right"):
        worn.turn("right", (1.0, 0.0, 0.0), 0.2)
        turn = turn_heard()
    axis = unplaced([1.0, 0.0, 0.0], yaw, np.zeros(3))
    np.testing.assert_allclose(turn, 0.2 * axis, atol=1e-5)
    worn.turn("right", (1.0, 0.0, 0.0), 0.0)
    worn.press("Fine turn")
    take_back()


def test_a_hand_that_is_lost_or_behind_a_menu_holds_nothing(still, worn):
    page, state = still
    for lose, find in (
        ("headset.hands.right.connected = false", "headset.hands.right.connected = true"),
        (
            "headset.updateVisibilityState('visible-blurred')",
            "headset.updateVisibilityState('visible')",
        ),
    ):
        start = worn.reach("right", [0.9, 1.5, 0.4])
        worn.pinch("right")
        worn.reach("right", np.add(start, [0.0, 0.05, 0.0]))
        wait_until(lambda: page.human.read(state).twist.any(), "motion")
        worn.tab.evaluate(lose)
        # A busy machine may not be heard for a moment, which stops the arm sooner.
        wait_until(lambda: not page._held_gizmos.held(), "nothing is held")
        wait_until(lambda: not page.human.read(state).twist.any(), "nothing is asked for")
        worn.tab.evaluate(find)
        worn.pinch("right", closed=False)


def test_buttons_in_the_room_are_pressed_by_a_ray_and_by_a_fingertip(still, worn):
    page, state = still
    asked = lambda: page.human.read(state).requests  # noqa: E731
    eye, ahead, left = np.array([0.0, 1.6, 0.0]), [0.0, 0.0, -0.5], [-0.3, 0.0, 0.0]
    assert asked() == ()
    # "Start" is the first button; the panel stands before the eyes that entered, to their left.
    panel = eye + ahead + left + [0.0, -0.15, 0.0]
    z = (eye - panel) / np.linalg.norm(eye - panel)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    button = panel + _pixel(132, 256) @ np.stack([x, np.cross(z, x)])
    seen = worn.tab.evaluate("window.seen.hands.right.index")
    tip = np.array(seen).reshape(4, 4)[3, :3]
    pressing = worn.hand("right") - tip
    worn.reach("right", button + 0.1 * z + pressing)
    worn.reach("right", button + pressing)
    wait_until(lambda: "start" in asked(), "a fingertip starts")
    worn.reach("right", [0.9, 1.5, 0.4])


def _pixel(x, y, width=512, height=744, size=0.34):
    return np.array([x - width / 2, height / 2 - y]) * size / width


def test_a_controller_shakes_with_what_the_arm_meets(still, worn):
    page, _ = still
    worn.tab.evaluate(
        """headset.primaryInputMode = "controller";
        window.pulses = [];
        for (const { inputSource } of Object.values(headset.controllers))
          inputSource.gamepad.hapticActuators[0].pulse = async (...given) =>
            window.pulses.push(given) > 0;
        null;  // an expression that is a function would be called
        """
    )
    worn.frames(3)
    page.human.tell(Feedback(contact_force=np.array([0.0, 0.0, 40.0])))
    worn.tab.wait_for_function("window.pulses.length >= 4", timeout=20e3)
    # 40 N is half way from the least to the strongest contact.
    pulses = worn.tab.evaluate("window.pulses")
    for strength, duration in pulses:
        assert strength == pytest.approx(0.5)
        assert duration == 120
    page.human.tell(Feedback())
    worn.frames(10)
    quiet = worn.tab.evaluate("window.pulses.length")
    worn.frames(10)
    assert worn.tab.evaluate("window.pulses.length") == quiet
    worn.tab.evaluate("headset.primaryInputMode = 'hand'")
    worn.frames(2)


def test_the_place_is_kept_for_the_next_session(still, worn, placing):
    kept = worn.tab.evaluate("localStorage['hrc-placing']")
    worn.tab.reload()
    worn.button("Enter AR").wait_for()
    worn.enter()
    assert worn.tab.evaluate("localStorage['hrc-placing']") == kept
    arm = json.loads(kept)["arm"]
    # Hands are told in the base frame, which is where it was.
    page, _ = still
    wait_until(lambda: "left" in page.hands, "hands are seen")
    expected = unplaced(worn.hand("left"), arm["yaw"], np.array(arm["position"]))
    np.testing.assert_allclose(page.hands["left"].position, expected, atol=GEOMETRY)


def test_turns_of_the_room_and_of_the_base_agree():
    """The oracle above, by quaternions: a turn about x of the room in a base turned by yaw."""
    yaw = 0.7
    stands = quaternion.multiply(
        quaternion.exp(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64)),
        quaternion.exp(torch.tensor([-np.pi / 2, 0.0, 0.0], dtype=torch.float64)),
    )
    axis = quaternion.rotate(
        quaternion.conjugate(stands), torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    )
    np.testing.assert_allclose(
        unplaced([1.0, 0.0, 0.0], yaw, np.zeros(3)), axis.numpy(), atol=1e-12
    )
