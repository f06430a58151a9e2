"""The page beside a real job: whoever pulls at the elbow there moves it, and nothing else."""

import threading
from contextlib import nullcontext

import numpy as np
import pytest
from page_in_browser import PATIENCE, Browser, chromium, wait_until
from taught_models import teach

from hrc_learn.experiments import simulated_cell
from hrc_learn.experiments.collaboration_trial import (
    CollaborationScenario,
    simulate_collaboration,
)
from hrc_learn.experiments.run_measures import ELBOW, Deviation, span
from hrc_learn.experiments.simulated_cell import Observer
from hrc_learn.kinematics import panda
from hrc_learn.skills.pick_and_place import PickAndPlaceConfig
from hrc_learn.teleoperation.page import Page, PageConfig
from hrc_learn.teleoperation.page_session import TaskPage

pytestmark = [pytest.mark.browser, pytest.mark.slow]


class Job:
    """A collaboration beside its page, in a thread of its own, which waits for a browser."""

    def __init__(self, aiming, placing):
        self.pages, self.cell, self.done = [], None, None
        self.begin = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(aiming, placing))

    def _run(self, aiming, placing):
        self.done = simulate_collaboration(
            aiming,
            placing,
            ("middle",),
            CollaborationScenario(
                camera="synthetic",
                forces=(),
                config=PickAndPlaceConfig(interaction=15.0),
                page=PageConfig(timeout=PATIENCE),
            ),
            seed=3,
            observer=Observer(view=self._watch),
        )

    def _watch(self, cell, world, motion):
        self.cell = cell
        self.begin.wait()
        return nullcontext()

    def open(self, page: Page) -> Page:
        self.pages.append(page)
        return page

    def phase(self) -> str:
        events = self.cell.log.events
        return events[-1].text if events else ""

    def link(self, index: int) -> np.ndarray:
        joints = self.cell.log.snapshot()["joint_position"][-1]
        return panda.joint_origins(joints)[index].numpy()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *raised):
        self.begin.set()
        self._thread.join()


def test_the_elbow_yields_to_the_mouse_while_the_end_effector_servoes(tmp_path, monkeypatch):
    job = Job(*teach(tmp_path))
    monkeypatch.setattr(simulated_cell, "TaskPage", lambda *given: job.open(TaskPage(*given)))
    # The browser, which takes most of the machine, is closed before the job goes on.
    with job, chromium(tmp_path / "chromium") as tab:
        wait_until(lambda: job.cell, "a page", timeout=180)
        browser = Browser(tab, job.pages[0], guides=False)
        job.begin.set()
        wait_until(lambda: job.phase() == "interact", "time for the person", timeout=300)
        tab.get_by_text("the end effector keeps servoing").wait_for()
        assert not tab.get_by_role("button", name="Start", exact=True).count()
        elbow = job.link(ELBOW)
        with browser.dragging(elbow, by=(70, -10)):
            wait_until(lambda: np.linalg.norm(job.link(ELBOW) - elbow) > 0.05, "motion")
            tab.screenshot(path=tmp_path / "pulled.png")
    result = job.done
    log = result.cell.log
    assert result.failure == ""
    time = log["time"]
    start, end = span(log, "interact")
    effort = np.abs(log["nullspace_input"]).max(axis=1)
    assert effort[(time >= start) & (time < end)].max() > 1.0
    assert not effort[time < start].any()
    deviation = Deviation.of(log, result.motion, result.world)
    assert np.nan_to_num(deviation.elbow).max() > 0.05
    assert np.nan_to_num(deviation.position).max() < 1e-3
    # To the right of the screen is +y.
    moved = panda.joint_origins(log["joint_position"]).numpy()[:, ELBOW] - elbow
    assert moved[effort > 0][-1, 1] > 0
    assert result.world.rests_on("box", "board_middle")
