from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image
from sample_runs import sample_run
from unchecked import shapes_unchecked

from hrc_learn.experiments import run_report
from hrc_learn.experiments.run_report import (
    image_jacobian_figure,
    marker_figure,
    person_figure,
    placing_joints_figure,
    placing_paths_figure,
    run_sections,
    timeline_figure,
    trajectories_figure,
)
from hrc_learn.kinematics import panda
from hrc_learn.log import Event
from hrc_learn.sim.workplace import Workplace
from hrc_learn.viz import palette

OBJECTS = {"box": (0.0, 2.0), "tin": (2.0, 4.0)}
PHASES = ("detect", "servo", "transfer", "release")


@pytest.fixture(scope="module")
def run():
    times = np.concatenate([start + np.array([0.0, 0.4, 1.0, 1.7]) for start in (0.0, 2.0)])
    events = tuple(Event(float(t), text) for t, text in zip(times, PHASES * 2, strict=True))
    return sample_run(phases=events)


@pytest.mark.parametrize("draw", [trajectories_figure, marker_figure, timeline_figure])
def test_figures_are_drawn(run, draw):
    buffer = BytesIO()
    draw(run, OBJECTS).savefig(buffer, format="png", dpi=60)
    assert np.asarray(Image.open(buffer).convert("L")).std() > 10


def test_each_object_is_carried_along_its_own_path(run):
    axes = trajectories_figure(run, OBJECTS).axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert {"demonstration", "carried: box", "carried: tin"} <= lines.keys()
    x, _, _ = lines["carried: tin"].get_data_3d()
    carried = (run.time >= 3.0) & (run.time < run.time[-1])  # the last phase ends there
    np.testing.assert_array_equal(x, run.position[carried, 0])


def test_the_marker_is_shaded_where_it_is_wanted_and_not_seen(run):
    _, error = marker_figure(run, OBJECTS).axes
    (spell,) = [patch for patch in error.patches if patch.get_alpha() == 0.25]
    low, high = spell.get_extents().transformed(error.transData.inverted()).intervalx
    assert (low, high) == pytest.approx((run.time[50], run.time[59]))


def test_the_timeline_has_a_row_for_each_phase_and_for_people(run):
    axes = timeline_figure(run, OBJECTS).axes[0]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == [*PHASES, "person pushes", "marker occluded"]


def test_runs_without_a_camera_are_refused_where_it_is_needed(run):
    with pytest.raises(ValueError, match="needs the camera"):
        marker_figure(replace(run, camera=None), OBJECTS)


def test_figures_of_a_job_that_never_saw_its_marker_are_drawn_all_the_same(run):
    unknown = np.full_like(run.camera.feature, np.nan)
    blind = replace(
        run,
        camera=replace(
            run.camera, feature=unknown, target=unknown, images=(), image_time=np.empty(0)
        ),
        nullspace_input=np.zeros_like(run.nullspace_input),
        demo_path=None,
    )
    for draw in (trajectories_figure, marker_figure, timeline_figure):
        draw(blind, {"box": (0.0, 4.0)})


def bars(axes):
    """Row, beginning, end and colour of each bar of a timeline."""
    found = []
    for group in axes.collections:
        colour = to_hex(group.get_facecolor()[0]).upper()
        for path in group.get_paths():
            (left, low), (right, high) = path.vertices.min(axis=0), path.vertices.max(axis=0)
            assert high - low == pytest.approx(0.76)
            found.append(((low + high) / 2, left, right, colour))
    return found


def test_bars_of_the_timeline_show_phases_by_object_pushes_and_occlusions(run):
    events = (
        Event(0.0, "home"),
        Event(0.1, "servo"),  # short, and drawn wide enough to be seen
        Event(0.15, "transfer"),
        Event(2.0, "servo"),
        Event(2.0, "nothing"),  # of no length
        Event(2.0, "transfer"),
        Event(3.5, "home"),
    )
    objects = {"box": (0.1, 2.0), "tin": (2.0, 3.5)}
    figure = timeline_figure(replace(run, phases=events), objects)
    (axes,) = figure.axes
    rows = [label.get_text() for label in axes.get_yticklabels()]
    assert rows == ["home", "servo", "transfer", "person pushes", "marker occluded"]
    first, second = (colour.upper() for colour in palette.SERIES[:2])
    expected = [
        (0, 0.0, 0.15, palette.GREY.upper()),
        (1, 0.1, 0.25, first),
        (2, 0.15, 2.0, first),
        (2, 2.0, 3.5, second),
        (0, 3.5, run.time[-1], palette.GREY.upper()),
        (3, run.time[80], run.time[119], palette.PURPLE.upper()),
        (4, run.time[50], run.time[59], "#8D8F94"),
    ]
    found = bars(axes)
    assert len(found) == len(expected)
    for bar, wanted in zip(found, expected, strict=True):
        assert bar[:3] == pytest.approx(wanted[:3], abs=1e-9)
        assert bar[3] == wanted[3]
    assert axes.get_xlim() == (run.time[0], run.time[-1])
    bottom, top = axes.get_ylim()
    assert bottom > top  # the first phase is the upper row
    assert tuple(figure.get_size_inches()) == pytest.approx((7.2, 0.9 + 0.26 * 5))
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["box", "tin"]


def test_a_marker_is_drawn_from_where_it_was_first_seen_to_its_last_target(run):
    image, error = marker_figure(run, OBJECTS).axes
    camera = run.camera
    lines = image.get_lines()
    for k, (name, span) in enumerate(OBJECTS.items()):
        rows = (run.time >= span[0]) & (run.time < span[1])
        seen = rows & np.isfinite(camera.feature).all(axis=1)
        path, first, target = lines[3 * k : 3 * k + 3]
        assert path.get_label() == name
        np.testing.assert_array_equal(path.get_xydata(), camera.feature[seen])
        np.testing.assert_array_equal(first.get_xydata(), camera.feature[seen][:1])
        np.testing.assert_array_equal(target.get_xydata(), camera.target[seen][-1:])
        assert (first.get_marker(), target.get_marker()) == ("o", "+")
        curve = error.get_lines()[k]
        np.testing.assert_array_equal(curve.get_xdata(), run.time[rows])
        np.testing.assert_array_equal(curve.get_ydata(), camera.error[rows])
        assert curve.get_color() == path.get_color() == palette.SERIES[k]
    assert image.get_xlim() == (0, 160)
    assert image.get_ylim() == (120, 0)
    (background,) = image.get_images()
    np.testing.assert_array_equal(background.get_array(), camera.images[0])
    assert error.get_yscale() == "log"
    known = np.flatnonzero(np.isfinite(camera.target).all(axis=1))
    assert error.get_xlim() == (run.time[known[0]], run.time[known[-1]])
    assert image.get_legend() is not None


def test_an_object_whose_marker_was_never_seen_has_no_path(run):
    feature = run.camera.feature.copy()
    feature[run.time < 2.0] = np.nan
    camera = replace(run.camera, feature=feature, images=(), image_time=np.empty(0))
    blind = replace(run, camera=camera)
    image, _ = marker_figure(blind, OBJECTS).axes
    labels = [line.get_label() for line in image.get_lines()]
    assert "box" not in labels
    assert "tin" in labels
    assert len(image.get_images()) == 0


def test_a_square_marks_where_an_object_was_released(run):
    axes = trajectories_figure(run, OBJECTS).axes[0]
    lines = axes.get_lines()
    demonstration, *others = lines
    np.testing.assert_array_equal(np.transpose(demonstration.get_data_3d()), run.demo_path)
    assert demonstration.get_label() == "demonstration"
    for k, (name, span) in enumerate(OBJECTS.items()):
        whole, carried, square = others[3 * k : 3 * k + 3]
        rows = (run.time >= span[0]) & (run.time < span[1])
        np.testing.assert_array_equal(np.transpose(whole.get_data_3d()), run.position[rows])
        assert whole.get_label() == f"path: {name}"
        assert carried.get_label() == f"carried: {name}"
        path = np.transpose(carried.get_data_3d())
        np.testing.assert_array_equal(np.ravel(square.get_data_3d()), path[-1])
        assert square.get_marker() == "s"
        assert {line.get_color() for line in (whole, carried, square)} == {palette.SERIES[k]}
    bare = replace(run, demo_path=None, phases=())
    lines = trajectories_figure(bare, {"box": (0.0, 9.0)}).axes[0].get_lines()
    # Nothing was carried, so nothing was released, and no entry of the legend says so.
    assert [line.get_label() for line in lines] == ["path: box"]


@pytest.mark.parametrize(
    ("changes", "left_out"),
    [
        ({}, set()),
        ({"worker_distance": {}}, {"worker"}),
        ({"nullspace_input": None}, {"person"}),
        ({"nullspace_input": np.zeros((200, 7))}, {"person"}),
    ],
)
def test_sections_tell_of_people_only_if_they_came(run, changes, left_out, monkeypatch):
    figure = Figure()
    for name in vars(run_report).copy():
        if name.endswith("_figure"):
            monkeypatch.setattr(run_report, name, lambda *given: figure)
    sections = run_sections(replace(run, **changes), OBJECTS, ["first note.", "second note."])
    names = [picture.name for section in sections for picture in section.figures]
    every = [
        "timeline",
        "marker",
        "image_jacobian",
        "person",
        "worker",
        "trajectories",
        "joints",
    ]
    assert names == [name for name in every if name not in left_out]
    assert sections[0].text.endswith(" first note. second note.")
    assert "note" not in sections[1].text
    assert all(picture.caption for section in sections for picture in section.figures)
    quiet = run_sections(replace(run, **changes), OBJECTS)[0]
    assert quiet.text.endswith(" No recovery was needed.")


def shown_by(monkeypatch, draw, run):
    """What a figure of curves shows and shades."""
    calls: list[Any] = []
    monkeypatch.setattr(run_report, "plots_figure", lambda *given, **more: calls.append(more))
    with shapes_unchecked():
        draw(run)
    return calls[0]


@pytest.mark.parametrize("deviation", [True, False])
def test_a_person_is_shown_while_present_and_shaded_while_acting(run, monkeypatch, deviation):
    known = np.full(200, np.nan)
    known[60:150] = 0.0
    changed = replace(run, position_deviation=known if deviation else None)
    more = shown_by(monkeypatch, person_figure, changed)
    acting = np.zeros(200, dtype=bool)
    acting[80:120] = True
    np.testing.assert_array_equal(more["shaded"], acting)
    present = acting.copy()
    if deviation:
        present[60:150] = True
    np.testing.assert_array_equal(more["shown"], present)


def test_an_image_jacobian_is_shown_where_all_of_it_is_known(run, monkeypatch):
    jacobian = run.image_jacobian.copy()
    jacobian[:30] = np.nan
    jacobian[180, 1, 5] = np.nan
    more = shown_by(monkeypatch, image_jacobian_figure, replace(run, image_jacobian=jacobian))
    known = np.ones(200, dtype=bool)
    known[:30], known[180] = False, False
    np.testing.assert_array_equal(more["shown"], known)
    assert more["columns"] == 2


@pytest.fixture(scope="module")
def placings():
    """Placings on two shelves, planned in both spaces, that move a little differently."""
    rng, ready = np.random.default_rng(0), panda.ready.numpy()
    shelves = ("lower", "upper")
    runs = {
        (planned, shelf): SimpleNamespace(
            path=rng.normal([0.3, 0.0, 0.4], 0.05, (20, 3)),
            time=np.linspace(0.0, 2.0 + k, 20),
            joint_position=ready + rng.normal(0, 0.1, (20, 7)),
        )
        for planned in ("pose", "joint")
        for k, shelf in enumerate(shelves)
    }
    demonstration = SimpleNamespace(
        time=np.linspace(5.0, 9.0, 30),
        joint_position=ready + rng.normal(0, 0.1, (30, 7)),
        joint_names=panda.joint_names,
    )
    scene = SimpleNamespace(workplace=Workplace(), demonstration=demonstration)
    return SimpleNamespace(scene=scene, placings=runs), shelves


def test_paths_to_shelves_have_a_panel_for_each_planning_space(placings):
    run, shelves = placings
    with shapes_unchecked():
        figure = placing_paths_figure(run, shelves)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Task space", "Joint space"]
    for planned, axes in zip(("pose", "joint"), figure.axes, strict=True):
        demonstration, *lines = axes.get_lines()
        assert len(demonstration.get_data_3d()[0]) == 30
        for k, shelf in enumerate(shelves):
            path, square = lines[2 * k : 2 * k + 2]
            assert path.get_label() == f"{shelf} shelf"
            expected = run.placings[planned, shelf].path
            np.testing.assert_array_equal(np.transpose(path.get_data_3d()), expected)
            np.testing.assert_array_equal(np.ravel(square.get_data_3d()), expected[-1])
        assert (axes.elev, axes.azim) == (16, 62)
        spots = axes.get_subplotspec()
        assert (spots.get_gridspec().nrows, spots.get_gridspec().ncols) == (1, 2)
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == ["demonstration", "lower shelf", "upper shelf"]


def test_joints_to_shelves_are_drawn_from_the_start_of_each_motion(placings):
    run, shelves = placings
    with shapes_unchecked():
        figure = placing_joints_figure(run, shelves)
    lines = [line for line in figure.axes[0].get_lines() if len(line.get_xdata()) > 2]
    demonstration, *others = lines
    np.testing.assert_allclose(demonstration.get_xdata(), np.linspace(0.0, 4.0, 30))
    joint = run.scene.demonstration.joint_position[:, 0]
    np.testing.assert_allclose(demonstration.get_ydata(), joint)
    for line, shelf in zip(others, shelves, strict=True):
        placed = run.placings["pose", shelf]
        np.testing.assert_array_equal(line.get_xdata(), placed.time)
        np.testing.assert_array_equal(line.get_ydata(), placed.joint_position[:, 0])


def test_the_figure_of_a_person_has_no_empty_panels_and_no_empty_rows(run):
    nothing = np.full(len(run.time), np.nan)
    never = {"never": np.zeros(len(run.time), dtype=bool)}
    often = {"joint_limit": ~never["never"], "person": ~never["never"]}
    changed = replace(run, rotation_deviation=nothing, hindered=never | often)
    titles, fewer = (
        [axes.get_title("left") for axes in person_figure(shown).axes]
        for shown in (run, changed)
    )
    assert fewer == [title for title in titles if "rotation" not in title]
    assert len(fewer) == len(titles) - 1
    (reasons,) = (
        axes
        for axes in person_figure(changed).axes
        if axes.get_title("left").startswith("Reasons")
    )
    named = [text.get_text() for text in reasons.get_yticklabels()]
    assert named == ["joint limit", "person"]
    assert reasons.get_yticks().tolist() == [2, 3]
