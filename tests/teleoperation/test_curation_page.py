"""The page for decisions on demonstrations: who gets in, what it sends, what it takes."""

import http.client
import json
import struct

import numpy as np
import pytest
from clean_sets import CAMERA, write_set
from lerobot_folders import write_folder
from page_in_browser import chromium, wait_until

from hrc_learn.demos import load_demos
from hrc_learn.demos.format.videos import decode_image
from hrc_learn.demos.images import load_images
from hrc_learn.demos.quality.decisions import read_decisions
from hrc_learn.demos.quality.ranking import rank_episodes
from hrc_learn.teleoperation.curation_page import CurationPage
from hrc_learn.teleoperation.gate import AddressConfig


@pytest.fixture
def page(tmp_path):
    root = write_set(tmp_path / "set", "v3.0", camera=True)
    config = AddressConfig(port=0)
    with CurationPage(rank_episodes(root), tmp_path / "out", config) as page:
        yield page


class Client:
    """Speaks HTTP to the page, with its cookie unless told otherwise."""

    def __init__(self, page):
        address = page.admission.address
        self.origin, self.port = address.origin, address.port
        self.cookie = f"hrc_page_{address.port}={address.token}"

    def ask(self, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        method = "GET" if body is None else "POST"
        said = {"Cookie": self.cookie, "Origin": self.origin} | headers
        connection.request(method, path, body, {k: v for k, v in said.items() if v})
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer, content

    def decide(self, **said):
        return self.ask("/decide", json.dumps(said))


@pytest.fixture
def client(page):
    return Client(page)


def test_only_who_has_the_secret_gets_in(page, client):
    for path in ("/", "/data/overview", "/static/curation.js"):
        assert client.ask(path, Cookie="")[0].status == 401
    assert client.ask("/", Cookie="hrc_page_1=x")[0].status == 401
    assert client.ask("/?token=wrong", Cookie="")[0].status == 403
    assert client.ask("/", Host="evil.example")[0].status == 403
    answer, _ = client.ask(page.url.removeprefix(client.origin), Cookie="")
    assert answer.status == 303
    assert "HttpOnly; SameSite=Strict" in answer.headers["Set-Cookie"]
    answer, body = client.ask("/")
    assert answer.status == 200
    assert b"hrc curate" in body
    assert "default-src 'self'" in answer.headers["Content-Security-Policy"]


def test_another_site_decides_nothing(page, client):
    said = json.dumps({"episode": 0, "verdict": "reject"})
    for origin in ("https://evil.example", "", "null"):
        assert client.ask("/decide", said, Origin=origin)[0].status == 403
    assert not page.decisions


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/decide", "{", 400),
        ("/decide", "[]", 404),
        ("/decide", '{"episode": "0", "verdict": "reject"}', 400),
        ("/decide", '{"episode": 9, "verdict": "reject"}', 404),
        ("/decide", '{"episode": 0, "verdict": "burn"}', 400),
        ("/decide", '{"episode": 0, "verdict": "cut", "start": 5, "stop": 6}', 400),
        ("/decide", "x" * 5000, 413),
        ("/else", "{}", 404),
        ("/data/curves/99", None, 422),
        ("/data/curves/x", None, 404),
        ("/data/images/0/5/0", None, 404),
        ("/data/images/0/0/9999", None, 404),
        ("/../../etc/passwd", None, 404),
        ("/static/../server.py", None, 404),
    ],
)
def test_what_makes_no_sense_is_refused(page, client, path, body, status):
    assert client.ask(path, body)[0].status == status
    assert not page.decisions


def test_images_and_curves_are_those_of_the_dataset(page, client):
    root = page.ranking.path
    demo = load_demos(root)[2]
    curves = json.loads(client.ask("/data/curves/2")[1])
    joint = curves["charts"][0]
    assert [line["name"] for line in joint["lines"]] == ["state", "command"]
    frames, values = joint["lines"][0]["points"]
    np.testing.assert_allclose(values, demo.joint_position[frames, 0])
    np.testing.assert_allclose(curves["time"], demo.time)
    body = client.ask("/data/images/2/0/64")[1]
    count = struct.unpack_from("<I", body)[0]
    sizes = struct.unpack_from(f"<{count}I", body, 4)
    assert count == 32
    assert 4 * (count + 1) + sum(sizes) == len(body)
    at = 4 * (count + 1) + sum(sizes[:7])
    image = decode_image(body[at : at + sizes[7]])
    truth = load_images(root, 2, frames=[71])[CAMERA][0].permute(1, 2, 0).numpy()
    assert np.abs(image.astype(int) - truth).mean() < 4  # what JPEG loses


def test_curves_of_columns_without_a_meaning_go_by_their_own_names(tmp_path):
    """Actions that belong to other joints than the state, and a column without names."""
    way = np.linspace(0, 1, 40)[:, None] * np.ones(3)
    episodes = [{"observation.state": way + i, "action": 2 * way, "extra": way} for i in (1, 2)]
    names = {
        "observation.state": ["a.pos", "b.pos", "c.pos"],
        "action": ["lift", "grip", "turn"],
    }
    root = write_folder(tmp_path / "set", episodes, names)
    with CurationPage(rank_episodes(root), tmp_path / "out", AddressConfig(port=0)) as page:
        curves = json.loads(Client(page).ask("/data/curves/1")[1])
    lines = {c["name"]: [line["name"] for line in c["lines"]] for c in curves["charts"]}
    assert lines["action"] == names["action"]
    assert lines["extra"] == ["component 0", "component 1", "component 2"]


def test_curves_of_long_episodes_lose_no_spike():
    from hrc_learn.teleoperation.curation_page.server import _points

    values = np.zeros(100_000)
    values[54_321] = 7.0
    frames, points = _points(values, np.linspace(0, 100_000, 1001).astype(int))
    assert len(points) <= 2000
    assert max(points) == 7.0
    assert frames[points.index(7.0)] == 54_321


def test_decisions_are_kept_at_once_and_taken_back(page, client):
    assert client.decide(episode=1, verdict="reject")[0].status == 200
    assert client.decide(episode=2, verdict="cut", start=4, stop=60)[0].status == 200
    assert read_decisions(page.ranking.path) == page.decisions
    assert page.decisions[2].start == 4
    state = json.loads(client.decide(episode=1, verdict=None)[1])
    assert [*state["decisions"]] == ["2"]
    assert read_decisions(page.ranking.path) == page.decisions


def test_a_set_that_cannot_be_written_says_why(page, client):
    page.out.mkdir()
    client.ask("/write", "{}")
    wait_until(lambda: not page.state()["written"]["writing"], "an answer")
    assert page.state()["written"]["failed"]
    assert str(page.out) in page.state()["written"]["said"]


@pytest.mark.browser
def test_an_episode_is_looked_at_cut_and_written_in_the_browser(page, tmp_path):
    with chromium(tmp_path / "chromium", (1280, 800)) as tab:
        errors: list = []
        tab.on("pageerror", lambda error: errors.append(error))
        tab.goto(page.url)
        tab.locator("#charts canvas").first.wait_for()
        # The same order as in the terminal.
        listed = tab.locator("#episodes b").all_inner_texts()
        rows = [line.split()[0] for line in page.ranking.lines()][1 : 1 + len(listed)]
        assert listed == [f"Episode {row}" for row in rows]
        wait_until(lambda: tab.locator("#videos canvas[data-frame='0']").count(), "an image")
        tab.get_by_role("button", name="Play").click()
        moved = tab.locator("#videos canvas").first
        wait_until(lambda: int(moved.get_attribute("data-frame")) > 20, "playing")
        tab.get_by_role("button", name="Pause").click()
        tab.keyboard.press("x")  # rejects the first, and goes on to the next
        wait_until(lambda: len(page.decisions) == 1, "a rejection")
        first, second = (q.episode for q in page.ranking.episodes[:2])
        tab.get_by_role("heading", name=f"Episode {second}").wait_for()
        tab.locator("#slider").fill("30")
        tab.get_by_role("button", name="Start here").click()
        tab.locator("#slider").fill("99")
        tab.get_by_role("button", name="End here").click()
        tab.get_by_role("button", name="Cut to 30 - 100").click()
        wait_until(lambda: len(page.decisions) == 2, "a cut")
        tab.get_by_role("button", name="Write the cleaned set").click()
        tab.get_by_text("4 episodes with").wait_for()
        assert not errors
    assert page.decisions[first].verdict == "reject"
    kept = load_demos(page.out)
    assert len(kept) == 4
    (cut,) = (demo for demo in kept if len(demo) == 70)
    source = load_demos(page.ranking.path)[second]
    np.testing.assert_array_equal(cut.joint_position, source.joint_position[30:100])
    np.testing.assert_array_equal(cut.command_position, source.command_position[30:100])


@pytest.mark.browser
def test_a_phone_shows_image_and_buttons_at_once(page, tmp_path):
    with chromium(tmp_path / "chromium", (390, 844)) as tab:
        tab.goto(page.url)
        wait_until(lambda: tab.locator("#videos canvas[data-frame='0']").count(), "an image")
        for name in ("Accept", "Reject", "Start here"):
            box = tab.get_by_role("button", name=name).bounding_box()
            assert box["y"] + box["height"] <= 844
            assert box["x"] + box["width"] <= 390
            assert box["height"] >= 40
        assert tab.evaluate("document.documentElement.scrollWidth") <= 390
