"""Planned paths of the joints, on which the null space yields to people and goes back."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry.numerics import null_projection
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.failures import BlockedPathError, TaskFailedError
from hrc_learn.skills.null_space_yielding import (
    CHANGE_OF_RATE,
    LONGEST_RETURN,
    NARROW,
    STUCK,
    NullSpaceYielding,
    changed_rate,
    nears_singularity,
    smallest_singular_value,
    waited_for,
)
from hrc_learn.skills.person_feedback import share_kept
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig

# After which they go back straight [s]; and to how many samples of the path that is tried.
_LONGEST_WAIT, _OTHERS = 20.0, 20
# Distance of the end effector from its path for the path to wait, and time by which servos lag
# [m, s]: half the deviation that a push may cause, and twice the lag of an arm 20 ms late.
_ON_PATH, _SERVO_LAG = 0.001, 0.06
# Metres that a radian of the end effector counts for: a length of hand and object.
_METRES_PER_RADIAN = 0.1
# Postures on the straight way back to a path that are checked: 0.1 rad apart at most.
_CHECKED = 50


def follow_path(
    cell: WorkCell,
    path: Float[np.ndarray, "steps joints"],
    until: Callable[[], bool] = lambda: False,
) -> int:
    """Move the joints along a path sampled at the control step, yielding to the person.

    While a person pushes, the end effector keeps to the poses of the path, and the null
    space yields. Where the arm, pushed aside, cannot follow, the path waits: where it would
    meet something, and before a singularity of the path, at which nobody can push the arm
    off it. When they let go the joints go back to the path, at the end of it too, or stay
    beside it (`WorkCellConfig.after_push`).

    Args:
        cell: Of the arm.
        path: Joint positions [rad].
        until: Asked before each step whether to stop there.

    Returns:
        Number of samples that were tracked.

    Raises:
        BlockedPathError: If the arm, pushed aside, does not find back to a path that waits.
        TaskFailedError: If somebody holds the arm aside for too long (`longest_wait`) while the
            path waits.
    """
    if not len(path):
        return 0
    cell.plan = path
    try:
        return PathFollower(cell, path).follow(until)
    finally:
        cell.plan = None


class PathFollower:
    """Follows one path; `follow_path` says how."""

    def __init__(self, cell: WorkCell, path: Float[np.ndarray, "steps joints"]):
        """Begin at its first sample.

        Args:
            cell: Of the arm.
            path: Joint positions [rad], at least one.
        """
        self._cell, self._path = cell, path
        self._yielding, self._config = cell.yielding, cell.config
        dt = self._config.dt
        self._velocity = np.gradient(path, dt, axis=0) if len(path) > 1 else np.zeros_like(path)
        singular = smallest_singular_value(cell.chain, torch.from_numpy(path.copy()))
        self._narrow = singular < NARROW
        self._yielding.begin(torch.from_numpy(path[0]) - cell.joints)

    def follow(self, until: Callable[[], bool]) -> int:
        """Along all of it; the number of samples that were tracked."""
        cell, path, yielding, dt = self._cell, self._path, self._yielding, self._config.dt
        progress, rate, patience = 0.0, 1.0, _Patience(self._config)
        while progress <= len(path) - 1:
            if until():
                return int(progress)
            now = rate * cell.pace.led
            later = progress + now * self._config.command_delay / dt
            goal, wanted = _between(path, progress), now * _between(self._velocity, later)
            narrow = bool(self._narrow[int(progress)])
            behind = self._track(goal, wanted, yields=not narrow, returns=rate <= 0)
            patience.step(yielding, goal - cell.joints, rate, cell.pace.undisturbed)
            # The null space that led aside further back leads back there as well.
            backs = patience.is_stuck and progress > 0
            if not backs and yielding.aside and self._stops(progress):
                behind = math.inf
            rate = float(changed_rate(rate, 2.0 - behind, dt, -1 if backs else 1))
            if rate <= 0:
                cell.hindrances.mention("task_waits")
            progress = max(progress + rate * cell.pace.share, 0.0)
            if patience.is_over:
                progress, patience = self.go_straight_back(progress), _Patience(self._config)
        if self._config.after_push == "return":
            end = torch.from_numpy(path[-1])
            deadline = cell.time + LONGEST_RETURN
            while yielding.aside and not yielding.pushed and cell.time < deadline:
                self._track(end, torch.zeros_like(end))
        return len(path)

    def _track(
        self,
        goal: Float[Tensor, " joints"],
        velocity: Float[Tensor, " joints"],
        yields: bool = True,
        returns: bool = False,
    ) -> float:
        """One step along a path of the joints, or of the end effector while they are aside.

        Args:
            goal: Where on the path [rad].
            velocity: Along it [rad/s].
            yields: Whether the person can push the joints off it here.
            returns: Whether joints that were pushed off it go back in any case.

        Returns:
            How far the end effector then is from its goal, as a ratio to what is allowed;
            above 1 the path has to wait.
        """
        cell = self._cell
        error = goal - cell.joints
        back = self._yielding.way_back(
            cell.joints, error, cell.jacobian, yields=yields, returns=returns
        )
        pose = cell.chain.forward(goal)
        if back is None:
            if not yields:
                cell.hindrances.note("narrow_path", 0.0)
            cell.step(velocity + self._config.pose_gain * error, pose, path_joints=goal)
            return 0.0
        self._tell(back)
        ahead = goal + self._config.command_delay * velocity
        twist = cell.chain.jacobian(ahead) @ velocity
        share, drift = self._yielding.push_share, velocity + back
        if cell.track_pose(pose, twist, drift, push_share=share, path_joints=goal):
            return math.inf
        return float(behind_path(cell.pose.twist_to(pose), twist))

    def _stops(self, progress: float) -> bool:
        """Whether joints aside could not follow the path from a sample on, or not find back."""
        cell, ahead = self._cell, int(progress + CHANGE_OF_RATE / self._config.dt)
        return (
            self._yielding.lost
            or bool(self._narrow[int(progress) : ahead + 1].any())
            or bool(nears_singularity(cell.chain, cell.joints, cell.commanded_velocity))
        )

    def _tell(self, back: Float[Tensor, " joints"]) -> None:
        """Tell who pushes what they cannot lead on, or is led back meanwhile [rad/s]."""
        cell, yielding = self._cell, self._yielding
        if yielding.pushed:
            push = null_projection(cell.jacobian, yielding.null_velocity)
            kept = share_kept(push, yielding.push_share * push + back)
            far = yielding.lost or yielding.push_share < 1
            cell.hindrances.note("too_far" if far else "task_waits", kept)

    def go_straight_back(self, progress: float) -> float:
        """To a path that waits, where no motion of the null space leads.

        Another posture for the same pose may lie between. The end effector leaves its path.

        Args:
            progress: Sample at which it waits.

        Returns:
            The sample at which the arm is then: that one if its way there is clear of what is
            around it, else the nearest to the arm of which it is.

        Raises:
            BlockedPathError: If the arm would meet something on the way to any sample.
        """
        cell, path, config = self._cell, self._path, self._config
        others = range(0, len(path), max(1, len(path) // _OTHERS))
        far = {k: float(np.linalg.norm(path[k] - cell.joints.numpy())) for k in others}
        for sample in (progress, *sorted(far, key=far.__getitem__)):
            goal = _between(path, sample)
            way = joint_line(cell.joints, goal, config.return_speed, config.dt)
            if self._is_clear(way):
                break
        else:
            raise BlockedPathError(
                "path: the arm was pushed aside and finds no way back that is clear of what is "
                "around it."
            )
        self._yielding.aside, pose, passed = False, cell.chain.forward(goal), 0.0
        while passed <= len(way) - 1:
            q = way[int(passed)]
            passed += cell.pace.led
            cell.hindrances.note("too_far", 0.0)
            cell.step(config.pose_gain * (q - cell.joints), pose, path_joints=q)
        return float(sample)

    def _is_clear(self, way: Float[Tensor, "steps joints"]) -> bool:
        """Whether the arm comes no nearer to what is around it than at the ends of a way."""
        if self._cell.clearance is None:
            return True
        distance = self._cell.clearance(way[:: max(1, len(way) // _CHECKED)])
        ends = distance[[0, -1]].min()
        return not bool((distance < ends.clamp(max=self._config.clearance)).any())


class _Patience:
    """For how long a path has waited for joints that somebody pushed aside."""

    def __init__(self, config: WorkCellConfig):
        """Begin with none."""
        self._config = config
        self._waited = torch.zeros((), dtype=torch.float64)
        self._nearest = torch.full_like(self._waited, torch.inf)
        self._held = 0.0

    @property
    def is_stuck(self) -> bool:
        """Whether it has waited so long that it is gone back."""
        return float(self._waited) > STUCK

    @property
    def is_over(self) -> bool:
        """Whether it has waited so long that the joints go straight back."""
        return float(self._waited) > _LONGEST_WAIT

    def step(
        self,
        yielding: NullSpaceYielding,
        error: Float[Tensor, " joints"],
        rate: float,
        undisturbed: bool,
    ) -> None:
        """Count one step.

        Args:
            yielding: Of the null space.
            error: From the joints to the path [rad].
            rate: Of the path, -1 to 1.
            undisturbed: Whether nobody slows it down or pauses it.

        Raises:
            TaskFailedError: Somebody holds the arm aside for too long.
        """
        # Who pushes again and again must not hold it up for good.
        counts = torch.tensor(undisturbed and not yielding.pushed)
        speed, dt = error.new_tensor(rate), self._config.dt
        self._waited, self._nearest = waited_for(
            self._waited, self._nearest, error.norm(), speed, counts, dt
        )
        if not yielding.aside:
            self._waited = torch.zeros_like(self._waited)
        self._held = self._held + dt if rate <= 0 and yielding.pushed else 0.0
        if self._held > self._config.longest_wait:
            raise TaskFailedError(
                f"the arm was held aside for {self._held:.0f} s while its path waited: let it "
                "go, or let it wait longer (longest_wait)."
            )


def _between(samples: Float[np.ndarray, "steps joints"], at: float) -> Float[Tensor, " joints"]:
    """A path between two of its samples, or at its end."""
    k = min(int(at), len(samples) - 1)
    following = samples[min(k + 1, len(samples) - 1)]
    return torch.from_numpy(samples[k] + (at - k) * (following - samples[k]))


def behind_path(
    off: Float[Tensor, "*batch 6"], twist: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch"]:
    """How far the end effector is from its path, as a ratio to what is allowed.

    Args:
        off: Motion to where it should be (linear [m], angular [rad]).
        twist: Of the path there (linear [m/s], angular [rad/s]).
    """
    return _size(off) / (_ON_PATH + _SERVO_LAG * _size(twist))


def _size(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Of a motion, its turn counted in metres [m]."""
    return twist[..., :3].norm(dim=-1) + _METRES_PER_RADIAN * twist[..., 3:].norm(dim=-1)
