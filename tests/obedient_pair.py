"""A fake robot of LeRobot, for what leads robots."""

import time
from dataclasses import dataclass

from lerobot.robots import Robot, RobotConfig

NAMES = ["a.pos", "b.pos"]


@RobotConfig.register_subclass("obedient_pair")
@dataclass(kw_only=True)
class ObedientPairConfig(RobotConfig):
    start: float = 0.25
    breaks_after: int = 10**9
    drift: float = 0.0
    """Velocity before the first action."""


class ObedientPair(Robot):
    """A fake: two joints that are at once where they are sent, and remember all of it."""

    config_class = ObedientPairConfig
    name = "obedient_pair"
    observation_features = action_features = dict.fromkeys(NAMES, float)
    is_calibrated = True
    is_connected = False

    def __init__(self, config):
        super().__init__(config)
        self.sent, self.times = [[config.start, -config.start]], []
        self.breaks_after, self.drift = config.breaks_after, config.drift
        self.made = time.perf_counter()

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def calibrate(self):
        pass

    configure = calibrate

    def get_observation(self):
        moved = 0.0 if self.times else self.drift * (time.perf_counter() - self.made)
        return {name: x + moved for name, x in zip(NAMES, self.sent[-1], strict=True)}

    def send_action(self, action):
        if len(self.sent) > self.breaks_after:
            raise OSError("no answer on the bus")
        self.sent.append([action[name] for name in NAMES])
        self.times.append(time.perf_counter())
        return action
