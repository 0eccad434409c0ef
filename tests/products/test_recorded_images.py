"""Images of a recording stay in memory between stages, and no longer than the recording."""

import gc

import numpy as np

from lvba.io.dataset import open_dataset
from lvba.products import recorded_images
from lvba.visual.image import ImageConfig


def test_undistorted_images_are_decoded_once_while_they_fit(recording):
    dataset = open_dataset(recording)
    load = recorded_images.views_of(dataset).load
    assert load(3) is recorded_images.views_of(dataset).load(3)
    # what is in the files, and no more than fits
    little = recorded_images.Undistorted(dataset, kept_bytes=2 * 320 * 240 * 3)
    assert [little(i) is little(i) for i in range(4)] == [True, True, False, False]
    np.testing.assert_array_equal(little(3), load(3))


def test_a_pyramid_is_kept_for_the_next_level_only_and_for_the_same_images(recording):
    dataset, config = open_dataset(recording), ImageConfig()
    chosen = np.arange(0, 16, 4)
    first = recorded_images.pyramid(dataset, chosen, 2, config, keep=True)
    assert recorded_images.pyramid(dataset, chosen, 2, config, keep=True) is first
    assert recorded_images.pyramid(dataset, chosen, 2, config) is first
    again = recorded_images.pyramid(dataset, chosen, 2, config, keep=True)
    assert again is not first
    np.testing.assert_array_equal(again.levels[1], first.levels[1])
    assert recorded_images.pyramid(dataset, chosen[:2], 2, config) is not again


def test_images_go_with_their_recording(recording):
    dataset = open_dataset(recording)
    recorded_images.views_of(dataset).load(0)
    key = id(dataset)
    assert key in recorded_images._KEPT
    del dataset
    gc.collect()
    assert key not in recorded_images._KEPT


def test_images_read_for_the_pyramid_are_not_read_again(recording, monkeypatch):
    dataset = open_dataset(recording)
    recorded_images.pyramid(dataset, np.array([2, 5]), 2, ImageConfig())
    read = []
    real = recorded_images.recordings.load_image
    monkeypatch.setattr(
        recorded_images.recordings, "load_image", lambda d, i: (read.append(i), real(d, i))[1]
    )
    load = recorded_images.views_of(dataset).load
    np.testing.assert_array_equal(load(5), recorded_images.Undistorted(dataset, 0)(5))
    load(4)
    assert read == [5, 4]
