"""Aiming at an object with an uncalibrated camera: the adaptive controller at work."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..controller import AdaptiveController, ControllerState, Goals, Observation
from ..geometry import Pose
from .failure import MissedGraspError
from .station import Station


@dataclass(frozen=True, kw_only=True)
class AimingConfig:
    """When aiming is done, and when it is given up."""

    tolerance: float = 2.0
    """Distance of the feature from the target at which it counts as reached [px]."""
    dwell: float = 0.4
    """How long it has to stay there [s]."""
    patience: float = 40.0
    """After which aiming is given up [s]."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Box in which the camera takes over [m]. Flat: the image tells little about height, and
    an object has to be met at the height at which aiming was taught."""
    angle: float = 0.01
    """Tolerated turn of the hand [rad]. The paper's cone of 7.6 degrees would leave the marker
    1 cm off the place it was taught to be at."""
    rate: float = 4.0
    """How fast the hand returns into the box from above or below, and into the cone [1/s]."""

    def goals(self, above: Pose, target: Float[np.ndarray, "2"] | None) -> Goals:
        """Goals of aiming.

        Args:
            above: Middle of the box above the table, and orientation of the hand.
            target: Where in the image the hand's marker should be [px]; None: anywhere.

        Raises:
            ValueError: If the target lies outside the image.
        """
        goals = Goals.at(
            above.position,
            above.orientation,
            None if target is None else torch.from_numpy(target),
            half_size=self.half_size,
        )
        # Near the border of a region its excess decays at 4 k_c / h^2 and k_o (alpha_o / 2)^2.
        upright = self.rate / 4 * self.half_size[2] ** 2
        sharpness = 2 / self.angle
        return replace(
            goals,
            position=replace(goals.position, stiffness=(4e-4, 4e-4, upright)),
            orientation=replace(
                goals.orientation, sharpness=sharpness, stiffness=4 * self.rate / sharpness**2
            ),
        )


class Aimer:
    """Runs the controller on a station until the hand's marker is at its target.

    Attributes:
        state: Of the controller; the estimate of the image Jacobian goes on from aim to aim.
    """

    def __init__(
        self,
        station: Station,
        controller: AdaptiveController,
        marker: int,
        config: AimingConfig | None = None,
    ):
        """Prepare.

        Args:
            station: Where.
            controller: The adaptive controller.
            marker: ArUco number of the hand's marker.
            config: When aiming is done.
        """
        self._station = station
        self._controller = controller
        self._marker = marker
        self._config = config or AimingConfig()
        self._last_image = -np.inf
        self.state: ControllerState = controller.initial_state(station.joints)

    def aim(self, goals: Goals) -> float:
        """Bring the hand's marker to the target.

        Returns:
            Time it took [s].

        Raises:
            MissedGraspError: If it takes too long.
        """
        begin = reached = self._station.time
        while self._station.time - reached < self._config.dwell:
            if not self.error(goals) < self._config.tolerance:
                reached = self._station.time
            if self._station.time - begin > self._config.patience:
                raise MissedGraspError(
                    f"aiming: after {self._config.patience:.0f} s the marker is still "
                    f"{self.error(goals):.1f} px from its target (NaN: not seen)."
                )
            self.step(goals)
        return reached - begin

    def hold(self, goals: Goals, duration: float) -> None:
        """Keep aiming for a while [s], whatever the person does to the body."""
        end = self._station.time + duration
        while self._station.time < end:
            self.step(goals)

    def error(self, goals: Goals) -> float:
        """Distance of the feature from its target [px]; NaN if it is not seen."""
        return float(np.linalg.norm(self._feature() - goals.vision.target.numpy()))

    def step(self, goals: Goals) -> None:
        """One step of the controller."""
        sight = self._station.sight
        feature = torch.from_numpy(self._feature())
        seen = torch.tensor(bool(torch.isfinite(feature).all()))
        new = torch.tensor(sight.time > self._last_image)
        self._last_image = sight.time
        command, self.state = self._controller.step(
            self.state,
            Observation(
                joint_position=self._station.joints,
                feature=feature,
                feature_visible=seen,
                feature_new=new,
                feature_age=_scalar(self._station.time - sight.time),
                image_joint_position=sight.joints,
                human_effort=torch.from_numpy(self._station.asked.effort),
                goals=goals,
                dt=self._station.config.dt,
            ),
        )
        self._station.obey(command, goals.vision.target.numpy(), feature.numpy())

    def _feature(self) -> Float[np.ndarray, "2"]:
        return self._station.sight.pixels.get(self._marker, np.full(2, np.nan))


def _scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
