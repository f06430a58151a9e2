"""Settings of the scripted expert."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("panda_expert")
@dataclass(kw_only=True)
class PandaExpertConfig(TeleoperatorConfig):
    """The script that shows a `mujoco_panda` its scenario; `--teleop.type=panda_expert`."""

    robot_id: str | None = None
    """Which robot to lead, where several are connected."""
