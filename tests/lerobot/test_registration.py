"""The names by which LeRobot's command lines know what is ours."""

from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env_config
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from hrc_learn.lerobot import DMPConfig, MotionChunkConfig
from hrc_learn.lerobot.envs import ArmEnvConfig
from hrc_learn.lerobot.robots import FrankaPandaConfig, MujocoArmRobotConfig
from hrc_learn.lerobot.teleoperators import ArmExpertConfig, ArmPageConfig


def test_lerobot_knows_them_by_name():
    assert RobotConfig.get_choice_class("mujoco_arm") is MujocoArmRobotConfig
    assert RobotConfig.get_choice_class("franka_panda") is FrankaPandaConfig
    assert TeleoperatorConfig.get_choice_class("arm_expert") is ArmExpertConfig
    assert TeleoperatorConfig.get_choice_class("arm_page") is ArmPageConfig
    assert EnvConfig.get_choice_class("mujoco_arm") is ArmEnvConfig
    # As they were called when there was no other arm.
    assert RobotConfig.get_choice_class("mujoco_panda") is MujocoArmRobotConfig
    assert TeleoperatorConfig.get_choice_class("panda_expert") is ArmExpertConfig
    assert TeleoperatorConfig.get_choice_class("panda_page") is ArmPageConfig
    assert issubclass(EnvConfig.get_choice_class("panda"), ArmEnvConfig)
    # LeRobot takes the type of an environment for the name that it was asked for by.
    assert [make_env_config(name).type for name in ("panda", "mujoco_arm")] == [
        "panda",
        "mujoco_arm",
    ]
    assert MujocoArmRobotConfig().type == "mujoco_arm"
    for step in ("hrc_learn_watch_state", "hrc_learn_smooth_actions"):
        assert ProcessorStepRegistry.get(step)
    assert PreTrainedConfig.get_choice_class("dmp") is DMPConfig
    assert PreTrainedConfig.get_choice_class("motion_chunk") is MotionChunkConfig
