import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import RBFImageJacobian, paper_grid
from hrc_learn.jacobian.fitting import ImageJacobianFitReport
from hrc_learn.kinematics import gripper_down
from hrc_learn.skills.visual_skill import (
    LONGEST_OFFSET,
    VisualServoSkill,
    VisualTarget,
)
from hrc_learn.vision.camera_model import IMAGE_SIZE

OFFSET = np.array([0.12, -0.01, 0.18])


def random_turns(n, rng):
    return quaternion.normalize(torch.from_numpy(rng.standard_normal((n, 4))))


def demonstrations(n, noise=0.0, seed=3):
    """Pixels of both markers, image Jacobians, and tools turned in any way."""
    rng = np.random.default_rng(seed)
    objects, jacobians = rng.uniform(200, 900, (n, 2)), rng.normal(0, 1500, (n, 2, 6))
    turns = random_turns(n, rng)
    in_base = quaternion.rotate(turns, torch.from_numpy(OFFSET)).numpy()
    hands = objects + np.einsum("nij,nj->ni", jacobians[..., :3], in_base)
    return objects, hands + rng.normal(0, noise, hands.shape), jacobians, turns


@pytest.mark.parametrize("n", [3, 4, 12])
def test_the_offset_is_found_whatever_way_camera_and_tool_are_turned(n):
    target = VisualTarget.fit(*demonstrations(n))
    np.testing.assert_allclose(target.offset, OFFSET, atol=1e-9)
    rng = np.random.default_rng(9)
    pixel, jacobian = np.array([500.0, 600.0]), rng.normal(0, 1500, (2, 6))
    (turn,) = random_turns(1, rng)
    in_base = quaternion.to_matrix(turn).numpy() @ OFFSET
    np.testing.assert_allclose(
        target(pixel, jacobian, turn), pixel + jacobian[:, :3] @ in_base, atol=1e-6
    )


def looked_at(turn, shift, focal=1900.0):
    """Pixels and image Jacobians of a pinhole camera, about a metre above."""
    (rotation,) = quaternion.to_matrix(quaternion.exp(torch.tensor([turn]).double())).numpy()
    rotation = rotation @ np.diag([1.0, -1.0, -1.0])

    def see(points):
        *aside, depth = (points @ rotation.T + shift).T
        xi = np.stack(aside, -1) / depth[:, None]
        rows = rotation[:2] - xi[:, :, None] * rotation[2]
        jacobians = np.zeros((len(points), 2, 6))
        jacobians[..., :3] = focal / depth[:, None, None] * rows
        return focal * xi + np.array(IMAGE_SIZE) / 2, jacobians

    return see


def test_with_a_focal_length_the_target_holds_for_a_camera_that_was_moved():
    rng = np.random.default_rng(5)
    turns = random_turns(8, rng)
    in_base = quaternion.rotate(turns, torch.from_numpy(OFFSET)).numpy()
    objects = rng.uniform(-0.1, 0.1, (8, 3)) * [1, 1, 0]
    see = looked_at((0.05, 0.02, 0.3), (0.03, 0.0, 1.1))
    (pixels, _), (hands, jacobians) = see(objects), see(objects + in_base)
    target = VisualTarget.fit(pixels, hands, jacobians, turns, focal=1900.0)
    np.testing.assert_allclose(target.offset, OFFSET, atol=1e-9)
    without = VisualTarget.fit(pixels, hands, jacobians, turns)

    see, further = looked_at((0.2, -0.1, 0.3), (-0.05, 0.02, 1.0)), np.array([0.01, 0.0, 0.03])
    (pixels, _), (hands, jacobians) = see(objects), see(objects + in_base + further)
    for pixel, hand, jacobian, turn in zip(pixels, hands, jacobians, turns, strict=True):
        seen = target(pixel, jacobian, turn, further)
        np.testing.assert_allclose(seen, hand, atol=0.2)
        assert np.linalg.norm(without(pixel, jacobian, turn, further) - hand) > 4


def test_a_wild_image_jacobian_does_not_turn_the_offset_round():
    target = VisualTarget(offset=OFFSET, error=0.0, focal=1900.0)
    plain = VisualTarget(offset=OFFSET, error=0.0)
    rng = np.random.default_rng(6)
    for turn in random_turns(50, rng):
        jacobian, pixel = rng.normal(0, 20_000, (2, 6)), np.array([700.0, 500.0])
        apart, affine = (t(pixel, jacobian, turn) - pixel for t in (target, plain))
        ratio = (apart @ affine) / (affine @ affine)
        assert 0.6 < ratio < 1.51


def test_the_line_leads_up_along_the_offset_and_turns_with_the_tool():
    target = VisualTarget(offset=np.array([0.0, 0.1, -0.2]), error=0.0)
    down = gripper_down()
    np.testing.assert_allclose(
        target.line(down), np.array([0.1, 0.0, 0.2]) / 0.05**0.5, atol=1e-12
    )
    quarter = quaternion.exp(torch.tensor([0.0, 0.0, np.pi / 2], dtype=torch.float64))
    turned = quaternion.multiply(quarter, down)
    np.testing.assert_allclose(
        target.line(turned), np.array([0.0, 0.1, 0.2]) / 0.05**0.5, atol=1e-12
    )
    flat = VisualTarget(offset=np.array([0.0, 0.2, -0.05]), error=0.0)
    np.testing.assert_array_equal(flat.line(down), [0.0, 0.0, 1.0])


def test_an_offset_that_only_metres_would_explain_is_kept_short():
    rng = np.random.default_rng(3)
    objects = rng.uniform(200, 900, (5, 2))
    level = np.array([[-1600.0, 0.0, 0.0], [0.0, 1600.0, 0.0]])
    jacobians = np.zeros((5, 2, 6))
    jacobians[..., :3] = level
    jacobians[:, 0, 2] = rng.uniform(-5, 5, 5)  # height, of which nothing is known
    hands = objects + level @ np.array([0.12, 0.0, 0.0]) + rng.normal(0, 10, (5, 2))
    free, *_ = np.linalg.lstsq(
        jacobians[..., :3].reshape(-1, 3), (hands - objects).ravel(), rcond=None
    )
    assert np.linalg.norm(free) > 2 * LONGEST_OFFSET
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(5, 4)
    offset = VisualTarget.fit(objects, hands, jacobians, upright).offset
    assert np.linalg.norm(offset) == pytest.approx(LONGEST_OFFSET, rel=1e-5)
    np.testing.assert_allclose(offset[:2], [0.12, 0.0], atol=0.01)


def test_the_error_is_what_leaving_each_demonstration_out_gives():
    objects, hands, jacobians, turns = demonstrations(7, noise=2.0)
    misses = []
    for i in range(7):
        rest = np.arange(7) != i
        left_out = VisualTarget.fit(
            objects[rest], hands[rest], jacobians[rest], turns[torch.from_numpy(rest)]
        )
        misses.append(np.sum((left_out(objects[i], jacobians[i], turns[i]) - hands[i]) ** 2))
    target = VisualTarget.fit(objects, hands, jacobians, turns)
    assert target.error == pytest.approx(np.sqrt(np.mean(misses)))


def test_too_few_demonstrations_are_refused():
    with pytest.raises(ValueError, match="needs three or more demonstrations"):
        VisualTarget.fit(*demonstrations(2))


@pytest.mark.parametrize("n", [3, 7])
def test_it_survives_the_disk(tmp_path, n):
    target = VisualTarget.fit(*demonstrations(n, noise=1.0))
    target.save(tmp_path / "target.json")
    loaded = VisualTarget.load(tmp_path / "target.json")
    np.testing.assert_array_equal(loaded.offset, target.offset)
    np.testing.assert_equal(loaded.error, target.error)
    assert loaded.focal is None
    replace(target, focal=1900.0).save(tmp_path / "target.json")
    assert VisualTarget.load(tmp_path / "target.json").focal == 1900.0
    assert [path.name for path in tmp_path.iterdir()] == ["target.json"]


@pytest.mark.parametrize(
    "content", [{"version": 99}, {"version": 99, "offset_m": [0.0] * 3}, {"version": 2}]
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "target.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"target\.json"):
        VisualTarget.load(path)


def network():
    return RBFImageJacobian.from_jacobian(torch.zeros(2, 6), paper_grid(), 0.1)


def test_a_skill_knows_its_metrics_only_where_it_was_fitted(tmp_path):
    VisualServoSkill(jacobian=network(), target=None).save(tmp_path)
    loaded = VisualServoSkill.load(tmp_path)
    with pytest.raises(ValueError, match="a loaded skill has no metrics"):
        loaded.metrics()
    fitted = network()
    fitted.report = ImageJacobianFitReport(
        pairs=9, motion=20.0, error=1.0, held_out_error=2.0, noise=1.0
    )
    with pytest.raises(
        ValueError, match="a loaded skill has no metrics"
    ):  # it lacks the errors by cell
        VisualServoSkill(jacobian=fitted, target=None).metrics()
