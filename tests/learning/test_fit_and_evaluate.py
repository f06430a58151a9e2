"""Fits and evaluations on small data with known answers."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.demos import DatasetWriter, Demonstration, DemonstrationSet, open_demos
from hrc_learn.dmp import JointDMP, LearnedMotion, OrientationDMP, PoseDMP
from hrc_learn.geometry import quaternion
from hrc_learn.learning import primitive_fitting
from hrc_learn.learning.fit_dashboards import shown_fit
from hrc_learn.learning.fitted_model import FittedModel
from hrc_learn.learning.model_choice import contexts, keep_best
from hrc_learn.learning.primitive_fitting import (
    EACH,
    Motions,
    fit_primitives,
    fit_streamed,
    load_primitive,
    sampled,
)


def demonstration(episode, frames=120):
    """A hand that moves and turns, further in each episode."""
    s = np.linspace(0, 1, frames)
    way = s**3 * (10 - 15 * s + 6 * s**2)
    reach = 0.2 + 0.1 * episode
    turn = torch.from_numpy(np.outer(way, [0.0, 0.3, 0.5 + 0.1 * episode]))
    return Demonstration(
        episode=episode,
        fps=60,
        time=2 * s,
        joint_names=(),
        position=np.outer(way, [reach, 0.1, -0.2]) + np.array([0.3, 0.0, 0.4]),
        orientation=quaternion.exp(turn).numpy(),
        extra={"observation.size": np.full((frames, 1), 1.5 + episode)},
    )


@pytest.fixture(scope="module")
def demos():
    # Of two lengths, so that there is something to mask.
    return DemonstrationSet([demonstration(0), demonstration(1, 100), demonstration(2)])


def test_every_kind_is_fitted_saved_and_read_back(demos, tmp_path):
    fitted = fit_primitives(demos, 25, channels=("position", "orientation", "pose"))
    fitted.save(tmp_path, each=True)
    classes = {"position": JointDMP, "orientation": OrientationDMP, "pose": PoseDMP}
    for channel, cls in classes.items():
        assert isinstance(load_primitive(tmp_path / channel, channel), cls)
        assert load_primitive(tmp_path / EACH / channel, channel).duration.shape == (3,)
    metrics = fitted.metrics()
    assert metrics["position_nrmse_max"] < 1e-3
    assert metrics["pose_turn_rmse_max"] < 0.05
    assert metrics["mean_pose_goal_error_max"] < 1e-3
    assert metrics["mean_orientation_turn_at_goal_max"] < 0.2


def test_a_kind_that_was_not_recorded_is_refused(demos):
    with pytest.raises(ValueError, match="no joint_position, which channel 'joint' needs"):
        fit_primitives(demos, 10, channels=("joint",))


@pytest.mark.parametrize("count", [0, -3])
def test_a_number_of_basis_functions_that_is_none_is_refused(demos, count):
    for channel in ("position", "orientation", "pose"):
        with pytest.raises(ValueError, match=f"at least 2 functions, got {count}"):
            fit_primitives(demos, count, channels=(channel,))


@pytest.mark.parametrize(
    ("position", "message"),
    [(np.full((40, 3), 0.3), "nothing moves"), (np.full((40, 3), np.nan), "not finite")],
)
def test_a_demonstration_that_shows_nothing_is_refused(position, message):
    still = Demonstration(
        episode=1, fps=20, time=np.arange(40) / 20, joint_names=(), position=position
    )
    shown = DemonstrationSet([demonstration(0), still])
    with pytest.raises(ValueError, match=f"episode 1: .*{message}"):
        fit_primitives(shown, 10, channels=("position",))


def test_the_number_of_basis_functions_is_chosen_by_samples_held_out(demos):
    fitted = fit_primitives(demos, None, channels=("position",), candidates=(5, 12, 20))
    assert fitted.selection is not None
    assert fitted.n_basis == fitted.selection.count
    best = fitted.selection.error.min()
    chosen = fitted.selection.candidates.index(fitted.n_basis)
    assert fitted.selection.error[chosen] <= 1.05 * best


def test_what_a_kind_cannot_do_is_named(demos, tmp_path):
    with pytest.raises(ValueError, match=r"chosen by joints or positions: give n_basis"):
        fit_primitives(demos, None, channels=("orientation",))
    fitted = fit_primitives(demos, 10, channels=("orientation",))
    with pytest.raises(ValueError, match="orientations alone cannot be shown"):
        shown_fit(fitted, "Fit")
    with pytest.raises(ValueError, match="shortest demonstration has 100 samples, too few"):
        fit_primitives(demos, None, channels=("position",), candidates=(51, 60))
    (tmp_path / "orientation").mkdir()
    with pytest.raises(FileNotFoundError, match="holds no primitive of joints, poses or"):
        FittedModel.load(tmp_path)


def test_a_stream_is_of_joints_or_positions_that_are_recorded(tmp_path):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a"]) as writer:
        writer.start_episode("reach")
        for k in range(40):
            writer.add_frame(joint_position=[0.01 * k])
        writer.save_episode()
    source = open_demos(tmp_path / "set")
    with pytest.raises(ValueError, match="'pose' cannot be streamed, only joint and position"):
        fit_streamed(source, 10, channels=("pose",))
    with pytest.raises(ValueError, match=r"set, episode 0: no position\."):
        fit_streamed(source, 10, channels=("position",))


def test_contexts_are_ends_or_columns(demos, tmp_path):
    column = ("observation.size",)
    fitted = fit_primitives(demos, 15, channels=("position",))
    ends = contexts(demos, (), fitted.motions, "position")
    assert ends.shape == (3, 6)
    np.testing.assert_allclose(ends[1, 3:], demos[1].position[-1])
    size = contexts(demos, column, fitted.motions, "position")
    assert size[:, 0].tolist() == [1.5, 2.5, 3.5]
    with pytest.raises(ValueError, match="needs 4 demonstrations or more, got 3"):
        keep_best(fitted, demos, column, tmp_path, regression_only=True)
    more = DemonstrationSet([*demos, demonstration(3), demonstration(4)])
    fitted = fit_primitives(more, 15, channels=("position",))
    metrics = keep_best(fitted, more, column, tmp_path, regression_only=True)
    # The reach is a linear function of the size, so the others tell of each.
    assert metrics["held_out_position_contextual_nrmse_median"] < 1e-2
    middle = LearnedMotion.load(tmp_path / "learned" / "position").at(context=[2.0])
    assert middle.goal[0].item() == pytest.approx(0.3 + 0.25, abs=1e-4)
    fitted = fit_primitives(more, 15, channels=("orientation",))
    with pytest.raises(ValueError, match="needs joint positions or tool positions"):
        keep_best(fitted, more, column, tmp_path, regression_only=True)
    with pytest.raises(ValueError, match=r"episode 0: no column 'observation.mass'"):
        contexts(demos, ("observation.mass",), fitted.motions, "position")


def test_errors_of_a_known_offset(demos):
    motions = Motions.of(demos)
    mask = motions.demos.mask[..., None]
    shown, turn = motions.column("position"), motions.column("orientation")
    # What stands behind the end of a demonstration must not count.
    offset = torch.tensor([0.0, 0.03, 0.0], dtype=torch.float64)
    made = torch.where(mask, shown + offset, 1e6)
    tilt = quaternion.exp(torch.tensor([math.radians(2.0), 0.0, 0.0], dtype=torch.float64))
    turned = quaternion.multiply(tilt, turn)
    error = motions.error("pose", SimpleNamespace(position=made, orientation=turned))
    columns = error.columns()
    span = torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64)
    expected = 0.03 / 3**0.5 / span
    torch.testing.assert_close(columns["nrmse"], expected, rtol=1e-9, atol=0)
    torch.testing.assert_close(columns["goal_error"], torch.full((3,), 0.03).double())
    torch.testing.assert_close(columns["turn_rmse"], torch.full((3,), 2.0).double())
    torch.testing.assert_close(columns["jerk"], torch.ones(3).double(), rtol=1e-6, atol=0)


def big_set(root, monkeypatch, episodes=11):
    """Poses on disk, of several lengths, of which three and no more fit into memory."""
    monkeypatch.setattr(primitive_fitting, "HELD_AT_ONCE", 3 * 110 * 7)
    with DatasetWriter(root, fps=60, robot_type="hand", joint_names=[]) as writer:
        for episode in range(episodes):
            demo = demonstration(episode, 90 + 10 * (episode % 3))
            assert demo.position is not None
            assert demo.orientation is not None
            writer.start_episode("reach")
            for time, position, turn in zip(
                demo.time, demo.position, demo.orientation, strict=True
            ):
                writer.add_frame(time=time, position=position, orientation=turn)
            writer.save_episode()
    return open_demos(root)


def test_a_sample_stands_for_more_than_fit_into_memory(tmp_path, monkeypatch):
    sample = sampled(big_set(tmp_path / "set", monkeypatch))
    assert [demo.episode for demo in sample] == [0, 5, 10]
    assert sample.notes[-1] == (
        "3 of 11 demonstrations, evenly spread, are used; --several streamed uses all"
    )


def test_of_demonstrations_too_long_to_hold_some_frames_are_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr(primitive_fitting, "LONGEST", 60)
    source = big_set(tmp_path / "set", monkeypatch, episodes=2)
    monkeypatch.setattr(primitive_fitting, "HELD_AT_ONCE", 60 * 7)
    (demo,) = sampled(source)
    whole = source[0]
    assert len(demo) == 60
    assert demo.duration == whole.duration
    for name in ("position", "orientation"):
        np.testing.assert_array_equal(
            getattr(demo, name)[[0, -1]], getattr(whole, name)[[0, -1]]
        )
    np.testing.assert_array_equal(np.isin(demo.time, whole.time), True)
    assert demo.fps == pytest.approx(60 * 59 / (len(whole) - 1))


def test_few_are_loaded_as_they_are(tmp_path, monkeypatch):
    source = big_set(tmp_path / "set", monkeypatch)
    monkeypatch.setattr(primitive_fitting, "HELD_AT_ONCE", 11 * 110 * 7)
    assert len(sampled(source)) == 11
    assert sampled(source).notes == source.notes
