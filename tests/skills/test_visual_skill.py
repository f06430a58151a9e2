import json

import numpy as np
import pytest

from hrc_learn.jacobian.fitting import ImageJacobianFitReport
from hrc_learn.skills.visual_skill import (
    LONGEST_OFFSET,
    VisualServoSkill,
    VisualTarget,
    guessed_network,
)


def demonstrations(n, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    objects = rng.uniform([200, 200], [1200, 900], size=(n, 2))
    matrix = np.array([[1.15, 0.01, -310.0], [-0.02, 1.14, -80.0]])
    hands = np.column_stack([objects, np.ones(n)]) @ matrix.T
    return objects, hands + noise * rng.normal(size=hands.shape), matrix


@pytest.mark.parametrize("n", [3, 4, 12])
def test_an_affine_offset_is_found_exactly(n):
    objects, hands, matrix = demonstrations(n)
    target = VisualTarget.fit(objects, hands)
    np.testing.assert_allclose(target.matrix, matrix, atol=1e-6)
    np.testing.assert_allclose(target(np.array([500.0, 600.0])), matrix @ [500, 600, 1])


def test_the_offset_in_space_is_found_whatever_way_the_camera_is_turned():
    rng = np.random.default_rng(3)
    objects, offset = rng.uniform(200, 900, (6, 2)), np.array([0.12, -0.01, 0.18])
    jacobians = rng.normal(0, 1500, (6, 2, 6))
    target = VisualTarget.fit(objects, objects + jacobians[..., :3] @ offset, jacobians)
    np.testing.assert_allclose(target.offset, offset, atol=1e-9)
    pixel, turned = np.array([500.0, 600.0]), rng.normal(0, 1500, (2, 6))
    expected = pixel + turned[:, :3] @ offset
    np.testing.assert_allclose(target.from_view(pixel, turned), expected, atol=1e-6)


def test_without_an_image_jacobian_the_camera_is_taken_to_stand_still():
    objects, hands, matrix = demonstrations(5)
    target, pixel = VisualTarget.fit(objects, hands), np.array([500.0, 600.0])
    expected = matrix @ np.append(pixel, 1.0)
    np.testing.assert_allclose(target.from_view(pixel, np.ones((2, 6))), expected)


def test_the_error_is_what_leaving_each_demonstration_out_gives():
    objects, hands, _ = demonstrations(9, noise=2.0)
    misses = []
    for i in range(9):
        rest = np.arange(9) != i
        left_out = VisualTarget.fit(objects[rest], hands[rest])
        misses.append(np.sum((left_out(objects[i]) - hands[i]) ** 2))
    assert VisualTarget.fit(objects, hands).error == pytest.approx(np.sqrt(np.mean(misses)))


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
    offset = VisualTarget.fit(objects, hands, jacobians).offset
    assert np.linalg.norm(offset) == pytest.approx(LONGEST_OFFSET, rel=1e-5)
    np.testing.assert_allclose(offset[:2], [0.12, 0.0], atol=0.01)


def test_the_error_of_the_offset_is_what_leaving_each_demonstration_out_gives():
    rng = np.random.default_rng(4)
    objects, jacobians = rng.uniform(200, 900, (7, 2)), rng.normal(0, 1500, (7, 2, 6))
    hands = objects + jacobians[..., :3] @ [0.12, -0.01, 0.18] + rng.normal(0, 2, (7, 2))
    misses = []
    for i in range(7):
        rest = np.arange(7) != i
        left_out = VisualTarget.fit(objects[rest], hands[rest], jacobians[rest])
        misses.append(np.sum((left_out.from_view(objects[i], jacobians[i]) - hands[i]) ** 2))
    target = VisualTarget.fit(objects, hands, jacobians)
    assert target.offset_error == pytest.approx(np.sqrt(np.mean(misses)))


def test_too_few_or_collinear_demonstrations_are_refused():
    objects, hands, _ = demonstrations(2)
    with pytest.raises(ValueError, match="at least three"):
        VisualTarget.fit(objects, hands)
    line = np.outer(np.arange(6.0), [10.0, 20.0]) + 100.0
    with pytest.raises(ValueError, match="line"):
        VisualTarget.fit(line, line)


def test_it_survives_the_disk(tmp_path):
    objects, hands, _ = demonstrations(7, noise=1.0)
    jacobians = np.random.default_rng(5).normal(size=(7, 2, 6))
    target = VisualTarget.fit(objects, hands, jacobians)
    target.save(tmp_path / "target.json")
    loaded = VisualTarget.load(tmp_path / "target.json")
    np.testing.assert_array_equal(loaded.matrix, target.matrix)
    np.testing.assert_array_equal(loaded.offset, target.offset)
    assert (loaded.error, loaded.offset_error) == (target.error, target.offset_error)
    assert [path.name for path in tmp_path.iterdir()] == ["target.json"]


@pytest.mark.parametrize(
    "content", [{"version": 99}, {"version": 99, "matrix": [[0.0] * 3] * 2}, {"version": 1}]
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "target.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"target\.json"):
        VisualTarget.load(path)


def test_a_skill_knows_its_metrics_only_where_it_was_fitted(tmp_path):
    VisualServoSkill(jacobian=guessed_network(), target=None).save(tmp_path)
    loaded = VisualServoSkill.load(tmp_path)
    with pytest.raises(ValueError, match="just fitted"):
        loaded.metrics()
    fitted = guessed_network()
    fitted.report = ImageJacobianFitReport(
        pairs=9, motion=20.0, error=1.0, held_out_error=2.0, noise=1.0
    )
    with pytest.raises(ValueError, match="just fitted"):  # it lacks the errors by cell
        VisualServoSkill(jacobian=fitted, target=None).metrics()
