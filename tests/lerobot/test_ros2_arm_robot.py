"""An arm over topics of ROS 2 as a LeRobot robot, with a camera of an image topic."""

import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
pytest.importorskip("rclpy")

from lerobot.robots import make_robot_from_config
from ros2_robot import Ros2Robot
from unchecked import shapes_unchecked

from hrc_learn.hardware.ros2_topics import Ros2Session, quality
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.driven_arms import Ros2ArmRobotConfig, Ros2CameraConfig
from hrc_learn.sim import SceneConfig, World

pytestmark = [pytest.mark.realtime, pytest.mark.simulation]
READY = panda.chain.ready.numpy()
COLOUR = (250, 120, 20)


@pytest.fixture(autouse=True)
def _unchecked():
    with shapes_unchecked():
        yield


@pytest.fixture
def robot():
    world = World(replace(SceneConfig(), timestep=0.002))
    world.reset(READY)
    with Ros2Robot(world, rate=200.0) as robot:
        yield robot


@pytest.fixture
def images():
    """A topic of images, 64 by 48, at 30 Hz."""
    from sensor_msgs.msg import Image

    session, ended = Ros2Session("camera"), threading.Event()
    publisher = session.node.create_publisher(Image, "/front/image_raw", quality())
    content = np.full((48, 64, 3), COLOUR[::-1], np.uint8).tobytes()

    def publish():
        while not ended.wait(1 / 30):
            image = Image(height=48, width=64, encoding="bgr8", step=192, data=content)
            publisher.publish(image)

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    yield
    ended.set()
    thread.join()
    session.close()


def test_it_observes_joints_and_images_and_follows_actions(robot, images):
    camera = Ros2CameraConfig(topic="/front/image_raw", width=64, height=48)
    config = Ros2ArmRobotConfig(arm="panda", fps=30, cameras={"front": camera}, timeout=0.5)
    arm = make_robot_from_config(config)
    arm.connect()
    goal = READY + 0.1
    for _ in range(60):
        seen = arm.get_observation()
        arm.send_action(dict(zip(arm.action_features, [*goal, 0.0], strict=True)))
        time.sleep(1 / 30)
    assert seen["front"].shape == arm.observation_features["front"] == (48, 64, 3)
    assert tuple(seen["front"][10, 10]) == COLOUR
    joints = [seen[f"{name}.pos"] for name in panda.chain.joint_names]
    np.testing.assert_allclose(joints, goal, atol=0.02)
    assert robot.violations == 0
    arm.disconnect()


def test_a_camera_without_images_says_so():
    from lerobot.cameras import make_cameras_from_configs

    config = Ros2CameraConfig(topic="/nothing", width=64, height=48, timeout=0.3)
    camera = make_cameras_from_configs({"front": config})["front"]
    with pytest.raises(ConnectionError, match=r"no image on /nothing for 0\.3 s"):
        camera.connect()
    with pytest.raises(ValueError, match="give width and height"):
        Ros2CameraConfig(topic="/nothing")


CAMERA = "{type: ros2, topic: /front/image_raw, width: 64, height: 48, timeout: 30}"
TELEOPERATOR = """
import math, time
from dataclasses import dataclass
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_robot import Device
NAMES = [f"{name}.pos" for name in panda.chain.joint_names]

@TeleoperatorConfig.register_subclass("wave")
@dataclass
class WaveConfig(TeleoperatorConfig):
    pass

class Wave(Device, Teleoperator):
    config_class = WaveConfig
    name = "wave"
    def __init__(self, config):
        super().__init__(config)
        self.config, self._began = config, time.time()
    @property
    def action_features(self):
        return dict.fromkeys([*NAMES, "gripper.pos"], float)
    feedback_features = {}
    def _open(self): ...
    def _close(self): ...
    def send_feedback(self, feedback): ...
    def get_action(self):
        wave = 0.1 * math.sin(2 * (time.time() - self._began))
        ready = panda.chain.ready.tolist()
        return dict(zip(NAMES, [q + wave for q in ready])) | {"gripper.pos": 0.0}
"""


ROBOT = (
    "--robot.discover_packages_path=hrc_learn.lerobot",
    *("--robot.type=ros2", "--robot.arm=panda", "--robot.fps=15", "--robot.timeout=1.0"),
    f"--robot.cameras={{front: {CAMERA}}}",
    "--play_sounds=false",
)


@pytest.mark.slow
def test_lerobot_records_it_and_rolls_a_policy_out(robot, images, tmp_path):
    from lerobot.datasets import LeRobotDataset

    (tmp_path / "lerobot_teleoperator_wave").mkdir()
    (tmp_path / "lerobot_teleoperator_wave/__init__.py").write_text(TELEOPERATOR)
    root = Path(__file__).parents[2]
    environment = os.environ | {
        "HF_HUB_OFFLINE": "1",
        "HF_LEROBOT_HOME": str(tmp_path / "home"),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": f"{root}:{tmp_path}",
    }

    def run(*command):
        words = list(map(str, command))
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]

    programs = Path(sys.executable).parent
    run(
        programs / "lerobot-record",
        *ROBOT,
        "--teleop.discover_packages_path=lerobot_teleoperator_wave",
        *("--teleop.type=wave", "--dataset.repo_id=local/wave"),
        f"--dataset.root={tmp_path / 'set'}",
        *("--dataset.single_task=wave", "--dataset.fps=15", "--dataset.num_episodes=1"),
        *("--dataset.episode_time_s=4", "--dataset.reset_time_s=0"),
        "--dataset.push_to_hub=false",
    )
    dataset = LeRobotDataset("local/wave", root=tmp_path / "set")
    assert len(dataset) > 20
    states = np.stack([dataset[k]["observation.state"].numpy() for k in range(len(dataset))])
    assert np.ptp(states[:, 0]) > 0.1
    image = 255 * dataset[5]["observation.images.front"].numpy()[:, 24, 32]
    np.testing.assert_allclose(image, COLOUR, atol=12)

    fit = sys.executable, root / "training/fit_dmp.py", "--as-lerobot-policy"
    run(*fit, "--dataset", tmp_path / "set", "--out", tmp_path / "policy")
    positions, ended = [], threading.Event()

    def watch():
        while not ended.wait(0.02):
            positions.append(robot.state.joint_position[0])

    watcher = threading.Thread(target=watch)
    watcher.start()
    run(
        programs / "lerobot-rollout",
        *ROBOT,
        f"--policy.path={tmp_path / 'policy'}",
        *("--fps=15", "--duration=4", "--task=wave"),
    )
    ended.set()
    watcher.join()
    assert np.ptp(positions) > 0.1
    assert robot.violations == 0
