"""Images of a recording from its files, without distortion, kept in memory as far as they fit."""

import numpy as np

from lvba.io.dataset import load_image, open_dataset
from lvba.products import recorded_images
from lvba.visual import image


def test_undistorted_images_are_decoded_once_while_they_fit(recording):
    dataset = open_dataset(recording)
    load = recorded_images.views_of(dataset).load
    assert load(3) is load(3)
    np.testing.assert_array_equal(load(3), image.undistort(load_image(dataset, 3), dataset.camera))
    # what is in the files, and no more than fits
    little = recorded_images.Undistorted(dataset, kept_bytes=2 * 320 * 240 * 3)
    assert [little(i) is little(i) for i in range(4)] == [True, True, False, False]
    np.testing.assert_array_equal(little(3), load(3))


def test_views_take_images_that_are_decoded_already(recording):
    dataset = open_dataset(recording)
    assert recorded_images.views_of(dataset, lambda index: index).load(5) == 5
