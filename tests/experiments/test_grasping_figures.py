from dataclasses import replace

import numpy as np
import pytest
from sample_runs import STEPS, camera_recording, sample_run

from hrc_learn.experiments.grasping_report import reach_figure, regions_figure, variants_figure

TARGET = np.array([80.0, 80.0])


def known(axes, label):
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    x, y = (np.asarray(values, float) for values in line.get_data())
    return x[np.isfinite(y)], y[np.isfinite(y)]


def later_run():
    """As the sample, but the feature is seen from half a second later on."""
    run = sample_run()
    camera = camera_recording(run.time)
    target = camera.target.copy()
    target[:45] = np.nan
    return replace(run, camera=replace(camera, target=target))


def test_errors_count_from_the_true_target_and_from_when_the_first_one_saw():
    runs = {"first": sample_run(), "second": later_run()}
    figure = variants_figure(runs, TARGET)
    image, error = figure.axes
    time, distance = known(error, "first")
    assert time[0] == 0.0
    feature = runs["first"].camera.feature[20]
    assert distance[0] == pytest.approx(np.linalg.norm(feature - TARGET))
    assert known(error, "second")[0][0] == pytest.approx((45 - 20) / 50)
    u, v = known(image, "second")
    np.testing.assert_allclose([u[0], v[0]], runs["second"].camera.feature[45])


def test_what_never_saw_the_feature_cannot_be_compared():
    run = sample_run()
    blind = replace(run.camera, feature=np.full((STEPS, 2), np.nan))
    with pytest.raises(ValueError, match="no run saw"):
        variants_figure({"blind": replace(run, camera=blind)}, TARGET)


def test_the_path_is_parted_where_the_marker_came_into_view():
    (axes,) = reach_figure(sample_run()).axes
    parts = {line.get_label(): line.get_data_3d() for line in axes.get_lines()}
    assert len(parts["out of view"][0]) == 21
    assert len(parts["since the marker was in view"][0]) == STEPS - 20


def test_shares_and_potentials_are_drawn_while_they_are_known():
    run = sample_run()
    early = np.where(run.time < 2.0, 1.0, np.nan)
    shares = dict.fromkeys(("joint space", "Cartesian space", "vision"), early)
    potentials = {name: early * np.exp(-run.time) for name in ("position", "turn", "vision")}
    potentials["turn"] = 0.0 * run.time
    above, below = regions_figure(run, shares, potentials).axes
    assert below.get_xlim() == pytest.approx((0.0, 1.98))
    assert set(known(above, "vision")[1]) == {1.0}
    assert len(known(below, "turn")[1]) == 0  # nothing left, which a logarithm cannot show
    assert below.get_yscale() == "log"
