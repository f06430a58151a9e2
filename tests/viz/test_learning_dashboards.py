"""Recordings of demonstrations, fits and rounds of learning, read again."""

from dataclasses import replace

import numpy as np
import pytest
from rrd_reading import Rrd
from sample_runs import LIMITS, NAMES, sample_fit, sample_run

from hrc_learn.viz import (
    DemonstrationsRecording,
    DemonstrationTrace,
    ErrorMap,
    LearningRecording,
)
from hrc_learn.viz.learning_dashboards import record_demonstrations, record_fit, record_learning


def shown(episode: int, steps: int, **changes) -> DemonstrationTrace:
    time = np.arange(steps) / 50
    feature = np.stack([100 + time, 200 - time], axis=-1)
    feature[3:6] = np.nan
    values = {
        "joint_position": np.sin(time[:, None] + np.arange(7) + episode),
        "position": np.stack([time, 0 * time, 0.5 + 0 * time], axis=-1),
        "feature": feature,
        "human_effort": np.ones((steps, 7)),
        "gripper": np.full(steps, 0.04),
    }
    return DemonstrationTrace(episode=episode, task="place", time=time, **(values | changes))


@pytest.fixture(scope="module")
def demos() -> DemonstrationsRecording:
    bodies = sample_run().bodies
    steps = len(bodies[0].position)
    return DemonstrationsRecording(
        title="Placing",
        joint_names=NAMES,
        demonstrations=(
            replace(shown(2, steps), bodies=bodies),
            shown(5, 90, human_effort=None, feature=None),
            shown(7, 80),
        ),
        joint_limits=LIMITS,
        notes=("position: guessed to be in m",),
    )


@pytest.fixture(scope="module")
def rrd(demos, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("rrd") / "demos.rrd"
    record_demonstrations(path, demos, most=2)
    return Rrd(path)


def test_joints_and_features_of_all_lie_over_one_another(demos, rrd):
    for demo in demos.demonstrations:
        path = f"together/joint_position_4/{demo.episode}"
        np.testing.assert_array_equal(rrd.scalars(path)[:, 0], demo.joint_position[:, 4])
        np.testing.assert_allclose(rrd.time(path), demo.time, atol=1e-9)
    v = rrd.scalars("together/feature_1/7")[:, 0]
    np.testing.assert_array_equal(v, demos.demonstrations[2].feature[:, 1])
    assert "together/feature_1/5" not in rrd.entities
    np.testing.assert_array_equal(rrd.scalars("together/limits_0")[0], [-2.9, 2.9])


def test_the_first_have_tabs_with_what_was_recorded(demos, rrd):
    first = demos.demonstrations[0]
    np.testing.assert_array_equal(rrd.scalars("episode_2/effort"), first.human_effort)
    np.testing.assert_array_equal(rrd.scalars("episode_2/gripper")[:, 0], first.gripper)
    alone = {entity for entity in rrd.entities if entity.startswith("episode_")}
    both = {f"episode_{k}/{name}" for k in (2, 5) for name in ("joints", "position", "gripper")}
    assert alone == both | {"episode_2/feature", "episode_2/effort"}


def test_paths_are_drawn_and_the_arm_moves(demos, rrd):
    for demo in demos.demonstrations:
        ((strip,),) = rrd.column(
            f"world/paths/{demo.episode}", "LineStrips3D:strips", static=True
        )
        np.testing.assert_allclose(strip, demo.position, atol=1e-6)
        last = rrd.column(f"world/now/{demo.episode}", "Points3D:positions")[-1]
        np.testing.assert_allclose(last[0], demo.position[-1], atol=1e-6)
    moved = np.array(rrd.column("world/bodies/hand", "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(
        moved[-1], demos.demonstrations[0].bodies[0].position[-1], atol=1e-6
    )


def test_the_summary_lists_them(rrd):
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    assert "| 5 | place | 1.78 | 90 | 1.78 |" in text
    assert "- position: guessed to be in m" in text


def test_other_robots_and_little_that_was_recorded_do_too(tmp_path):
    bare = dict.fromkeys(("position", "feature", "human_effort", "gripper"))
    one = DemonstrationsRecording(
        title="", joint_names=NAMES, demonstrations=(shown(0, 20, **bare),)
    )
    record_demonstrations(tmp_path / "bare.rrd", one)
    rrd = Rrd(tmp_path / "bare.rrd")
    assert not {e for e in rrd.entities if e.startswith(("world/", "together/limits"))}
    assert "episode_0/joints" in rrd.entities


def test_what_cannot_be_shown_is_refused():
    torn = shown(3, 20)
    # Set afterwards, since the checks of array shapes in tests would speak first.
    object.__setattr__(torn, "gripper", np.zeros(4))
    with pytest.raises(ValueError, match="time has 20 samples, but episode 3: gripper has 4"):
        torn.__post_init__()
    with pytest.raises(ValueError, match="must not be empty"):
        DemonstrationsRecording(title="", joint_names=NAMES, demonstrations=())


def test_demonstrations_and_reproductions_are_recorded(tmp_path):
    fit = sample_fit()
    record_fit(tmp_path / "fit.rrd", fit)
    rrd = Rrd(tmp_path / "fit.rrd")
    assert rrd.blueprints == 1
    for i, time in enumerate(fit.time):
        for j, name in enumerate(NAMES):
            root = f"demonstration_{i + 1}/{name}"
            demo, done = rrd.scalars(f"{root}/demonstration"), rrd.scalars(f"{root}/position")
            np.testing.assert_array_equal(demo[:, 0], fit.demos[i][:, j])
            np.testing.assert_array_equal(done[:, 0], fit.reproductions[i][:, j])
            np.testing.assert_allclose(rrd.time(f"{root}/position"), time, atol=1e-9)
        error = rrd.scalars(f"demonstration_{i + 1}/error")
        np.testing.assert_allclose(error, 1.0, atol=1e-9)  # 1 mrad everywhere
    (strips,) = rrd.column("world/demonstrations", "LineStrips3D:strips", static=True)
    assert [len(strip) for strip in strips] == [len(path) for path in fit.demo_paths]


def test_the_summary_lists_every_residual(tmp_path):
    record_fit(tmp_path / "fit.rrd", sample_fit())
    ((text,),) = Rrd(tmp_path / "fit.rrd").column("summary", "TextDocument:text", static=True)
    for line in ("# Placing", "| 50 (used) | 0.0001 |", "| 10 | 0.01 |", "| 2 | 3.00 | 1 |"):
        assert line in text.splitlines()


@pytest.mark.parametrize("most", [1, 2, 10])
def test_only_the_first_demonstrations_get_a_tab(tmp_path, most):
    record_fit(tmp_path / "fit.rrd", sample_fit(), most=most)
    entities = Rrd(tmp_path / "fit.rrd").entities
    shown = {e.split("/")[0] for e in entities if e.startswith("demonstration_")}
    assert len(shown) == min(most, 3)


def test_a_fit_of_an_unknown_robot_has_no_paths(tmp_path):
    fit = sample_fit(demo_paths=(), reproduction_paths=(), joint_limits=None, residual={})
    record_fit(tmp_path / "fit.rrd", fit)
    entities = Rrd(tmp_path / "fit.rrd").entities
    assert not {e for e in entities if e.startswith("world/")}
    assert not {e for e in entities if e.endswith("/limits")}


ROUNDS, NEURONS = 4, 3
ERROR, WIDTH = "Error on demonstrations held out [px]", "Width of the neurons [m]"


def learning(**changes) -> LearningRecording:
    rng = np.random.default_rng(0)
    given = {
        "title": "Image Jacobian",
        "measured": {"held_out_error_px": 0.25},
        "curves": {ERROR: np.array([0.5, 0.3, 0.2, 0.4]), WIDTH: np.linspace(0.1, 0.2, ROUNDS)},
        "best": 2,
        "centers": rng.normal(size=(ROUNDS, NEURONS, 3)),
        "paths": (rng.normal(size=(50, 3)), rng.normal(size=(2000, 3))),
        "errors": ErrorMap(
            x=np.array([0.0, 0.1, 0.3]),
            y=np.array([0.4, 0.5]),
            z=0.15,
            relative_error=np.array([[0.05], [np.nan]]),
        ),
    }
    return LearningRecording(**given | changes)


def recorded(tmp_path, **changes) -> Rrd:
    record_learning(tmp_path / "fit.rrd", learning(**changes))
    return Rrd(tmp_path / "fit.rrd")


def test_every_round_is_one_step_and_the_one_kept_is_marked(tmp_path):
    rrd = recorded(tmp_path)
    assert rrd.blueprints == 1
    error = "learning/Error_on_demonstrations_held_out_px"
    np.testing.assert_array_equal(rrd.scalars(error)[:, 0], [0.5, 0.3, 0.2, 0.4])
    np.testing.assert_array_equal(rrd.scalars(f"{error}/kept"), [[0.2]])
    assert rrd.column(error, "round") == [0, 1, 2, 3]
    assert rrd.column(f"{error}/kept", "round") == [2]
    np.testing.assert_allclose(
        rrd.scalars("learning/Width_of_the_neurons_m")[:, 0], np.linspace(0.1, 0.2, ROUNDS)
    )


def test_neurons_are_followed_from_round_to_round(tmp_path):
    positions = recorded(tmp_path).column("world/neurons", "Points3D:positions")
    np.testing.assert_allclose(positions, learning().centers, atol=1e-6)


def test_cells_say_their_error_in_percent_and_empty_ones_are_left_out(tmp_path):
    rrd = recorded(tmp_path)
    assert rrd.column("world/errors", "Boxes3D:labels", static=True) == [["5.0 %"]]
    ((centre,),) = rrd.column("world/errors", "Boxes3D:centers", static=True)
    np.testing.assert_allclose(centre, [0.05, 0.45, 0.15], atol=1e-6)
    ((half_size,),) = rrd.column("world/errors", "Boxes3D:half_sizes", static=True)
    np.testing.assert_allclose(half_size[:2], [0.05, 0.05], atol=1e-6)


def test_the_summary_says_what_was_kept_and_measured(tmp_path):
    ((text,),) = recorded(tmp_path).column("summary", "TextDocument:text", static=True)
    assert "Round 2 of 3 was kept" in text
    assert "| held out error px | 0.25 |" in text.splitlines()


def test_a_fit_without_rounds_shows_where_it_errs(tmp_path):
    rrd = recorded(tmp_path, curves={}, best=0, centers=np.zeros((1, 0, 3)))
    assert "world/errors" in rrd.entities
    assert not {e for e in rrd.entities if e.startswith(("learning", "world/neurons"))}
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    assert "Round" not in text


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"curves": {"short": np.zeros(3)}}, "'short' has 3 values"),
        ({"best": 4}, "one of the 4 rounds, but is 4"),
        ({"best": -1}, "one of the 4 rounds"),
    ],
)
def test_rounds_that_do_not_agree_are_refused(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        learning(**changes)
