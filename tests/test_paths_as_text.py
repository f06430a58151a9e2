"""Every public function that takes a path also takes text."""

import importlib
import inspect
import pkgutil
import re
from dataclasses import is_dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import hrc_learn
from hrc_learn.controller.interface import Goals, Observation
from hrc_learn.deploy import PackageRunner, export_step
from hrc_learn.jacobian import RBFImageJacobian
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.skills import VisualServoSkill
from hrc_learn.skills.visual_skill import MarkerAngle
from hrc_learn.skills.visual_target import VisualTarget

# Arms are made by `arm` and `arm_from_file`.
NOT_BY_USERS = {"Arm.__init__"}


def _packages():
    for module in pkgutil.iter_modules(hrc_learn.__path__, "hrc_learn."):
        if module.ispkg and module.name not in ("hrc_learn.cli", "hrc_learn.store"):
            yield module.name
    yield "hrc_learn.lerobot.smoothing"


def _public_functions(package):
    """Exported functions, and public methods of exported classes, by qualified name."""
    for name, value in vars(package).items():
        if name.startswith("_") or not getattr(value, "__module__", "").startswith("hrc_learn"):
            continue
        if inspect.isfunction(value):
            yield name, value
        elif inspect.isclass(value):
            for method, raw in vars(value).items():
                if method == "__init__" and is_dataclass(value):
                    continue  # values that this package fills in
                function = getattr(raw, "__func__", raw)
                if inspect.isfunction(function) and (
                    method == "__init__" or not method.startswith("_")
                ):
                    yield f"{name}.{method}", function


@pytest.mark.parametrize("name", list(_packages()))
def test_public_paths_may_be_text(name):
    wrong = []
    for function, value in _public_functions(importlib.import_module(name)):
        if function in NOT_BY_USERS:
            continue
        for parameter in inspect.signature(value).parameters.values():
            annotation = parameter.annotation
            text = annotation if isinstance(annotation, str) else str(annotation)
            if re.search(r"\b(Path|PathLike|FilePath)\b", text) and not re.search(
                r"\bstr\b", text
            ):
                wrong.append(f"{function}({parameter.name}: {text})")
    assert not wrong


def test_skill_in_a_folder_given_as_text(tmp_path):
    folder = str(tmp_path / "skill")
    network = RBFImageJacobian.from_jacobian(torch.ones(2, 6), torch.zeros(1, 2), 0.1)
    skill = VisualServoSkill(
        jacobian=network,
        target=VisualTarget(offset=np.array([0.0, 0.1, 0.2]), error=1.0),
        approach=Approach(orientation_wxyz=(0.0, 1.0, 0.0, 0.0), spread_rad=0.1, turned_rad=0),
        angle=MarkerAngle(offset_rad=0.1, spread_rad=0.2),
    )
    skill.save(folder)
    again = VisualServoSkill.load(folder)
    assert again.approach == skill.approach
    assert again.angle == skill.angle
    assert again.target is not None
    assert again.jacobian.state_dict().keys() == network.state_dict().keys()


def test_step_in_a_folder_given_as_text(tmp_path):
    from hrc_learn.controller import AdaptiveController
    from hrc_learn.jacobian import FixedEstimator

    network = RBFImageJacobian.from_jacobian(torch.ones(2, 6), torch.zeros(1, 2), 0.1)
    pose = panda.forward(panda.ready)
    goals = Goals.at(pose.position, pose.orientation, torch.tensor([1.0, 2.0]).double())
    controller = AdaptiveController(panda, FixedEstimator(network.double()), goals)
    observation = Observation(
        joint_position=panda.ready,
        feature=torch.zeros(2).double(),
        feature_visible=torch.tensor(True),
        dt=0.01,
    )
    code = export_step(controller, observation, str(tmp_path))
    assert Path(code).is_relative_to(tmp_path)
    runner = PackageRunner(str(code))
    assert runner is not None
