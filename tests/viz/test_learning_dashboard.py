import numpy as np
import pytest
from rrd_reading import Rrd

from hrc_learn.viz import ErrorMap, LearningRecording
from hrc_learn.viz.fit_dashboard import record_learning

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
            share=np.array([[0.05], [np.nan]]),
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
