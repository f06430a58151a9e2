"""A demonstration by hands that a headset tracks, from the first pinch to the dataset."""

import numpy as np
import pyarrow.parquet as parquet
import pytest
from headset_in_browser import headset
from page_in_browser import Session, wait_until

pytestmark = pytest.mark.browser


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
            person.button("Save").wait_for()
            wait_until(lambda: session.recorder.status.state == "stopped", "it stopped")
            person.press("Replay")
            person.tab.wait_for_function(
                "[...document.querySelectorAll('button')].some("
                "b => b.textContent === 'Replay' && b.getAttribute('aria-pressed') === 'true')"
            )
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
    return "Save again" in person.tab.locator("#words").text_content()
