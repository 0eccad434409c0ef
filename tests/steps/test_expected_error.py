"""What is promised of the poses that are the result."""

from types import SimpleNamespace

import numpy as np
import pytest

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
