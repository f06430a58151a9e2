"""Tasks by name, and the lengths of their chunks."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from public_tasks.protocol import PublicTask


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Settings of learning a task, the same for all policies."""

    make: Callable[[], PublicTask]
    chunk: int
    """Number of actions predicted at once: one to two seconds, a third of a second in
    MetaWorld."""
    executed: int
    """Number of these actions that are executed before the next prediction."""


def _pusht() -> PublicTask:
    from public_tasks.pusht import PushT

    return PushT()


def _aloha() -> PublicTask:
    from public_tasks.aloha import AlohaTransfer

    return AlohaTransfer()


def _metaworld(name: str) -> PublicTask:
    from public_tasks.metaworld import MetaWorld

    return MetaWorld(name)


def _so101() -> PublicTask:
    from public_tasks.so101 import SO101PickPlace

    return SO101PickPlace()


def _grasping() -> PublicTask:
    from public_tasks.grasping import Grasping

    return Grasping()


TASKS = {
    "pusht": Setting(make=_pusht, chunk=16, executed=8),
    "aloha-transfer": Setting(make=_aloha, chunk=48, executed=12),
    "metaworld-pick-place": Setting(
        make=partial(_metaworld, "pick-place-v3"), chunk=24, executed=3
    ),
    "metaworld-push": Setting(make=partial(_metaworld, "push-v3"), chunk=24, executed=3),
    "metaworld-shelf-place": Setting(
        make=partial(_metaworld, "shelf-place-v3"), chunk=24, executed=3
    ),
    "metaworld-coffee-push": Setting(
        make=partial(_metaworld, "coffee-push-v3"), chunk=24, executed=3
    ),
    "metaworld-box-close": Setting(
        make=partial(_metaworld, "box-close-v3"), chunk=24, executed=3
    ),
    "so101-pick-place": Setting(make=_so101, chunk=16, executed=4),
    "grasping": Setting(make=_grasping, chunk=24, executed=12),
}


def make_task(name: str) -> PublicTask:
    """A task by its name.

    Raises:
        ValueError: There is no such task.
    """
    if name not in TASKS:
        raise ValueError(f"there is no task {name!r}; there are {', '.join(TASKS)}")
    return TASKS[name].make()
