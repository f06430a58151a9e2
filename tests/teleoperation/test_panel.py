"""What the panel says, as text."""

import re

import numpy as np

from hrc_learn.protocols import Feedback, Reason
from hrc_learn.teleoperation.page import PageStatus
from hrc_learn.teleoperation.panel import felt_words, panel_texts
from hrc_learn.viz.palette import GREEN, VERMILION


def bars(html):
    """Left end and width of each bar [%]."""
    return [
        tuple(map(float, ends)) for ends in re.findall(r"left:([\d.]+)%;width:([\d.]+)%", html)
    ]


def test_efforts_are_bars_from_the_middle_to_either_side():
    html = panel_texts().nullspace_input([10.0, -5.0, 0.0, 40.0], 20.0)
    assert bars(html) == [(50.0, 25.0), (37.5, 12.5), (50.0, 0.0), (50.0, 50.0)]
    assert "+10.0" in html
    assert "-5.0" in html


def test_an_arm_without_null_space_has_no_bars_and_is_dragged_by_its_gripper():
    html = panel_texts().nullspace_input((), 20.0)
    assert bars(html) == []
    assert "no null space" in html
    ready = PageStatus()
    assert "drag its gripper." in panel_texts().state(ready, 0, "", False)
    assert "drag its gripper, a link or a knob." in panel_texts().state(ready, 0, "")


def test_interventions_are_counted_and_the_new_ones_stand_out():
    status = PageStatus(interventions={"velocity": 3, "tcp_speed": 7, "jerk": 0}, contacts=2)
    html = panel_texts().safety(status, "tcp_speed")
    rows = re.findall(r"<tr.*?</tr>", html)
    assert [re.sub(r"<.*?>", " ", row).split() for row in rows] == [
        ["velocity", "3"],
        ["tcp", "speed", "7"],
        ["touches", "of", "the", "surroundings", "2"],
    ]
    assert ["bold" in row or "600" in row for row in rows] == [False, True, False]


def test_a_filter_that_has_not_acted_is_said_to():
    html = panel_texts().safety(PageStatus(interventions={"velocity": 0}), "")
    assert "has not had to act" in html


def test_what_others_have_written_is_not_taken_for_the_pages_own():
    html = panel_texts().state(PageStatus(title="<script>", note="<b>"), 2, "")
    assert "<script>" not in html
    assert "<b>" not in html
    assert "2 connected" in html
    recording = PageStatus(state="recording", seconds=1.5)
    assert "recording 1.5 s" in panel_texts().state(recording, 0, "")


def test_what_can_be_done_now_is_said():
    instruction = panel_texts().instruction
    said = {
        (state, task): instruction(PageStatus(state=state), task)
        for state in ("ready", "recording", "stopped")
        for task in ("", "show it")
    }
    assert "Press Start" in said["ready", ""]
    assert "press Stop" in said["recording", "show it"]
    assert said["stopped", "show it"] == "Save it or discard it."
    assert "Task" in said["stopped", ""]
    assert instruction(PageStatus(doing="servo"), "") == ""
    assert "Press Start" in panel_texts().state(PageStatus(), 0, "")


def test_an_arm_that_works_by_itself_says_what_it_does_and_records_nothing():
    html = panel_texts().state(PageStatus(doing="aim & wait", seconds=12.34), 0, "")
    assert "aim &amp; wait" in html
    assert "12.3 s" in html
    assert "saved" not in html
    assert "ready" not in html


def feedback_html(feedback):
    return panel_texts().feedback(feedback, felt_words(feedback))


def words(feedback):
    return re.sub(r"<.*?>", " ", feedback_html(feedback)).replace("&ensp;", " ").split()


def test_how_far_a_push_is_followed_is_said_in_words_and_by_colour():
    reasons = (
        Reason(hindrance="joint_limit", kept=0.0, text="joint 4 is at its limit"),
        Reason(hindrance="person", kept=1.0, text="somebody is 0.4 m <b>away"),
    )
    html = feedback_html(Feedback(pushed=True, followed=0.02, reasons=reasons))
    assert f"background:{VERMILION}" in html
    assert "follows by 0 %" in html
    assert "joint 4 is at its limit; somebody is 0.4 m &lt;b&gt;away" in html
    assert f"background:{GREEN}" in feedback_html(Feedback(pushed=True))


def test_what_the_arm_feels_is_said_while_nobody_pushes():
    assert feedback_html(Feedback()) == ""
    felt = Feedback(
        contact_force=np.array([0.0, 18.0, 24.0]),
        near_limits=("joint4",),
        person_distance=0.42,
        pace=0.31,
        slip=0.0042,
    )
    told = " ".join(words(felt))
    assert told == (
        "contact: 30 N near their limits: joint4 slip of the held object: 4 mm "
        "nearest person: 0.4 m away, pace 30 %"
    )
    # Friction feels like a small force; unknown people are said to be.
    assert feedback_html(Feedback(contact_force=np.array([0.0, 15.0, 0.0]))) == ""
    assert "at an unknown distance" in feedback_html(Feedback(person_distance=float("nan")))


def test_numbers_are_shown_as_far_as_they_are_steady():
    a, b = (
        Feedback(contact_force=np.array([0, 0, f]), person_distance=d)
        for f, d in ((29.0, 0.41), (31.5, 0.44))
    )
    assert feedback_html(a) == feedback_html(b)
