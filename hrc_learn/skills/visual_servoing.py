"""Image-based visual servoing to an object with an uncalibrated camera."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import (
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    ControllerState,
    Goals,
    Observation,
)
from hrc_learn.controller.interface import IMAGE_SIZE
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    CellErrors,
    EvidenceResult,
    KalmanEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.skills.visual_target import OBJECT_FEATURE, VisualTarget
from hrc_learn.skills.work_cell import MissedGraspError, Station

# Aiming at an object with an uncalibrated camera: the adaptive controller at work.


@dataclass(frozen=True, kw_only=True)
class AimingConfig:
    """When aiming is done, and when it is given up."""

    tolerance: float = 2.0
    """Distance of the feature from the target at which it counts as reached [px]."""
    dwell: float = 0.4
    """How long it has to stay there [s]."""
    height_tolerance: float = 0.01
    """How far above or below the middle of the box the hand may then be [m]."""
    patience: float = 40.0
    """After which aiming is given up [s]."""
    unseen_patience: float = 10.0
    """How long the hand's marker may stay out of sight [s]."""
    probe: float = 0.03
    """Height above the box from which the hand comes down into it, along the line from the
    object's marker to its own [m]. From this motion the controller learns how that line looks
    to a camera that may have been moved, and so where on it the marker has to be. The longer,
    the less matters noise, and the more perspective, which makes the line look longer from
    nearer to the camera. 0: none."""
    probe_speed: float = 0.05
    """How fast the hand comes down from there: no faster than the camera can lead it along the
    line [m/s]."""
    probe_tolerance: float = 10.0
    """Distance of the feature from the target at which the hand comes down [px]."""
    probe_reach: float = 0.015
    """The line looks different elsewhere, and one motion may not tell it well: a hand that has
    come further off it than this by the time it is down goes up again, and comes down where
    it then is [m]."""
    most_probes: int = 3
    """How often the hand comes down at most."""
    border: float = 50.0
    """Distance that the target keeps from the edge of the image [px]."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Box in which the camera takes over [m]. Flat: the image tells little about height, and
    an object has to be met at the height at which aiming was taught."""
    unseen_half_size: tuple[float, float, float] = (0.03, 0.03, 0.003)
    """The same until the camera has seen the hand's marker: one that was moved may not see all
    of the box, but will see its middle [m]."""
    angle: float = 0.01
    """Tolerated turn of the hand [rad]. The paper's cone of 7.6 degrees would leave the marker
    1 cm off the place it was taught to be at."""
    rate: float = 4.0
    """How fast the hand returns into the box from above or below, and into the cone [1/s]."""

    def within(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """A pixel, or the nearest one that keeps its distance from the edge of the image."""
        return np.clip(pixel, self.border, np.array(IMAGE_SIZE) - 1 - self.border)

    def goals(
        self, above: Pose, target: Float[np.ndarray, "2"], *, found: bool = True
    ) -> Goals:
        """Goals of aiming.

        Args:
            above: Middle of the box above the table, and orientation of the hand.
            target: Where in the image the hand's marker should be [px]. One outside the image
                is brought to its border: on the way there the image Jacobian is learned, which
                may have put it outside.
            found: Whether the camera has seen the hand's marker.
        """
        goals = Goals.at(
            above.position,
            above.orientation,
            torch.from_numpy(self.within(target)),
            half_size=self.half_size if found else self.unseen_half_size,
        )
        # Near the border of a region its excess decays at 4 k_c / h^2 and k_o (alpha_o / 2)^2.
        upright = self.rate / 4 * self.half_size[2] ** 2
        sharpness = 2 / self.angle
        return replace(
            goals,
            # Pulls from wherever the marker is seen; the paper's region may leave it outside.
            vision=replace(goals.vision, formulation="saturated"),
            position=replace(goals.position, stiffness=(4e-4, 4e-4, upright)),
            orientation=replace(
                goals.orientation, sharpness=sharpness, stiffness=4 * self.rate / sharpness**2
            ),
        )


@dataclass(frozen=True, kw_only=True)
class Aim:
    """What to aim at. Where that is in the image depends on what is known of the camera."""

    config: AimingConfig
    above: Pose
    """Middle of the box above the table, and orientation of the hand."""
    posture: Float[Tensor, " joints"] | None
    """Joint positions with the hand there, by which it is approached [rad]; None: it is
    approached by the Cartesian regions."""
    target: Callable[[Float[np.ndarray, "2 6"]], Float[np.ndarray, "2"]]
    """Where the hand's marker should be [px], given the image Jacobian there."""
    line: Float[np.ndarray, "3"]
    """Direction from the object's marker to the hand's, base frame; it leads up."""
    raised: float = 0.0
    """Height above there at which to stay for now, further away along the line [m]."""

    def goals(
        self, image_jacobian: Float[np.ndarray, "2 6"], hand: Pose, *, found: bool = True
    ) -> Goals:
        """Goals by an estimate of the image Jacobian, with the hand where it is."""
        away = torch.from_numpy(self._away(self.raised))
        above = Pose(self.above.position + away, self.above.orientation)
        goals = self.config.goals(above, self.pixel(image_jacobian, hand), found=found)
        return goals.approached_by(self.posture)

    def pixel(
        self, image_jacobian: Float[np.ndarray, "2 6"], hand: Pose
    ) -> Float[np.ndarray, "2"]:
        """Where the marker should be for the hand to be on the line, at the height it has."""
        height = float(hand.position[2] - self.above.position[2])
        away = self._away(min(max(height, 0.0), self.config.probe))
        pixel = self.target(image_jacobian) + image_jacobian[:, :3] @ away
        return self.config.within(pixel) if self.raised else pixel

    def aside(self, hand: Pose, before: Pose) -> float:
        """How far a hand has left the line that it was on before, sideways [m]."""
        moved = (hand.position - before.position).numpy()
        return float(np.linalg.norm((moved - self._away(moved[2]))[:2]))

    def _away(self, height: float) -> Float[np.ndarray, "3"]:
        return height / self.line[2] * self.line


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
        self._last_image = self._last_seen = -np.inf
        self._known = (np.nan, np.zeros((2, 6)))  # when, and the image Jacobian then
        self._found = False
        self.state: ControllerState = controller.initial_state(station.joints)

    def aim(self, aim: Aim) -> float:
        """Bring the hand's marker to the target, first from higher up, along a line.

        Returns:
            Time it took [s].

        Raises:
            MissedGraspError: If it takes too long, or the marker stays out of sight.
        """
        begin, config = self._station.time, self._config
        self._found = False
        self._resume()
        reached, above = begin, self._station.pose
        for _ in range(config.most_probes if config.probe > 0 else 1):
            if config.probe > 0:
                self._reach(replace(aim, raised=config.probe), config.probe_tolerance, begin)
                above = self._station.pose
                self._come_down(aim)
            reached = self._reach(aim, config.tolerance, begin)
            if config.probe == 0 or aim.aside(self._station.pose, above) < config.probe_reach:
                break
        return reached - begin

    def _resume(self) -> None:
        """Tell the estimate how long nobody has watched: the camera may have been moved."""
        pause = self._station.time - self._last_image
        if 0 < pause < np.inf:
            estimator = self._controller.estimator
            resumed = estimator.resumed(self.state.estimator, pause)
            self.state = replace(self.state, estimator=resumed)

    def _reach(self, aim: Aim, tolerance: float, begin: float) -> float:
        """Steps until marker and height have stayed at the target; when they came there [s]."""
        reached = self._last_seen = self._station.time
        while self._station.time - reached < self._config.dwell:
            self.step(aim)
            if not (self.error(aim) < tolerance and self._at_height(aim)):
                reached = self._station.time
            self._check(aim, self._station.time - begin)
        return reached

    def _come_down(self, aim: Aim) -> None:
        """Along the line, from as high up as a probe begins."""
        config = self._config
        drop = config.probe_speed * self._station.config.dt
        for height in np.arange(config.probe, 0.0, -drop):
            self.step(replace(aim, raised=float(height)))

    def hold(self, aim: Aim, duration: float) -> None:
        """Keep aiming for a while [s], whatever the person does to the body."""
        end = self._station.time + duration
        while self._station.time < end:
            self.step(aim)

    def error(self, aim: Aim) -> float:
        """Distance of the feature from its target [px]; NaN if it is not seen."""
        target = aim.pixel(self._image_jacobian(), self._station.pose)
        return float(np.linalg.norm(self._feature() - target))

    def step(self, aim: Aim) -> None:
        """One step of the controller."""
        sight = self._station.sight
        feature = torch.from_numpy(self._feature())
        seen = torch.tensor(bool(torch.isfinite(feature).all()))
        new = torch.tensor(sight.time > self._last_image)
        self._last_image = sight.time
        if seen:
            self._last_seen, self._found = sight.time, True
        goals = aim.goals(self._image_jacobian(), self._station.pose, found=self._found)
        command, self.state = self._controller.step(
            self.state,
            Observation(
                joint_position=self._station.joints,
                feature=feature,
                feature_visible=seen,
                feature_new=new,
                feature_age=_scalar(self._station.time - sight.time),
                image_joint_position=sight.joints,
                nullspace_input=torch.from_numpy(self._station.asked.effort),
                goals=goals,
                dt=self._station.config.dt,
            ),
        )
        approach = 0.0 if aim.posture is None else 1.0 - float(self.state.task_level)
        target = goals.vision.target.numpy()
        self._station.obey(command, target, feature.numpy(), approach)

    def _image_jacobian(self) -> Float[np.ndarray, "2 6"]:
        """Estimate where the hand was in the newest image [px/m, px/rad]."""
        sight = self._station.sight
        if sight.time != self._known[0]:
            joints = self._station.joints if sight.joints is None else sight.joints
            pose = self._station.chain.forward(joints)
            estimate = self._controller.estimator.jacobian(self.state.estimator, pose)
            self._known = sight.time, estimate.numpy()
        return self._known[1]

    def _at_height(self, aim: Aim) -> bool:
        wrong = self._station.pose.position[2] - aim.above.position[2] - aim.raised
        return abs(float(wrong)) < self._config.height_tolerance

    def _check(self, aim: Aim, spent: float) -> None:
        if self._station.time - self._last_seen > self._config.unseen_patience:
            raise MissedGraspError(
                f"aiming: for {self._config.unseen_patience:.0f} s the camera has not seen the "
                f"hand's marker {self._marker}. If nothing covers it, put the object nearer to "
                "the middle of the image."
            )
        if spent > self._config.patience:
            raise MissedGraspError(
                f"aiming: after {spent:.0f} s the marker is still {self.error(aim):.1f} px "
                "from its target (NaN: not seen)."
            )

    def _feature(self) -> Float[np.ndarray, "2"]:
        return self._station.sight.pixels.get(self._marker, np.full(2, np.nan))


def _scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


# A learned visual servo: image Jacobian, visual target and approach direction.


@dataclass(frozen=True, kw_only=True)
class AimingSkill:
    """What was learned from demonstrations of aiming."""

    jacobian: RBFImageJacobian
    target: VisualTarget | None
    """None where no object was watched."""
    approach: Approach | None = None
    """None where no object was watched."""
    learned: EvidenceResult | None = None
    """How neurons, noise and prior were learned; None where they were given."""
    cells: CellErrors | None = None
    """Held-out errors by place; None of a skill that was loaded."""

    def save(self, folder: Path) -> None:
        """Write `folder/jacobian`, `folder/visual_target.json`, `folder/approach.json`."""
        self.jacobian.save(folder / "jacobian")
        if self.target is not None:
            self.target.save(folder / "visual_target.json")
        if self.approach is not None:
            self.approach.save(folder / "approach.json")

    @classmethod
    def load(cls, folder: Path) -> "AimingSkill":
        """Read what `hrc fit image-jacobian` wrote.

        Raises:
            FileNotFoundError: If there is no such folder or file.
            ValueError: If a file is not one of ours.
        """
        target, approach = folder / "visual_target.json", folder / "approach.json"
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
            target=VisualTarget.load(target) if target.exists() else None,
            approach=Approach.load(approach) if approach.exists() else None,
        )

    def target_of(
        self, pixel: Float[np.ndarray, "2"], jacobian: Float[np.ndarray, "2 6"]
    ) -> Float[np.ndarray, "2"]:
        """Where the hand's marker should be, to stand above an object seen at a pixel.

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the hand's marker [px/m, px/rad].

        Raises:
            ValueError: If no object was watched in the demonstrations.
        """
        if self.target is None:
            raise ValueError(
                f"the aiming skill knows no visual target: its demonstrations lack "
                f"{OBJECT_FEATURE}."
            )
        return self.target.seen_by(pixel, jacobian)

    def metrics(self) -> dict[str, float]:
        """How well image motion is predicted, and how well aiming.

        Raises:
            ValueError: If the skill was loaded; its metrics are in metrics.json.
        """
        report = self.jacobian.report
        if report is None or self.cells is None:
            raise ValueError("only a skill just fitted has metrics; see its metrics.json.")
        known = self.cells.relative[self.cells.pairs > 0]
        values = {
            "pairs": float(report.pairs),
            "neurons": float(len(self.jacobian.centers)),
            "motion_px": report.motion,
            "fit_error_px": report.error,
            "held_out_error_px": report.held_out_error,
            "held_out_relative": report.held_out_error / report.motion,
            "held_out_relative_worst_cell": float(known.max()),
        }
        if self.learned is not None:
            first, best = self.learned.rounds[0], self.learned.rounds[self.learned.best]
            values |= {
                "pixel_noise_px": self.learned.config.pixel_noise,
                "width": float(self.learned.neurons.width),
                "learning_rounds": float(self.learned.best),
                "before_learning_error_px": first.held_out_error,
                "after_learning_error_px": best.held_out_error,
            }
        if self.target is not None:
            values["target_error_px"] = self.target.error
            values["target_error_by_offset_px"] = self.target.offset_error
        if self.approach is not None:
            values["approach_spread_deg"] = math.degrees(self.approach.spread)
            values["approach_turned_deg"] = math.degrees(self.approach.turned)
        return values


# Image Jacobians to start from, learned or guessed.


def from_learned(learned: RBFImageJacobian) -> KalmanEstimator:
    """A Kalman filter that starts from the learned Jacobian, but does not rely on it.

    The camera may have been moved since it was learned, about which the covariance of the fit
    knows nothing; the wide prior of a guess takes its place.
    """
    network = copy.deepcopy(learned).double()
    network.covariance = None
    return KalmanEstimator(network)


def guessed_network() -> RBFImageJacobian:
    """The paper's initial image Jacobian, the same everywhere."""
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    return RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)
