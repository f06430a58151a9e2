"""MetaWorld, by its scripted experts and from beginnings of its own.

Actions are where the hand is sent, as on most robots; MetaWorld takes the change to it, up to a
centimetre at a time. An episode succeeds as soon as MetaWorld says so, as in LeRobot.
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
"""Of MetaWorld: five steps of simulation of 2.5 ms an action."""
LONGEST = 200
"""Actions after which an episode has failed: some three times what the experts take."""
MOVED_AT = 12
"""Actions after which the object is moved: experts close the gripper on it after 12 to 32."""
MOVED = 0.07
"""How far [m]: whoever goes to where it was misses it."""
PER_METRE = 100.0
"""MetaWorld's own action of a change of position; at most 1."""
AGENT = 4
"""Numbers of the hand, which come first: its position and how far it is open."""
FRAME = 18
"""Numbers of a frame: those of the hand, and 14 for two objects, 0 where there is none."""
TRIES = 1000
"""Of a direction to move the object in, until it may begin there."""
SUITE_SEED = 42
"""Of MetaWorld's list of tasks, as in LeRobot; beginnings have seeds of their own."""
CAMERA = "corner3"
"""Sees hand, object and goal from the side, upside down."""
SIDE = 480
"""Of a picture [px]."""


class MetaWorld:
    """A task of MetaWorld with one object that can be moved, begun as LeRobot begins it.

    Seen are the position of the hand [m] and how far it is open, from 0 to 1; and of the
    object the position [m] and orientation (quaternion, scalar last), seven zeros, and where
    the goal is [m]. An action is where to send the hand [m], and how hard to close it, from
    -1 (open) to 1.
    """

    fps: float = FPS
    n_actions: int = 4
    longest: int = LONGEST
    moved_at: int | None = MOVED_AT

    def __init__(self, name: str, *, moved: float = MOVED):
        """Make the task.

        Args:
            name: As in MetaWorld: pick-place-v3, push-v3.
            moved: How far `move_object` moves it [m].
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
        """Put everything in its place; the same seed begins alike."""
        self._env.seed(seed)
        return _observation(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "4"]) -> tuple[Observation, bool]:
        """What is seen after an action, and whether the task is done as MetaWorld says."""
        own = action.astype(float)
        own[:3] = PER_METRE * (own[:3] - self._sent())
        seen, _, _, _, info = self._env.step(own.clip(-1, 1))
        return _observation(seen), bool(info["success"])

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the object in a direction that leaves it where episodes may begin with it.

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
        """Picture of what is there."""
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._env.model, SIDE, SIDE)
            atexit.register(self._renderer.close)
        self._renderer.update_scene(self._env.data, camera=CAMERA)
        return self._renderer.render()[::-1, ::-1]

    def _sent(self) -> Float[np.ndarray, "3"]:
        """Where the hand has been sent [m]."""
        return self._env.data.mocap_pos[0].copy()


@dataclass(frozen=True)
class _Expert:
    """What MetaWorld does itself: `begin` an episode, then `act` on what is seen."""

    policy: Any
    sent: Callable[[], Float[np.ndarray, "3"]]

    def begin(self) -> None:
        """It sees anew for every action."""

    def act(self, seen: Observation) -> Float[np.ndarray, "4"]:
        """What to do when that is seen; to be called once for each action."""
        frame = np.concatenate([seen[AGENT_POS], seen[ENVIRONMENT_STATE]])
        own = np.concatenate([frame[:FRAME], np.zeros(FRAME), frame[FRAME:]])
        with warnings.catch_warnings():
            # It asks for more than the arm does, and says so at each action.
            warnings.filterwarnings("ignore", message="Constant.s. may be too high")
            action = self.policy.get_action(own).astype(float).clip(-1, 1)
        action[:3] = self.sent() + action[:3] / PER_METRE
        return action.astype(np.float32)


def _observation(seen: Float[np.ndarray, "39"]) -> Observation:
    """Without the frame before, which MetaWorld repeats in the middle."""
    seen = seen.astype(np.float32)
    things = np.concatenate([seen[AGENT:FRAME], seen[2 * FRAME :]])
    return {AGENT_POS: seen[:AGENT], ENVIRONMENT_STATE: things}
