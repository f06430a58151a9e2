"""Demonstrations keep their arrays consistent, alone and stacked."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetError, Demonstration, DemonstrationSet

NAMES = ("a", "b", "c")


def demonstration(frames=5, **changed) -> Demonstration:
    values = np.arange(3.0 * frames).reshape(frames, 3)
    recorded = {
        "time": 0.1 * np.arange(frames),
        "joint_position": values,
        "human_effort": -values,
        "position": 2 * values,
        "joint_names": NAMES,
        "fps": 10,
    }
    return Demonstration(**recorded | changed)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"time": np.zeros(0)}, "at least one frame"),
        ({"joint_position": np.zeros((4, 3))}, "joint_position has 4 frames, but time has 5"),
        ({"joint_position": np.zeros((5, 2))}, r"expected \(5, 3\) for the joints a, b, c"),
        ({"orientation": np.zeros((5, 3))}, r"orientation has shape \(5, 3\)"),
        ({"time": np.array([0, 0.1, 0.1, 0.2, 0.3])}, "from 0.1 s to 0.1 s at frame 1"),
        ({"time": np.array([0, 0.1, np.nan, 0.3, 0.4])}, "from 0.1 s to nan s at frame 1"),
        ({"extra": {"force": np.zeros((4, 1))}}, "force has 4 frames, but time has 5"),
    ],
)
def test_arrays_that_contradict_each_other_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        demonstration(**changed)


def test_joints_are_selected_in_every_field_that_goes_by_joints():
    demo = demonstration().select_joints(["c", "a"])
    assert demo.joint_names == ("c", "a")
    np.testing.assert_array_equal(demo.joint_position[0], [2, 0])
    np.testing.assert_array_equal(demo.human_effort[1], [-5, -3])
    np.testing.assert_array_equal(demo.position, demonstration().position)
    with pytest.raises(DatasetError, match=r"no joint named d; .* are a, b, c"):
        demonstration().select_joints(["d"])


def test_a_demonstration_tells_what_it_holds():
    text = repr(demonstration(task="pour", episode=3))
    assert "episode 3, 'pour': 5 frames, 0.4 s; time, joint_position, position" in text


def test_a_demonstration_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        demonstration().task = "other"


@given(st.lists(st.integers(2, 20), min_size=1, max_size=5))
def test_padding_holds_the_end_and_lets_time_go_on(lengths):
    demos = DemonstrationSet([demonstration(n) for n in lengths])
    padded = demos.padded()
    assert padded.mask.sum(1).tolist() == padded.length.tolist() == lengths
    assert (padded.time.diff(dim=1) > 0).all()
    for index, demo in enumerate(demos):
        row = padded.joint_position[index]
        torch.testing.assert_close(row[: len(demo)], torch.from_numpy(demo.joint_position))
        assert (row[len(demo) :] == row[len(demo) - 1]).all()
    assert padded.orientation is None


def test_what_one_demonstration_lacks_is_not_stacked():
    padded = DemonstrationSet([demonstration(), demonstration(position=None)]).padded()
    assert padded.position is None
    assert padded.joint_position is not None


def test_a_set_slices_and_iterates_like_a_tuple():
    demos = DemonstrationSet([demonstration(n) for n in (2, 3, 4)], notes=["guessed"])
    assert [len(demo) for demo in demos] == [2, 3, 4]
    assert demos.frames == 9
    assert isinstance(demos[1:], DemonstrationSet)
    assert demos[1:].notes == ("guessed",)
    assert demos.select_joints(["b"]).joint_names == ("b",)


def test_sets_hold_one_robot():
    with pytest.raises(ValueError, match="need the same joints"):
        DemonstrationSet([demonstration(), demonstration(joint_names=("x", "y", "z"))])
    with pytest.raises(ValueError, match="no padded form"):
        DemonstrationSet([]).padded()


def test_lists_and_tensors_become_arrays():
    joints = torch.tensor([[0.0, 1.0], [0.5, 2.0]], requires_grad=True)
    with shapes_unchecked():
        demo = Demonstration(
            time=[0.0, 0.1],  # type: ignore[arg-type]
            joint_position=joints,  # type: ignore[arg-type]
            feature=[[3, 4], [5, 6]],  # type: ignore[arg-type]
            feature_visible=torch.tensor([True, False]),  # type: ignore[arg-type]
            extra={"force": [[1], [2]]},  # type: ignore[dict-item]
            joint_names=("a", "b"),
            fps=10,
        )
    assert demo.recorded == ("time", "joint_position", "feature", "feature_visible")
    np.testing.assert_array_equal(demo.feature_visible, [True, False], strict=True)
    np.testing.assert_array_equal(demo.extra["force"], [[1.0], [2.0]], strict=True)
    assert demo.joint_position is not None
    assert demo.joint_position.dtype == np.float64
    np.testing.assert_array_equal(demo.joint_position, joints.detach().numpy())
    assert demo.duration == pytest.approx(0.1)


def test_time_goes_on_by_the_last_step_or_by_one_period():
    uneven = demonstration(3, time=np.array([0.0, 0.1, 0.4]))
    padded = DemonstrationSet([uneven, demonstration(5), demonstration(1)]).padded()
    np.testing.assert_allclose(padded.time[0], [0, 0.1, 0.4, 0.7, 1.0])
    np.testing.assert_allclose(padded.time[1], np.arange(5) / 10)
    np.testing.assert_allclose(padded.time[2], np.arange(5) / 10)
    assert padded.mask[2].tolist() == [True, False, False, False, False]
    assert (padded.position[2] == padded.position[2, :1]).all()


@pytest.mark.parametrize(
    ("changed", "shape"),
    [
        ({"orientation": np.ones((5, 4))}, None),
        ({"position": np.ones((5, 2))}, r"\(5, 2\), expected \(5, 3\)"),
        ({"feature": np.ones((5, 3))}, r"\(5, 3\), expected \(5, 2\)"),
        ({"joint_velocity": np.ones((5, 4))}, r"\(5, 4\), expected \(5, 3\) for the joints"),
        ({"gripper": np.ones(5)}, None),
        ({"joint_position": None, "human_effort": None, "joint_names": ()}, None),
    ],
)
def test_fields_have_their_widths(changed, shape):
    if shape is None:
        assert len(demonstration(**changed)) == 5
        return
    with pytest.raises(ValueError, match=f"has shape {shape}"), shapes_unchecked():
        demonstration(**changed)


def test_sets_keep_their_notes_and_unit_whatever_is_done_with_them():
    demos = DemonstrationSet(
        [demonstration(n) for n in (2, 3, 4)], notes=["x"], source="set", joint_unit="1"
    )
    assert repr(demos) == "DemonstrationSet(3 demonstrations, 9 frames, joints: a, b, c)"
    assert repr(DemonstrationSet([])).endswith("0 demonstrations, 0 frames, joints: none)")
    short = demos.filter(lambda demo: len(demo) < 4)
    slow = demos.map(lambda demo: dataclasses.replace(demo, time=2 * demo.time))
    for made, lengths in ((short, [2, 3]), (slow, [2, 3, 4]), (demos[::2], [2, 4])):
        assert [len(demo) for demo in made] == lengths
        assert (made.notes, made.source, made.joint_unit) == (("x",), "set", "1")
    assert slow[1].duration == pytest.approx(0.4)
    same = demonstration()
    assert same.select_joints(NAMES) is same
