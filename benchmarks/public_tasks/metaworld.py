"""MetaWorld with its scripted experts and its own initial scenes.

Actions are commanded positions of the hand, as on most robots; MetaWorld accepts changes of at
most a centimetre per action. An episode succeeds as soon as MetaWorld reports success, as in
LeRobot.
"""

import atexit
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs, and MetaWorld is taken for this file.

FPS = 80.0
"""Actions per second of MetaWorld: an action lasts five simulation steps of 2.5 ms."""
LONGEST = 200
"""Number of actions after which an episode has failed: about three times the experts' number.
"""
MOVED_AT = 12
"""Number of actions after which the object is moved: experts close the gripper after 12 to 32.
"""
MOVED = 0.07
"""Distance of this move [m]: an agent that moves to the old place misses the object."""
PER_METRE = 100.0
"""MetaWorld's action for a position change of one metre; an action is at most 1."""
AGENT = 4
"""Number of the hand's components, which come first: its position and its opening."""
FRAME = 18
"""Number of components of a frame: those of the hand, and 14 for two objects, 0 if missing."""
TRIES = 1000
"""Largest number of directions tried for a move of the object to an allowed initial place."""
SUITE_SEED = 42
"""Seed of MetaWorld's list of tasks, as in LeRobot; initial scenes have their own seeds."""
CAMERA = "corner3"
"""Camera that sees hand, object and goal from the side, upside down."""
SIDE = 480
"""Width and height of an image [px]."""


class MetaWorld:
    """A task of MetaWorld with one movable object, with initial scenes as in LeRobot.

    Observations are the position of the hand [m] and its opening, 0 to 1; the position [m] and
    orientation of the object (quaternion, scalar last); seven zeros; and the position of the
    goal [m]. An action is the commanded position of the hand [m], and the gripper's command,
    from -1 (open) to 1 (closed).
    """

    fps: float = FPS
    n_actions: int = 4
    longest: int = LONGEST
    moved_at: int | None = MOVED_AT

    def __init__(self, name: str, *, moved: float = MOVED):
        """Make the task.

        Args:
            name: Name in MetaWorld, such as pick-place-v3 or push-v3.
            moved: Distance by which `move_object` moves the object [m].
        """
        from metaworld import MT1, policies  # pyright: ignore[reportMissingImports]

        suite = MT1(name, seed=SUITE_SEED)
        self._env: Any = suite.train_classes[name]()
        self._env.set_task(suite.train_tasks[0])
        self._env._freeze_rand_vec, self._env.seeded_rand_vec = False, True
        self._moved = moved
        self._renderer: mujoco.Renderer | None = None
        words = "".join(word.capitalize() for word in name.split("-"))
        self.expert: Expert = _Expert(getattr(policies, f"Sawyer{words}Policy")(), self._sent)

    def begin(self, seed: int) -> Observation:
        """Begin an episode; the same seed gives the same initial scene."""
        self._env.seed(seed)
        return _observation(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "4"]) -> tuple[Observation, bool]:
        """Observation after an action, and True if MetaWorld reports success."""
        own = action.astype(float)
        own[:3] = PER_METRE * (own[:3] - self._sent())
        seen, _, _, _, info = self._env.step(own.clip(-1, 1))
        return _observation(seen), bool(info["success"])

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the object in a random direction to an allowed initial place.

        Raises:
            RuntimeError: There is no such place.
        """
        space = self._env._random_reset_space
        low, high = space.low[:2], space.high[:2]
        where = self._env._get_pos_objects()[:3].copy()
        for _ in range(TRIES):
            angle = rng.uniform(0, 2 * math.pi)
            aside = where + self._moved * np.array([math.cos(angle), math.sin(angle), 0.0])
            if (aside[:2] >= low).all() and (aside[:2] <= high).all():
                self._env._set_obj_xyz(aside)
                return _observation(self._env._get_obs())
        raise RuntimeError(f"MetaWorld begins with no object {self._moved} m from {where}")

    def render(self) -> UInt8[np.ndarray, "H W 3"]:
        """Image of the scene."""
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._env.model, SIDE, SIDE)
            atexit.register(self._renderer.close)
        self._renderer.update_scene(self._env.data, camera=CAMERA)
        return self._renderer.render()[::-1, ::-1]

    def _sent(self) -> Float[np.ndarray, "3"]:
        """Commanded position of the hand [m]."""
        return self._env.data.mocap_pos[0].copy()


@dataclass(frozen=True)
class _Expert:
    """MetaWorld's own expert: `begin` an episode, then `act` on observations."""

    policy: Any
    sent: Callable[[], Float[np.ndarray, "3"]]

    def begin(self) -> None:
        """Begin an episode; the expert has no state."""

    def act(self, seen: Observation) -> Float[np.ndarray, "4"]:
        """Action for an observation; called once for each action."""
        frame = np.concatenate([seen[AGENT_POS], seen[ENVIRONMENT_STATE]])
        own = np.concatenate([frame[:FRAME], np.zeros(FRAME), frame[FRAME:]])
        with warnings.catch_warnings():
            # The expert requests larger actions than allowed, and warns at each one.
            warnings.filterwarnings("ignore", message="Constant.s. may be too high")
            action = self.policy.get_action(own).astype(float).clip(-1, 1)
        action[:3] = self.sent() + action[:3] / PER_METRE
        return action.astype(np.float32)


def _observation(seen: Float[np.ndarray, "39"]) -> Observation:
    """Observation without the previous frame, which MetaWorld inserts in the middle."""
    seen = seen.astype(np.float32)
    things = np.concatenate([seen[AGENT:FRAME], seen[2 * FRAME :]])
    return {AGENT_POS: seen[:AGENT], ENVIRONMENT_STATE: things}
