import json

import numpy as np
import pytest

from hrc_learn.tasks.visual_target import VisualTarget


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


def test_the_error_is_what_leaving_each_demonstration_out_gives():
    objects, hands, _ = demonstrations(9, noise=2.0)
    misses = []
    for i in range(9):
        rest = np.arange(9) != i
        left_out = VisualTarget.fit(objects[rest], hands[rest])
        misses.append(np.sum((left_out(objects[i]) - hands[i]) ** 2))
    assert VisualTarget.fit(objects, hands).error == pytest.approx(np.sqrt(np.mean(misses)))


def test_too_few_or_collinear_demonstrations_are_refused():
    objects, hands, _ = demonstrations(2)
    with pytest.raises(ValueError, match="at least three"):
        VisualTarget.fit(objects, hands)
    line = np.outer(np.arange(6.0), [10.0, 20.0]) + 100.0
    with pytest.raises(ValueError, match="line"):
        VisualTarget.fit(line, line)


def test_it_survives_the_disk(tmp_path):
    objects, hands, _ = demonstrations(7, noise=1.0)
    target = VisualTarget.fit(objects, hands)
    target.save(tmp_path / "target.json")
    loaded = VisualTarget.load(tmp_path / "target.json")
    np.testing.assert_array_equal(loaded.matrix, target.matrix)
    assert loaded.error == target.error
    assert [path.name for path in tmp_path.iterdir()] == ["target.json"]


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "target.json"
    path.write_text(json.dumps({"version": 99}))
    with pytest.raises(ValueError, match=r"target\.json"):
        VisualTarget.load(path)
