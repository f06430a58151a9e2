"""Settings of the page."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("panda_page")
@dataclass(kw_only=True)
class PandaPageConfig(TeleoperatorConfig):
    """A person who leads a Panda in a browser; `--teleop.type=panda_page`."""

    robot_id: str | None = None
    """Which robot to lead, where several are connected."""
    host: str = "127.0.0.1"
    """Address to serve the page at. Whoever reaches it can move the arm."""
    port: int = 8080
    """Port to serve at; the next free one is taken if it is in use."""
