"""Limits for smoothing, of small datasets on disk, against loops over their differences."""

import itertools
import json

import numpy as np
import pytest

from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.lerobot.action_limits import demonstrated_limits
from hrc_learn.lerobot.panda_robot import JOINTS

FPS = 20.0


def write(folder, episodes, names=("a", "b", "c")):
    """A dataset of a robot that was sent along paths, (frames, values) each."""
    with DatasetWriter(folder, fps=FPS, robot_type="point", joint_names=names) as writer:
        for path in episodes:
            writer.start_episode("move")
            for row in path:
                writer.add_frame(joint_position=row[::-1], command_position=row)
            writer.save_episode()
    return folder


def describe_anew(folder, change):
    """Change the features that the dataset declares."""
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    change(info["features"])
    file.write_text(json.dumps(info))


def paths(width=3, frames=(70, 4, 60), seed=0):
    """Walks that start far apart: a step from one to the next would be the largest."""
    rng = np.random.default_rng(seed)
    scale = np.linspace(1, 3, width)
    walks = [scale * rng.normal(size=(n, width)).cumsum(0) / 10 for n in frames]
    # As exact as a dataset keeps them.
    return [(walk + 100 * k).astype(np.float32).astype(float) for k, walk in enumerate(walks)]


def largest(episodes, order):
    """The 99.9th percentile of the absolute differences, linearly between the two nearest."""
    columns = []
    for j in range(episodes[0].shape[1]):
        found = []
        for x in (e[:, j].tolist() for e in episodes):
            for _ in range(order):
                x = [(b - a) * FPS for a, b in itertools.pairwise(x)]
            found += [abs(value) for value in x]
        found.sort()
        at = 0.999 * (len(found) - 1)
        low = int(at)
        high = min(low + 1, len(found) - 1)
        columns.append(found[low] + (at - low) * (found[high] - found[low]))
    return columns


@pytest.mark.parametrize("share", [None, 0.5])
def test_limits_are_what_was_demonstrated_within_episodes(tmp_path, share):
    shown = paths()
    dataset = write(tmp_path / "set", shown)
    limits = demonstrated_limits(dataset, **({} if share is None else {"share": share}))
    for name, order in (("velocity", 1), ("acceleration", 2), ("jerk", 3)):
        expected = [(share or 1.0) * value for value in largest(shown, order)]
        assert getattr(limits, name) == pytest.approx(expected, rel=1e-9)
    assert limits.names == ["a.pos", "b.pos", "c.pos"]
    assert limits.fps == FPS
    assert limits.state_columns == [0, 1, 2]
    assert limits.lower == limits.upper == [None, None, None]


def test_what_holds_still_has_a_thousandth_of_the_largest_limit(tmp_path):
    shown = paths()
    for path in shown:
        path[:, 1] = 0.25
    limits = demonstrated_limits(write(tmp_path / "set", shown))
    for values in (limits.velocity, limits.acceleration, limits.jerk):
        assert values[1] == pytest.approx(max(values) / 1000)


def test_joints_of_the_panda_have_its_limits(tmp_path):
    dataset = write(tmp_path / "set", paths(7), panda.joint_names)
    limits = demonstrated_limits(dataset)
    assert limits.names == list(JOINTS)
    assert limits.lower == panda.limits.lower.tolist()
    assert limits.upper == panda.limits.upper.tolist()


def test_names_may_be_missing_or_grouped(tmp_path):
    dataset = write(tmp_path / "set", paths())
    describe_anew(dataset, lambda f: f["action"].update(names={"motors": ["x", "y", "z"]}))
    limits = demonstrated_limits(dataset)
    assert limits.names == ["x", "y", "z"]
    assert limits.state_columns == [-1, -1, -1]
    for feature in ("action", "observation.state"):
        describe_anew(dataset, lambda f, feature=feature: f[feature].update(names=None))
    limits = demonstrated_limits(dataset)
    assert limits.names == ["action.0", "action.1", "action.2"]
    describe_anew(dataset, lambda f: f.pop("observation.state"))
    assert demonstrated_limits(dataset).state_columns == [-1, -1, -1]


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        ([np.zeros((9, 2))], "hold still"),
        ([np.arange(18.0).reshape(9, 2)], "hold still"),  # no acceleration either
        ([np.arange(6.0).reshape(3, 2) ** 2], "too short"),
    ],
)
def test_what_shows_no_motion_is_refused(tmp_path, shown, message):
    with pytest.raises(ValueError, match=message):
        demonstrated_limits(write(tmp_path / "set", shown, ("a", "b")))


def test_a_dataset_without_actions_is_refused(tmp_path):
    dataset = write(tmp_path / "set", paths())
    describe_anew(dataset, lambda f: f.pop("action"))
    with pytest.raises(ValueError, match="has no actions"):
        demonstrated_limits(dataset)
