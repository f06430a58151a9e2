"""Reports of a control step: feedback to the person that guides an arm, and log columns."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import (
    INTERVENTIONS,
    Command,
    Goals,
    SafetyReport,
    SeparationConfig,
)
from hrc_learn.controller.arm_loop_state import ArmReport, Limitation, WatchedPeople
from hrc_learn.controller.null_space_motion import fraction_kept
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import GraspedBox, SerialChain
from hrc_learn.protocols import HINDRANCES, ArmState, Feedback, Hindrance, Reason
from hrc_learn.skills.drawn_goals import DrawnGoalsState
from hrc_learn.store import read_toml

# An arm counts as following the person if it keeps more than this fraction of the requested
# motion. Late servos and the curvature of the null space can reduce the fraction to this value.
_FOLLOWED = 0.97
# A joint closer to its limit than this is reported [rad]. Pushes end 0.12 rad before the limit:
# this is the margin of the safety filter plus the margin of the task.
_NEAR_LIMIT = 0.15
# Time between two updates of contacts and joint limits [s]: no device shows them faster.
_UPDATE_EVERY = 0.1
# Pace below which an arm counts as waiting instead of slowing down.
_WAITING = 0.05

type Detail = float | int | str
"""Number or words that are inserted into the text of a reason."""

_TABLES = read_toml(Path(__file__).with_name("hindrances.toml"))
_TEXTS: Mapping[Hindrance, str] = _TABLES["texts"]
_INTERVENTIONS: Mapping[str, Hindrance] = _TABLES["interventions"]


def filter_hindrance(report: SafetyReport) -> Hindrance | None:
    """Reason why a safety filter may have reduced a motion; None: it was delayed at most."""
    acted = {INTERVENTIONS[int(k)] for k in report.flags.nonzero()}
    return next((cause for kind, cause in _INTERVENTIONS.items() if kind in acted), None)


def contact_force(
    jacobian: Float[Tensor, "6 joints"], state: ArmState
) -> Float[np.ndarray, "3"] | None:
    """Force at the end effector that best explains the external torques [N].

    Contacts elsewhere, friction and an unknown load contribute to this force, too.

    Args:
        jacobian: Jacobian of the end effector.
        state: Reading of the arm.

    Returns:
        The force; None if the arm has no estimate of external torques.
    """
    if state.external_torque is None:
        return None
    return np.linalg.lstsq(jacobian.mT.numpy(), state.external_torque, rcond=None)[0][:3]


class PersonFeedback:
    """Collects the feedback of each step to the person that guides an arm.

    Causes that keep the arm from following the person are collected over one step. Each cause
    reduces the motion by a factor; the product of all factors is the fraction that remains.
    """

    def __init__(self, chain: SerialChain):
        """Begin with an arm without contact.

        Args:
            chain: Kinematics of the arm.
        """
        self._chain = chain
        self._lower, self._upper = chain.limits.lower.numpy(), chain.limits.upper.numpy()
        self._force: np.ndarray | None = None
        self._near: tuple[str, ...] = ()
        self._nearest = 1  # joint nearest to its limit, counted from 1
        self._updated, self._load, self._width = -math.inf, None, 0.0
        self._followed = 1.0
        self._causes: dict[Hindrance, tuple[float, dict[str, Detail]]] = {}

    _load: GraspedBox | None

    def note(
        self, cause: Hindrance, kept: float = 1.0, *, mention: bool = False, **details: Detail
    ) -> None:
        """Note a cause that limits the motion.

        Args:
            cause: Cause of the limitation.
            kept: Fraction of the motion that remains, 0 to 1.
            mention: Report the cause even if it does not reduce the motion.
            details: Values for the text of the cause.
        """
        self._followed *= kept
        if kept < _FOLLOWED or mention:
            before, _ = self._causes.get(cause, (1.0, {}))
            self._causes[cause] = before * kept, details

    def note_step(self, report: ArmReport, *, filtered: bool = True) -> None:
        """Note the causes for which the arm loop reduced a push.

        Args:
            report: Report of the step, for a single arm.
            filtered: Include the reduction by the safety filter.
        """
        self.note_limitations(report.limitations)
        if not filtered or report.null_motion is None:
            return
        cause = "person" if report.slowed_by_people else filter_hindrance(report.safety)
        if cause is not None:
            self.note(cause, float(fraction_kept(*report.null_motion)))

    def note_limitations(self, limitations: Iterable[Limitation]) -> None:
        """Note limitations of a push."""
        for cause, kept, joint, distance, mentioned in limitations:
            details: dict[str, Detail] = {}
            if joint is not None:
                details["joint"] = int(joint) + 1
            if distance is not None:
                details["distance"] = 100 * float(distance)
            mention = mentioned is not None and bool(mentioned)
            self.note(cause, float(kept), mention=mention, **details)

    def end_step(
        self,
        state: ArmState,
        jacobian: Float[Tensor, "6 joints"] | None = None,
        *,
        pushed: bool,
        person_distance: float | None = None,
        pace: float = 1.0,
        load: GraspedBox | None = None,
        contact_expected: bool = False,
    ) -> Feedback:
        """Return the feedback of this step; the next step begins without hindrances.

        Args:
            state: Reading of the arm.
            jacobian: Jacobian of the end effector; None: computed when needed.
            pushed: True if the person asks for a motion.
            person_distance: Distance of the nearest person [m], NaN while it is not known;
                None: people are not tracked.
            pace: Speed scale of the task due to people near the arm, 0 to 1.
            load: Object in the gripper; None: no object.
            contact_expected: True while the task searches for a contact, or shortly after.
        """
        # The clock jumps back if a simulation is restarted.
        if not 0 <= state.time - self._updated < _UPDATE_EVERY:
            self._update(state, jacobian)
        if load is not self._load:
            self._load, self._width = load, state.gripper_width
        followed, reasons = 1.0, ()
        if pushed:
            if person_distance is not None and pace < _FOLLOWED:
                self.note("person", mention=True)
            known = {"joint": self._nearest, "person": _person_text(person_distance, pace)}
            followed = self._followed
            reasons = tuple(
                Reason(hindrance=cause, kept=kept, text=_TEXTS[cause].format(**known | details))
                # The cause that limits the motion most comes first.
                for cause, (kept, details) in sorted(
                    self._causes.items(), key=lambda item: item[1][0]
                )
            )
        self._followed, self._causes = 1.0, {}
        return Feedback(
            pushed=pushed,
            followed=followed,
            reasons=reasons,
            contact_force=self._force,
            near_limits=self._near,
            person_distance=person_distance,
            pace=pace,
            slip=0.0 if load is None else abs(state.gripper_width - self._width),
            contact_expected=contact_expected,
        )

    def _update(self, state: ArmState, jacobian: Float[Tensor, "6 joints"] | None) -> None:
        """Find joints near their limits, and estimate the contact force."""
        q, names = state.joint_position, self._chain.joint_names
        distance = np.minimum(q - self._lower, self._upper - q)
        self._nearest = int(distance.argmin()) + 1
        self._near = tuple(names[k] for k in (distance < _NEAR_LIMIT).nonzero()[0])
        if jacobian is None:
            jacobian = self._chain.jacobian(torch.from_numpy(q))
        self._force = contact_force(jacobian, state)
        self._updated = state.time


def _person_text(distance: float | None, pace: float) -> str:
    """Text about people near the arm and their effect on its motion."""
    does = "keeps its distance" if pace >= _FOLLOWED else "slows down"
    does = "waits" if pace < _WAITING else does
    if distance is None or math.isnan(distance):
        return f"the distance of people is not known: the arm {does}"
    return f"a person is {max(distance, 0.0):.1f} m away: the arm {does}"


NO_VISION: dict[str, Any] = {
    "feature": np.full(2, math.nan),
    "target": np.full(2, math.nan),
    "image_jacobian": np.full((2, 6), math.nan),
    "weight_norm": math.nan,
    "potential": math.nan,
    "potential_rate": math.nan,
    "vision_activation": math.nan,
    "approach": math.nan,
    "region": np.full(6, math.nan),
    "drawn": False,
    "turn": np.full(3, math.nan),
}
"""Columns of a step without a camera in the loop."""


def vision_columns(
    command: Command,
    goals: Goals,
    feature: Float[np.ndarray, "2"],
    approach: float,
    drawn: DrawnGoalsState,
) -> dict[str, Any]:
    """Columns of a step of visual servoing.

    Args:
        command: Command of the controller.
        goals: Goals of the controller.
        feature: Pixel of the marker used in this step [px]; NaN: no pixel.
        approach: Fraction of a joint-space approach in the command, 0 to 1.
        drawn: A person's drawing and turn.
    """
    region = goals.position
    return {
        "feature": feature,
        "target": goals.vision.target.numpy(),
        "image_jacobian": command.image_jacobian.numpy(),
        "weight_norm": float(command.weight_norm),
        "potential": float(command.potential),
        "potential_rate": float(command.potential_rate),
        "vision_activation": float(command.vision_level),
        "approach": approach,
        "region": torch.cat([region.centre, region.half_size]).numpy(),
        "drawn": bool(drawn.active),
        "turn": quaternion.log(drawn.turn).numpy(),
    }


def step_columns(
    state: ArmState,
    velocity: Float[Tensor, " joints"],
    effort: Float[np.ndarray, " joints"],
    report: ArmReport,
    feedback: Feedback,
) -> dict[str, Any]:
    """Log columns of the arm, of its loop, and of the feedback to the person.

    The components of the column "hindered" are `HINDRANCES`; those of "safety" are
    `INTERVENTIONS`.

    Args:
        state: Reading of the arm.
        velocity: Joint velocity sent to the arm [rad/s].
        effort: Null-space input of the person [N m].
        report: Report of the control loop.
        feedback: Feedback to the person.
    """
    goal, path = report.goal, report.path_joints
    reasons = {reason.hindrance for reason in feedback.reasons}
    return {
        "time": state.time,
        "joint_position": state.joint_position,
        "joint_velocity": state.joint_velocity,
        "command_velocity": velocity.numpy(),
        "nullspace_input": effort,
        "gripper": state.gripper_width,
        "followed": feedback.followed if feedback.pushed else math.nan,
        "hindered": np.array([hindrance in reasons for hindrance in HINDRANCES]),
        "safety": report.safety.flags.numpy(),
        "goal_position": np.full(3, math.nan) if goal is None else goal.position.numpy(),
        "path_joints": np.full(len(effort), math.nan) if path is None else path.numpy(),
    }


def separation_columns(
    watched: WatchedPeople,
    separation: SeparationConfig,
    velocity: Float[Tensor, " joints"],
    people_scale: float,
) -> dict[str, float]:
    """Log columns: distance from people, and protective distance at the present speed.

    The protective distance is zero for contacts that power and force limiting allows.

    Args:
        watched: People near the arm.
        separation: Settings of the protective distance.
        velocity: Joint velocity sent to the arm [rad/s].
        people_scale: Speed scale imposed by people, 0 to 1.
    """
    near = watched.distances
    closing, coming = -(near.gradient @ velocity), near.approach_speed
    needed = separation.protective_distance(closing, coming)
    needed = needed.masked_fill(
        separation.touches_gently(closing, coming, near.contact_speed), 0.0
    )
    tightest = (near.distance - needed).argmin()
    return {
        "person_distance": float(watched.nearest),
        "person_age": float(watched.age),
        "protective_distance": float(needed[tightest]),
        "separation_margin": float((near.distance - needed)[tightest]),
        "pace": people_scale,
    }
