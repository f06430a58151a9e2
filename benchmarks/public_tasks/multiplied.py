"""Public tasks whose demonstrations `hrc multiply` multiplies and judges.

A stage adds the arm's joints to the observations of a task, and puts object and goal in given
places. Its demonstrations become a LeRobot dataset, written by LeRobot. The functions at the
end are judges for `hrc multiply --judge`.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from public_tasks.protocol import (
    ACTION,
    AGENT_POS,
    ENVIRONMENT,
    ENVIRONMENT_STATE,
    STATE,
    Episode,
    Observation,
    PublicTask,
)

HAND = ("ee.x", "ee.y", "ee.z")
BODY = tuple(f"object.{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz"))
GOAL = ("goal.x", "goal.y", "goal.z")
GRIPPER = "gripper.pos"
type Scene = Mapping[str, Float[np.ndarray, "_"]]
"""Poses of the object and the goal by name; x, y, z [m] come first."""


class Stage(ABC):
    """A task with its dataset's columns, in which objects can be put in given places."""

    task: PublicTask
    robot: str
    """The dataset's robot type."""
    names: Mapping[str, tuple[str, ...]]
    """Names of the columns of the dataset's features."""
    still: int
    """Number of frames for which the expert continues after its success."""
    longest: int
    """Number of actions after which the episode of a policy has failed. Multiplied motions keep
    the limits of the arm, which some experts do not, and take longer."""

    @abstractmethod
    def shown(self, seen: Observation) -> Observation:
        """Observations of the dataset, from those of the task."""

    @abstractmethod
    def seen(self, episode: Episode) -> Episode:
        """Observations of the task, from those of the dataset."""

    @abstractmethod
    def refusal(self, scene: Scene) -> str:
        """Reason why the task never begins with a scene; empty: it may."""

    @abstractmethod
    def placed(self, scene: Scene) -> Observation:
        """First observation of an episode with object and goal in their places."""

    @abstractmethod
    def ranges(self) -> Iterator[str]:
        """Settings of `hrc multiply`: ranges of places of the object and of the goal."""

    def record(self, folder: Path, count: int, name: str) -> None:
        """Record successful episodes of the expert as a dataset, written by LeRobot."""
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        features = {
            key: {"dtype": "float32", "shape": (len(each),), "names": list(each)}
            for key, each in self.names.items()
        }
        dataset = LeRobotDataset.create(
            "local/demonstrations",
            round(self.task.fps),
            features,
            folder,
            robot_type=self.robot,
            use_videos=False,
        )
        seed, kept = 0, 0
        while kept < count:
            frames = self.demonstrated(seed)
            seed += 1
            if frames is None:
                continue
            for frame in frames:
                dataset.add_frame({**frame, "task": name})
            dataset.save_episode()
            kept += 1
        dataset.finalize()

    def demonstrated(self, seed: int) -> list[dict[str, Any]] | None:
        """Frames of one episode of the expert; None: it fails."""
        task = self.task
        seen, frames, left = task.begin(seed), [], None
        task.expert.begin()
        while left != 0:
            if len(frames) == task.longest:
                return None
            action = task.expert.act(seen)
            frames.append({**self.shown(seen), ACTION: action.astype(np.float32)})
            seen, done = task.step(action)
            left = self.still if done and left is None else left if left is None else left - 1
        return frames


class MetaWorldStage(Stage):
    """A task of MetaWorld with one object and a goal."""

    robot = "sawyer"
    joints: ClassVar = tuple(f"right_j{k}" for k in range(7))
    still = 20
    longest = 500

    def __init__(self, name: str, apart: float):
        """Make the task.

        Args:
            name: Name in MetaWorld, such as pick-place-v3.
            apart: Smallest distance between object and goal in MetaWorld's initial scenes [m].
        """
        from public_tasks.metaworld import MetaWorld

        self.task = self._metaworld = MetaWorld(name)
        self._apart = apart
        state = (*(f"{joint}.pos" for joint in self.joints), *HAND, GRIPPER)
        self.names = {STATE: state, ENVIRONMENT: (*BODY, *GOAL), ACTION: (*HAND, GRIPPER)}

    def shown(self, seen: Observation) -> Observation:
        """Joints, hand and gripper; object (scalar first) and goal."""
        data = self._metaworld._env.data
        joints = [float(data.joint(joint).qpos[0]) for joint in self.joints]
        return {
            STATE: np.array([*joints, *seen[AGENT_POS]], np.float32),
            ENVIRONMENT: seen[ENVIRONMENT_STATE][[0, 1, 2, 6, 3, 4, 5, -3, -2, -1]],
        }

    def seen(self, episode: Episode) -> Episode:
        """Hand and gripper; object, scalar last, a missing second object, and goal."""
        things = episode[ENVIRONMENT]
        absent = torch.zeros(len(things), 7)
        parts = things[:, :3], things[:, 3:7].roll(-1, -1), absent, things[:, 7:]
        return episode | {STATE: episode[STATE][:, -4:], ENVIRONMENT: torch.cat(parts, -1)}

    def refusal(self, scene: Scene) -> str:
        """MetaWorld keeps object and goal apart."""
        apart = np.linalg.norm(scene["object"][:2] - scene["goal"][:2])
        near = "MetaWorld puts no object so near to the goal"
        return near if apart < self._apart else ""

    def placed(self, scene: Scene) -> Observation:
        """First observation; only object and goal differ between episodes."""
        from public_tasks.metaworld import _observation

        env = self._metaworld._env
        # An object that lies on the table has the height that MetaWorld gives it.
        space = env._random_reset_space
        height = (space.low[2] + space.high[2]) / 2
        env._last_rand_vec = np.array([*scene["object"][:2], height, *scene["goal"][:3]])
        env._freeze_rand_vec = True
        return _observation(env.reset()[0])

    def ranges(self) -> Iterator[str]:
        """MetaWorld's ranges; the height of the object is the demonstrated one."""
        space = self._metaworld._env._random_reset_space
        for k, place in enumerate(("object.x", "object.y", "", "goal.x", "goal.y", "goal.z")):
            if place:
                yield f"objects.{place}=[{space.low[k]},{space.high[k]}]"


class SO101Stage(Stage):
    """Pick-and-place of the SO-101."""

    robot = "so101_follower"
    still = 8
    longest = 150

    def __init__(self) -> None:
        from public_tasks.so101 import SO101PickPlace

        self.task = self._so101 = SO101PickPlace()
        joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
        state = (
            *(f"{joint}.pos" for joint in joints),
            *(f"{joint}.vel" for joint in joints),
            GRIPPER,
            *(f"site_{k}" for k in range(3)),
            *HAND,
        )
        things = ("object.x", "object.y", "object.z", *GOAL)
        self.names = {STATE: state, ENVIRONMENT: things, ACTION: (*HAND, GRIPPER)}

    def shown(self, seen: Observation) -> Observation:
        """The task's own observations."""
        return {STATE: seen[AGENT_POS], ENVIRONMENT: seen[ENVIRONMENT_STATE]}

    def seen(self, episode: Episode) -> Episode:
        """The dataset's own observations."""
        return episode

    def refusal(self, scene: Scene) -> str:
        """The package keeps block and goal apart."""
        from lerobot_env_so101 import pick_place_env  # pyright: ignore[reportMissingImports]

        apart = np.linalg.norm(scene["object"][:2] - scene["goal"][:2])
        near = "the package puts no block so near to the goal"
        return near if apart < pick_place_env._MIN_GOAL_DISTANCE else ""

    def placed(self, scene: Scene) -> Observation:
        """First observation; the arm begins at its home position."""
        self._so101.begin(0)
        env = self._so101._env
        env._goal_pos[:2] = scene["goal"][:2]
        return self._so101._with_block_at(scene["object"][:2])

    def ranges(self) -> Iterator[str]:
        """The package's ranges; heights are the demonstrated ones."""
        from lerobot_env_so101 import pick_place_env  # pyright: ignore[reportMissingImports]

        low, high = pick_place_env._SAMPLING_BOUNDS
        for name in ("object", "goal"):
            for k, axis in enumerate("xy"):
                yield f"objects.{name}.{axis}=[{low[k]},{high[k]}]"


STAGES = {
    "metaworld-pick-place": partial(MetaWorldStage, "pick-place-v3", 0.15),
    "metaworld-push": partial(MetaWorldStage, "push-v3", 0.15),
    "metaworld-coffee-push": partial(MetaWorldStage, "coffee-push-v3", 0.15),
    "metaworld-shelf-place": partial(MetaWorldStage, "shelf-place-v3", 0.1),
    "metaworld-box-close": partial(MetaWorldStage, "box-close-v3", 0.25),
    "so101-pick-place": SO101Stage,
}


class Judge:
    """A stage as an environment of gymnasium, for `hrc multiply --judge`.

    An episode ends some frames after its first success, as the demonstrations do.
    """

    def __init__(self, name: str):
        self._stage = STAGES[name]()
        self.metadata = {"render_fps": self._stage.task.fps}

    def reset(self, *, seed: int, options: dict[str, Any]) -> tuple[Observation, dict]:
        """Begin with object and goal in their places; everything else is always the same."""
        self._left = self._stage.still
        if reason := self._stage.refusal(options["objects"]):
            return {}, {"failure": reason}
        return self._stage.shown(self._stage.placed(options["objects"])), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """Execute an action."""
        seen, done = self._stage.task.step(action)
        done = done or self._left < self._stage.still
        self._left -= done
        return self._stage.shown(seen), float(done), self._left < 0, False, {"success": done}


def judge_of(name: str) -> str:
    """Judge of a task as `hrc multiply --judge` takes it."""
    return f"{__file__}:{name.replace('-', '_')}"


metaworld_pick_place = partial(Judge, "metaworld-pick-place")
metaworld_push = partial(Judge, "metaworld-push")
metaworld_coffee_push = partial(Judge, "metaworld-coffee-push")
metaworld_shelf_place = partial(Judge, "metaworld-shelf-place")
metaworld_box_close = partial(Judge, "metaworld-box-close")
so101_pick_place = partial(Judge, "so101-pick-place")
