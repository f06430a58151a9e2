"""`hrc record`: number, seed, contents and figures of demonstrations, without making them."""

import json
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.cli import record_command
from hrc_learn.cli.arguments import Record
from hrc_learn.demos import open_demos
from hrc_learn.experiments.real_arm import ArmSite
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.lerobot import episode_recording
from hrc_learn.protocols import ArmState
from hrc_learn.sim import PhysicsError
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import TaskFailedError

pytestmark = pytest.mark.simulation


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


@pytest.mark.parametrize(
    ("kind", "episodes", "seed"),
    [("placing", 3, 0), ("servoing", 8, 1), ("expert", 10, 0), ("leader", 5, 0)],
)
def test_each_kind_has_its_number_and_seed(monkeypatch, tmp_path, kind, episodes, seed):
    taken = []
    monkeypatch.setattr(record_command, f"_record_{kind}", lambda *given: taken.append(given))

    def recorded(**given):
        assert record_command.record(Record(demonstration=kind, out=tmp_path, **given)) == 0
        args, *numbers = taken.pop()
        assert [args.episodes, args.seed] == numbers
        return tuple(numbers)

    assert recorded() == (episodes, seed)
    assert recorded(episodes=1) == (1, seed)
    if kind == "leader":
        with pytest.raises(ValueError, match="--seed is an option of hrc record placing, serv"):
            recorded(seed=9)
    else:
        assert recorded(seed=0) == (episodes, 0)
        assert recorded(episodes=2, seed=9) == (2, 9)
    for refused in (0, -1):
        with pytest.raises(ValueError, match=f"at least 1, but is {refused}"):
            recorded(episodes=refused)


@pytest.mark.parametrize(
    "error",
    [
        TaskFailedError("it fell"),
        PhysicsError("it fell", 1.0),
        RuntimeError("it fell"),
        ConnectionError("it fell"),
    ],
)
def test_an_expert_that_fails_is_status_1(monkeypatch, tmp_path, capsys, error):
    def fail(*given):
        raise error

    monkeypatch.setattr(record_command, "_record_placing", fail)
    assert record_command.record(Record(demonstration="placing", out=tmp_path)) == 1
    assert capsys.readouterr().err == f"failed: {error}\n"


@pytest.fixture(scope="module")
def workplace():
    return Workplace()


@pytest.fixture
def no_world(monkeypatch, workplace):
    """The work cell in words: its world is the seed it was made for."""
    monkeypatch.setattr(
        record_command, "_work_cell", lambda args, seed: (workplace, f"world {seed}", "rng")
    )


def frames(count, shift=0.0, **more):
    """Frames of an arm whose tool ends at a distance from the middle shelf [m]."""
    goal = Workplace().shelf("middle").position.numpy()
    return [
        {
            "joint_position": panda.ready.numpy() + 0.01 * k,
            "position": goal + np.array([0.0, 0.0, shift]),
            **more,
        }
        for k in range(count)
    ]


def run(kind, folder, **given):
    args = Record(demonstration=kind, out=folder / "set", json=folder / "values.json", **given)
    assert record_command.record(args) == 0
    return json.loads((folder / "values.json").read_text())


def test_demonstrations_of_placing_report_the_largest_error(
    no_world, monkeypatch, workplace, tmp_path, capsys
):
    shown = iter([(frames(12, 0.002), 2), (frames(20, -0.007), 1), (frames(15, 0.004), 0)])
    asked = []

    def demonstrate(*given):
        asked.append(given)
        return next(shown)

    monkeypatch.setattr(record_command, "demonstrate_placing", demonstrate)
    values = run("placing", tmp_path, config=("demonstration.record_every=5",), seed=4)
    assert values["discarded"] == 3
    assert values["final_error_mm_max"] == pytest.approx(7.0)
    assert values["episodes"] == 3
    assert "3 demonstrations in" in (said := capsys.readouterr().out)
    assert "(3 discarded)" in said
    demos = open_demos(tmp_path / "set")
    assert [len(demo) for demo in demos] == [12, 20, 15]
    assert {demo.task for demo in demos} == {"place the box on the middle shelf"}
    assert demos[0].fps == 20
    assert [given[:3] for given in asked] == [("world 4", workplace, "middle")] * 3
    meta = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert meta["robot_type"] == "panda"


def test_demonstrations_of_servoing_report_the_least_visible_marker(
    no_world, monkeypatch, tmp_path, capsys
):
    seen = iter([8, 6, 10])

    def demonstrate(*given):
        visible = next(seen)
        made = frames(10)
        for k, frame in enumerate(made):
            frame["feature_visible"] = k < visible
            frame["feature"] = np.array([1.0, 2.0])
            frame["observation.object_feature"] = np.array([3.0, 4.0])
            frame["observation.angle_feature"] = np.array([0.1])
        return made

    names = ("u", "v")
    monkeypatch.setattr(record_command, "OBJECT_FEATURE", "observation.object_feature")
    monkeypatch.setattr(record_command, "OBJECT_FEATURE_NAMES", names)
    monkeypatch.setattr(record_command, "ANGLE_FEATURE", "observation.angle_feature")
    monkeypatch.setattr(record_command, "ANGLE_FEATURE_NAMES", ("angle",))
    cameras = []
    monkeypatch.setattr(
        record_command, "open_camera", lambda world, kind, rng: cameras.append(kind)
    )
    monkeypatch.setattr(record_command, "MarkerSensor", lambda camera, ids: "sensor")
    monkeypatch.setattr(record_command, "demonstrate_servoing", demonstrate)
    values = run("servoing", tmp_path, episodes=3)
    assert values["marker_seen_min"] == pytest.approx(0.6)
    assert cameras == ["synthetic"]
    assert "marker visible in 60 %" in capsys.readouterr().out
    assert [len(demo) for demo in open_demos(tmp_path / "set")] == [10, 10, 10]


def test_films_have_half_the_frames_and_the_cameras_size(monkeypatch, tmp_path, workplace):
    written, asked = [], []
    monkeypatch.setattr(record_command, "World", lambda scene: "world")
    monkeypatch.setattr(
        record_command, "open_camera", lambda world, kind, rng: f"{kind} camera"
    )
    monkeypatch.setattr(record_command, "MarkerSensor", lambda camera, ids: f"of {camera}")
    monkeypatch.setattr(
        record_command, "film_servoing", lambda *given: asked.append(given) or iter(())
    )

    def write(args, workplace, demonstrate, task, fps, features=None, cameras=None):
        list(demonstrate())
        written.append((task, fps, features, cameras))

    monkeypatch.setattr(record_command, "_write", write)
    config = ("demonstration.markerless=true", "demonstration.record_every=3")
    values = run("servoing", tmp_path, config=config, seed=6)
    assert values["episodes"] == 8
    ((task, fps, features, cameras),) = written
    assert (task, features, cameras) == ("servo to the box", None, {"front": (1080, 1440)})
    ((_, filmed, sensor, camera, settings, _),) = asked
    assert settings.record_every == 6
    assert fps == settings.fps
    assert (sensor, camera) == ("of synthetic camera", "egl camera")
    # The look is drawn by the seed, and no marker is left.
    assert filmed.scene.look.seed == 6
    assert filmed.scene.arm.marker is None or filmed.scene != workplace.scene


@pytest.mark.parametrize("scenario", ["placing", "grasping"])
@pytest.mark.parametrize("marker", [True, False])
def test_the_expert_records_what_lerobot_would(monkeypatch, tmp_path, capsys, scenario, marker):
    configs = []

    def record_expert(folder, config, episodes):
        configs.append((folder, config))
        outcomes = [False, True, False, False, True]
        yield from zip(np.cumsum(outcomes).tolist(), outcomes, strict=True)

    monkeypatch.setattr(episode_recording, "record_expert", record_expert)
    chosen = ("robot.marker=true",) if marker else ()
    values = run("expert", tmp_path, episodes=2, seed=3, scenario=scenario, config=chosen)
    assert values["discarded"] == 3
    assert values["episodes"] == 2
    assert "2 demonstrations in" in (said := capsys.readouterr().out)
    assert "(3 discarded)" in said
    ((folder, config),) = configs
    assert folder == tmp_path / "set"
    assert (config.arm, config.scenario, config.shelf) == ("panda", scenario, "middle")
    assert (config.fps, config.seed) == (20.0, 3)
    assert config.pixels == (scenario == "grasping")
    assert (config.marker, config.hand) == (marker, marker)


def test_a_negative_seed_is_refused_by_its_name(tmp_path):
    args = Record(demonstration="placing", out=tmp_path / "set", seed=-1)
    with pytest.raises(ValueError, match="--seed must not be negative, but is -1"):
        record_command.record(args)


def test_the_expert_overwrites_nothing(tmp_path):
    with pytest.raises(FileExistsError, match="give another --out"):
        record_command.record(Record(demonstration="expert", out=tmp_path))


class Servo:
    """An arm that moves as it is commanded, in periods of 20 ms."""

    def __init__(self, q):
        self.q, self.time, self.widths, self.stopped = q, 0.0, [], 0

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=np.zeros(len(self.q)),
            gripper_width=0.03,
        )

    def command(self, velocity):
        self.q, self.time = self.q + 0.02 * np.asarray(velocity), self.time + 0.02

    def move(self, width):
        self.widths.append(width)

    def stop(self):
        self.stopped += 1


class Leader:
    """Turns its first joint, with its handle open by a quarter."""

    def __init__(self, settings, names, *units):
        self.settings, self.units, self.reads, self.closed = settings, units, 0, False
        Leader.made = self

    def read(self):
        self.reads += 1
        q = arm("so101").chain.ready.numpy().copy()
        q[0] += min(0.002 * self.reads, 0.1)
        return q, 0.25

    def close(self):
        self.closed = True


class Rate:
    made: ClassVar = []

    def __init__(self, period):
        self.period, self.missed, self.ticks = period, 4, 0
        Rate.made.append(self)

    def wait(self):
        self.ticks += 1


def test_a_follower_is_recorded_after_each_pause(monkeypatch, tmp_path, capsys):
    robot = arm("so101")
    follower, sites = Servo(robot.chain.ready.numpy().copy()), []

    @contextmanager
    def opened(site, chain):
        sites.append(site)
        yield follower

    monkeypatch.setattr(record_command, "opened_arm", opened)
    monkeypatch.setattr(record_command, "LeaderArm", Leader)
    monkeypatch.setattr(record_command, "Rate", Rate)
    config = ("demonstration.duration=0.31", "demonstration.pause=0.2")
    values = run(
        "leader",
        tmp_path,
        robot="so101",
        episodes=2,
        config=(
            *(*config, "site.device.type=so101_follower", "demonstration.task=turn"),
            "site.lerobot.zeros.elbow_flex=1.57",
            'site.lerobot.reversed=["wrist_roll"]',
        ),
    )
    # 0.31 s at 50 Hz are 16 frames, and 0.2 s another 10 that are not kept.
    assert values == {**values, "episodes": 2, "frames": 32, "missed_ticks": 4}
    assert Rate.made[-1].period == pytest.approx(0.02)
    assert Rate.made[-1].ticks == Leader.made.reads == 2 * 26
    assert (follower.stopped, Leader.made.closed) == (1, True)
    assert sites[0].driver == "lerobot"
    assert Leader.made.units == ("", {"elbow_flex": 1.57}, ("wrist_roll",))  # the follower's
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if "demonstration " in line and "of" in line] == [
        "demonstration 1 of 2 in 0.2 s",
        "demonstration 2 of 2 in 0.2 s",
    ]
    assert said.count("recording for 0.31 s") == 2
    demos = open_demos(tmp_path / "set")
    assert [len(demo) for demo in demos] == [16, 16]
    assert demos[0].task == "turn"
    assert follower.widths == [pytest.approx(0.25 * 0.08)] * 52
    for begin, demo in zip((10, 36), demos, strict=True):
        action = demo.extra["action"]
        wanted = robot.chain.ready.numpy()[0] + np.minimum(
            0.002 * (begin + 1 + np.arange(16)), 0.1
        )
        np.testing.assert_allclose(action[:, 0], wanted, atol=1e-3)
        np.testing.assert_allclose(action[:, -1], 0.02, atol=1e-6)
        np.testing.assert_allclose(demo.gripper, 0.03, atol=1e-6)
        q = torch.from_numpy(np.asarray(demo.joint_position, np.float64))
        tool = robot.forward(q)
        np.testing.assert_allclose(demo.position, tool.position, atol=1e-5)
        np.testing.assert_allclose(
            np.abs((demo.orientation * tool.orientation.numpy()).sum(-1)), 1
        )


def test_a_follower_allows_for_the_delay_of_its_servos():
    site = ArmSite(driver="lerobot")
    servo = Servo(panda.ready.numpy().copy())
    leader: Any = SimpleNamespace(read=lambda: (panda.ready.numpy() + 0.01, 1.0))
    follow = record_command._follower(arm("panda"), servo, leader, site, 0.02)
    frame = follow()
    np.testing.assert_array_equal(frame["joint_position"], panda.ready)
    assert servo.widths == [site.lerobot.opening]
    assert frame["action"][-1] == site.lerobot.opening
    tool = arm("panda").forward(panda.ready)
    np.testing.assert_allclose(frame["position"], tool.position)
    np.testing.assert_allclose(frame["orientation"], tool.orientation)
