"""Features of images with places on the surfels of scans."""

from types import SimpleNamespace

import numpy as np
from textured_room import CAMERA

from lvba.steps import features_on_scans


def test_surfels_behind_others_are_not_seen():
    seen = features_on_scans._seen(
        np.array(
            [[0, 0, 2.0], [0.01, 0, 2.1], [0.02, 0.01, 4.0], [0, 0, -2.0], [5.0, 0, 2.0], [1.0, 0, 4.0]]
        ),
        CAMERA,
    )
    assert seen.tolist() == [0, 1, 5]


def test_the_scans_about_an_image_are_the_nearest_in_time():
    times = SimpleNamespace(times=np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    dataset = SimpleNamespace(scans=times, images=SimpleNamespace(times=np.array([2.2])))
    assert features_on_scans.nearest_scans(dataset, 0, np.array([0, 1, 3, 4]), 3).tolist() == [3, 1, 4]
