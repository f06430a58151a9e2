"""What the people at the page hold, and what they ask for."""

import threading

import numpy as np
import pytest
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.protocols import ArmState, DrawnRegion, Human, HumanInput
from hrc_learn.teleoperation import CombinedInput, InteractionForceConfig
from hrc_learn.teleoperation.gate.messages import Grip, Hands, MessageError
from hrc_learn.teleoperation.hand_guiding import gizmo_nullspace_input
from hrc_learn.teleoperation.page import PageHuman
from hrc_learn.teleoperation.page_operator import (
    HeadsetHands,
    HeldGizmo,
    HeldGizmos,
    gizmo_command,
)

Q = panda.ready.numpy()
STATE = ArmState(time=0.0, joint_position=Q, joint_velocity=0 * Q, gripper_width=0.08)
REGION = DrawnRegion(centre=(0.3, 0.2, 0.1), half_size=(0.1, 0.1, 0.1))


def pulling(**more):
    return HumanInput(nullspace_input=np.arange(7.0), twist=np.ones(6), **more)


class Clock:
    time = 0.0

    def __call__(self):
        return self.time


def test_a_wish_holds_for_a_moment_and_motion_ends_with_it():
    clock = Clock()
    human = PageHuman(holds_for=0.25, clock=clock)
    assert not human.read(STATE).effort(7).any()
    drawn = {"region": REGION, "target": (0.1, 0.2, 0.3), "turn": (0.1, 0.0, 0.2)}
    human.post(pulling(**drawn, gripper=0.05))
    clock.time = 0.25
    assert human.read(STATE).effort(7).any()
    clock.time = 0.26
    asked = human.read(STATE)
    assert not asked.effort(7).any()
    assert not asked.twist.any()
    assert asked.gripper is None
    # What was drawn has been drawn: it is no motion that a hand must keep up.
    assert asked.region == REGION
    assert asked.target == (0.1, 0.2, 0.3)
    assert asked.turn == (0.1, 0.0, 0.2)


def rotation(x, y, z):
    return quaternion.exp(torch.tensor([x, y, z], dtype=torch.float64))


def test_turns_of_the_rings_add_up_and_stay():
    held, here = HeldGizmos(), np.zeros(3)
    first, second = (1, "rings"), (2, "rings")
    assert held.turn_vector is None
    # The gizmo may stand anyhow when it is taken: what counts is how far it is turned.
    stood = rotation(0.3, 0.2, -0.9)
    held.take(first, None, stood.numpy())
    assert held.turning
    assert not held.held()
    held.move(first, here, quaternion.multiply(rotation(0.2, 0.0, 0.0), stood).numpy())
    held.move(second, here, quaternion.multiply(rotation(0.9, 0.0, 0.0), stood).numpy())
    held.release(*first)
    assert not held.turning
    held.move(first, here, rotation(0.0, 1.0, 0.0).numpy())
    np.testing.assert_allclose(held.turn_vector, [0.2, 0.0, 0.0], atol=1e-12)
    held.take(second, None, rotation(0.0, 0.0, 0.0).numpy())
    held.move(second, here, rotation(0.0, 0.3, 0.0).numpy())
    expected = quaternion.multiply(rotation(0.0, 0.3, 0.0), rotation(0.2, 0.0, 0.0))
    torch.testing.assert_close(held.turn, expected)
    held.release(2)
    assert not held.turning
    held.clear_turn()
    assert held.turn_vector is None


def test_a_turn_comes_on_top_of_the_coarse_rule():
    config = InteractionForceConfig(turn_rate=1.0, turn_speed=10.0)
    pose, turn = panda.forward(torch.from_numpy(Q)), rotation(0.1, -0.2, 0.05)
    asked = gizmo_command(panda, Q, [grip(None, np.zeros(3))], config, turn=turn)
    wanted = quaternion.multiply(turn, coarse_orientation(pose.position))
    # An angular velocity of so much for a second turns there.
    reached = quaternion.multiply(rotation(*asked.twist[3:]), pose.orientation)
    assert float(quaternion.angle(reached, wanted)) < 1e-9


def test_keys_add_to_what_is_held():
    config, way = InteractionForceConfig(speed=1.0), np.array([0.05, 0.0, 0.0])
    asked = gizmo_command(
        panda, Q, [grip(None, way)], config, direction=np.array([0.0, 0.5, 0.0])
    )
    np.testing.assert_allclose(asked.twist[:3], [config.rate * 0.05, 0.5, 0.0], atol=1e-12)
    assert not gizmo_command(panda, Q, [], config, direction=np.zeros(3)).twist.any()
    fast = gizmo_command(panda, Q, [], config, direction=np.array([3.0, 0.0, 4.0]))
    np.testing.assert_allclose(fast.twist[:3], [0.6, 0.0, 0.8], atol=1e-12)


def test_requests_come_once_each_and_in_order():
    human = PageHuman()
    for request in ("start", "stop", "save"):
        human.request(request)
    assert human.read(STATE).requests == ("start", "stop", "save")
    assert human.read(STATE).requests == ()


def test_the_page_learns_where_the_arm_is():
    human = PageHuman()
    assert human.state is None
    human.read(STATE)
    assert human.state is STATE


def test_effort_and_motion_change_together_under_the_loops_eyes():
    human = PageHuman(holds_for=60.0)
    done = threading.Event()

    def post():
        k = 0.0
        while not done.is_set():
            human.post(HumanInput(nullspace_input=np.full(7, k), twist=np.full(6, k)))
            k += 1.0

    thread = threading.Thread(target=post)
    thread.start()
    try:
        for _ in range(2000):
            asked = human.read(STATE)
            assert asked.nullspace_input[0] == asked.twist[0]
    finally:
        done.set()
        thread.join()


def grip(joint, displacement):
    links = panda.link_poses(torch.from_numpy(Q))
    point = links[joint - 1 if joint else -1].position.numpy()
    return HeldGizmo(joint=joint, held_at=np.zeros(3), pointer=point + displacement)


def test_two_hands_on_the_body_pull_as_their_sum():
    config = InteractionForceConfig(max_nullspace_input=1e9)
    a, b = grip(4, np.array([0.0, 0.1, 0.0])), grip(6, np.array([0.05, 0.0, 0.02]))
    origins = panda.link_poses(torch.from_numpy(Q)).position.numpy()
    expected = gizmo_nullspace_input(panda, Q, 4, origins[3], np.array([0.0, 0.1, 0.0]), config)
    expected += gizmo_nullspace_input(
        panda, Q, 6, origins[5], np.array([0.05, 0.0, 0.02]), config
    )
    asked = gizmo_command(panda, Q, [a, b], config)
    np.testing.assert_allclose(asked.nullspace_input, expected, atol=1e-12)
    assert not asked.twist.any()
    np.testing.assert_allclose(
        asked.arrows[:, 1] - asked.arrows[:, 0], [[0, 0.1, 0], [0.05, 0, 0.02]], atol=1e-12
    )
    small = gizmo_command(panda, Q, [a, b], InteractionForceConfig(max_nullspace_input=0.1))
    assert np.abs(small.nullspace_input).max() <= 0.1 + 1e-12


def test_a_point_held_goes_with_its_link():
    held_at = np.array([0.03, -0.02, 0.1])
    frame = panda.link_poses(torch.from_numpy(Q))[2]
    point = frame.apply(torch.from_numpy(held_at)).numpy()
    asked = gizmo_command(
        panda, Q, [HeldGizmo(joint=3, held_at=held_at, pointer=point)], InteractionForceConfig()
    )
    np.testing.assert_allclose(asked.nullspace_input, 0.0, atol=1e-9)
    np.testing.assert_allclose(asked.arrows[0, 0], point, atol=1e-12)


def test_a_guided_end_effector_turns_by_the_rule():
    config, way = InteractionForceConfig(turn_speed=100.0), np.array([0.05, 0.0, 0.0])
    hand = panda.forward(torch.from_numpy(Q))
    asked = gizmo_command(panda, Q, [grip(None, way)], config)
    np.testing.assert_allclose(asked.twist[:3], config.rate * way, atol=1e-12)
    step = torch.from_numpy(asked.twist[3:] / config.turn_rate)
    turned = torch.linalg.matrix_exp(torch.tensor(np.cross(np.eye(3), step)))
    R = panda.forward(torch.from_numpy(Q)).matrix()[:3, :3]
    goal = coarse_orientation(hand.position)
    torch.testing.assert_close(turned @ R, quaternion.to_matrix(goal), atol=1e-9, rtol=0)


def test_nobody_asks_for_nothing():
    asked = gizmo_command(panda, Q, [], InteractionForceConfig())
    assert not asked.nullspace_input.any()
    assert not asked.twist.any()
    assert asked.arrows.shape == (0, 2, 3)


class Source(Human):
    def __init__(self, **asked):
        self._asked = HumanInput(**asked)

    def read(self, state):
        return self._asked


def test_both_hands_act_at_once():
    device = Source(twist=np.ones(6), gripper=0.02, requests=("start",))
    page = Source(
        nullspace_input=np.arange(7.0), twist=np.ones(6), region=REGION, requests=("stop",)
    )
    asked = CombinedInput(device, page).read(STATE)
    np.testing.assert_array_equal(asked.nullspace_input, np.arange(7.0))
    np.testing.assert_array_equal(asked.twist, np.full(6, 2.0))
    assert asked.gripper == 0.02
    assert asked.region == REGION
    assert asked.target is None
    assert asked.requests == ("start", "stop")


def test_a_region_has_a_size():
    for wrong in (0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="half_size must be positive and finite"):
            DrawnRegion(centre=(0.0, 0.0, 0.0), half_size=(0.1, wrong, 0.1))
    with pytest.raises(ValueError, match="centre must be finite"):
        DrawnRegion(centre=(0.0, np.nan, 0.0), half_size=(0.1, 0.1, 0.1))


@pytest.fixture
def grips():
    return HeldGizmos()


def elbow(x=0.0):
    return HeldGizmo(joint=4, held_at=np.zeros(3), pointer=np.array([x, 0.0, 0.0]))


def test_a_handle_is_held_until_it_is_let_go(grips):
    grips.take((1, "elbow"), elbow())
    grips.move((1, "elbow"), np.array([0.3, 0.0, 0.0]))
    (grip,) = grips.held().values()
    assert grip.pointer.tolist() == [0.3, 0.0, 0.0]
    grips.release(1, "elbow")
    assert not grips.held()


def test_what_was_dropped_moves_nothing_before_it_is_taken_anew(grips):
    grips.take((1, "elbow"), elbow())
    grips.release()
    grips.move((1, "elbow"), np.array([0.5, 0.0, 0.0]))
    assert not grips.held()
    grips.take((1, "elbow"), elbow())
    assert grips.held()


def test_people_hold_independently_of_each_other(grips):
    grips.take((1, "elbow"), elbow(0.1))
    grips.take((2, "elbow"), elbow(0.2))
    assert len(grips.held()) == 2
    grips.release(1)
    assert [holder for holder, _ in grips.held()] == [2]


LINKS = panda.link_poses(panda.ready)
TOOL = LINKS.position[-1].numpy()


def hands_holding(*grips):
    return Hands(grips=tuple(Grip(**grip) for grip in grips))


def led(hand="right", by=(0.0, 0.0, 0.0), turn=None, start=TOOL):
    """A hand that holds the end effector and has moved and turned since."""
    turned = None if turn is None else tuple(rotation(*turn).tolist())
    start, pointer = tuple(start), tuple(start + by)
    return {"hand": hand, "joint": None, "start": start, "pointer": pointer} | {
        "orientation": turned
    }


def test_hands_pull_links_and_lead_and_turn_the_end_effector():
    held = HeldGizmos(links=lambda: LINKS)
    hands = HeadsetHands(held, guides=True)
    point = LINKS.position[3].numpy() + 0.02
    left = {"hand": "left", "joint": 4, "start": tuple(point), "pointer": (0.5, 0.1, 0.6)}
    # The rotation of a hand that pulls a link turns nothing.
    left["orientation"] = tuple(rotation(0.5, 0.0, 0.0).tolist())
    hands.hear(hands_holding())
    hands.hear(hands_holding(left, led(by=(0.1, 0.0, 0.2), turn=(0.0, 0.3, 0.0))))
    elbow, tool = held.held()["headset", "left"], held.held()["headset", "right"]
    assert (elbow.joint, tool.joint) == (4, None)
    at = LINKS[3].apply(torch.from_numpy(elbow.held_at))
    np.testing.assert_allclose(at, point, atol=1e-12)
    np.testing.assert_allclose(elbow.pointer, (0.5, 0.1, 0.6))
    np.testing.assert_allclose(tool.held_at, 0, atol=1e-12)
    np.testing.assert_allclose(tool.pointer, np.add(TOOL, (0.1, 0.0, 0.2)))
    np.testing.assert_allclose(held.turn_vector, (0.0, 0.3, 0.0), atol=1e-12)
    hands.hear(hands_holding(led(by=(0.3, 0.0, 0.0), turn=(0.0, 0.5, 0.0))))
    assert [*held.held()] == [("headset", "right")]
    np.testing.assert_allclose(held.turn_vector, (0.0, 0.5, 0.0), atol=1e-12)
    # The next hold begins with another point, and its rotation comes on top.
    hands.hear(hands_holding(led(turn=(0.0, 0.2, 0.0), start=TOOL + 0.01)))
    np.testing.assert_allclose(held.turn_vector, (0.0, 0.7, 0.0), atol=1e-12)
    hands.hear(hands_holding())
    assert not held.held()
    assert not held.turning


def test_what_hands_hold_from_the_beginning_moves_nothing():
    held = HeldGizmos(links=lambda: LINKS)
    hands = HeadsetHands(held, guides=True)
    for _ in range(2):
        for by in (0.1, 0.2):
            hands.hear(hands_holding(led(by=(by, 0.0, 0.0), turn=(0.1, 0.0, 0.0))))
        assert not held.held()
        assert held.turn_vector is None
        hands.forget()  # as after a change of control


def test_without_an_end_effector_to_hold_hands_pull_links_only():
    held = HeldGizmos(links=lambda: LINKS)
    hands = HeadsetHands(held, guides=False)
    last = {"hand": "left", "joint": 7, "start": tuple(TOOL)}
    last["pointer"] = tuple(TOOL)
    hands.hear(hands_holding())
    hands.hear(hands_holding(led(), last))
    assert [*held.held()] == [("headset", "left")]
    with pytest.raises(MessageError, match="the arm has no joint 8"):
        hands.hear(hands_holding(last | {"joint": 8}))
    # What is held can be asked of the arm.
    assert gizmo_command(panda.chain, Q, held.held().values(), InteractionForceConfig()).held
    unknown = HeldGizmos()  # before the first reading of the arm
    HeadsetHands(unknown, guides=True).hear(hands_holding(led()))
    assert not unknown.held()
