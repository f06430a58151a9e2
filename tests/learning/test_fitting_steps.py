"""What the fits take from demonstrations: ends, sampled frames, and channels."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.kinematics import panda
from hrc_learn.learning.primitive_fitting import (
    HELD_AT_ONCE,
    LONGEST,
    Motions,
    _thinned,
    require_motion,
    sampled,
    select_channels,
)
from hrc_learn.learning.visual_servo_fitting import _end, _ends, feature_trajectories
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE

pytestmark = pytest.mark.simulation

FPS, FRAMES = 8, 20


def watched(episode=0, **more):
    """A tool that moves, seen in every frame but the last."""
    rng = np.random.default_rng(episode)
    turns = Rotation.from_rotvec(rng.normal(0, 0.5, (FRAMES, 3)))
    visible = np.arange(FRAMES) < FRAMES - 1
    given = {
        "time": np.arange(FRAMES) / FPS,
        "position": rng.normal(0, 0.1, (FRAMES, 3)),
        "orientation": turns.as_quat(scalar_first=True),
        "feature": rng.uniform(0, 500, (FRAMES, 2)),
        "feature_visible": visible,
        "extra": {
            OBJECT_FEATURE: rng.uniform(0, 500, (FRAMES, 3)),
            ANGLE_FEATURE: rng.uniform(-1, 1, (FRAMES, 2)),
        },
        "fps": FPS,
        "episode": episode,
    }
    return Demonstration(**(given | more))


def test_a_demonstration_ends_with_the_mean_of_its_last_three_tenths_of_a_second():
    demo = watched()
    end = _end(demo, "here")
    rows = slice(FRAMES - 3, FRAMES - 1)  # the last frame is not seen
    np.testing.assert_allclose(end.object_pixel, demo.extra[OBJECT_FEATURE][rows, :2].mean(0))
    np.testing.assert_allclose(end.pose.position, demo.position[rows].mean(0))
    np.testing.assert_array_equal(end.pose.orientation, demo.orientation[FRAMES - 2])
    assert end.angle == demo.extra[ANGLE_FEATURE][FRAMES - 2, 1]
    np.testing.assert_array_equal(end.path.position, demo.position)
    assert _end(replace(demo, extra={OBJECT_FEATURE: np.ones((FRAMES, 3))}), "").angle is None


def test_a_marker_that_is_not_seen_at_rest_is_refused():
    hidden = np.arange(FRAMES) < FRAMES - 3
    with pytest.raises(ValueError, match=r"here, episode 4: .* not visible in the last 0.3 s"):
        _end(watched(4, feature_visible=hidden), "here")


def test_frames_in_which_the_object_is_hidden_do_not_count():
    demo = watched()
    demo.extra[OBJECT_FEATURE][FRAMES - 2] = 0.0
    end = _end(demo, "here")
    np.testing.assert_allclose(end.object_pixel, demo.extra[OBJECT_FEATURE][FRAMES - 3, :2])
    np.testing.assert_allclose(end.pose.position, demo.position[FRAMES - 3])
    demo.extra[OBJECT_FEATURE][:, 2] = 0.0
    with pytest.raises(ValueError, match="end effector and object are not visible in the last"):
        _end(demo, "here")


def test_objects_are_seen_in_all_demonstrations_or_in_none():
    demos = DemonstrationSet([watched(0), watched(1)], source="here")
    assert [float(end.pose.position[0]) for end in _ends(demos)] == [
        float(_end(demo, "").pose.position[0]) for demo in demos
    ]
    bare = [watched(k, extra={}) for k in (2, 3)]
    assert _ends(DemonstrationSet(bare)) == []
    mixed = DemonstrationSet([watched(0), *bare], source="here")
    with pytest.raises(ValueError, match=f"here, episode 2: no {OBJECT_FEATURE}"):
        _ends(mixed)


def test_features_need_a_pose_recorded_or_of_the_joints_of_a_panda():
    q = panda.ready.numpy() + 0.1 * np.random.default_rng(0).normal(size=(FRAMES, 7))
    joints = {"joint_position": q, "joint_names": panda.joint_names}
    none = {"position": None, "orientation": None}
    (found,) = feature_trajectories(DemonstrationSet([watched(**none, **joints)]))
    np.testing.assert_allclose(found.pose.position, panda.forward(torch.from_numpy(q)).position)
    (own,) = feature_trajectories(DemonstrationSet([watched(**joints)]))
    np.testing.assert_array_equal(own.pose.position, watched().position)
    assert own.visible.tolist() == [True] * (FRAMES - 1) + [False]
    other = {"joint_position": q, "joint_names": tuple("abcdefg")}
    for wrong, missing in (
        (none | other, "position, orientation"),
        ({"orientation": None} | other, "position, orientation"),
        ({"feature": None, "feature_visible": None}, "feature, feature_visible"),
    ):
        demos = DemonstrationSet([watched(3, **wrong)], source="here")
        with pytest.raises(ValueError, match=f"here, episode 3: no {missing}\\."):
            feature_trajectories(demos)[0]


def moving(span=1.0, frames=30, episode=0, **more):
    at = np.linspace(0, 1, frames)[:, None]
    given = {
        "time": np.arange(frames) / FPS,
        "position": span * at * (0.5, 0.2, 0.1),
        "fps": FPS,
        "episode": episode,
    }
    return Demonstration(**(given | more))


def test_a_demonstration_in_which_nothing_moves_or_is_finite_is_refused():
    require_motion(moving(), "here")
    with pytest.raises(ValueError, match="here, episode 7: nothing moves"):
        require_motion(moving(0.0, episode=7), "here")
    turns = Rotation.from_rotvec([[0, 0, 0.01 * k] for k in range(30)])
    require_motion(moving(0.0, orientation=turns.as_quat(scalar_first=True)), "here")
    broken = moving()
    broken.position[3, 1] = np.nan
    with pytest.raises(ValueError, match="here, episode 0: values are not finite"):
        require_motion(broken, "here")


@pytest.mark.parametrize(("frames", "longest"), [(100, 34), (100, 100), (100, 99), (7, 2)])
def test_a_thinned_demonstration_keeps_its_ends_and_duration(frames, longest):
    demo = moving(frames=frames, extra={"mood": np.arange(frames)[:, None]})
    thin = _thinned(demo, longest)
    assert len(thin) == min(frames, longest)
    assert (thin.time[0], thin.time[-1]) == (demo.time[0], demo.time[-1])
    rows = thin.extra["mood"][:, 0].astype(int)
    np.testing.assert_array_equal(thin.position, demo.position[rows])
    step = (frames - 1) / (longest - 1)
    assert np.abs(rows - step * np.arange(longest)).max() <= 0.5
    assert (len(thin) - 1) / thin.fps == pytest.approx((frames - 1) / demo.fps)
    assert (thin is demo) == (longest == frames)


def stored(lengths, joints=7):
    """A dataset of these lengths, each demonstration as many frames."""
    demos = [moving(frames=n, episode=k) for k, n in enumerate(lengths)]

    def spread(count):
        return [demos[k] for k in np.linspace(0, len(demos) - 1, count).round().astype(int)]

    return SimpleNamespace(
        lengths=lengths,
        joint_names=("j",) * joints,
        load=lambda: DemonstrationSet(demos),
        spread=spread,
        notes=("a note",),
        source="here",
        joint_unit="1",
    )


def test_a_sample_takes_as_many_demonstrations_as_are_held_at_once(monkeypatch):
    monkeypatch.setattr("hrc_learn.learning.primitive_fitting.HELD_AT_ONCE", 4 * 30 * 7)
    whole: Any = stored([30] * 4)
    assert len(sampled(whole)) == 4
    one_more: Any = stored([30] * 5)
    found = sampled(one_more)
    assert [demo.episode for demo in found] == [0, 1, 3, 4]
    assert found.notes[0] == "a note"
    assert found.notes[1].startswith("4 of 5 demonstrations, evenly spread")
    assert "longer ones" not in found.notes[1]
    assert (found.source, found.joint_unit) == ("here", "1")
    # Longer than twice the median: thinned to 60 frames.
    long: Any = stored([30, 30, 30, 200])
    found = sampled(long)
    assert [len(demo) for demo in found] == [30, 60]
    assert "; longer ones are thinned to 60 frames; --several" in found.notes[1]
    # The widest channel has at least seven columns.
    wide: Any = stored([30] * 4, joints=8)
    assert len(sampled(wide)) == 3
    narrow: Any = stored([30] * 4, joints=2)
    assert len(sampled(narrow)) == 4
    huge: Any = stored([900])
    assert len(sampled(huge)) == 1
    assert HELD_AT_ONCE > LONGEST


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (("position",), ("position",)),
        (("position", "orientation"), ("pose",)),
        (("orientation",), ("orientation",)),
        (("position", "joint_position"), ("joint", "position")),
        (("position", "orientation", "joint_position"), ("joint", "pose")),
    ],
)
def test_channels_are_joints_and_the_whole_pose_or_its_parts(columns, expected):
    demo = watched(
        joint_position=np.random.default_rng(0).normal(size=(FRAMES, 2)), joint_names=("a", "b")
    )
    left = dict.fromkeys(("position", "orientation", "joint_position"))
    left = {name: value for name, value in left.items() if name not in columns}
    if "joint_position" in left:
        left["joint_names"] = ()
    motions = Motions.of(DemonstrationSet([replace(demo, **left)], source="here"))
    assert select_channels(motions, ()) == expected
    assert select_channels(motions, expected[:1]) == expected[:1]
    lost = {"position", "orientation"} - set(columns)
    if lost:
        message = f"here: .* have no {' and no '.join(sorted(lost, reverse=True))}, which"
        with pytest.raises(ValueError, match=message):
            select_channels(motions, ("pose",))
