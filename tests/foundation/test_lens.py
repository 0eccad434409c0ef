"""Lens models: OpenCV's figures, exact inverses, and an end where the polynomial folds back."""

import cv2
import numpy as np
import pytest

from lvba.camera import Camera
from lvba.lens import Lens, distort, undistort, widest_angle
from lvba.visual.image import Undistorter

BROWN = [
    (-0.12, 0.04, 8e-4, -6e-4),
    (-0.28, 0.09, 1e-4, 2e-4, -0.0222),
    (0.4, -0.1, 2e-4, -3e-4, 0.01, 0.5, -0.02, 0.003),
]
FISHEYE = [(-0.037, -0.009, 0.009, -0.004), (0.0, 0.0, 0.0, 0.0), (0.02, -0.01, 0.004, -0.001)]


@pytest.mark.parametrize("coefficients", BROWN)
def test_radial_tangential_is_opencv_s_and_its_inverse_exact(coefficients):
    x, y = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 500))
    u, v = distort(Lens.RADIAL_TANGENTIAL, coefficients, x, y)
    points = np.stack([x, y, np.ones_like(x)], axis=-1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    np.testing.assert_allclose(np.stack([u, v], -1), expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(undistort(Lens.RADIAL_TANGENTIAL, coefficients, u, v), (x, y), atol=1e-11)


@pytest.mark.parametrize("coefficients", FISHEYE)
def test_equidistant_is_opencv_s_and_its_inverse_exact(coefficients):
    angle = np.linspace(0, np.radians(75), 500)
    turn = np.random.default_rng(0).uniform(0, 2 * np.pi, 500)
    x, y = np.tan(angle) * np.cos(turn), np.tan(angle) * np.sin(turn)
    u, v = distort(Lens.EQUIDISTANT, coefficients, x, y)
    points = np.stack([x, y, np.ones_like(x)], axis=-1)[:, None]
    expected, _ = cv2.fisheye.projectPoints(
        points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients)
    )
    np.testing.assert_allclose(np.stack([u, v], -1), expected[:, 0], atol=1e-11)
    np.testing.assert_allclose(undistort(Lens.EQUIDISTANT, coefficients, u, v), (x, y), atol=1e-10)


def test_a_lens_ends_where_its_polynomial_folds_back():
    """With k1 alone, r (1 + k1 r^2) is largest where 1 + 3 k1 r^2 = 0; of the angle for an equidistant lens."""
    where = np.sqrt(1 / (3 * 0.3))
    assert widest_angle(Lens.RADIAL_TANGENTIAL, (-0.3, 0, 0, 0)) == pytest.approx(np.arctan(where), abs=1e-3)
    assert widest_angle(Lens.EQUIDISTANT, (-0.3, 0, 0, 0)) == pytest.approx(where, abs=1e-3)
    assert widest_angle(Lens.EQUIDISTANT, (0.0,) * 4) == np.pi / 2
    assert widest_angle(Lens.RADIAL_TANGENTIAL, (0.0,) * 4) == np.pi / 2


def test_what_no_ray_is_imaged_at_spoils_nothing():
    """k1 = -0.3 images no ray farther out than 0.70: asked for one there, steps diverge, and stay finite."""
    u = np.array([0.2, 0.9, 5.0, 1e4])
    with np.errstate(all="raise"):
        x, _ = undistort(Lens.RADIAL_TANGENTIAL, (-0.3, 0.0, 0.0, 0.0), u, np.zeros(4))
    assert np.isfinite(x).all()
    assert distort(Lens.RADIAL_TANGENTIAL, (-0.3, 0.0, 0.0, 0.0), x[:1], np.zeros(1))[0] == pytest.approx(0.2)


def image_through(camera, seen):
    """What a camera records where `seen(x, y)` is the radiance along the rays (x, y, 1), (H, W) uint8."""
    row, column = np.mgrid[: camera.height, : camera.width].astype(float)
    u, v = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    return np.rint(seen(*undistort(camera.lens, camera.distortion, u, v))).astype(np.uint8)


@pytest.mark.parametrize(
    ("lens", "coefficients", "focal"),
    [
        (Lens.EQUIDISTANT, FISHEYE[0], 150),
        (Lens.EQUIDISTANT, FISHEYE[1], 150),
        (Lens.RADIAL_TANGENTIAL, BROWN[1], 300),
    ],
)
def test_an_undistorted_image_is_that_of_a_pinhole(lens, coefficients, focal):
    camera = Camera(320, 240, focal, 1.02 * focal, 158.0, 121.0, coefficients, lens)

    def seen(x, y):
        return 120 + 60 * np.sin(9 * x) + 50 * np.cos(7 * y)

    row, column = np.mgrid[:240, :320].astype(float)
    expected = seen((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    found = Undistorter(camera)(image_through(camera, seen)).astype(float)
    inside = found > 0
    assert inside.mean() > 0.9
    assert np.abs(found - expected)[inside].max() < 3


def test_beyond_the_widest_angle_there_is_no_image():
    """k1 = -0.3 folds back at 46.5 degrees: the corners of a wide picture show nothing rather than a mirrored middle."""
    camera = Camera(320, 240, 120.0, 120.0, 159.5, 119.5, (-0.3, 0.0, 0.0, 0.0))
    found = Undistorter(camera)(np.full((240, 320), 200, np.uint8))
    row, column = np.mgrid[:240, :320].astype(float)
    angle = np.arctan(np.hypot(column - 159.5, row - 119.5) / 120)
    widest = np.arctan(np.sqrt(1 / 0.9))
    assert not found[angle > widest + 0.01].any()
    assert found[angle < widest - 0.01].all()
