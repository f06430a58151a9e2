"""A headset that is emulated in Chromium, and what a person does who wears it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from page_in_browser import chromium, wait_until

from hrc_learn.teleoperation.headset import BUILD, CLIENT
from hrc_learn.teleoperation.page import Page

EMULATOR = CLIENT / "node_modules" / "iwer" / "build" / "iwer.min.js"

_WEAR = """
const device = new IWER.XRDevice(IWER.metaQuest3);
device.installRuntime();
device.primaryInputMode = "hand";
window.headset = device;
// The arm as the client is told of it.
window.bodies = [];
window.Worker = class extends Worker {
  constructor(...options) {
    super(...options);
    this.addEventListener("message", ({ data }) => {
      if (data.scene) window.bodies = data.scene.bodies;
    });
  }
};
// What the client is told in each frame, seen beside it.
const request = navigator.xr.requestSession.bind(navigator.xr);
navigator.xr.requestSession = async (...options) => {
  const session = await request(...options);
  const space = await session.requestReferenceSpace("local-floor");
  const pose = (found) => found && [...found.transform.matrix];
  window.seen = { frames: 0 };
  const look = (_, frame) => {
    const hands = {};
    for (const source of session.inputSources) {
      const joint = (name) =>
        source.hand ? pose(frame.getJointPose(source.hand.get(name), space)) : null;
      hands[source.handedness] = {
        grip: source.gripSpace && pose(frame.getPose(source.gripSpace, space)),
        thumb: joint("thumb-tip"),
        index: joint("index-finger-tip"),
      };
    }
    window.seen = { frames: window.seen.frames + 1, hands };
    session.requestAnimationFrame(look);
  };
  session.requestAnimationFrame(look);
  return session;
};
"""


class Headset:
    """The client in a tab, and a person with two hands before it."""

    def __init__(self, tab, url: str):
        self.tab = tab
        tab.set_default_timeout(120e3)
        tab.add_init_script(path=str(EMULATOR))
        tab.add_init_script(_WEAR)
        tab.goto(url)
        self.button("Enter AR").wait_for()

    def enter(self) -> None:
        """Put it on: the arm stands in the person's own room from now on."""
        self.button("Enter AR").click()
        self.button("Place the arm").wait_for()
        self.frames(3)

    def button(self, name: str):
        return self.tab.get_by_role("button", name=name, exact=True)

    def press(self, name: str) -> None:
        """Press a button of the page, once it can be pressed: those in the room do the same."""
        enabled = self.tab.get_by_role("button", name=name, exact=True, disabled=False)
        # The page's own view may not answer to a mouse while the headset shows another.
        enabled.evaluate("button => button.click()")
        self.frames(2)

    def frames(self, count: int) -> None:
        """Wait for frames of the session."""
        then = self.tab.evaluate("window.seen.frames") + count
        self.tab.wait_for_function(f"window.seen.frames >= {then}")

    def look(self, position, towards) -> None:
        """Stand somewhere and look at a point, both in the room (y up)."""
        position, towards = np.asarray(position, float), np.asarray(towards, float)
        back = position - towards
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        x, y, z, w = _quaternion(np.stack([right, np.cross(back, right), back], axis=1))
        self.tab.evaluate(
            f"headset.position.set({position[0]}, {position[1]}, {position[2]});"
            f"headset.quaternion.set({x}, {y}, {z}, {w})"
        )

    def hand(self, hand: str, orientation=None) -> np.ndarray:
        """Where thumb and index finger of a hand meet, as the session tells it."""
        seen = self.tab.evaluate(f"window.seen.hands['{hand}']")
        tips = [np.array(seen[name]).reshape(4, 4)[3, :3] for name in ("thumb", "index")]
        return np.mean(tips, axis=0)

    def reach(self, hand: str, point) -> np.ndarray:
        """Bring the fingertips of a hand to a point of the room; where they really are then."""
        for _ in range(2):
            away = np.asarray(point) - self.hand(hand)
            self.tab.evaluate(
                f"(() => {{ const p = headset.hands['{hand}'].position;"
                f"p.set(p.x + {away[0]}, p.y + {away[1]}, p.z + {away[2]}); }})()"
            )
            self.frames(2)
        return self.hand(hand)

    def turn(self, hand: str, axis, angle: float) -> None:
        """Turn a hand."""
        x, y, z = np.sin(angle / 2) * np.asarray(axis, float)
        self.tab.evaluate(
            f"headset.hands['{hand}'].quaternion.set({x}, {y}, {z}, {np.cos(angle / 2)})"
        )
        self.frames(2)

    def pinch(self, hand: str, closed: bool = True) -> None:
        """Close thumb and index finger, or open them."""
        self.tab.evaluate(f"headset.hands['{hand}'].updatePinchValue({int(closed)})")
        self.frames(3)

    def walk(self, hand: str, path: np.ndarray, rate: float) -> None:
        """Move the fingertips along points of the room, so many a second; waits for the end.

        In the browser's own time, so that a machine that draws slowly moves them no slower.
        """
        away = path - self.hand(hand)
        self.tab.evaluate(
            """([hand, steps, rate]) => new Promise((done) => {
              const p = headset.hands[hand].position, from = [p.x, p.y, p.z];
              const began = performance.now();
              const timer = setInterval(() => {
                const k = Math.floor((performance.now() - began) * rate / 1e3);
                const step = steps[Math.min(k, steps.length - 1)];
                p.set(from[0] + step[0], from[1] + step[1], from[2] + step[2]);
                if (k >= steps.length) { clearInterval(timer); done(); }
              }, 10);
            })""",
            [hand, away.tolist(), rate],
        )

    def watch_it_rest(self, patience: float = 120.0) -> None:
        """Look at the arm until it moves no more, as who leads it does before they go on."""
        positions = lambda: np.array(self.tab.evaluate("window.bodies"))[:, :3]  # noqa: E731
        before, end = positions(), time.monotonic() + patience
        while True:
            time.sleep(1.0)
            now = positions()
            if np.abs(now - before).max() < 1e-3:
                return
            if time.monotonic() > end:
                pytest.fail(f"the arm does not come to rest within {patience} s")
            before = now

    @contextmanager
    def pinching(self, hand: str) -> Iterator[None]:
        self.pinch(hand)
        try:
            yield
        finally:
            self.pinch(hand, closed=False)


def _quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Of a rotation matrix with a positive real part (xyzw)."""
    w = np.sqrt(max(1 + np.trace(R), 1e-12)) / 2
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    return x / (4 * w), y / (4 * w), z / (4 * w), w


@contextmanager
def headset(folder: Path, page: Page, size: tuple[int, int] = (640, 400)) -> Iterator[Headset]:
    """A person with an emulated headset; skips where it cannot be emulated."""
    if not page.headset_url or not EMULATOR.is_file():
        pytest.skip(f"the client for headsets is not built: {BUILD}")
    # Chromium's own WebXR stands in the way of the emulated one.
    with chromium(folder, size, ("--disable-blink-features=WebXR",)) as tab:
        yield Headset(tab, page.headset_url)


def placed(touch_points: np.ndarray, yaw: float, position) -> np.ndarray:
    """Points of the base frame in a room in which the arm stands somewhere (y up)."""
    x, y, z = np.asarray(touch_points, float).T
    level = np.stack([x, z, -y], axis=1)
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return level @ turn.T + np.asarray(position)


def unplaced(points: np.ndarray, yaw: float, position) -> np.ndarray:
    """The other way: from the room to the base frame."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    X, Y, Z = (np.asarray(points, float) - position) @ turn
    return np.array([X, -Z, Y])


def settled(condition, what: str) -> None:
    """As `wait_until`, and for a moment more."""
    wait_until(condition, what)
    time.sleep(0.1)
