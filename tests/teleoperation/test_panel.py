"""What the panel says, as text."""

import re

import numpy as np

from hrc_learn.teleoperation.page import PageStatus
from hrc_learn.teleoperation.page.panel import (
    interventions_html,
    nullspace_input_html,
    state_html,
)


def bars(html):
    """Left end and width of each bar [%]."""
    return [
        tuple(map(float, ends)) for ends in re.findall(r"left:([\d.]+)%;width:([\d.]+)%", html)
    ]


def test_efforts_are_bars_from_the_middle_to_either_side():
    html = nullspace_input_html(np.array([10.0, -5.0, 0.0, 40.0]), largest=20.0)
    assert bars(html) == [(50.0, 25.0), (37.5, 12.5), (50.0, 0.0), (50.0, 50.0)]
    assert "+10.0" in html
    assert "-5.0" in html


def test_interventions_are_counted_and_the_new_ones_stand_out():
    status = PageStatus(interventions={"velocity": 3, "tcp_speed": 7, "jerk": 0}, contacts=2)
    html = interventions_html(status, more=["tcp_speed"], latest="tcp_speed")
    rows = re.findall(r"<tr.*?</tr>", html)
    assert [re.sub(r"<.*?>", " ", row).split() for row in rows] == [
        ["velocity", "3"],
        ["tcp", "speed", "7"],
        ["touches", "of", "the", "surroundings", "2"],
    ]
    assert ["bold" in row or "600" in row for row in rows] == [False, True, False]
    assert "latest: tcp speed" in html


def test_a_filter_that_has_not_acted_is_said_to():
    html = interventions_html(PageStatus(interventions={"velocity": 0}), more=[], latest="")
    assert "has not had to act" in html


def test_what_others_have_written_is_not_taken_for_the_pages_own():
    html = state_html(PageStatus(title="<script>", note="<b>"), rate=100.0, people=2)
    assert "<script>" not in html
    assert "<b>" not in html
    assert "2 connected" in html
    assert "recording 1.5 s" in state_html(
        PageStatus(recording="recording", seconds=1.5), rate=0.0, people=0
    )


def test_an_arm_that_works_by_itself_says_what_it_does_and_records_nothing():
    html = state_html(PageStatus(doing="aim & wait", seconds=12.34), rate=0.0, people=0)
    assert "aim &amp; wait" in html
    assert "12.3 s" in html
    assert "saved" not in html
    assert "ready" not in html
