"""Public tasks as an environment of LeRobot: `--env.type=public_task --env.task=pusht`."""

from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from jaxtyping import Float
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from public_tasks.known import make_task
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Observation, PublicTask


@EnvConfig.register_subclass("public_task")
@dataclass
class PublicTaskConfig(EnvConfig):
    """One of `TASKS`, with numbers as observations."""

    task: str | None = "pusht"
    """Name of the task in `TASKS`."""
    move_object: bool = False
    """True if the object is moved while the agent approaches it."""
    fps: int = field(init=False)
    features: dict[str, PolicyFeature] = field(init=False)
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            AGENT_POS: OBS_STATE,
            ENVIRONMENT_STATE: OBS_ENV_STATE,
        }
    )

    def __post_init__(self) -> None:
        task = make_task(self.task or "")
        self.fps = round(task.fps)
        seen = task.begin(0)
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (task.n_actions,)),
            AGENT_POS: PolicyFeature(FeatureType.STATE, seen[AGENT_POS].shape),
        }
        if ENVIRONMENT_STATE in seen:
            shape = seen[ENVIRONMENT_STATE].shape
            self.features[ENVIRONMENT_STATE] = PolicyFeature(FeatureType.ENV, shape)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `PublicTaskEnv`."""
        return {"task": self.task, "move_object": self.move_object}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """A vector of environments that differ in their seeds."""
        makers = [partial(PublicTaskEnv, **self.gym_kwargs)] * n_envs
        mode = AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            vector: gym.vector.VectorEnv = gym.vector.AsyncVectorEnv(
                makers, autoreset_mode=mode, context="forkserver"
            )
        else:
            vector = gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
        return {self.type: {0: vector}}


class PublicTaskEnv(gym.Env):
    """A task as a gymnasium environment; the reward is 1 for success."""

    render_mode = "rgb_array"

    def __init__(self, task: str, move_object: bool = False):
        """Set up.

        Args:
            task: Name of the task in `TASKS`.
            move_object: True if the object is moved during the episode.
        """
        self._task: PublicTask = make_task(task)
        self._move_object = move_object
        self._steps = 0
        self._rng = np.random.default_rng(0)
        self._max_episode_steps = self._task.longest
        self.task = self.task_description = task
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(self._task.fps)}
        self.action_space = _unbounded(self._task.n_actions)
        self.observation_space = gym.spaces.Dict(
            {key: _unbounded(len(x)) for key, x in self._task.begin(0).items()}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin with a seed, or with the next random number."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self._steps, self._rng = 0, np.random.default_rng(seed)
        return _single(self._task.begin(seed)), {"is_success": False}

    def step(
        self, action: Float[np.ndarray, "A"]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one action. If the object is to be moved, it is moved before the action."""
        seen, success = self._task.step(np.asarray(action, float))
        self._steps += 1
        if self._move_object and self._steps == self._task.moved_at and not success:
            with suppress(RuntimeError):  # a policy may have knocked it away by then
                seen = self._task.move_object(self._rng)
        late = self._steps >= self._max_episode_steps and not success
        return _single(seen), float(success), success, late, {"is_success": success}

    def render(self) -> Any:
        """Image of the scene."""
        return self._task.render()


def _single(seen: Observation) -> Observation:
    return {key: x.astype(np.float32) for key, x in seen.items()}


def _unbounded(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
