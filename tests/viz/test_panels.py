import numpy as np
import pytest
from sample_runs import OPTIONAL, STEPS, sample_run

from hrc_learn.log import JointRanges
from hrc_learn.viz.panels import Curves, Tab, joint_plot, run_tabs

FIELDS = {"camera": "Servoing", "potentials": "Lyapunov"}


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
    assert tab.title == "Joints"
    assert [plot.title for plot in tab.plots] == [f"joint{i} [rad]" for i in range(1, 8)]


def test_the_story_tab_comes_first():
    titles = [tab.title for tab in run_tabs(sample_run())]
    details = ["Servoing", "Person", "Worker", "Primitive", "Safety", "Lyapunov"]
    assert titles == ["Story", *details]


def test_legends_name_each_curve():
    tabs = {tab.title: tab for tab in run_tabs(sample_run())}
    for tab in tabs.values():
        for plot in tab.plots:
            several = len({name for c in plot.curves for name in c.names}) > 1
            several |= any(c.marks for c in plot.curves)
            # The joints' plots are small: the first has the legend of all.
            small = tab.title == "Primitive" and plot is not tab.plots[0]
            assert plot.legend == (several and not small), plot.title
    first = {name for c in tabs["Primitive"].plots[0].curves for name in c.names}
    assert first == {"position", "demonstration", "lower limit", "upper limit"}


def test_the_story_shows_one_plot_of_each_topic():
    story, *others = run_tabs(sample_run())
    assert [plot.curves[0].path for plot in story.plots] == [
        "camera/error",
        "person/effort_norm",
        "person/position_deviation",
        "worker/distance",
    ]
    details, overview = curves(others), curves([story])
    # One curve for all joints: the plot is too low for a legend of seven.
    norm = np.linalg.norm(details["person/effort"].values, axis=1)
    np.testing.assert_array_equal(overview.pop("person/effort_norm").values[:, 0], norm)
    for path, shown in overview.items():
        np.testing.assert_array_equal(shown.values, details[path].values)
    bare = sample_run(camera=None, nullspace_input=None, position_deviation=None)
    (plot,) = run_tabs(bare)[0].plots
    assert plot.title == "Worker's distance from robot and load [mm]"


def test_each_curve_has_a_name_a_colour_and_a_path():
    _, *tabs = run_tabs(sample_run())
    every = [c for tab in tabs for plot in tab.plots for c in plot.curves]
    paths = [c.path for c in every]
    assert {path for path in paths if paths.count(path) > 1} == {"camera/error"}  # enlarged
    for c in every:
        assert c.values.shape == (STEPS, len(c.names))
        assert len(c.colours) == len(c.names)


def test_all_twelve_entries_of_the_jacobian_are_shown_with_the_true_ones():
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


def test_the_distance_of_a_worker_is_shown_as_a_whole_and_enlarged():
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
    shown = curves(run_tabs(sample_run(potentials={"box [m/s]": values})))
    assert "regions/box_m_s" in shown


def test_joints_named_with_blanks_and_slashes_have_plain_paths():
    values = np.zeros((5, 1))
    limits = JointRanges(lower=-np.ones(1), upper=np.ones(1))
    plot = joint_plot("joints", "wrist 1/a", 0, values, values, limits)
    assert plot.title == "wrist 1/a [rad]"
    paths = [curves.path for curves in plot.curves]
    assert paths == [f"joints/wrist_1_a/{x}" for x in ("limits", "demonstration", "position")]


def test_joints_at_their_limits_are_at_the_edges_of_the_bands():
    limits = JointRanges(
        lower=np.array([-1.0, 0.0]), upper=np.array([1.0, 4.0]), velocity=np.array([2.0, 0.5])
    )
    position = np.tile([-1.0, 3.0], (STEPS, 1))
    velocity = np.tile([1.0, -0.5], (STEPS, 1))
    run = sample_run(
        joint_names=("a", "b"),
        joint_limits=limits,
        joint_position=position,
        joint_velocity=velocity,
        demo_joint_position=None,
        nullspace_input=None,
    )
    shown = curves(run_tabs(run))
    np.testing.assert_allclose(shown["safety/position/joints"].values[7], [-1.0, 0.5])
    np.testing.assert_allclose(shown["safety/velocity/joints"].values[7], [0.5, -1.0])
    np.testing.assert_array_equal(shown["safety/velocity/limits"].values[7], [-1.0, 1.0])


def test_each_guard_has_its_own_row_of_marks():
    often = np.arange(STEPS) % 3
    run = sample_run(safety={"never": np.zeros(STEPS), "often_so": often, "at_once": often > 1})
    marks = curves(run_tabs(run))["safety/acted"]
    assert marks.names == ("1 never", "2 often so", "3 at once")
    assert np.isnan(marks.values[:, 0]).all()
    for k, acted in ((1, often > 0), (2, often > 1)):
        np.testing.assert_array_equal(np.isfinite(marks.values[:, k]), acted)
        assert (marks.values[acted, k] == k + 1).all()


def test_each_hindrance_has_its_own_row():
    run = sample_run()
    shown = curves(run_tabs(run))
    np.testing.assert_array_equal(shown["person/followed"].values[:, 0], run.followed)
    reasons = shown["person/hindered"]
    assert reasons.names == ("1 joint limit", "2 person")
    for k, name in enumerate(run.hindered):
        drawn = np.isfinite(reasons.values[:, k])
        np.testing.assert_array_equal(drawn, run.hindered[name])
        assert (reasons.values[drawn, k] == k + 1).all()


def test_rows_have_space_above_and_below():
    run = sample_run(safety=dict.fromkeys(("one", "two", "three"), np.ones(STEPS)))
    plots = [plot for tab in run_tabs(run) for plot in tab.plots if plot.rows]
    assert {len(plot.curves[0].names): plot.range for plot in plots}[3] == (0.0, 4.0)
    assert all(plot.range == (0.0, len(plot.curves[0].names) + 1.0) for plot in plots)


def test_the_many_plots_of_the_person_stand_in_two_columns():
    columns = {tab.title: tab.columns for tab in run_tabs(sample_run())}
    assert (columns["Person"], columns["Worker"]) == (2, 1)


def test_the_last_pixels_of_the_servoing_error_have_a_plot_of_their_own():
    (servoing,) = (tab for tab in run_tabs(sample_run()) if tab.title == "Servoing")
    whole, last = (p for p in servoing.plots if p.curves[0].path == "camera/error")
    assert (whole.range, last.range) == (None, (0.0, 5.0))
    assert "5 px" in last.title


def test_a_finished_run_has_no_curves_without_a_value():
    often, nothing = np.arange(STEPS) % 2, np.full(STEPS, np.nan)
    run = sample_run(
        safety={"never": np.zeros(STEPS), "often": often, "once": often},
        potentials={"x": nothing},
        potential_rate=None,
    )
    going_on, over = run_tabs(run), run_tabs(run, finished=True)
    assert [tab.title for tab in over] == [t.title for t in going_on if t.title != "Lyapunov"]
    all_, seen = (curves(tabs)["safety/acted"] for tabs in (going_on, over))
    assert seen.names == ("2 often", "3 once")  # the numbers are those of the rows
    assert seen.colours == all_.colours[1:]
    np.testing.assert_array_equal(seen.values, all_.values[:, 1:])
