"""Public environments with experts, and an object that may be moved under way.

Each is what its package makes it, seen as numbers: where the agent is and where things are. Add
one by a module with a class that has all of `PublicTask`, and name it in known.py. They need
packages of their own: tools/make_environments.sh.
"""

from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
AGENT_POS, ENVIRONMENT_STATE = "agent_pos", "environment_state"
"""What gymnasium environments call the first two for LeRobot."""
type Observation = dict[str, Float[np.ndarray, "_"]]
"""`AGENT_POS` and `ENVIRONMENT_STATE`."""
type Episode = dict[str, Tensor]
"""`STATE`, `ENVIRONMENT` and `ACTION`, float32, (frames, components)."""


class Expert(Protocol):
    """Who knows how a task is done."""

    def begin(self) -> None:
        """An episode begins; to be called after the task's own `begin`."""
        ...

    def act(self, seen: Observation) -> Float[np.ndarray, "A"]:
        """What to do when that is seen; to be called once for each action."""
        ...


class PublicTask(Protocol):
    """One environment with one task.

    The same seed begins alike.
    """

    fps: float
    """Actions a second."""
    n_actions: int
    """A, components of an action."""
    longest: int
    """Actions after which an episode has failed."""
    moved_at: int | None
    """Actions after which the object is moved, the agent being on its way to it; None: it is
    not."""
    expert: Expert

    def begin(self, seed: int) -> Observation:
        """Put everything in its place."""
        ...

    def step(self, action: Float[np.ndarray, "A"]) -> tuple[Observation, bool]:
        """What is seen after an action, and whether the task is done as its package says."""
        ...

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the object aside, to where episodes may begin with it.

        Raises:
            RuntimeError: There is no such place.
        """
        ...

    def render(self) -> Any:
        """Picture of what is there, (H, W, 3), 8 bits."""
        ...


def demonstrate(task: PublicTask, seed: int) -> Episode | None:
    """What the expert sees and does until it succeeds; None: it does not."""
    columns: dict[str, list[np.ndarray]] = {STATE: [], ENVIRONMENT: [], ACTION: []}
    seen, done = task.begin(seed), False
    task.expert.begin()
    while not done:
        if len(columns[ACTION]) == task.longest:
            return None
        action = task.expert.act(seen)
        for key, x in ((STATE, AGENT_POS), (ENVIRONMENT, ENVIRONMENT_STATE)):
            columns[key].append(seen[x])
        columns[ACTION].append(action)
        seen, done = task.step(action)
    return {key: torch.from_numpy(np.stack(x)).float() for key, x in columns.items()}


def succeeds(task: PublicTask, seed: int, *, moved: bool) -> bool:
    """Whether the expert does it, with the object moved under way or not."""
    seen, rng = task.begin(seed), np.random.default_rng(seed)
    task.expert.begin()
    for steps in range(1, task.longest + 1):
        seen, done = task.step(task.expert.act(seen))
        if done:
            return True
        if moved and steps == task.moved_at:
            seen = task.move_object(rng)
    return False
