"""Placing from starts drawn at random, again and again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ..demos import load_demos
from ..kinematics import panda
from ..sim import World
from .failure import BlockedPathError, TaskFailedError
from .placing import PlacingSkill, Plan, check_plan
from .placing_figures import placing_figures
from .placing_run import place
from .workplace import Workplace

_DT = 0.01  # of plans that are only looked at [s]
_DRAWS = 100  # of a start, before it is taken that there is no free one


@dataclass(frozen=True, kw_only=True)
class PlacingTrials:
    """Tries once with a seed: places on each shelf from a start of its own."""

    placing: Path
    """Folder of the learned motion."""
    demonstrations: Path
    """Dataset that it was learned from."""
    speed: float = 1.5
    """How many times faster than demonstrated."""
    noise: float = 0.1
    """Standard deviation of each joint at the start, about home [rad]."""

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Values by name, with "failure" where a placing in task space was not good enough."""
        skill = PlacingSkill.load(self.placing)
        demonstration = load_demos(self.demonstrations, episodes=[0])[0]
        workplace, rng = Workplace(), np.random.default_rng(seed)
        world = World(workplace.scene)
        values, faults = {}, []
        for shelf in workplace.shelf_names():
            start = perturbed_start(world, workplace, self.noise, rng)
            plan = skill.plan(
                start, workplace.shelf(shelf), space="joint", dt=_DT, speed=self.speed
            )
            values[f"{shelf}_joint_space_blocked"] = _blocked(plan, world)
            run = place(
                skill, workplace, shelf, start, space="pose", speed=self.speed, world=world
            )
            figures = placing_figures(run, workplace, demonstration)
            values |= {f"{shelf}_{name}": value for name, value in figures.row().items()}
            faults += [f"{shelf} shelf: {fault}" for fault in figures.faults]
        return values | {"failure": "; ".join(faults)}


def perturbed_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[torch.Tensor, "7"]:
    """Joint positions about home that are within the limits and touch nothing.

    Leaves the world there, with its first object in the hand.

    Args:
        world: Of the workplace.
        workplace: Where.
        noise: Standard deviation of each joint [rad].
        rng: Source of the noise.

    Raises:
        TaskFailedError: If no start drawn is free.
    """
    home, item = workplace.home_joints(), workplace.scene.objects[0].name
    for _ in range(_DRAWS):
        start = home + noise * torch.from_numpy(rng.standard_normal(len(home)))
        if not panda.limits.contain(start):
            continue
        world.hold(item, start.numpy())
        if not world.collisions_along(start.numpy()[None], item):
            return start
    raise TaskFailedError(f"no free start in {_DRAWS} draws with noise of {noise:g} rad")


def _blocked(plan: Plan, world: World) -> bool:
    """Whether a plan leaves the arm's limits or hits something, by geometry alone."""
    try:
        check_plan(plan, world, world.config.objects[0].name)
    except BlockedPathError:
        return True
    return False
