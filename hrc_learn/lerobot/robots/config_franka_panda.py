"""Settings of the real Panda."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

from hrc_learn.lerobot.panda_features import ActionSpace


@RobotConfig.register_subclass("franka_panda")
@dataclass(kw_only=True)
class FrankaPandaConfig(RobotConfig):
    """A Franka Panda at its control box; `--robot.type=franka_panda`."""

    ip: str
    """Address of the control box."""
    fps: float = 50.0
    """Actions a second: the rate of the dataset, or of the rollout."""
    action_space: ActionSpace = "joint"
    """What actions give: positions of the joints, or of the hand ("ee")."""
    velocity: bool = False
    """Whether joint velocities are observed."""
    hand: bool = False
    """Whether the pose of the hand is observed; it is where actions give it."""
    dynamics: float = 0.3
    """Share of the driver's own limits of velocity, acceleration and jerk."""
    tcp_speed: float = 0.25
    """Cap on the speed of the tool centre point [m/s] (ISO 10218: reduced speed)."""
    timeout: float = 0.15
    """Silence of the loop after which the arm is stopped [s]."""
    grip_force: float = 20.0
    """With which the gripper squeezes [N]."""
    grip_speed: float = 0.1
    """Of the fingers [m/s]."""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    """Cameras of LeRobot, by name."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 5 <= self.fps <= 1000:
            raise ValueError(f"fps must be from 5 to 1000, but is {self.fps}.")
        if not 0 < self.dynamics <= 1:
            raise ValueError(f"dynamics must be in (0, 1], but is {self.dynamics}.")
        if not self.timeout > 1.5 / self.fps:
            raise ValueError(
                f"timeout must be longer than an action and a half at {self.fps:g} fps, but is "
                f"{self.timeout} s."
            )
