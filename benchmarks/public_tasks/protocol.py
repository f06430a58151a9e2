"""Public environments with experts, and an object that can be moved during an episode.

Each environment comes from its package, with numbers as observations: positions of the agent
and of objects. To add one, write a module with a class that has all members of `PublicTask`,
and name it in known.py. The environments need their own packages: tools/make_environments.sh.
"""

from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
AGENT_POS, ENVIRONMENT_STATE = "agent_pos", "environment_state"
"""Names of the two observations in LeRobot's gymnasium environments."""
type Observation = dict[str, Float[np.ndarray, "_"]]
"""`AGENT_POS` and `ENVIRONMENT_STATE`."""
type Episode = dict[str, Tensor]
"""`STATE`, `ENVIRONMENT` and `ACTION`, float32, (frames, components)."""


class Expert(Protocol):
    """An expert that demonstrates a task."""

    def begin(self) -> None:
        """Begin an episode; called after the task's own `begin`."""
        ...

    def act(self, seen: Observation) -> Float[np.ndarray, "A"]:
        """Action for an observation; called once for each action."""
        ...


class PublicTask(Protocol):
    """One environment with one task.

    The same seed gives the same initial scene.
    """

    fps: float
    """Actions per second."""
    n_actions: int
    """Number A of components of an action."""
    longest: int
    """Number of actions after which an episode has failed."""
    moved_at: int | None
    """Number of actions after which the object is moved, while the agent approaches it; None:
    it is not moved."""
    expert: Expert

    def begin(self, seed: int) -> Observation:
        """Begin an episode."""
        ...

    def step(self, action: Float[np.ndarray, "A"]) -> tuple[Observation, bool]:
        """Observation after an action, and True if the package reports success."""
        ...

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the object to an allowed initial place.

        Raises:
            RuntimeError: There is no such place.
        """
        ...

    def render(self) -> Any:
        """Image of the scene, (H, W, 3), 8 bits."""
        ...


def demonstrate(task: PublicTask, seed: int) -> Episode | None:
    """Observations and actions of the expert until its success; None: it fails."""
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
    """True if the expert succeeds, with or without the object moved during the episode."""
    seen, rng = task.begin(seed), np.random.default_rng(seed)
    task.expert.begin()
    for steps in range(1, task.longest + 1):
        seen, done = task.step(task.expert.act(seen))
        if done:
            return True
        if moved and steps == task.moved_at:
            seen = task.move_object(rng)
    return False
