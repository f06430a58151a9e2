"""Placing and grasping as environments for lerobot-eval."""

from hrc_learn.lerobot.envs.config_panda_env import PandaEnvConfig as PandaEnvConfig
