from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from sample_runs import sample_run

from hrc_learn.experiments.run_report import (
    marker_figure,
    timeline_figure,
    trajectories_figure,
)
from hrc_learn.log import Event

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
    with pytest.raises(ValueError, match="needs camera"):
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
