"""`hrc record leader`: LeRobot's SO-101 leader leads its follower, both on simulated buses."""

import json
import math
import sys
import threading
import time

import numpy as np
import pytest
from commands import done, hrc
from feetech_bus import RANGES, TORQUE, FeetechBus, calibration, so101_servos
from unchecked import shapes_unchecked

from hrc_learn.demos import open_demos
from hrc_learn.kinematics.registry import arm

pytest.importorskip("scservo_sdk")

STEP = 2 * math.pi / 4095
MIDDLES = [sum(ends) / 2 for ends in RANGES.values()]


def options(kind, device, port, folder):
    given = {"type": device, "port": port, "id": "mine", "calibration_dir": folder}
    return [f"--{kind}.{name}={value}" for name, value in given.items()]


@pytest.mark.realtime
@shapes_unchecked()  # a loop at 50 Hz
def test_a_follower_records_what_its_leader_shows(tmp_path):
    (tmp_path / "mine.json").write_text(json.dumps(calibration()))
    ended = threading.Event()

    def lead(servos):
        """Turn the first joint to and fro, and close the handle by half."""
        began = time.monotonic()
        while not ended.wait(0.01):
            servos[1].position = MIDDLES[0] + 250 * math.sin(1.5 * (time.monotonic() - began))
            servos[6].position = 2000 + 0.5 * 1500

    before = sys.getswitchinterval()
    sys.setswitchinterval(2e-4)
    with FeetechBus(so101_servos()) as leading, FeetechBus(so101_servos()) as following:
        person = threading.Thread(target=lead, args=(leading.servos,))
        person.start()
        try:
            done(
                *("record", "leader", "--robot", "so101", "--episodes", 2),
                *("--out", tmp_path / "set", "--json", tmp_path / "values.json"),
                *options("robot", "so101_follower", following.port, tmp_path),
                *options("teleop", "so101_leader", leading.port, tmp_path),
                *("--config", "demonstration.duration=1.5", "demonstration.pause=0.5"),
                "demonstration.task=turn to and fro",
            )
        finally:
            ended.set()
            person.join()
            sys.setswitchinterval(before)
        assert not leading.servos[1].memory[TORQUE]  # a person moves it
    values = json.loads((tmp_path / "values.json").read_text())
    assert (values["episodes"], values["frames"]) == (2, 150)
    demos = open_demos(tmp_path / "set")
    limits = arm("so101").limits
    for demo in demos:
        assert demo.task == "turn to and fro"
        assert demo.joint_position is not None
        assert demo.gripper is not None
        q, action = demo.joint_position, demo.extra["action"]
        asked = action[:, :5]
        assert np.ptp(q[:, 0]) > 0.1
        assert np.abs(q[:, 0]).max() < 260 * STEP
        assert np.abs(q[:, 1:]).max() < 3 * STEP
        assert np.abs(asked - q).max() < 0.15  # the lag of the servos
        assert (np.abs(np.diff(asked, axis=0)) * 50 <= limits.velocity.numpy()).all()
        assert action[-1, 5] == pytest.approx(0.04, abs=0.002)
        assert demo.gripper[-1] == pytest.approx(0.04, abs=0.002)
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    assert features["action"]["names"][-1] == "gripper.pos"


@pytest.mark.long
def test_a_leader_that_is_not_there_is_one_line(tmp_path):
    (tmp_path / "mine.json").write_text(json.dumps(calibration()))
    words = ("record", "leader", "--robot", "so101", "--out", tmp_path / "set")
    asked = hrc(*words, *options("teleop", "so101_leader", "/dev/nothing", tmp_path))
    assert asked.status == 1
    assert "--teleop.type=so101_leader cannot be reached at /dev/nothing" in asked.error
    assert asked.error.count("\n") == 1
    assert not (tmp_path / "set").exists()
    asked = hrc("serve", "--arm", "lerobot", "--robot.type=nothing", "--config", "step=eager")
    assert asked.status == 1
    assert "--robot.type=nothing: LeRobot has no such type" in asked.error
    assert asked.error.count("\n") == 1
    asked = hrc(*words, "--teleop.type=so101_leder")
    assert asked.status == 2
    assert "did you mean so101_leader?" in asked.error


@pytest.mark.parametrize(
    ("timing", "refused"),
    [
        (("duration=0.02", "pause=0"), "duration=0.02 has less than two frames"),
        (("duration=0.04", "pause=-0.1"), "pause must not be negative"),
        (("fps=0",), "fps must be positive"),
        (("duration=0.04", "pause=0"), ""),
    ],
)
def test_a_demonstration_has_two_frames_or_more(tmp_path, timing, refused):
    """Of 20 ms each; what is not refused goes on to the leader, which is not there."""
    (tmp_path / "mine.json").write_text(json.dumps(calibration()))
    words = ("record", "leader", "--robot", "so101", "--out", tmp_path / "set")
    devices = options("teleop", "so101_leader", "/dev/nothing", tmp_path)
    outcome = hrc(*words, *devices, "--config", *(f"demonstration.{word}" for word in timing))
    assert outcome.status == (2 if refused else 1)
    assert refused in outcome.error
