"""Segments of demonstrations, where they agree, and figures of what was fitted."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hrc_learn.demos import Demonstration
from hrc_learn.geometry import Pose
from hrc_learn.learning.fitted_model import FittedModel
from hrc_learn.learning.multiply_motions import (
    Segmentation,
    _free_fraction,
    _Segment,
    find_segments,
)

pytestmark = pytest.mark.simulation

HERE = Pose(torch.zeros(2, 3).double(), torch.tensor([[1.0, 0, 0, 0]] * 2).double())


def demo(frames, episode=0, gripper=None):
    return Demonstration(
        time=np.arange(frames) / 20,
        joint_position=np.zeros((frames, 1)),
        joint_names=("hip",),
        gripper=gripper,
        fps=20,
        episode=episode,
    )


@pytest.mark.parametrize(
    ("cuts", "right"),
    [
        ((0, 6, 19), True),
        ((0, 13, 19), True),
        ((0, 5, 19), False),
        ((0, 14, 19), False),
        ((0, 6, 20), False),
        ((0, 19), False),
        ((0, 6, 12, 19), False),
        ((6, 0, 19), False),
        ((-6, 6, 19), False),
    ],
)
def test_cuts_are_six_frames_apart_within_the_demonstration(cuts, right):
    found = Segmentation(frames=("cup", "base"), cuts={3: cuts})
    if right:
        found.check([demo(20, 3)], {"cup": HERE})
    else:
        message = rf"episode 3 needs 3 cuts of 0 to 19, 6 frames or more .* \[{cuts[0]}, "
        with pytest.raises(ValueError, match=message):
            found.check([demo(20, 3)], {"cup": HERE})


def test_frames_of_segments_are_known():
    demos = [demo(20, 3)]
    for frame in ("base", "cup", "cup position"):
        Segmentation(frames=(frame,), cuts={3: (0, 19)}).check(demos, {"cup": HERE})
    for frame in ("lid", "cup place"):
        wrong = Segmentation(frames=(frame,), cuts={3: (0, 19)})
        with pytest.raises(ValueError, match=rf"no frame '{frame}'; there are base, cup"):
            wrong.check(demos, {"cup": HERE})
    with pytest.raises(ValueError, match=r"episode 3 needs 2 cuts of 0 to 19, .* has \[\]"):
        Segmentation(frames=("base",), cuts={4: (0, 19)}).check(demos, {})
    for cuts in ((), (19,), (0, 19)):
        with pytest.raises(ValueError, match=r"no frame ''; there are base"):
            Segmentation(frames=(), cuts={3: cuts}).check(demos, {})


def still(frames, place):
    return Pose(
        torch.tensor(place).double().expand(frames, 3),
        torch.tensor([1.0, 0, 0, 0]).double().expand(frames, 4),
    )


def test_each_segment_has_the_frame_in_which_its_ends_agree():
    """First at the cup, where the gripper closes, then at the same place of the base."""
    cups = torch.tensor([[0.1, 0.2, 0.0], [0.4, -0.3, 0.0]]).double()
    objects = {"cup": Pose(cups, HERE.orientation)}
    demos, tools = [], []
    for episode, (cup, closes) in enumerate(zip(cups, (15, 20), strict=True)):
        gripper = np.where(np.arange(40) > closes, 0.0, 0.08)
        demos.append(demo(40, episode, gripper))
        at = cup + torch.tensor([0.0, 0.0, 0.1])
        end = torch.tensor([0.6, 0.0, 0.3]).double()
        rows = [at.expand(closes + 1, 3), end.expand(39 - closes, 3)]
        tools.append(Pose(torch.cat(rows), still(40, [0.0] * 3).orientation))
    found = find_segments(demos, objects, tools)
    assert found == Segmentation(frames=("cup", "base"), cuts={0: (0, 15, 39), 1: (0, 20, 39)})
    # The range of the gripper is that of all demonstrations: one that stays open has no cut.
    open_ = demo(40, 1, np.full(40, 0.08))
    with pytest.raises(ValueError, match=r"differ .* \(episode 0: 1, episode 1: 0\)"):
        find_segments([demos[0], open_], objects, tools)
    for shorter in ([demo(6, 5)], [demos[0], demo(6, 5)]):
        with pytest.raises(ValueError, match=r"episode 5 has 6 frames, but .* needs 7 or more"):
            find_segments(shorter, objects, tools)
    assert find_segments([demo(7, 5)] * 2, objects, tools).cuts == {5: (0, 6)}
    whole = find_segments([demo(30, 7), demo(30, 8)], objects, [tools[0], tools[1]])
    assert whole.cuts == {7: (0, 29), 8: (0, 29)}


@pytest.mark.parametrize(
    ("until", "spread", "rest", "expected"),
    [
        (0.5, 0.1, 0.0, 0.5),
        (0.8, 0.1, 0.0, 0.8),
        (0.1, 0.1, 0.0, 0.2),  # at least a fifth
        (1.0, 0.1, 0.0, 1.0),
        (0.5, 0.0, 0.0, 0.6),  # all start at one place
        (0.5, 9e-4, 0.0, 0.6),  # up to the tremor of a hand
        (0.5, 0.1, 0.02, 0.5),  # the spread at the end is what remains
    ],
)
def test_a_segment_is_free_until_its_demonstrations_agree(until, spread, rest, expected):
    """Up to a twentieth of their first spread, or that at their end, and 1 mm."""
    duration = torch.tensor([1.0, 2.0]).double()

    def rollout(time):
        s = time / duration[:, None]
        apart = torch.where(s < until, spread, rest) / 2**0.5
        signs = torch.tensor([1.0, -1.0])[:, None]
        offset = torch.stack([signs * apart, signs * apart, 0 * apart], -1)
        return SimpleNamespace(position=offset + torch.stack([s, 2 * s, s], -1))

    dmp: Any = SimpleNamespace(duration=duration, rollout=rollout)
    assert _free_fraction(dmp) == pytest.approx(expected, abs=1.01 / 49)


def test_a_gradual_approach_is_free_until_a_twentieth_is_left():
    def rollout(time):
        apart = 0.2 * (1 - time) * torch.tensor([1.0, -1.0])[:, None]
        return SimpleNamespace(position=torch.stack([apart, 0 * apart, 0 * apart], -1))

    dmp: Any = SimpleNamespace(duration=torch.ones(2).double(), rollout=rollout)
    # 0.05 of the spread 0.2, and the tremor.
    assert _free_fraction(dmp) == pytest.approx(1 - 0.05 - 0.005, abs=1 / 49)


def test_the_span_of_a_segment_is_its_first_frame_and_further_frames():
    dmp: Any = None
    first, last = torch.tensor([[0.0, 3.0, 5.0], [10.0, 9.0, 25.0]]).double()
    segment = _Segment(frame="base", dmp=dmp, first=first, last=last)
    found = segment.span(torch.tensor([2, 0]))
    assert found.tolist() == [[[5], [0]], [[20], [10]]]


def model_of(**primitives):
    folder: Any = "model"
    return FittedModel(folder=folder, primitives=primitives)


def joints(count, names=None, units="rad"):
    given: Any = SimpleNamespace(start=torch.zeros(count), joint_names=names, units=units)
    return given


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("1 2 3", {"position": [1, 2, 3]}),
        ("position 1 2 3", {"position": [1, 2, 3]}),
        ("1 2", {"joints": [1, 2]}),
        ("joints 1 2", {"joints": [1, 2]}),
        ("1 2 3 0 1.01 0 0", {"position": [1, 2, 3], "orientation": [0, 1, 0, 0]}),
    ],
)
def test_targets_differ_by_their_numbers(words, expected):
    found = model_of(joint=joints(2)).target(words.split(), "--goal")
    for name in ("joints", "position", "orientation"):
        value = getattr(found, name)
        assert (None if value is None else value.tolist()) == expected.get(name)


@pytest.mark.parametrize(
    ("count", "words", "message"),
    [
        (3, "1 2 3", "3 numbers may be joints or position: write --goal joints or"),
        (7, "1 2 3 1 0 0 0", "7 numbers may be joints or pose"),
        (2, "1 2 3 4", r"accepts 2 numbers \(joints\), 3 numbers \(position\), 7 numbers"),
        (2, "joints 1 2 3", "accepts 2 numbers"),
        (2, "1 x", "accepts 2 numbers"),
        (2, "1 nan", "all finite"),
        (2, "1 2 3 1.021 0 0 0", r"norm of w x y z is 1\.021"),
        (2, "1 2 3 0.979 0 0 0", r"norm of w x y z is 0\.979"),
        (0, "joints", "accepts 3 numbers"),
    ],
)
def test_words_that_are_no_target_are_refused(count, words, message):
    model = model_of(joint=joints(count)) if count else model_of()
    with pytest.raises(ValueError, match=message):
        model.target(words.split(), "--goal")


def test_joints_of_an_arm_are_found_by_their_names_and_units():
    robot: Any = SimpleNamespace(chain=SimpleNamespace(joint_names=("hip", "knee", "toe")))
    model = model_of(joint=joints(3, ["toe.pos", "hip.pos", "knee.pos"], "deg"))
    assert model.joint_names == ("toe", "hip", "knee")
    values = torch.tensor([[30.0, 10.0, 20.0]]).double()
    found = model.in_rad(robot, values)
    np.testing.assert_allclose(found, np.radians([[10.0, 20.0, 30.0]]))
    np.testing.assert_allclose(model.from_rad(robot, found), values)
    rad = model_of(joint=joints(3, ["hip", "knee", "toe"]))
    assert torch.equal(rad.in_rad(robot, values), values)
    for unit, shown in (("1", "fractions of their ranges"), ("tick", "'tick'")):
        wrong = model_of(joint=joints(3, ["hip", "knee", "toe"], unit))
        with pytest.raises(ValueError, match=shown):
            wrong.in_rad(robot, values)
    assert model_of(joint=joints(2)).joint_names == ("joint1", "joint2")
    assert model_of().joint_names == ()
