"""A demonstration by hands that a headset tracks, from the first pinch to the dataset."""

import json
import os
import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from headset_in_browser import EMULATOR, Headset, headset, placed
from page_in_browser import Session, chromium, wait_until

from hrc_learn.kinematics import panda
from hrc_learn.sim.workplace import Workplace

pytestmark = pytest.mark.browser

ROOT = Path(__file__).parents[2]
PLACINGS = 20
"""From random starts."""
LIFTED = 0.02
"""How far above its place a hand that drifts by millimetres brings an object, and sets it down
[m]: the place itself is 7 mm above the board."""
ATTEMPTS = 3
"""At a demonstration that the quality gate doubts, as where the machine is busy."""
RATE = 60.0
"""Points of a hand's path [1/s]."""


@pytest.mark.slow
def test_a_demonstration_by_two_hands_is_recorded_kept_and_replayed(tmp_path):
    with Session(tmp_path / "demos") as session:
        page = session.page
        with headset(tmp_path / "headset", page, (320, 200)) as person:
            person.enter()
            person.press("Start")
            elbow = session.frame(4)
            start = person.reach("right", [0.6, 1.5, 0.4])
            person.pinch("right")
            tool = session.frame(-1)
            for k in range(1, 8):
                person.reach("right", np.add(start, [0.0, 0.015 * k, 0.01 * k]))
            wait_until(lambda: session.frame(-1)[2] - tool[2] > 0.03, "the hand was followed")
            person.pinch("right", closed=False)
            assert np.linalg.norm(session.frame(4) - elbow) > 0
            person.press("Stop")
            wait_until(lambda: session.recorder.status.state == "stopped", "it stopped")
            # Watched from now on: on a busy machine it may be over before the page is asked.
            person.tab.evaluate(
                "() => { window.replayed = false;"
                " new MutationObserver(() => { window.replayed ||="
                " [...document.querySelectorAll('button')].some(b => b.textContent === 'Replay'"
                " && b.getAttribute('aria-pressed') === 'true'); })"
                ".observe(document, {subtree: true, childList: true, attributes: true}); }"
            )
            person.press("Replay")
            person.tab.wait_for_function("window.replayed")
            person.press("Save")
            wait_until(lambda: session.recorder.status.state == "ready" or _doubted(person), "")
            if _doubted(person):  # this machine is busy, and the quality gate says so
                person.press("Save")
            wait_until(lambda: session.recorder.status.saved == 1, "it is saved")
    (file,) = (tmp_path / "demos" / "data").rglob("*.parquet")
    rows = parquet.read_table(file).to_pydict()
    right = np.array(rows["observation.right_hand"])
    assert right.shape[1] == 7
    assert np.ptp(right[:, 2]) > 0.05  # it went up
    np.testing.assert_allclose(np.linalg.norm(right[:, 3:], axis=1), 1.0, atol=1e-5)
    assert np.abs(np.array(rows["observation.human_twist"])).max() > 0.05


def _doubted(person) -> bool:
    return "Save again" in _words(person)


def hand_paths(
    corners: np.ndarray, rng: np.random.Generator, speed: float = 0.13
) -> list[np.ndarray]:
    """A hand from corner to corner: minimum-jerk, with tremor and drift.

    Physiological tremor is of 8 to 12 Hz and some tenths of a millimetre (Elble and Koller,
    1990); hands that are held up drift by millimetres.
    """
    pieces = []
    for start, end in pairwise(corners):
        duration = 1.875 * np.linalg.norm(end - start) / (speed * rng.uniform(0.8, 1.2))
        s = np.linspace(0, 1, max(int(duration * RATE), 2))[:, None]
        pieces.append(start + (10 * s**3 - 15 * s**4 + 6 * s**5) * (end - start))
    path = np.concatenate(pieces)
    time = np.arange(len(path))[:, None] / RATE
    for frequency, size in ((rng.uniform(8, 12, 3), 0.0004), (rng.uniform(0.2, 0.6, 3), 0.002)):
        phase = rng.uniform(0, 2 * np.pi, 3)
        path = path + size * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase))
    return np.split(path, np.cumsum([len(piece) for piece in pieces])[:-1])


def program(name, *arguments, status=(0,)):
    done = subprocess.run(
        [sys.executable, name, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode in status, done.stdout + done.stderr


@pytest.mark.slow
def test_demonstrations_by_hands_are_learned_and_placed(tmp_path):
    count = int(os.environ.get("HAND_DEMONSTRATIONS", "20"))
    if not EMULATOR.is_file():
        pytest.skip("the client for headsets is not built")
    workplace = Workplace()
    start = panda.forward(workplace.home_joints()).position.numpy()
    end = workplace.shelf("middle").position.numpy()
    beside = end[1] + 0.3 * np.sign(start[1] - end[1])
    above = end[2] + LIFTED
    corners = np.array(
        [
            start,
            [start[0], start[1], above],
            [start[0], beside, above],
            [end[0], beside, above],
            [end[0], end[1], above],
            end,
        ]
    )
    # Nobody has placed the arm: it stands ahead of who enters, and faces them.
    room = lambda points: placed(points, -np.pi / 2, (0.0, 0.72, -1.1))  # noqa: E731
    demos, log = tmp_path / "demos", tmp_path / "log"
    options = ("--out", demos, "--config", "page.timeout=12", "page.silence=12")
    with (
        log.open("w") as output,
        chromium(tmp_path / "headset", (320, 200), ("--disable-blink-features=WebXR",)) as tab,
    ):
        served = subprocess.Popen(
            [sys.executable, "control/serve_page.py", *map(str, options), "page.meshes=false"],
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            said = lambda: re.search(r"phones: (\S+)", log.read_text("utf-8"))  # noqa: E731
            wait_until(said, "the page's address", timeout=180)
            person = Headset(tab, said()[1])
            person.enter()
            closing = _closing(person)
            for k in range(count):
                for again in reversed(range(ATTEMPTS)):
                    person.reach("right", room(start[None])[0] - closing)
                    person.press("Start")
                    person.pinch("right")
                    offset = person.hand("right") - room(start[None])
                    # Who sees that the arm lags, on a slow machine, waits for it.
                    for path in hand_paths(corners, np.random.default_rng(k)):
                        person.walk("right", room(path) + offset, RATE)
                        person.watch_it_rest()
                    person.pinch("right", closed=False)
                    person.press("Stop")
                    wait_until(lambda: "stopped" in _words(person), "it stopped")
                    person.press("Save")
                    wait_until(
                        lambda k=k: f"{k + 1} saved" in _words(person) or _doubted(person),
                        "it is judged",
                    )
                    if not _doubted(person):
                        break
                    person.press("Discard" if again else "Save")
                    if again:
                        person.press("Back to start")
                        time.sleep(0.5)
                wait_until(lambda k=k: f"{k + 1} saved" in _words(person), "it is saved")
                person.press("Back to start")
                time.sleep(0.5)
            tab.evaluate("null")
        finally:
            served.terminate()
            served.wait(timeout=120)
    program("datasets/check_dataset.py", demos)
    program("training/fit_dmp.py", "--dataset", demos, "--out", tmp_path / "model")
    outcome = tmp_path / "measured"
    run = ("--placing", tmp_path / "model", "--out", tmp_path / "run", "--config", "film=false")
    run += ("--trials", PLACINGS)
    program("control/run_placing.py", *run, "--json", outcome, status=(0, 1))
    measured = json.loads(outcome.read_text("utf-8"))
    # On the shelf that was demonstrated and on the two others. A start may bring the object
    # against the cabinet, as none of the demonstrations was from there: none of 60 did.
    assert measured["random_starts_placings"] == 3 * PLACINGS
    assert measured["random_starts_fraction_that_stands_on_its_shelf"] == 1
    assert measured["random_starts_fraction_within_3_mm_and_3_deg_of_its_place"] == 1
    assert measured["random_starts_joint_limit_violations"] == 0
    assert measured["random_starts_fraction_without_contact"] > 0.9


def _words(person) -> str:
    return person.tab.locator("#words").text_content()


def _closing(person) -> np.ndarray:
    start = person.reach("right", [0.9, 1.6, 0.5])
    with person.pinching("right"):
        return person.hand("right") - start
