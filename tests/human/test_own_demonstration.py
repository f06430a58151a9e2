"""A newcomer's way: show it in the browser, check it, learn it, and see it reproduced."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from page_in_browser import chromium

from hrc_learn.demos import load_demos
from hrc_learn.dmp import JointDMP

pytestmark = [pytest.mark.browser, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


def run(program, *arguments):
    done = subprocess.run(
        [sys.executable, program, *map(str, arguments)],
        cwd=ROOT,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def address(log: Path, timeout: float = 180.0) -> str:
    """Where the page is, once the program says so."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if found := re.search(r"Page at (\S+)", log.read_text()):
            return found[1]
        time.sleep(0.2)
    pytest.fail(f"no page within {timeout} s: {log.read_text()}")


def show(tab, keys: str, seconds: float = 4.0) -> None:
    """Lead the hand by keys, each held for a while as a keyboard repeats them."""
    tab.mouse.move(100, 400)
    for key in keys:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            tab.keyboard.press(key)
            time.sleep(0.03)


def test_ones_own_demonstration_is_recorded_learned_and_reproduced(tmp_path):
    demos, model, log = tmp_path / "demos", tmp_path / "model", tmp_path / "log"
    with log.open("w") as output, chromium(tmp_path / "chromium", (900, 600)) as tab:
        options = ["--page.port", "8400", "--page.patience", "12"]
        options += ["--out", str(demos), "--json", str(tmp_path / "figures")]
        program = subprocess.Popen(
            [sys.executable, "control/serve_page.py", *options],
            cwd=ROOT,
            env=ENVIRONMENT,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            tab.set_default_timeout(180e3)
            tab.goto(address(log))
            tab.get_by_role("button", name="Start", exact=True).click()
            tab.get_by_role("button", name="Stop", exact=True).wait_for()
            show(tab, "kou")
            tab.get_by_role("button", name="Stop", exact=True).click()
            tab.get_by_role("button", name="save", exact=True).click()
            tab.get_by_text("1 saved").wait_for()
            tab.get_by_role("button", name="finish", exact=True).click()
            assert program.wait(timeout=120) == 0, log.read_text()
        finally:
            program.kill()
    assert json.loads((tmp_path / "figures").read_text())["episodes"] == 1

    assert "0 errors" in run("datasets/check_dataset.py", demos)
    run("training/fit_dmp.py", "--dataset", demos, "--out", model, "--json", tmp_path / "fit")
    (demo,) = load_demos(demos)
    assert demo.position is not None
    assert np.ptp(demo.position, axis=0).max() > 0.05  # the hand was led somewhere
    assert np.abs(demo.extra["observation.human_twist"]).max() > 0.1
    motion = JointDMP.load(model / "joint").rollout(time=torch.from_numpy(demo.time))
    error = np.abs(motion.position.detach().numpy() - demo.joint_position).max()
    # 60 basis functions smooth the starts and stops of held keys, the more so the longer a
    # busy machine makes the demonstration: by one to two degrees.
    assert error < 0.035
