"""SO-101 picks up a block and puts it down at a goal, by the controller of its package.

Actions are where the point between the jaws is sent, as on most robots; the package takes the
change from where that point is, up to a few centimetres at a time.
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
"""Of the package."""
LONGEST = 150
"""Actions after which an episode has failed: some three times what the expert takes."""
MOVED_AT = 4
"""Actions after which the block is moved: the expert is above it after 6 to 11."""
MOVED = 0.04
"""How far [m]: as wide as it is; whoever goes to where it was misses it."""
STILL = 1e-6
"""Changes that are less [m] are due to rounding; the package tells 0 from all others."""
TRIES = 1000
"""Of a direction to move the block in, until it may begin there."""
HEIGHT, WIDTH = 240, 320
"""Of a picture [px]."""


class SO101PickPlace:
    """Pick-and-place of `lerobot_env_so101`, with block and goal anywhere it may put them.

    Seen are of the arm five joint angles [rad] and their speeds [rad/s], how far the jaws have
    been told to open, from -1 to 1, and the positions of the gripper and of the point between
    its jaws; and the positions of block and goal, all [m]. An action is where to send the
    point between the jaws [m], and how far to open them, from 0 to 1.
    """

    fps: float = FPS
    n_actions: int = 4
    longest: int = LONGEST
    moved_at: int | None = MOVED_AT

    def __init__(self, *, moved: float = MOVED):
        """Make the task.

        Args:
            moved: How far `move_object` moves the block [m].
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
        """Put everything in its place; the same seed begins alike."""
        return self._observation(self._env.reset(seed=seed)[0])

    def step(self, action: Float[np.ndarray, "4"]) -> tuple[Observation, bool]:
        """What is seen after an action, and whether the task is done as the package says."""
        own = action.astype(float)
        change = own[:3] - self._env.ik_point_pos
        own[:3] = change / self._scale if np.linalg.norm(change) > STILL else 0.0
        space = self._env.action_space
        seen, _, _, _, info = self._env.step(own.clip(space.low, space.high))
        return self._observation(seen), bool(info["succeed"])

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the block in a direction that leaves it where episodes may begin with it.

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
        """Picture of what is there."""
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
        """With the point that actions move, which the package keeps to itself."""
        arm = np.concatenate([seen[AGENT_POS], self._env.ik_point_pos])
        return {
            AGENT_POS: arm.astype(np.float32),
            ENVIRONMENT_STATE: seen[ENVIRONMENT_STATE].astype(np.float32),
        }


class _Expert:
    """The controller of the package: `begin` an episode, then `act` on what is seen."""

    def __init__(self, scale: float):
        from lerobot_env_so101.scripted.pick_place import (  # pyright: ignore[reportMissingImports]
            PickPlaceController,
        )

        self._controller: Any = PickPlaceController(scale)
        self._scale = scale

    def begin(self) -> None:
        """Forget how far it has come in the episode before."""
        self._controller.reset()

    def act(self, seen: Observation) -> Float[np.ndarray, "4"]:
        """What to do when that is seen; to be called once for each action."""
        point, things = seen[AGENT_POS][-3:].astype(float), seen[ENVIRONMENT_STATE]
        action = self._controller.act(point, things[:3], things[3:]).astype(float)
        action[:3] = point + self._scale * action[:3]
        return action.astype(np.float32)
