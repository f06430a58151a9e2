"""Limits for smoothing: an arm's own, or how its demonstrators moved it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import open_folder
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.panda_robot import JOINTS
from hrc_learn.lerobot.policy.closed_form import read_episodes
from hrc_learn.lerobot.policy.motion_planner import matched_columns

ACTION, STATE = "action", "observation.state"


@dataclass(frozen=True, kw_only=True)
class ActionLimits:
    """Limits of every value of an action, and where it is measured."""

    names: list[str]
    fps: float
    velocity: list[float]
    acceleration: list[float]
    jerk: list[float]
    lower: list[float | None]
    upper: list[float | None]
    state_columns: list[int]


def demonstrated_limits(dataset: Path, share: float = 1.0) -> ActionLimits:
    """The policy may move as abruptly as its demonstrators did, and no more.

    Limits are the 99.9th percentiles of differences of the actions within episodes. Positions
    have the Panda's own limits where actions are named as its joints, otherwise none.

    Args:
        dataset: LeRobot dataset that the policy was trained on.
        share: Of what was demonstrated.

    Raises:
        ValueError: The dataset cannot be read, or its actions hold still.
    """
    folder = open_folder(dataset)
    features, fps = folder.info["features"], float(folder.fps)
    if ACTION not in features:
        raise ValueError(f"{dataset} has no actions.")
    episodes = [e[ACTION].double().numpy() for e in read_episodes(dataset, [ACTION])]
    names, width = _names(features, ACTION), episodes[0].shape[-1]
    limits = [share * _largest(episodes, order, fps) for order in (1, 2, 3)]
    names = names or [f"{ACTION}.{i}" for i in range(width)]
    if not all((limit > 0).any() for limit in limits):
        raise ValueError(f"the actions of {dataset} hold still: there is no motion to go by.")
    floor = [np.maximum(limit, 1e-3 * limit.max()) for limit in limits]
    lower, upper = _positions(names)
    return ActionLimits(
        names=names,
        fps=fps,
        velocity=floor[0].tolist(),
        acceleration=floor[1].tolist(),
        jerk=floor[2].tolist(),
        lower=lower,
        upper=upper,
        state_columns=_state_columns(features, names, width),
    )


def _largest(episodes: Sequence[np.ndarray], order: int, fps: float) -> np.ndarray:
    differences = [np.abs(np.diff(e, n=order, axis=0)) for e in episodes if len(e) > order]
    if not differences:
        raise ValueError("episodes are too short to tell how the actions move.")
    return np.quantile(np.concatenate(differences), 0.999, axis=0) * fps**order


def _names(features: dict, key: str) -> list[str]:
    names = features[key].get("names") or []
    if isinstance(names, dict):
        names = next(iter(names.values()), [])
    return [str(name) for name in names]


def _state_columns(features: dict, names: list[str], width: int) -> list[int]:
    if STATE not in features:
        return [-1] * width
    states = _names(features, STATE) or None
    return matched_columns(names, states, (width, features[STATE]["shape"][0]))


def _positions(names: list[str]) -> tuple[list[float | None], list[float | None]]:
    limits = {
        name: (float(panda.limits.lower[i]), float(panda.limits.upper[i]))
        for i, name in enumerate(JOINTS)
    }
    pairs = [limits.get(name, (None, None)) for name in names]
    return [low for low, _ in pairs], [high for _, high in pairs]
