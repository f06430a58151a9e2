"""Targets of visual servoing: pixel of the marker, line of the descent, goals of the
controller.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import Goals
from hrc_learn.geometry import Pose
from hrc_learn.regions import OrientationRegion
from hrc_learn.skills.drawn_goals import DrawnGoalsConfig
from hrc_learn.vision.camera_model import IMAGE_SIZE


@dataclass(frozen=True, kw_only=True)
class VisualServoConfig:
    """Tolerances, time limits and regions of visual servoing."""

    tolerance: float = 2.0
    """Distance of the feature from the target that counts as reached [px]."""
    dwell: float = 0.4
    """Time at the target until it counts as reached [s]."""
    height_tolerance: float = 0.01
    """Height error of the end effector that counts as reached [m]."""
    turn_tolerance: float = 0.03
    """Orientation error of the end effector that counts as reached [rad]."""
    timeout: float = 40.0
    """Give up after this long [s]."""
    occlusion_timeout: float = 10.0
    """Give up after the end effector's marker is undetected for this long [s]."""
    probe: float = 0.06
    """Height above the box from which the end effector descends into it, along the line from
    the object's marker to its own [m]; 0: no descent. The motion shows the controller how that
    line appears to a camera that may have been moved, and so the target on it. The remaining
    way to the object is four times as long, and multiplies the error of the descent."""
    probe_speed: float = 0.05
    """Speed of that descent [m/s]: the highest at which the camera can guide it along the
    line."""
    probe_tolerance: float = 10.0
    """Distance of the feature from the target at which the descent begins [px]."""
    probe_correction: float = 0.003
    """Correction of the end effector after a descent above which the descent is repeated [m]:
    half the required accuracy above an object."""
    probe_deviation: float = 0.012
    """Sideways deviation of the first descent above which it is repeated [m]: a motion in
    another direction is less informative about the line."""
    max_probes: int = 5
    """Largest number of descents."""
    border: float = 80.0
    """Distance of the target from the border of the image [px]; within 50 px, a marker is cut
    off."""
    turn_border: float = 60.0
    """Distance of the marker from the border below which turns of the gripper wait that would
    reduce it further [px]."""
    turn_rate: float = 0.4
    """Highest speed of a turn of the gripper for the object [rad/s]. The marker swings by 0.15
    m per radian while the delayed camera guides it: at twice this rate, the markers of two
    objects in a hundred left the image or went behind the forearm."""
    marker_tolerance: float = 1.5
    """Deviation of the marker from its predicted pixel, while the end effector is held, above
    which it counts as half hidden [px]: three times the noise of pixel and prediction."""
    lost_after: float = 1.0
    """Time after which a marker last seen near the border counts as out of view instead of
    occluded; then the end effector returns to the middle of the box [s]."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Half edges of the box in which vision feedback acts [m]. The box is flat: the image shows
    little about height, and an object has to be grasped at the demonstrated height."""
    acquisition_half_size: tuple[float, float, float] = (0.03, 0.03, 0.003)
    """Half edges of the box until the marker is first detected [m]: a camera that was moved may
    not see the whole box, but will see its middle."""
    angle: float = 0.01
    """Half angle of the tolerated cone of orientations [rad]. The paper's cone of 7.6 degrees
    would shift the marker by 1 cm."""
    rate: float = 4.0
    """Rate at which the end effector returns into the box and into the cone [1/s]."""
    rest_rate: float = 1.0
    """Rate at which the null space returns to the posture above the table [1/s]."""
    drawn: DrawnGoalsConfig = field(default_factory=DrawnGoalsConfig)
    """Effect of a person's drawing on the goals."""

    def within(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest pixel that keeps the distance from the border of the image [px]."""
        return np.clip(pixel, self.border, np.array(IMAGE_SIZE) - 1 - self.border)

    def goals(
        self, above: Pose, target: Float[np.ndarray, "2"], *, detected: bool = True
    ) -> Goals:
        """Goals of the controller.

        Args:
            above: Middle of the box above the table, and orientation of the end effector.
            target: Target of the end effector's marker [px]. A target outside the image is
                moved to the border: the motion towards it corrects the image Jacobian whose
                error may have placed it outside.
            detected: False until the end effector's marker is first detected.
        """
        half_size = self.half_size if detected else self.acquisition_half_size
        goals = Goals.at(
            above.position,
            above.orientation,
            torch.from_numpy(self.within(target)),
            half_size=half_size,
        )
        # Near the wall of a region its excess decays at 4 k_c / h^2 and k_o (alpha_o / 2)^2.
        # With the paper's 4e-4, the arm would follow a marker that has left the image until it
        # is stretched.
        walls = tuple(self.rate / 4 * h**2 for h in half_size)
        sharpness = 2 / self.angle
        return replace(
            goals,
            # Attracts from anywhere in the image, unlike the paper's region.
            vision=replace(goals.vision, formulation="saturated"),
            position=replace(goals.position, stiffness=walls),
            orientation=OrientationRegion(
                goal=above.orientation,
                sharpness=sharpness,
                stiffness=4 * self.rate / sharpness**2,
            ),
        )


def no_perspective(
    jacobian: Float[np.ndarray, "2 6"], pixel: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3"]:
    """Depth gradient of a camera without perspective, zero [1/m]."""
    return np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class ServoTarget:
    """Pose to servo to, and the functions that locate it in the image."""

    config: VisualServoConfig
    above: Pose
    """Middle of the box above the table, and orientation of the end effector."""
    posture: Float[Tensor, " joints"] | None
    """Joint positions there, approached in joint space [rad]; None: approached by the
    Cartesian regions."""
    target: Callable[
        [Float[np.ndarray, "2 6"], Float[Tensor, "4"], Float[np.ndarray, "3"]],
        Float[np.ndarray, "2"],
    ]
    """Target of the end effector's marker [px], from the image Jacobian there, the orientation
    of the end effector, and its offset from right above the object [m]."""
    lines: Callable[[Float[Tensor, "4"]], Float[np.ndarray, "3"]]
    """Direction from the object's marker to the end effector's, base frame, upwards, from the
    orientation of the end effector."""
    depth_gradient: Callable[
        [Float[np.ndarray, "2 6"], Float[np.ndarray, "2"]], Float[np.ndarray, "3"]
    ] = no_perspective
    """Relative change of the marker's depth with its position [1/m], from image Jacobian and
    pixel."""
    angle: float | None = None
    """Direction of the object's marker in the image [rad]; None: the gripper does not turn."""
    turn_range: tuple[float, float] = (0.0, 0.0)
    """Smallest and largest turn of the gripper about the vertical [rad]."""
    orientation: Float[Tensor, "4"] | None = None
    """Orientation of the end effector, turned for the object; None: that of `above`."""
    rest: Float[Tensor, " joints"] | None = None
    """Posture to which the null space returns [rad]; None: it stays where it is."""
    raised: float = 0.0
    """Present height above the box, along the line [m]."""

    def goals(
        self, image_jacobian: Float[np.ndarray, "2 6"], pose: Pose, *, detected: bool = True
    ) -> Goals:
        """Goals from an estimate of the image Jacobian at a pose of the end effector."""
        # A camera that was moved may not see above the box until the marker is detected.
        offset = torch.from_numpy(self._offset(self.raised if detected else 0.0))
        above = Pose(self.above.position + offset, self.tool_orientation)
        goals = self.config.goals(above, self.pixel(image_jacobian, pose), detected=detected)
        return goals.approached_by(self.posture)

    def pixel(
        self, image_jacobian: Float[np.ndarray, "2 6"], pose: Pose
    ) -> Float[np.ndarray, "2"]:
        """Target of the marker with the end effector on the line at its present height [px]."""
        # Within the box the gripper moves straight down, not along the line: millimetres of
        # remaining height must not move it sideways.
        height = float(pose.position[2] - self.above.position[2]) - self.config.half_size[2]
        pixel = self.raised_pixel(image_jacobian, min(max(height, 0.0), self.config.probe))
        return self.config.within(pixel) if self.raised else pixel

    def raised_pixel(
        self, image_jacobian: Float[np.ndarray, "2 6"], height: float
    ) -> Float[np.ndarray, "2"]:
        """Target pixel of the marker with the end effector on the line at a height [m]."""
        return self.target(image_jacobian, self.tool_orientation, self._offset(height))

    def deviation(self, pose: Pose, before: Pose) -> float:
        """Sideways distance of a pose from the line through an earlier one [m]."""
        moved = (pose.position - before.position).numpy()
        return float(np.linalg.norm((moved - self._offset(moved[2]))[:2]))

    @property
    def tool_orientation(self) -> Float[Tensor, "4"]:
        """Orientation of the end effector."""
        return self.above.orientation if self.orientation is None else self.orientation

    def _offset(self, height: float) -> Float[np.ndarray, "3"]:
        """Offset along the line at a height above its start [m]."""
        line = self.lines(self.tool_orientation)
        return height / line[2] * line
