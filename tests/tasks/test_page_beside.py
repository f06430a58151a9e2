"""A page beside a task: who is there reaches the task, and time goes on for all."""

import time

import numpy as np
import pytest

from hrc_learn.human.page import PageConfig
from hrc_learn.protocols import HumanInput
from hrc_learn.sim import World
from hrc_learn.tasks.page_beside import page_beside
from hrc_learn.tasks.simulated_job import _joined
from hrc_learn.tasks.workplace import Workplace


def test_who_pulls_at_the_page_is_heard_by_the_task_in_real_time():
    pytest.importorskip("viser", reason="the extra `ui` is not installed")
    workplace, opened = Workplace(), []
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy())
    with page_beside(world, 0.01, PageConfig(port=8500), opened.append) as (human, tick):
        assert opened[0].startswith("http://127.0.0.1:")
        assert not human.read(world.arm.read()).effort.any()
        for _ in range(1000):  # the page renews what is asked, and may come in between
            human.post(HumanInput(effort=np.arange(7.0)))
            effort = human.read(world.arm.read()).effort
            if effort.any():
                break
        np.testing.assert_array_equal(effort, np.arange(7.0))
        began = time.perf_counter()
        for _ in range(20):
            tick()
        assert time.perf_counter() - began > 0.15
        # Nobody holds anything in a browser, so the page takes the pull back.
        end = time.monotonic() + 60
        while human.read(world.arm.read()).effort.any():
            assert time.monotonic() < end
            time.sleep(0.02)


class Pulling:
    def __init__(self, effort):
        self._effort = effort

    def read(self, state):
        return HumanInput(effort=self._effort.copy())


def test_the_script_and_the_page_pull_together_and_time_passes_for_both():
    passed = []
    human, advance = _joined(
        Pulling(np.arange(7.0)),
        lambda duration: passed.append(duration),
        Pulling(np.ones(7)),
        lambda: passed.append("shown"),
    )
    asked = human.read(World().arm.read())
    np.testing.assert_array_equal(asked.effort, np.arange(7.0) + 1)
    advance(0.01)
    assert passed == [0.01, "shown"]
