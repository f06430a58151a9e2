"""The page for decisions on demonstrations: who gets in, what it sends, what it takes."""

import contextlib
import http.client
import json
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from clean_sets import CAMERA, write_set
from lerobot_folders import write_folder
from page_in_browser import chromium, wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from hrc_learn.demos import load_demos
from hrc_learn.demos.images import load_images
from hrc_learn.demos.quality.ranking import rank_episodes, read_decisions
from hrc_learn.demos.videos import decode_image
from hrc_learn.kinematics import panda
from hrc_learn.teleoperation import curation_page
from hrc_learn.teleoperation.curation_page import CurationPage
from hrc_learn.teleoperation.gate import AddressConfig


@pytest.fixture(scope="module")
def cleaned(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("clean") / "set", "v3.0", camera=True)


@pytest.fixture(scope="module")
def ranking(cleaned):
    return rank_episodes(cleaned)


@pytest.fixture
def page(cleaned, ranking, tmp_path):
    root = shutil.copytree(cleaned, tmp_path / "set")
    config = AddressConfig(port=0)
    with CurationPage(replace(ranking, path=root), tmp_path / "out", config) as page:
        yield page


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("chromium"), (1280, 800)) as tab:
        yield tab


class Client:
    """Speaks to the page with its secret, unless told otherwise."""

    def __init__(self, page):
        origin, _, self.secret = page.url.partition("/#token=")
        self.origin, self.port = origin, int(origin.rpartition(":")[2])

    def ask(self, path, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        said = {"Authorization": f"Bearer {self.secret}"} | headers
        connection.request("GET", path, headers={k: v for k, v in said.items() if v})
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer, content

    def say(self, text, origin=None):
        """Answer of the page to a message; None if it closes the socket instead."""
        where = f"ws://127.0.0.1:{self.port}/session/{'c' * 24}"
        offered = ["hrc", f"secret.{self.secret}"]
        origin = self.origin if origin is None else origin
        with connect(where, subprotocols=offered, origin=origin or None, proxy=None) as one:
            one.send(text)
            with contextlib.suppress(ConnectionClosed):
                return json.loads(one.recv(timeout=20))
        return None

    def decide(self, **said):
        return self.say(json.dumps({"type": "decide", **said}))


@pytest.fixture
def client(page):
    return Client(page)


@pytest.fixture(scope="module")
def unchanged(ranking, tmp_path_factory):
    """A page on which nothing is decided, and its client."""
    out = tmp_path_factory.mktemp("out") / "set"
    with CurationPage(ranking, out, AddressConfig(port=0)) as page:
        yield page, Client(page)


def test_only_who_has_the_secret_gets_in(unchanged):
    _, client = unchanged
    for path in ("/data/overview", "/data/state", "/data/images/0/0/0"):
        assert client.ask(path, Authorization="")[0].status == 401
        assert client.ask(path, Authorization="Bearer wrong")[0].status == 403
    assert client.ask("/", Host="evil.example")[0].status == 403
    answer, body = client.ask("/", Authorization="")
    assert answer.status == 200
    assert b"hrc curate" in body
    assert "default-src 'self'" in answer.headers["Content-Security-Policy"]


def test_the_most_typical_episode_is_shown_next_to_others(unchanged):
    _, client = unchanged
    shown = json.loads(client.ask("/data/overview")[1])
    distance = {e["episode"]: e["measures"]["distance"] for e in shown["episodes"]}
    assert len(set(distance.values())) > 1
    assert distance[shown["usual"]] == min(distance.values())


def test_an_episode_that_is_broken_or_cannot_be_read_is_not_typical(ranking, tmp_path):
    ordered = sorted(ranking.episodes, key=lambda q: q.measures["distance"])
    first, second, third, *_ = ordered
    for without, usual in (
        ([replace(first, broken=True), second, third], second),
        ([replace(first, measures={}), second, third], second),
        ([third, second, first], first),
        ([replace(first, measures={}), replace(second, broken=True)], None),
    ):
        less = replace(ranking, episodes=tuple(without))
        with CurationPage(less, tmp_path / "out", AddressConfig(port=0)) as page:
            assert page.overview()["usual"] == (None if usual is None else usual.episode)


def test_another_site_decides_nothing(unchanged):
    page, client = unchanged
    said = json.dumps({"type": "decide", "episode": 0, "verdict": "reject"})
    for origin in ("https://evil.example", "http://127.0.0.1", "http://localhost", "null", ""):
        with pytest.raises(InvalidStatus):
            client.say(said, origin=origin)
    assert not page.decisions


@pytest.mark.parametrize(
    "said",
    [
        "{",
        "[]",
        '{"type": "decide", "episode": ' + "[" * 10_000,
        '{"type": "decide", "episode": "0", "verdict": "reject"}',
        '{"type": "decide", "episode": true, "verdict": "reject"}',
        '{"type": "decide", "episode": 0, "verdict": "burn"}',
        '{"type": "decide", "episode": 0}',
        '{"type": "else"}',
        "x" * 50_000,
    ],
)
def test_what_is_no_decision_closes_the_socket(unchanged, said):
    page, client = unchanged
    assert client.say(said) is None
    assert not page.decisions
    assert not read_decisions(page.ranking.path)


def test_a_decision_that_makes_no_sense_is_refused_with_its_reason(unchanged):
    page, client = unchanged
    assert "no episode 9" in client.decide(episode=9, verdict="reject")["refused"]
    assert client.decide(episode=0, verdict="cut", start=5, stop=6)["refused"]
    assert not page.decisions


def test_a_decision_on_a_full_disk_is_refused_with_its_reason(page, client, monkeypatch):
    client.decide(episode=1, verdict="reject")

    def full(*_):
        raise OSError(28, "No space left on device", "set.curation.json")

    with monkeypatch.context() as patched:
        patched.setattr(curation_page, "keep_decisions", full)
        assert "No space left" in client.decide(episode=2, verdict="reject")["refused"]
    assert [*page.decisions] == [1] == [*read_decisions(page.ranking.path)]
    assert client.decide(episode=2, verdict="reject")["decisions"]


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/data/curves/99", 422),
        ("/data/curves/x", 404),
        ("/data/images/0/5/0", 404),
        ("/data/images/0/0/9999", 404),
        ("/../../etc/passwd", 404),
        ("/static/../curation_page.py", 404),
    ],
)
def test_there_is_nothing_elsewhere(unchanged, path, status):
    _, client = unchanged
    assert client.ask(path)[0].status == status


def test_images_and_curves_are_those_of_the_dataset(unchanged):
    page, client = unchanged
    root = page.ranking.path
    demo = load_demos(root)[2]
    curves = json.loads(client.ask("/data/curves/2")[1])
    joint = curves["charts"][0]
    assert [line["name"] for line in joint["lines"]] == ["measured", "commanded"]
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


def test_curves_are_in_the_units_of_the_dataset(tmp_path):
    degrees = np.rad2deg(panda.ready.numpy()) + np.linspace(0, 20, 50)[:, None]
    names = [f"{name}_deg.pos" for name in panda.joint_names]
    columns = {"observation.state": names}
    root = write_folder(tmp_path / "set", [{"observation.state": degrees}], columns)
    with CurationPage(rank_episodes(root), tmp_path / "out", AddressConfig(port=0)) as page:
        curves = json.loads(Client(page).ask("/data/curves/0")[1])
    assert curves["charts"][0]["unit"] == "deg"
    np.testing.assert_allclose(
        curves["charts"][0]["lines"][0]["points"][1], degrees[:, 0], atol=1e-4
    )


def test_curves_of_long_episodes_lose_no_spike():
    from hrc_learn.teleoperation.curation_page import _points

    values = np.zeros(100_000)
    values[54_321] = 7.0
    frames, points = _points(values)
    assert len(points) <= 2000
    assert max(points) == 7.0
    assert frames[points.argmax()] == 54_321
    values[54_300], values[70_000:80_000] = np.nan, np.nan  # a sensor that falls out
    frames, points = _points(values)
    assert np.nanmax(points) == 7.0
    assert np.isnan(points[(frames > 70_500) & (frames < 79_500)]).all()
    assert np.isfinite(points[frames < 70_000]).all()


def test_decisions_are_kept_at_once_and_taken_back(page, client):
    client.decide(episode=1, verdict="reject")
    client.decide(episode=2, verdict="cut", start=4, stop=60)
    assert read_decisions(page.ranking.path) == page.decisions
    assert page.decisions[2].start == 4
    state = client.decide(episode=1, verdict=None)
    assert [*state["decisions"]] == ["2"]
    assert read_decisions(page.ranking.path) == page.decisions


def test_a_set_that_cannot_be_written_says_why(page, client):
    page.out.mkdir()
    client.say('{"type": "write"}')
    wait_until(lambda: not page.state()["written"]["writing"], "an answer")
    assert page.state()["written"]["failed"]
    assert str(page.out) in page.state()["written"]["said"]


@pytest.mark.browser
@pytest.mark.long
def test_an_episode_is_looked_at_cut_and_written_in_the_browser(page, tab):
    errors: list = []
    tab.on("pageerror", lambda error: errors.append(error))
    tab.goto(page.url)
    tab.locator("#charts canvas").first.wait_for()
    # The same order as in the terminal.
    listed = tab.locator("#episodes b").all_inner_texts()
    rows = [line.split()[0] for line in page.ranking.lines()][1 : 1 + len(listed)]
    assert listed == [f"Episode {row}" for row in rows]
    wait_until(lambda: tab.locator("#videos canvas[data-frame='0']").count(), "an image")
    tab.locator("#sort").select_option("duration")
    longest = max(page.ranking.episodes, key=lambda q: q.measures.get("duration", -1))
    assert tab.locator("#episodes b").first.inner_text() == f"Episode {longest.episode}"
    tab.locator("#sort").select_option("score")
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


@pytest.mark.long
@pytest.mark.browser
def test_a_phone_shows_image_and_buttons_at_once(page, tab):
    tab.set_viewport_size({"width": 390, "height": 844})
    tab.goto(page.url)
    wait_until(lambda: tab.locator("#videos canvas[data-frame='0']").count(), "an image")
    tab.locator("#sort").select_option("duration")
    longest = max(page.ranking.episodes, key=lambda q: q.measures.get("duration", -1))
    assert tab.locator("#episodes b").first.inner_text() == f"Episode {longest.episode}"
    tab.locator("#sort").select_option("score")
    for name in ("Accept", "Reject", "Start here"):
        box = tab.get_by_role("button", name=name).bounding_box()
        assert box["y"] + box["height"] <= 844
        assert box["x"] + box["width"] <= 390
        assert box["height"] >= 40
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize(("frames", "kept"), [(1999, 1999), (2000, 2000), (2001, 2000)])
def test_a_curve_of_two_thousand_frames_is_drawn_as_it_is(frames, kept):
    """Of a longer one each section keeps its extremes, in the order of time."""
    from hrc_learn.teleoperation.curation_page import _points

    values = np.sin(np.arange(float(frames)))
    chosen, points = _points(values)
    assert len(chosen) <= kept
    assert len(chosen) > kept - 200
    np.testing.assert_array_equal(points, values[chosen])
    assert (np.diff(chosen) > 0).all()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_spikes_to_either_side_stay_in_a_reduced_curve(sign):
    from hrc_learn.teleoperation.curation_page import _points

    values = np.random.default_rng(0).uniform(-0.1, 0.1, 50_000)
    at = np.arange(77, 50_000, 4_999)
    values[at] = sign * np.arange(1.0, 1.0 + len(at))
    chosen, points = _points(values)
    assert set(at) <= set(chosen.tolist())
    assert sign * points.max() == values.max() * sign
    assert points.min() == values.min()
