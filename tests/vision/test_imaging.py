import numpy as np
import pytest
from marker_scenes import MARKER, corners_of, overhead, poses_in_view

from hrc_learn.vision import CameraModel, ImageNoise, Lens, MarkerDetector, SyntheticCamera
from hrc_learn.vision.imaging import pixel_rays

GREY = np.full((90, 120, 3), 128, dtype=np.uint8)


def test_noise_has_the_standard_deviation_asked_for():
    image = ImageNoise(blur=0.0, noise=3.0).degrade(GREY, np.random.default_rng(0))
    error = image.astype(float) - 128
    # Rounding to whole grey levels adds a variance of 1/12.
    assert error.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.03)
    assert abs(error.mean()) < 0.1
    assert np.corrcoef(error[0].ravel(), error[1].ravel())[0, 1] == pytest.approx(0, abs=0.15)


def test_noise_saturates_instead_of_wrapping():
    white = np.full((40, 40, 3), 255, dtype=np.uint8)
    image = ImageNoise(blur=0.0, noise=5.0).degrade(white, np.random.default_rng(0))
    assert image.min() > 200


def test_degrading_is_seeded_and_leaves_its_input_alone():
    first, again = (ImageNoise().degrade(GREY, np.random.default_rng(4)) for _ in range(2))
    other = ImageNoise().degrade(GREY, np.random.default_rng(5))
    assert (first == again).all()
    assert (first != other).any()
    assert (GREY == 128).all()


def test_switched_off_noise_returns_an_equal_copy():
    image = ImageNoise(blur=0.0, noise=0.0).degrade(GREY, np.random.default_rng(0))
    assert (image == GREY).all()
    assert image is not GREY


def test_blur_softens_an_edge_by_its_standard_deviation():
    edge = np.zeros((20, 40, 3), dtype=np.uint8)
    edge[:, 20:] = 255
    image = ImageNoise(blur=1.5, noise=0.0).degrade(edge, np.random.default_rng(0))
    slope = np.diff(image[10, :, 0].astype(float)) / 255
    offset = np.arange(39) - 19
    # Grey levels are whole numbers, which cuts the tails.
    assert slope.sum() == 1
    assert slope @ offset**2 == pytest.approx(1.5**2, rel=0.05)


@pytest.mark.parametrize("field", ["blur", "noise"])
def test_negative_amounts_are_refused(field):
    with pytest.raises(ValueError, match="must not be negative"):
        ImageNoise(**{field: -0.1})


@pytest.mark.parametrize("k1", [-0.2, 0.0, 0.1])
def test_lens_fills_the_image_from_the_pinhole(k1):
    model = CameraModel(width=320, height=240, focal=(260.0, 250.0), principal=(150.0, 125.0))
    model = CameraModel(
        width=320,
        height=240,
        focal=model.focal,
        principal=model.principal,
        distortion=(k1, 0.02, 1e-3, 0.0, 0.0),
    )
    lens = Lens(model)
    white = np.full((lens.pinhole.height, lens.pinhole.width, 3), 255, dtype=np.uint8)
    assert lens.apply(white).min() == 255  # nowhere does the black outside show
    assert lens.apply(white).shape == (240, 320, 3)


def test_every_pixel_knows_its_ray():
    model = overhead()
    u, v = np.meshgrid(np.arange(1440), np.arange(1080))
    pixels = model.to_pixels(pixel_rays(model).astype(np.float64))
    # Rays are in single precision.
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-3)


def test_lens_refuses_an_image_of_another_size():
    with pytest.raises(ValueError, match=r"Lens\.pinhole"):
        Lens(CameraModel(width=320, height=240)).apply(GREY)


def test_a_marker_seen_through_the_lens_lies_where_the_model_says():
    model = overhead()
    lens = Lens(model)
    for pose in poses_in_view(model, MARKER, 10, seed=3):
        rendered = SyntheticCamera(
            lens.pinhole,
            [MARKER],
            lambda pose=pose: {7: pose},
            rng=np.random.default_rng(0),
            noise=ImageNoise(blur=0.0, noise=0.0),
        ).read()
        corners = MarkerDetector([7]).detect(lens.apply(rendered))[7]
        error = corners - model.project(corners_of(MARKER, pose))
        assert np.linalg.norm(error, axis=1).max() < 1.0
