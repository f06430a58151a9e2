import numpy as np
import pytest
from sample_runs import OPTIONAL, STEPS, sample_run

from hrc_learn.viz.panels import Curves, Tab, run_tabs

FIELDS = {
    "camera": "Pixel error",
    "potentials": "Regions",
    "safety": "Safety",
    "worker_distance": "Worker",
}


def curves(tabs: list[Tab]) -> dict[str, Curves]:
    return {c.path: c for tab in tabs for plot in tab.plots for c in plot.curves}


@pytest.mark.parametrize("field", FIELDS)
def test_absent_fields_drop_their_tab(field):
    titles = [tab.title for tab in run_tabs(sample_run())]
    empty = None if field == "camera" else {}
    fewer = [tab.title for tab in run_tabs(sample_run(**{field: empty}))]
    assert FIELDS[field] in titles
    assert fewer == [title for title in titles if title != FIELDS[field]]


def test_a_bare_run_shows_its_joints():
    bare = dict.fromkeys(OPTIONAL)
    none = {name: {} for name in ("potentials", "safety", "worker_distance", "hindered")}
    (tab,) = run_tabs(sample_run(**bare, **none))
    assert tab.title == "Joints: position blue"
    assert [plot.title for plot in tab.plots] == [f"joint{i} [rad]" for i in range(1, 8)]


def test_titles_tell_what_the_colours_mean():
    titles = [tab.title for tab in run_tabs(sample_run())]
    assert "Joints: position blue, demonstration grey, limits red" in titles
    shown = [plot.title for tab in run_tabs(sample_run()) for plot in tab.plots]
    assert "∂u / linear velocity [px/m]: x blue, y orange, z green; pale: true" in shown


def test_curves_have_a_name_and_a_colour_each_and_a_path_of_their_own():
    tabs = run_tabs(sample_run())
    every = [c for tab in tabs for plot in tab.plots for c in plot.curves]
    assert len({c.path for c in every}) == len(every)
    for c in every:
        assert c.values.shape == (STEPS, len(c.names))
        assert len(c.colours) == len(c.names)


def test_all_twelve_entries_of_the_jacobian_are_shown_beside_the_truth():
    run = sample_run()
    shown = curves(run_tabs(run))
    for kind, expected in (
        ("estimate", run.image_jacobian),
        ("actual", run.true_image_jacobian),
    ):
        for row, pixel in enumerate("uv"):
            for half, columns in (("linear", slice(0, 3)), ("angular", slice(3, 6))):
                c = shown[f"image_jacobian/{pixel}_{half}/{kind}"]
                np.testing.assert_array_equal(c.values, expected[:, row, columns])
    assert shown["image_jacobian/u_linear/actual"].width > 2


def test_lengths_are_shown_in_millimetres_and_angles_in_degrees():
    shown = curves(run_tabs(sample_run()))
    assert shown["person/elbow"].values.max() == pytest.approx(100.0)
    assert shown["person/position_deviation"].values.max() == pytest.approx(0.1)
    assert shown["person/rotation_deviation"].values.max() == pytest.approx(0.01)


def test_the_distance_of_a_worker_is_shown_twice_the_second_time_from_near():
    run = sample_run()
    shown = curves(run_tabs(run))
    far, near = shown["worker/distance"], shown["worker/near"]
    assert far.names == near.names == ("true", "seen")
    np.testing.assert_allclose(far.values[:, 0], 1e3 * run.worker_distance["true"])
    close = far.values < 300
    assert 0 < close.sum() < close.size
    np.testing.assert_array_equal(near.values[close], far.values[close])
    assert np.isnan(near.values[~close]).all()


def test_names_with_blanks_and_slashes_make_plain_paths():
    values = np.zeros(STEPS)
    shown = curves(run_tabs(sample_run(safety={"limit [rad/s]": values})))
    assert "safety/limit_rad_s" in shown


def test_guards_that_never_acted_lie_at_the_bottom_of_their_plot():
    never, often = np.zeros(STEPS), np.arange(STEPS)
    tabs = run_tabs(sample_run(safety={"never": never, "often": often.astype(float)}))
    ranges = {plot.title: plot.range for plot in tabs[-1].plots}
    assert ranges["Safety filter: never"] == (-0.05, 1.05)
    assert ranges["Safety filter: often"] == pytest.approx((-9.95, 208.95))


def test_hindrances_are_lines_at_heights_of_their_own_while_they_act():
    run = sample_run()
    shown = curves(run_tabs(run))
    np.testing.assert_array_equal(shown["person/followed"].values[:, 0], run.followed)
    reasons = shown["person/hindered"]
    assert reasons.names == ("joint_limit", "person")
    for k, name in enumerate(reasons.names):
        drawn = np.isfinite(reasons.values[:, k])
        np.testing.assert_array_equal(drawn, run.hindered[name])
        assert (reasons.values[drawn, k] == k + 1).all()
