"""Images in color without distortion, and scans without points that move, from pieces."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lvba.blocks import decoded_images, decoded_scans
from lvba.blocks.decoded_scans import MovingPoints, ScanPoints
from lvba.camera import Camera
from lvba.parallel import in_order
from lvba.visual import image

CAMERA = Camera(32, 24, 20.0, 20.0, 15.5, 11.5, (-0.1, 0.01, 0.0, 0.0))
PHOTOS = np.random.default_rng(3).integers(0, 200, (10, 24, 32, 3), np.uint8)


def test_states_that_are_looked_at_together_undistort_an_image_once_for_each_camera(monkeypatch):
    """And nothing of the pieces is read twice; several threads, each with images of its own."""
    undistorted, read = [], []
    real = image.Undistorter.__call__

    def counted(self, raw, turn=None):
        undistorted.append(self.camera)
        return real(self, raw, turn)

    def piece(first, end):
        read.append(first)
        return PHOTOS[first:end]

    monkeypatch.setattr(image.Undistorter, "__call__", counted)
    pieces = [((k + 5, k + 7), lambda k=k: piece(k, k + 2)) for k in range(0, 10, 2)]
    reader = decoded_images.PhotoReader(pieces, CAMERA, first=5)
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


def test_images_of_rows_are_as_if_all_were_read_at_once():
    """Each by its own turn; another look at the same images has turns of its own."""
    turns = 0.1 * np.random.default_rng(5).normal(size=(5, 3))
    turns[3] = 0.0
    pieces = [((5, 10), lambda: PHOTOS[5:])]
    reader = decoded_images.PhotoReader(pieces, CAMERA, 5, turns)
    undistorter = image.Undistorter(CAMERA)
    for index in range(5):
        np.testing.assert_array_equal(reader(index), undistorter(PHOTOS[5 + index], turns[index]))
        assert np.array_equal(reader(index), image.undistort(PHOTOS[5 + index], CAMERA)) == (index == 3)
        at_once = reader.seen_by(CAMERA)(index)
        np.testing.assert_array_equal(at_once, image.undistort(PHOTOS[5 + index], CAMERA))


def test_an_image_without_distortion_is_as_it_was_taken():
    plain = replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0))
    reader = decoded_images.PhotoReader([((0, 10), lambda: PHOTOS)], plain)
    np.testing.assert_array_equal(reader(3), PHOTOS[3])


def scan_points(every=1, cosine=True):
    """Four scans of which the second is empty."""
    rng = np.random.default_rng(4)
    return ScanPoints(
        points=rng.normal(size=(30, 3)).astype(np.float32),
        offsets=np.array([0, 7, 7, 18, 30]),
        intensity=rng.random(30).astype(np.float32),
        cosine=rng.random(30).astype(np.float16) if cosine else None,
        every=every,
    )


@pytest.mark.parametrize("numbers", [[], [0, 6, 7, 17, 29], list(range(7)), list(range(30))])
def test_readers_give_scans_without_the_points_that_move(numbers):
    """With what is known of the other points."""
    points, moving = scan_points(), MovingPoints(np.array(numbers, np.int64), 30)
    reader = decoded_scans.ScanReader([((5, 9), (lambda: points, lambda: moving))], first=5)
    static = [np.setdiff1d(np.arange(*span), numbers) for span in pairwise(points.offsets)]
    for scan, kept in enumerate(static):
        np.testing.assert_array_equal(reader(scan), points.points[kept])
    kept = np.concatenate(static)
    np.testing.assert_array_equal(reader.intensities(range(4)), points.intensity[kept])
    np.testing.assert_array_equal(reader.cosines(range(4)), points.cosine[kept].astype(float))


def test_scans_are_solved_with_every_so_many_th_of_the_points_that_do_not_move():
    points, moving = scan_points(every=3, cosine=False), MovingPoints(np.array([0, 8]), 30)
    reader, whole = (
        decoded_scans.ScanReader([((0, 4), (lambda: points, lambda: moving))], all_points=everything)
        for everything in (False, True)
    )
    np.testing.assert_array_equal(whole(2), points.points[[7, *range(9, 18)]])
    np.testing.assert_array_equal(reader(2), whole(2)[::3])
    assert reader.cosines([2]) is None


@pytest.mark.parametrize("every", [1, 3])
def test_moving_points_are_those_of_the_scans_as_they_were_solved(every):
    points, moving = scan_points(every=every), MovingPoints(np.array([0, 8, 9, 10, 21]), 30)
    solved = np.concatenate([np.arange(first, end, every) for first, end in pairwise(points.offsets)])
    found = decoded_scans.moving_solved([((5, 9), (lambda: points, lambda: moving))], np.arange(5, 9))
    np.testing.assert_array_equal(found, np.isin(solved, moving.numbers))
    assert found.sum() == (5 if every == 1 else 3)
    own = decoded_scans.moving_solved([((5, 9), (lambda: points, lambda: moving))], np.array([5, 7]))
    np.testing.assert_array_equal(
        own, found[np.r_[0 : -(-7 // every), -(-7 // every) : -(-7 // every) - (-11 // every)]]
    )
    assert not decoded_scans.moving_solved([((5, 9), lambda: points)], np.arange(5, 9)).any()
