"""Settings of the controller that stay the same through a task."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from hrc_learn.controller.activation import ActivationConfig
from hrc_learn.controller.safety import SafetyConfig


@dataclass(frozen=True, kw_only=True)
class ControllerConfig:
    """The defaults are those that were measured to work best."""

    linear_speed: float = 0.25
    """Cap on the linear part of the twist [m/s]; the direction of the twist is kept."""
    angular_speed: float = 1.0
    """Cap on its angular part [rad/s]."""
    vision_rate: float = 4.0
    """Fastest decay of the pixel error that the estimate may ask for [1/s]. The gain of the
    law grows with the square of the Jacobian over that of the region: uncapped it can exceed
    what images at 15 to 30 Hz, late by a frame or more, allow."""
    approach_linear_speed: float = 0.5
    """Cap on the linear speed of the tool during a joint-space approach [m/s]."""
    approach_angular_speed: float = 2.0
    """Cap on its angular speed then [rad/s]."""
    jacobian: Literal["geometric", "analytic"] = "geometric"
    """By which gradients become motions of the tool: the analytic one counts rotation by the
    rotation vector, whose rates differ from angular velocity the more the tool is turned."""
    null_damping: float = 3.0
    """c_d: effort divided by it is velocity."""
    null_space_yields: bool = True
    """Scale null-space motion as a whole where a limit would cut single joints."""
    hold_rate: float = 2.0
    """Rate at which the tool returns to its place while a person acts [1/s]; 0: it does not."""
    activation: ActivationConfig = field(default_factory=ActivationConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self):
        for name in (
            "linear_speed",
            "angular_speed",
            "vision_rate",
            "approach_linear_speed",
            "approach_angular_speed",
            "null_damping",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        if self.jacobian not in ("geometric", "analytic"):
            raise ValueError(
                f"jacobian must be 'geometric' or 'analytic', but is {self.jacobian!r}"
            )
        if self.hold_rate < 0:
            raise ValueError(f"hold_rate must not be negative, but is {self.hold_rate}")

    @classmethod
    def paper(cls) -> ControllerConfig:
        """The law as printed: nothing between it and the safety filter."""
        return cls(
            linear_speed=math.inf,
            angular_speed=math.inf,
            vision_rate=math.inf,
            null_space_yields=False,
            hold_rate=0.0,
            activation=ActivationConfig(hysteresis=0.0, blend_time=0.0),
        )
