"""Who leads a Panda: positions that go on from where the arm is, by script and from a page."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.teleoperators import make_teleoperator_from_config
from served_franka import served_franka
from unchecked import shapes_unchecked

from hrc_learn.kinematics import fr3, panda
from hrc_learn.lerobot.arm_teleoperators import ArmExpertConfig, ArmPageConfig, GuidedRobot
from hrc_learn.lerobot.arm_values import GRIPPER, HAND, ArmValues
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.sim import MovingBodies
from hrc_learn.teleoperation import hand_guiding, page

READY = panda.ready.numpy()
JOINTS = ArmValues(panda).joints


class Arm:
    """One that stays where it is put, as a robot of LeRobot's."""

    def __init__(self, space):
        self.space, self.dt, self.initial_configurations = space, 0.1, 0
        self.values = ArmValues(panda)
        self.joints = READY.copy()

    def read_state(self):
        return ArmState(
            time=0.0, joint_position=self.joints, joint_velocity=np.zeros(7), gripper_width=0.03
        )


class Pull:
    """Stands for the law of hand guiding: commands a velocity, and passes on the gripper."""

    velocity, gripper = np.zeros(7), None

    def __init__(self, chain, arm, human, config):
        self.arm, self.dt = arm, config.dt

    def step(self):
        self.arm.command(self.velocity)
        asked = HumanInput(gripper=self.gripper)
        return SimpleNamespace(state=self.arm.read(), human_input=asked)


@pytest.fixture
def pull(monkeypatch):
    monkeypatch.setattr(hand_guiding, "HandGuidedArm", Pull)
    monkeypatch.setattr(Pull, "velocity", np.zeros(7))
    monkeypatch.setattr(Pull, "gripper", None)
    with shapes_unchecked():  # stand-ins are of no declared class
        yield Pull


def joints_of(action):
    return np.array([action[name] for name in JOINTS])


def test_positions_are_as_far_ahead_as_the_arm_moves_in_a_step(pull):
    arm = Arm("joint")
    guided = GuidedRobot(arm, human=None)
    pull.velocity = np.linspace(-0.3, 0.3, 7)
    for k in range(1, 4):
        action, _ = guided.next()
        arm.joints = READY + 0.1 * k * pull.velocity
        np.testing.assert_allclose(joints_of(action), arm.joints, atol=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_blocked_arm_is_not_wound_up(pull, sign):
    guided = GuidedRobot(Arm("joint"), human=None)
    pull.velocity = sign * np.full(7, 0.2)
    for _ in range(9):
        action, _ = guided.next()
    np.testing.assert_allclose(joints_of(action) - READY, sign * (0.05 + 0.02), atol=1e-12)


def test_the_gripper_stays_until_it_is_asked_for(pull):
    guided = GuidedRobot(Arm("joint"), human=None)
    widths = []
    for pull.gripper in (None, 0.07, None):
        action, asked = guided.next()
        assert asked.gripper == pull.gripper
        widths.append(action[GRIPPER])
    assert widths == [0.03, 0.07, 0.07]


def test_poses_of_the_hand_go_on_past_half_a_turn(pull):
    """Down is half a turn from the base, where the shortest rotation vector changes sides."""
    arm = Arm("ee")
    guided = GuidedRobot(arm, human=None)
    pull.velocity = 0.4 * np.eye(7)[5]
    vectors = []
    for k in range(20):
        action, _ = guided.next()
        assert list(action) == [*HAND, GRIPPER]
        vectors.append([action[name] for name in HAND[3:]])
        arm.joints = READY + (k + 1) * 0.1 * pull.velocity - 0.4 * np.eye(7)[5] * (k > 9)
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.5


@pytest.mark.parametrize("space", ["joint", "ee"])
def test_the_expert_leads_from_wherever_it_begins(simulated, tmp_path, space):
    robot = simulated(scenario="grasping", fps=20.0, seed=3, action_space=space)
    expert = make_teleoperator_from_config(ArmExpertConfig(calibration_dir=tmp_path))
    expert.connect()

    def led(steps):
        start = robot.read_state().joint_position.copy()
        for _ in range(steps):
            action = expert.get_action()
            assert action.keys() == robot.action_features.keys()
            assert action.keys() == expert.action_features.keys()
            robot.send_action(action)
        return start, robot.read_state().joint_position.copy()

    with shapes_unchecked():
        start, end = led(30)
        assert np.abs(end - start).max() > 0.05
        robot.begin(4)
        again, _ = led(1)
        np.testing.assert_allclose(again, start, atol=0.02)


def torch_of(robot):
    return torch.from_numpy(robot.read_state().joint_position)


class Page(Human):
    """Stands for the page in a browser: what it was shown, and what a person there asks for."""

    requests = ()

    def __init__(self, world, config, *, guides):
        self.chain, self.config = world.arm.robot.chain, config
        self.open, self.human = False, self
        self.places = []

    def __enter__(self):
        self.open = True
        return self

    def __exit__(self, *error):
        self.open = False

    def show(self, status):
        self.status = status

    def place(self, world):
        self.places.append(MovingBodies(world).poses())

    def read(self, state):
        return HumanInput(twist=np.array([0.05, 0, 0, 0, 0, 0]), requests=self.requests)


@pytest.fixture
def served(monkeypatch, tmp_path):
    monkeypatch.setattr(page, "Page", Page)
    config = ArmPageConfig(calibration_dir=tmp_path, host="0.0.0.0", port=8123)
    leader = make_teleoperator_from_config(config)
    leader.connect()
    assert leader.page.open
    assert (leader.page.config.host, leader.page.config.port) == ("0.0.0.0", 8123)
    yield leader
    shown = leader.page
    leader.disconnect()
    assert not shown.open


def test_a_page_leads_the_simulated_panda_and_shows_its_world(simulated, served):
    robot = simulated(scenario="grasping", fps=20.0, seed=3)
    start = panda.forward(torch_of(robot)).position
    for _ in range(10):
        robot.send_action(served.get_action())
    end = panda.forward(torch_of(robot)).position
    assert (end - start)[0] > 0.01
    data = robot.run.world.data
    before, now = served.page.places[0][0], served.page.places[-1][0]
    assert np.abs(now - before).max() > 0.01  # it moves on the page as well
    served.get_action()
    assert any(np.allclose(served.page.places[-1][0][-1], x) for x in data.xpos)
    assert robot.run.seed == 3


def test_a_page_that_was_there_first_shows_the_arm_that_is_connected(simulated, served):
    first = served.page
    assert first.chain is panda
    robot = simulated(scenario="grasping", fps=20.0, arm="fr3")
    action = served.get_action()
    assert action.keys() == robot.action_features.keys() == served.action_features.keys()
    assert served.page.chain is fr3
    assert served.page.open
    assert not first.open
    shown = served.page
    served.get_action()
    assert served.page is shown


def test_home_begins_the_scenario_anew(simulated, served):
    robot = simulated(scenario="grasping", fps=20.0, seed=3)
    served.get_action()
    served.page.requests = ("home",)
    served.get_action()
    assert robot.run.seed == 4
    served.page.requests = ("start",)
    served.get_action()
    assert robot.run.seed == 4


@pytest.mark.simulation
def test_the_expert_begins_again_with_a_robot_that_is_connected_again(simulated, tmp_path):
    robot = simulated(scenario="grasping")
    expert = make_teleoperator_from_config(ArmExpertConfig(calibration_dir=tmp_path))
    expert.connect()
    first = expert.get_action()
    for _ in range(20):
        robot.send_action(expert.get_action())
    robot.disconnect()
    robot.connect()
    assert expert.get_action() == first


@pytest.fixture
def franka(tmp_path):
    with served_franka(tmp_path, joints=READY + 0.3 * np.eye(7)[1]) as served:
        yield served.robot


@pytest.mark.realtime
def test_a_page_shows_the_real_panda_where_it_is(franka, served):
    served.page.requests = ("home",)  # means nothing to a real arm
    served.get_action()
    (positions, _), links = served.page.places[-1], panda.link_poses(torch_of(franka))
    for joint in range(7):
        distance = np.linalg.norm(positions - links.position[joint].numpy(), axis=-1)
        assert distance.min() < 1e-4  # that its servos hold it to


@pytest.mark.long
def test_the_expert_knows_no_real_panda(franka, tmp_path):
    expert = make_teleoperator_from_config(ArmExpertConfig(calibration_dir=tmp_path))
    expert.connect()
    with pytest.raises(ValueError, match="of mujoco_arm, not of franka_panda"):
        expert.get_action()
