"""What the grasping experiment asks of each grasp; the grasps themselves are stood in for."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from hrc_learn.experiments import grasping_experiment as experiment
from hrc_learn.experiments.grasping_experiment import GraspingExperiment
from hrc_learn.experiments.grasping_trial import SimulatedGrasp
from hrc_learn.jacobian import RBFImageJacobian, paper_grid
from hrc_learn.sim import Imperfections
from hrc_learn.skills.visual_skill import VisualServoSkill


@pytest.fixture
def asked(monkeypatch):
    """The settings of each grasp, in turn."""
    asked = []

    def fake_grasp(skill, scene, **settings):
        asked.append(SimpleNamespace(imperfections=scene, **settings))
        return object.__new__(SimulatedGrasp)  # nothing of it is looked at

    jacobian = RBFImageJacobian.from_jacobian(torch.rand(2, 6) + 1.0, paper_grid(), 0.1)
    skill = VisualServoSkill(jacobian=jacobian, target=None)
    monkeypatch.setattr(experiment.VisualServoSkill, "load", lambda folder: skill)
    monkeypatch.setattr(experiment.GraspingScene, "draw", lambda *drawn: drawn[-1])
    monkeypatch.setattr(experiment, "simulate_grasp", fake_grasp)
    return asked


def test_variants_are_compared_by_servoing_alone(asked):
    """Each knows the target, goes straight there and tries once; the whole grasp does not."""
    grasping = GraspingExperiment(aiming=Path("skill"), variants=("learned", "fixed"))
    runs = grasping.run(seed=3)
    assert list(runs.compared) == ["learned", "fixed"]
    whole, *compared = asked
    assert whole.config == grasping.config
    assert not whole.known_target
    assert whole.imperfections == Imperfections.nominal()
    for settings in compared:
        assert settings.known_target
        assert settings.imperfections == whole.imperfections
        assert settings.config.attempts == 1
        assert settings.config.servo.probe == 0.0
        assert settings.config.servo.timeout > 0
        assert settings.config.controller == grasping.config.controller
    assert type(compared[0].estimator) is not type(compared[1].estimator)


def test_an_unknown_variant_is_refused():
    with pytest.raises(ValueError, match=r"no variant 'luck'; there are .*learned"):
        GraspingExperiment(aiming=Path("skill"), variants=("luck",))
