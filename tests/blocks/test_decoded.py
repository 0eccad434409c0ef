"""Images in color without distortion, from pieces."""

from dataclasses import replace

import numpy as np
import pytest

from lvba.blocks import decoded
from lvba.camera import Camera
from lvba.parallel import in_order
from lvba.visual import image

CAMERA = Camera(32, 24, 20.0, 20.0, 15.5, 11.5, (-0.1, 0.01, 0.0, 0.0))
PHOTOS = np.random.default_rng(3).integers(0, 200, (10, 24, 32, 3), np.uint8)


def test_states_that_are_looked_at_together_undistort_an_image_once_for_each_camera(monkeypatch):
    """And nothing of the pieces is read twice; several threads, each with images of its own."""
    undistorted, read = [], []
    real = image.Undistorter.__call__

    def counted(self, raw):
        undistorted.append(self.camera)
        return real(self, raw)

    def piece(first, end):
        read.append(first)
        return PHOTOS[first:end]

    monkeypatch.setattr(image.Undistorter, "__call__", counted)
    pieces = [((k + 5, k + 7), lambda k=k: piece(k, k + 2)) for k in range(0, 10, 2)]
    reader = decoded.PhotoReader(pieces, CAMERA, first=5)
    other = replace(CAMERA, fx=21.0)
    self_calibrated = reader.seen_by(other)

    def look(index):
        return [each(index).copy() for each in (reader, reader, self_calibrated, self_calibrated)]

    seen = list(in_order(look, range(10), threads=2))
    assert [undistorted.count(camera) for camera in (CAMERA, other)] == [10, 10]
    assert sorted(read) == [0, 2, 4, 6, 8]
    for index, (first, again, second, second_again) in enumerate(seen):
        np.testing.assert_array_equal(first, image.undistort(PHOTOS[index], CAMERA))
        np.testing.assert_array_equal(second, image.undistort(PHOTOS[index], other))
        assert np.array_equal(again, first)
        assert np.array_equal(second_again, second)
    with pytest.raises(IndexError, match="no piece holds image 15"):
        reader(10)


def test_an_image_without_distortion_is_as_it_was_taken():
    plain = replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0))
    reader = decoded.PhotoReader([((0, 10), lambda: PHOTOS)], plain)
    np.testing.assert_array_equal(reader(3), PHOTOS[3])
