import numpy as np
import pytest

from lvba.camera import Camera


def test_a_level_keeps_the_viewing_rays_of_pixel_centers():
    camera = Camera(640, 480, 500.0, 510.0, 321.3, 239.1)
    half = camera.at_level(1)
    # the center of a level-1 pixel (c) is the middle of full-size pixels 2c and 2c + 1
    column, full = 17.0, 2 * 17.0 + 0.5
    assert (column - half.cx) / half.fx == pytest.approx((full - camera.cx) / camera.fx)
    assert (half.width, half.height) == (320, 240)


def test_odd_sizes_are_rounded_down():
    assert (
        Camera(1408, 375, 1, 1, 0, 0).at_level(1).height,
        Camera(1407, 375, 1, 1, 0, 0).at_level(2).width,
    ) == (187, 351)


def test_the_matrix_projects():
    np.testing.assert_array_equal(Camera(4, 4, 2, 3, 1, 1.5).matrix @ [1, 1, 1], [3, 4.5, 1])
