from dataclasses import replace

import numpy as np
from sample_runs import STEPS, sample_run

from hrc_learn.experiments.grasping_experiment import reach_figure, regions_figure


def test_the_path_is_parted_where_the_marker_came_into_view():
    (axes,) = reach_figure(sample_run()).axes
    parts = {line.get_label(): line.get_data_3d() for line in axes.get_lines()}
    assert len(parts["out of view"][0]) == 21
    assert len(parts["since the marker was in view"][0]) == STEPS - 20


def test_fractions_and_the_potential_are_drawn_while_they_are_known():
    run = sample_run()
    early = np.where(run.time < 2.0, 1.0, np.nan)
    potentials = {"task space": early * np.exp(-run.time), "fraction of vision": early}
    above, below = regions_figure(replace(run, potentials=potentials)).axes
    assert above.get_lines()[0].get_label() == "vision"
    assert below.get_xlim()[1] < 2.0
    assert below.get_yscale() == "log"
