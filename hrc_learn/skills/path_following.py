"""Planned joint paths on which the null space yields to people and returns."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from hrc_learn.skills.work_cell import WorkCell


def follow_path(
    cell: WorkCell,
    path: Float[np.ndarray, "steps joints"],
    until: Callable[[], bool] = lambda: False,
) -> int:
    """Move the joints along a path sampled at the control step, yielding to the person.

    While a person pushes, the end effector keeps to the poses of the path, and the null space
    yields. The path waits where the arm, pushed aside, cannot follow: where it would meet
    something, before a singularity of the path, and where the joints might not find back. After
    a push the joints return to the path, at its end too, or stay off it
    (`WorkCellConfig.after_push`).

    Args:
        cell: Work cell of the arm.
        path: Joint positions [rad].
        until: Asked before each step whether to stop there.

    Returns:
        Number of samples that were tracked.

    Raises:
        BlockedPathError: The arm, pushed aside, does not find back to a path that waits.
        TaskFailedError: A person holds the arm aside for longer than `longest_wait` while the
            path waits, or blocks it for as long.
    """
    if not len(path):
        return 0
    cell.plan = path
    try:
        return cell.follow(path, until)
    finally:
        cell.plan = None
