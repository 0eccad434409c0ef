"""What is promised of the poses that are the result."""

from types import SimpleNamespace

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.steps import expected_error


@pytest.mark.parametrize("with_cameras", [True, False])
def test_errors_that_planes_share_are_promised_of_scans(with_cameras):
    with_own = SimpleNamespace(marginal=np.full((3, 6, 6), 2.0))
    lidar = SimpleNamespace(result=SimpleNamespace(whole_covariance=with_own, shared_factor=4.0))
    fused = SimpleNamespace(result=SimpleNamespace(covariance=np.full((3, 6, 6), 1.5)))
    accepted = SimpleNamespace(
        scans=SimpleNamespace(accepted=True), fusion=SimpleNamespace(accepted=with_cameras)
    )
    promised = expected_error.scan_covariance(lidar, fused, accepted)
    np.testing.assert_array_equal(promised, np.full((3, 6, 6), 6.0 if with_cameras else 8.0))


def test_what_is_expected_along_open_directions_is_in_the_world_and_of_slides_alone():
    rng = np.random.default_rng(0)
    poses = geometry.exp(rng.normal(size=(4, 6)))
    along = np.array([0.6, 0.8, 0.0])
    own = poses[:, :3, :3].swapaxes(1, 2) @ along
    covariance = np.tile(1e-6 * np.eye(6), (4, 1, 1))
    covariance[:, 3:, 3:] += 0.3**2 * own[:, :, None] * own[:, None, :]
    slide = DegenerateDirection(np.array([0.001, 0.0, 0.0, *along]), 0.1)
    turn = DegenerateDirection(np.array([1.0, 0, 0, 0, 0, 0]), 0.1)
    assert expected_error.along_open(covariance, poses, [turn, slide]) == pytest.approx(0.3, rel=1e-4)
    covariance[1] = np.nan
    assert expected_error.along_open(covariance, poses, [slide]) == pytest.approx(0.3, rel=1e-4)
    assert expected_error.along_open(covariance, poses, [turn]) == 0.0
    assert expected_error.along_open(None, poses, [slide]) == 0.0
