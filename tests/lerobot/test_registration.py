"""The names by which LeRobot's command lines know what is ours."""

from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env_config
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from hrc_learn.lerobot import DMPConfig, MotionChunkConfig
from hrc_learn.lerobot.arm_teleoperators import ArmExpertConfig, ArmPageConfig
from hrc_learn.lerobot.driven_arms import FrankaPandaConfig
from hrc_learn.lerobot.envs import ArmEnvConfig
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobotConfig


def test_lerobot_knows_them_by_name():
    assert RobotConfig.get_choice_class("mujoco_arm") is MujocoArmRobotConfig
    assert RobotConfig.get_choice_class("franka_panda") is FrankaPandaConfig
    assert TeleoperatorConfig.get_choice_class("arm_expert") is ArmExpertConfig
    assert TeleoperatorConfig.get_choice_class("arm_page") is ArmPageConfig
    assert EnvConfig.get_choice_class("mujoco_arm") is ArmEnvConfig
    assert make_env_config("mujoco_arm").type == MujocoArmRobotConfig().type == "mujoco_arm"
    for step in ("hrc_learn_watch_state", "hrc_learn_smooth_actions"):
        assert ProcessorStepRegistry.get(step)
    assert PreTrainedConfig.get_choice_class("dmp") is DMPConfig
    assert PreTrainedConfig.get_choice_class("motion_chunk") is MotionChunkConfig
