"""A grasp without any marker, from filmed demonstrations to the lifted object."""

import pytest

from hrc_learn.cli.arguments import FitImageJacobian, Record
from hrc_learn.cli.image_jacobian_commands import fit_image_jacobian
from hrc_learn.cli.record_command import record
from hrc_learn.experiments.grasping_experiment import (
    GRASP_OFFSET,
    LIFTED,
    GraspingExperiment,
    descent,
    lift,
)
from hrc_learn.sim.scene import UnmarkedLook

pytestmark = [pytest.mark.slow, pytest.mark.egl, pytest.mark.simulation]


def test_an_object_known_from_films_only_is_grasped(tmp_path):
    films, model = tmp_path / "films", tmp_path / "aiming"
    unmarked = ("demonstration.markerless=true",)
    assert not record(Record(demonstration="servoing", out=films, config=unmarked))
    fit_image_jacobian(FitImageJacobian(dataset=films, out=model, markerless=True))
    run = GraspingExperiment(aiming=model, look=UnmarkedLook()).run(3000)
    assert not run.failure
    assert lift(run) > LIFTED
    assert descent(run)[0] < GRASP_OFFSET
