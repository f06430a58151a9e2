"""A package must be built anew when anything changes that the step depends on."""

import shutil
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    ControllerConfig,
    Goals,
    Observation,
)
from hrc_learn.deploy import export
from hrc_learn.deploy.export import UnknownCodeError, _structure, content_hash
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    FixedEstimator,
    ImageJacobianEstimator,
    KalmanEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics import panda

DOUBLE = torch.float64


def controller(
    scale: float = 1.0,
    half_size: float = 0.1,
    kind: Callable[[RBFImageJacobian], ImageJacobianEstimator] = KalmanEstimator,
    **config: float,
) -> AdaptiveController:
    J = scale * torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=DOUBLE)
    estimator = kind(RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1))
    down = quaternion.normalize(torch.tensor(GRIPPER_DOWN, dtype=DOUBLE))
    centre = torch.tensor((0.4, 0.1, 0.4), dtype=DOUBLE)
    goals = Goals.at(centre, down, half_size=(half_size,) * 3)
    return AdaptiveController(panda, estimator, goals, config=ControllerConfig(**config))


def test_equal_controllers_have_equal_hashes():
    assert content_hash(controller()) == content_hash(controller())


def test_use_leaves_no_trace():
    one = controller()
    before = content_hash(one)
    one.float().initial_state(panda.ready.float())
    one.double()
    assert content_hash(controller()) == before


@pytest.mark.parametrize(
    "change",
    [
        {"scale": 1 + 1e-15},
        {"half_size": 0.11},
        {"kind": FixedEstimator},
        {"drift_compensation_rate": 0.0},
        {"vision_rate": 5.0},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_weight_goal_part_and_setting_counts(change):
    assert content_hash(controller(**change)) != content_hash(controller())


def test_of_an_observation_the_structure_counts_not_the_values():
    one = Observation(
        joint_position=panda.ready,
        feature=torch.zeros(2, dtype=DOUBLE),
        feature_visible=torch.tensor(True),
        dt=0.001,
    )
    seen = content_hash(_structure(one))
    assert content_hash(_structure(replace(one, joint_position=panda.ready + 1))) == seen
    for other in (
        replace(one, dt=0.002),
        replace(one, nullspace_input=panda.ready),
        replace(one, joint_position=panda.ready.float()),
    ):
        assert content_hash(_structure(other)) != seen


def test_code_it_cannot_know_is_refused():
    class Own(FixedEstimator):
        """Somebody's own."""

    with pytest.raises(UnknownCodeError, match=r"code of"):
        content_hash(controller(kind=Own))
    with pytest.raises(UnknownCodeError, match="function"):
        content_hash([lambda x: x])
    for container in (dict, list, tuple, set):
        own = type("Own", (container,), {"__module__": "somebody"})()
        with pytest.raises(UnknownCodeError, match="Own"):
            content_hash({"part": own})


def test_half_precision_is_hashed_by_its_bits():
    one, other = (
        torch.ones((), dtype=torch.bfloat16),
        torch.full((), 1.01, dtype=torch.bfloat16),
    )
    assert content_hash(one) == content_hash(one.clone()) != content_hash(other)


def test_a_change_of_any_source_that_a_step_is_made_from_changes_the_hash(
    tmp_path, monkeypatch
):
    for name in export._PARTS:
        source = export._ROOT / name
        assert source.exists(), f"{name} has moved: its changes would go unnoticed"
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / name)
    monkeypatch.setattr(export, "_ROOT", tmp_path)
    whole = fresh_hash()
    for name in ("controller/safety_filter.py", "kinematics/franka.py", "deploy/package.py"):
        file = tmp_path / name
        text = file.read_text(encoding="utf-8")
        file.write_text(text + "# changed\n", encoding="utf-8")
        assert fresh_hash() != whole
        file.write_text(text, encoding="utf-8")
        assert fresh_hash() == whole


def fresh_hash() -> str:
    export._source_hash.cache_clear()
    try:
        return content_hash()
    finally:
        export._source_hash.cache_clear()


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_values_count_and_not_how_they_lie_in_memory(dtype):
    """The position of a pose, for example, is a column of a matrix."""
    rows = torch.arange(12).reshape(3, 4).to(dtype)
    assert not rows[:, 3].is_contiguous()
    assert content_hash(rows[:, 3]) == content_hash(rows[:, 3].clone())
    assert content_hash(rows[:, 0]) != content_hash(rows[:, 1])
    assert content_hash(rows.T) != content_hash(rows.reshape(4, 3))
