import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from seen_cameras import camera_network, camera_vector
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraEstimator, RBFImageJacobian, paper_grid
from hrc_learn.jacobian.fitting import ImageJacobianFitReport
from hrc_learn.jacobian.perspective import FOCAL, marker_pixels
from hrc_learn.kinematics import gripper_down
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.sim.scene import overhead_camera
from hrc_learn.skills.visual_skill import MarkerAngle, VisualServoSkill
from hrc_learn.skills.visual_target import LONGEST_OFFSET, VisualTarget, _solved
from hrc_learn.vision.landmarks import Features, Landmarks, Object, Tool

OFFSET = np.array([0.012, -0.01, 0.11])
MIDDLE = torch.tensor([0.26, 0.54, 0.16], dtype=torch.float64)
MODEL = replace(overhead_camera(), distortion=(-0.06, 0.0, 0.0, 0.0, 0.0))


def turned(yaw):
    about = quaternion.exp(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))
    return quaternion.multiply(about, gripper_down())


def demonstrations(n, noise=0.0, seed=3):
    """Pixels of objects seen by the simulator's camera, and tools right above them."""
    rng = np.random.default_rng(seed)
    place = MIDDLE + torch.from_numpy(rng.uniform(-0.1, 0.1, (n, 3)) * [1, 1, 0.1])
    poses = Pose(place, torch.stack([turned(yaw) for yaw in rng.uniform(-1, 1, n)]))
    objects = MODEL.project(poses.apply(torch.from_numpy(OFFSET)).numpy())
    return camera_vector(MODEL), objects + rng.normal(0, noise, objects.shape), poses


@pytest.mark.parametrize("n", [3, 4, 12])
def test_the_object_is_found_in_the_tool_frame(n):
    target = VisualTarget.fit(*demonstrations(n))
    np.testing.assert_allclose(target.offset, OFFSET, atol=1e-6)


@pytest.mark.parametrize("raised", [0.0, 0.06])
@pytest.mark.parametrize(("tilt", "roll"), [(0.0, 0.0), (0.17, 2.0), (-0.1, -3.0)])
def test_the_target_is_the_pixel_of_the_marker_above_the_object(tilt, roll, raised):
    """For a camera that was moved: object and marker are projected by the simulator's."""
    eye = np.array([0.3, 0.48, 1.5])
    looked_at = eye + np.array([np.tan(tilt), 0.02, -1.0])
    model = MODEL.look_at(eye, looked_at, roll=roll)
    marker = torch.tensor([-0.008, 0.145, -0.083], dtype=torch.float64)
    tool = Pose(MIDDLE, turned(0.7))
    item = model.project(tool.apply(torch.from_numpy(OFFSET)).numpy())
    above = tool.position + torch.tensor([0.0, 0.0, raised]).double()
    expected = model.project(Pose(above, tool.orientation).apply(marker).numpy())
    target = VisualTarget(offset=OFFSET, error=0.0)
    # Only height and orientation of the demonstrations are known, not the place.
    somewhere = Pose(torch.tensor([9.0, 9.0, float(MIDDLE[2])]).double(), tool.orientation)
    camera, pixel = camera_vector(model, marker.tolist()), torch.from_numpy(item)
    place = target.tool_position(camera, pixel, somewhere)
    np.testing.assert_allclose(place, tool.position, atol=1e-6)
    seen = target(camera, pixel, somewhere, MIDDLE[2] + raised)
    np.testing.assert_allclose(seen, expected, atol=1e-4)


def test_the_uncertainty_is_that_of_the_place_above_the_object():
    vector, objects, poses = demonstrations(3)
    estimator = CameraEstimator(camera_network(vector))
    state = estimator.initial_state()
    target, above = VisualTarget(offset=OFFSET, error=0.0), poses[0]
    jacobian = estimator.jacobian(
        replace(state, cameras=vector.expand(1, 13), cost=torch.zeros(1)), above
    )
    pixel = torch.from_numpy(objects[0])

    def uncertainty(covariance, cameras, cost):
        changed = replace(state, covariance=covariance, cameras=cameras, cost=cost)
        return target.uncertainty(changed.spread(), jacobian.numpy(), pixel, above)

    one, none = vector.expand(1, 13), torch.zeros(1, dtype=torch.float64)
    tilt = torch.zeros(13, 13, dtype=torch.float64)
    tilt[4, 4] = 0.01**2
    # A tilt moves points 19 cm apart in depth by different amounts of pixels.
    assert uncertainty(tilt, one, none) == pytest.approx(0.19 * 0.01, rel=0.3)
    assert uncertainty(0 * tilt, one, none) == 0
    # Two hypotheses that are equally probable are as far apart as they are.
    both = estimator.initial_state().cameras[[0, 4]]
    assert uncertainty(0 * tilt, both, none.expand(2)) > 0.1
    certain = torch.tensor([0.0, 60.0], dtype=torch.float64)
    assert uncertainty(0 * tilt, both, certain) < 1e-9


def test_an_offset_that_only_metres_would_explain_is_kept_short():
    camera, objects, poses = demonstrations(4)
    still = Pose(poses.position[:1].expand(4, 3), poses.orientation[:1].expand(4, 4))
    wrong = objects[:1] + np.random.default_rng(0).normal(0, 200, (4, 2))
    offset = VisualTarget.fit(camera, wrong, still).offset
    assert np.linalg.norm(offset) <= LONGEST_OFFSET * (1 + 1e-5)


def test_the_error_is_what_leaving_each_demonstration_out_gives():
    camera, objects, poses = demonstrations(7, noise=2.0)
    misses = []
    for i in range(7):
        rest = [k for k in range(7) if k != i]
        left_out = VisualTarget.fit(camera, objects[rest], poses[torch.tensor(rest)])
        carrying = torch.cat([camera[:10], torch.from_numpy(left_out.offset)])
        seen = marker_pixels(carrying, poses[i : i + 1])[0][0].numpy()
        misses.append(np.sum((seen - objects[i]) ** 2))
    target = VisualTarget.fit(camera, objects, poses)
    # The prediction is linear in the offset but for perspective.
    assert target.error == pytest.approx(np.sqrt(np.mean(misses)), rel=0.02)


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
    assert [path.name for path in tmp_path.iterdir()] == ["target.json"]


@pytest.mark.parametrize(
    "content", [{"version": 99}, {"version": 99, "offset_m": [0.0] * 3}, {"version": 3}]
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


def test_metrics_of_a_fitted_skill_are_in_their_units():
    """Of a camera of 800 px, known to one percent and 4 mm; one cell has no pairs."""
    vector = torch.zeros(13, dtype=torch.float64)
    vector[FOCAL] = np.log(800.0)
    camera = SimpleNamespace(
        camera=vector, deviation=lambda part: 0.01 * (part == FOCAL), place_deviation=0.004
    )
    report = ImageJacobianFitReport(
        pairs=9, motion=20.0, error=1.0, held_out_error=2.0, noise=1.0
    )

    def best(error, noise, width):
        return SimpleNamespace(
            held_out_error=error,
            config=SimpleNamespace(pixel_noise=noise),
            neurons=SimpleNamespace(width=width),
        )

    rounds = (best(5.0, 1.0, 0.1), best(3.0, 0.5, 0.2), best(3.5, 0.4, 0.3))
    skill: Any = SimpleNamespace(
        jacobian=SimpleNamespace(report=report, centers=[0] * 13, camera_fit=camera),
        cells=SimpleNamespace(relative=np.array([0.2, 0.9, 0.3]), pairs=np.array([4, 0, 1])),
        learned=SimpleNamespace(rounds=rounds, kept=rounds[1], best=1),
        target=None,
        approach=None,
        angle=None,
        landmarks=None,
    )
    with shapes_unchecked():
        metrics = VisualServoSkill.metrics(skill)
    expected = {
        "pairs": 9,
        "neurons": 13,
        "motion_px": 20,
        "fit_error_px": 1,
        "held_out_error_px": 2,
        "held_out_relative": 0.1,
        "held_out_relative_worst_cell": 0.3,
        "focal_px": 800,
        "focal_relative_std": 0.01,
        "camera_place_std_mm": 4,
        "pixel_noise_px": 0.5,
        "width": 0.2,
        "learning_rounds": 1,
        "before_learning_error_px": 5,
        "after_learning_error_px": 3,
    }
    assert metrics == pytest.approx(expected)


def test_landmarks_survive_the_disk(tmp_path):
    rng = np.random.default_rng(0)

    def descriptors(n):
        return rng.integers(0, 256, (n, 128), dtype=np.uint8)

    def view(n):
        return Features(pixels=rng.uniform(0, 600, (n, 2)), descriptors=descriptors(n))

    tool = Tool(
        points=rng.normal(size=(9, 3)),
        descriptors=descriptors(9),
        place=np.array([0.01, -0.02, 0.1]),
        optics=(810.0, 320.5, 239.5, -0.06),
    )
    objects = {"box": Object(views=(view(5), view(7))), "cup": Object(views=(view(3),))}
    landmarks = Landmarks(tool=tool, objects=objects, image_size=(640, 480))
    vector = camera_vector(MODEL)
    skill = VisualServoSkill(jacobian=camera_network(vector), target=None, landmarks=landmarks)
    skill.save(tmp_path / "skill")
    loaded = VisualServoSkill.load(tmp_path / "skill").landmarks
    assert loaded is not None
    assert loaded.image_size == (640, 480)
    assert loaded.tool.optics == pytest.approx(tool.optics)
    for name in ("points", "descriptors", "place"):
        np.testing.assert_array_equal(getattr(loaded.tool, name), getattr(tool, name))
    assert loaded.objects.keys() == objects.keys()
    for name, item in objects.items():
        views = zip(loaded.objects[name].views, item.views, strict=True)
        for got, given in views:
            np.testing.assert_array_equal(got.pixels, given.pixels)
            np.testing.assert_array_equal(got.descriptors, given.descriptors)


def test_each_part_of_a_skill_is_written_if_it_was_learned(tmp_path):
    """A model without an object has none of its files, and is read back so."""
    VisualServoSkill(jacobian=network(), target=None).save(tmp_path / "bare")
    assert [path.name for path in (tmp_path / "bare").iterdir()] == ["jacobian"]
    bare = VisualServoSkill.load(tmp_path / "bare")
    assert (bare.target, bare.approach, bare.angle, bare.landmarks) == (None,) * 4
    target = VisualTarget(offset=OFFSET, error=1.5)
    approach = Approach(orientation_wxyz=(0.0, 1.0, 0.0, 0.0), spread_rad=0.1, turned_rad=0.0)
    angle = MarkerAngle(offset_rad=0.3, spread_rad=0.02)
    parts = {"target": target, "approach": approach, "angle": angle}
    for name, part in parts.items():
        only = {"target": None} | {name: part}
        VisualServoSkill(jacobian=network(), **only).save(tmp_path / name)
        loaded = VisualServoSkill.load(tmp_path / name)
        assert [key for key in parts if getattr(loaded, key) is not None] == [name]
    assert VisualServoSkill.load(tmp_path / "approach").approach == approach
    assert VisualServoSkill.load(tmp_path / "angle").angle == angle


@pytest.mark.parametrize("size", [1e-4, 10.0])
@pytest.mark.parametrize("demos", [2, 4, 5, 8])
def test_the_solution_is_the_shortened_least_squares_one(demos, size):
    """Against NumPy's least squares; a penalty is a further row for each unknown."""
    rng = np.random.default_rng(demos)
    design, pixels = rng.normal(size=(2 * demos, 3)), size * rng.normal(size=(demos, 2))
    found, error = _solved(design, pixels)
    plain = np.linalg.lstsq(design, pixels.ravel())[0]
    if np.linalg.norm(plain) <= LONGEST_OFFSET:
        assert size < 1.0
        np.testing.assert_allclose(found, plain, atol=1e-12)
    else:
        assert size > 1.0
        assert np.linalg.norm(found) == pytest.approx(LONGEST_OFFSET, rel=1e-4)
        # The gradient of the squared error points along the solution: that is a ridge.
        slope = design.T @ (pixels.ravel() - design @ found)
        penalty = slope @ found / (found @ found)
        assert penalty > 0
        np.testing.assert_allclose(slope, penalty * found, atol=1e-4 * np.linalg.norm(slope))
    assert np.isnan(error) == (demos < 5)
    if demos >= 5 and size < 1.0:
        left_out = []
        for k in range(demos):
            rest = np.delete(design, [2 * k, 2 * k + 1], axis=0)
            refit = np.linalg.lstsq(rest, np.delete(pixels, k, axis=0).ravel())[0]
            left_out.append(pixels[k] - design[2 * k : 2 * k + 2] @ refit)
        assert error == pytest.approx(np.sqrt(np.mean(np.sum(np.square(left_out), axis=1))))


def test_a_direction_without_information_gets_no_offset():
    design = np.random.default_rng(0).normal(size=(12, 3)) * [1.0, 1.0, 0.0]
    found, error = _solved(design, 1e-3 * np.ones((6, 2)))
    assert np.isfinite(found).all()
    assert np.isfinite(error)
    assert found[2] == pytest.approx(0.0, abs=1e-9)
