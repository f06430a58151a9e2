"""A haptic device, by a fake that speaks the interface of forcedimension-core; no hardware."""

import ast
import importlib.util
import inspect
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback
from hrc_learn.teleoperation.devices import HapticDevice

HOME = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])


class FakeDevice:
    """Stands in for `forcedimension_core.dhd` and a device on the desk."""

    def __init__(self):
        self.hand, self.velocity, self.button = np.zeros(3), np.zeros(3), 0
        self.forces, self.said, self.plugged = [], [], True

    def _write(self, out, values) -> int:
        if not self.plugged:
            return -1
        for k in range(3):
            out[k] = float(values[k])
        return 0

    def getPosition(self, out, ID=-1):
        return self._write(out, self.hand)

    def getLinearVelocity(self, out, ID=-1):
        return self._write(out, self.velocity)

    def getButton(self, index, ID=-1):
        return self.button if index == 0 else 0

    def setForce(self, f, ID=-1):
        self.forces.append(np.array(f))
        return 0

    def enableForce(self, enable, ID=-1):
        self.said.append(("enable", enable, ID))
        return 0

    def close(self, ID=-1):
        self.said.append(("close", ID))
        return 0


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def state(q=HOME):
    return ArmState(time=0.0, joint_position=q, joint_velocity=np.zeros(7), gripper_width=0.0)


def tool(q):
    return panda.forward(torch.from_numpy(q)).position.numpy()


@pytest.fixture
def led():
    """A device whose clutch has just closed."""
    fake, clock = FakeDevice(), Clock()
    device = HapticDevice(panda, fake, clock=clock)
    fake.hand, fake.button = np.array([0.01, 0.02, 0.03]), 1
    assert not device.read(state()).twist[:3].any()
    return fake, clock, device


def test_the_end_effector_follows_the_hand_while_the_clutch_is_held(led):
    fake, _, device = led
    fake.hand = fake.hand + np.array([0.01, -0.02, 0.005])
    asked = device.read(state())
    # 2.5 times the way of the hand, at 2 m/s for a metre.
    np.testing.assert_allclose(asked.twist[:3], [0.05, -0.1, 0.025], atol=1e-12)
    assert asked.nullspace_input is None
    fake.button = 0
    fake.hand = np.zeros(3)
    assert not device.read(state()).twist.any()
    # Closed again elsewhere: it begins anew.
    fake.button = 1
    assert not device.read(state()).twist[:3].any()


def test_the_hand_is_pulled_to_where_the_arm_has_followed(led):
    fake, _, device = led
    start = fake.hand
    fake.hand = start + np.array([0.01, -0.02, 0.005])
    device.read(state())
    device.tell(Feedback())
    np.testing.assert_allclose(device.force(), [-1.2, 2.4, -0.6], atol=1e-12)
    # An arm that is where the hand leads it pulls at nothing.
    q = HOME + np.array([0.0, 0.05, 0.1, -0.02, 0.0, 0.0, 0.0])
    fake.hand = start + (tool(q) - tool(HOME)) / 2.5
    device.read(state(q))
    device.tell(Feedback())
    np.testing.assert_allclose(device.force(), 0.0, atol=1e-12)
    fake.velocity = np.array([0.1, 0.0, 0.0])
    np.testing.assert_allclose(device.force(), [-0.4, 0.0, 0.0], atol=1e-12)


def test_contact_is_felt_and_bounded(led):
    _, _, device = led
    for force, felt in ((20.0, 2.0), (1000.0, 6.0)):
        device.read(state())
        device.tell(Feedback(contact_force=np.array([0.0, 0.0, force])))
        np.testing.assert_allclose(device.force(), [0.0, 0.0, felt], atol=1e-12)
    device.tell(Feedback(contact_force=np.array([0.0, 0.0, 20.0]), contact_expected=True))
    assert not device.force().any()


def test_no_force_without_word_from_the_loop_a_clutch_or_a_device(led):
    fake, clock, device = led
    push = Feedback(contact_force=np.array([0.0, 0.0, 30.0]))
    device.tell(push)
    clock.now = 0.09
    assert device.force().any()
    clock.now = 0.11
    assert not device.force().any()
    device.tell(push)
    assert device.force().any()
    fake.plugged = False
    assert not device.force().any()
    assert not device.read(state()).twist.any()
    fake.plugged, fake.button = True, 0
    device.read(state())
    device.tell(push)
    assert not device.force().any()


def test_forces_go_out_by_themselves_and_end_with_the_block():
    fake = FakeDevice()
    with HapticDevice(panda, fake, number=3) as device:
        fake.button = 1
        device.read(state())
        fake.hand = np.array([0.0, 0.0, 0.01])
        end = time.monotonic() + 10
        while not any(force[2] < -1 for force in fake.forces) and time.monotonic() < end:
            device.tell(Feedback())
            time.sleep(0.01)
    np.testing.assert_allclose(min(force[2] for force in fake.forces), -1.2)
    assert not fake.forces[-1].any()
    assert fake.said == [("enable", True, 3), ("enable", False, 3), ("close", 3)]


def test_without_the_sdk_there_is_one_line(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "forcedimension_core", None)
    with pytest.raises(ValueError, match="extra `haptic` and Force Dimension's SDK"):
        HapticDevice.open(panda)


def test_the_fake_speaks_the_interface_of_the_library():
    """By its sources: importing it needs the maker's SDK."""
    found = importlib.util.find_spec("forcedimension_core")
    if found is None or found.origin is None:
        pytest.skip("the extra `haptic` is not installed")
    text = (Path(found.origin).parent / "dhd" / "__init__.py").read_text("utf-8")
    theirs = {
        node.name: [argument.arg for argument in node.args.args]
        for node in ast.parse(text).body
        if isinstance(node, ast.FunctionDef)
    }
    for name, fake in inspect.getmembers(FakeDevice, inspect.isfunction):
        if not name.startswith("_"):
            assert theirs[name] == [
                p for p in inspect.signature(fake).parameters if p != "self"
            ]
