"""The page at the size of a phone: view and panel one above the other."""

import pytest
from page_in_browser import Browser, Session, chromium, wait_until

pytestmark = pytest.mark.browser


def test_view_and_panel_share_a_phone_and_start_throws_nothing_away(tmp_path):
    with (
        Session(tmp_path / "demos") as session,
        chromium(tmp_path / "chromium", (390, 844)) as tab,
    ):
        browser = Browser(tab, session.page)
        view = tab.locator("canvas").first.bounding_box()
        button = browser.button("Start").bounding_box()
        assert view["width"] == 390
        assert view["height"] > 400
        assert button["y"] > view["y"] + view["height"]
        assert button["width"] > 300
        assert button["y"] + button["height"] < 844
        browser.button("Start").click()
        browser.button("Stop").click()
        browser.button("save").wait_for()
        wait_until(browser.button("Start").is_disabled, "nothing to start over")
        browser.button("save").click()
        tab.get_by_text("the arm has not moved").wait_for()
        wait_until(browser.button("Start").is_enabled, "the next demonstration")
