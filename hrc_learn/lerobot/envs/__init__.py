"""Placing and grasping as environments for lerobot-eval."""

from .config_panda_env import PandaEnvConfig as PandaEnvConfig
