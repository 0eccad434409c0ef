"""What is promised of the poses that are the result."""

from types import SimpleNamespace

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.steps import expected_error
from lvba.steps.open_motions import OpenMotions

SIGMAS = np.repeat([0.01, 0.05], 3)


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


def test_cameras_of_one_group_are_expected_along_open_motions_as_images_have_them():
    rng = np.random.default_rng(3)
    poses = geometry.exp(rng.normal(size=(6, 6)))
    x, y = (poses[:, axis, :3] for axis in (0, 1))
    local = np.tile(1e-8 * np.eye(6), (6, 1, 1))
    local[:, 3:, 3:] += 0.01**2 * x[:, :, None] * x[:, None, :]
    whole = local.copy()
    whole[:, 3:, 3:] += 0.3**2 * x[:, :, None] * x[:, None, :] + 0.02**2 * y[:, :, None] * y[:, None, :]
    visual = SimpleNamespace(
        world_from_camera=poses, covariance=whole, local_covariance=local, group=np.array([4, 4, -1, 4, 2, 4])
    )
    lidar = SimpleNamespace(result=SimpleNamespace(whole_covariance=None, shared_factor=1.0))
    slide = OpenMotions.of([DegenerateDirection(np.eye(6)[3], SIGMAS, 0.1)])

    def cameras(by_images, used=True):
        scans = SimpleNamespace(covariance=local, open_motions=slide, open_by_images=by_images)
        lidar.result.whole_covariance = SimpleNamespace(marginal=local)
        state = {name: SimpleNamespace(accepted=True) for name in ("scans", "cameras")}
        accepted = SimpleNamespace(**state, fusion=SimpleNamespace(accepted=used))
        expected = expected_error.of_result(
            lidar, SimpleNamespace(result=scans), SimpleNamespace(result=visual), accepted
        ).cameras
        return [np.sqrt(np.einsum("si,sij,sj->s", one, expected[:, 3:, 3:], one)) for one in (x, y)]

    for given in (cameras(False), cameras(True, used=False)):
        np.testing.assert_allclose(given[0], 0.3, rtol=1e-2)
    along, across = cameras(True)
    # an image that nothing ties to the others stays as the odometry has it
    np.testing.assert_allclose(along, [0.01, 0.01, 0.01, 0.01, 0.3, 0.01], rtol=1e-2)
    np.testing.assert_allclose(across, 0.02, rtol=1e-2)


def test_cameras_that_refined_ones_confirm_are_expected_to_be_off_by_what_is_between_them_too():
    poses = geometry.exp(np.random.default_rng(6).normal(size=(3, 6)))
    covariance = np.tile(np.diag(SIGMAS**2), (3, 1, 1))
    covariance[2] = 0.0
    visual = SimpleNamespace(
        world_from_camera=geometry.retract(poses, np.array([0, 0, 0, 0.12, 0, 0])), covariance=covariance
    )
    own = SimpleNamespace(marginal=covariance)
    lidar = SimpleNamespace(result=SimpleNamespace(whole_covariance=own, shared_factor=1.0))

    def cameras(**of_cameras):
        accepted = SimpleNamespace(
            scans=SimpleNamespace(accepted=True),
            fusion=SimpleNamespace(accepted=False),
            cameras=SimpleNamespace(accepted=False, **of_cameras),
            world_from_camera=poses,
        )
        found = expected_error.of_result(
            lidar, SimpleNamespace(result=None), SimpleNamespace(result=visual), accepted
        )
        return found.cameras

    expected = np.sqrt(np.diagonal(cameras(confirmed=True), axis1=1, axis2=2))
    np.testing.assert_allclose(expected[:2, 3:], [[0.13, 0.05, 0.05]] * 2, atol=2e-3)
    assert np.isnan(expected[2]).all()
    assert cameras(confirmed=False) is None


def test_what_is_expected_along_open_directions_is_in_the_world_and_of_slides_alone():
    rng = np.random.default_rng(0)
    poses = geometry.exp(rng.normal(size=(4, 6)))
    along = np.array([0.6, 0.8, 0.0])
    own = poses[:, :3, :3].swapaxes(1, 2) @ along
    covariance = np.tile(1e-6 * np.eye(6), (4, 1, 1))
    covariance[:, 3:, 3:] += 0.3**2 * own[:, :, None] * own[:, None, :]
    slide = DegenerateDirection(np.array([0.001, 0.0, 0.0, *along]), SIGMAS, 0.1)
    turn = DegenerateDirection(np.array([1.0, 0, 0, 0, 0, 0]), SIGMAS, 0.1)
    assert expected_error.along_open(covariance, poses, [turn, slide]) == pytest.approx(0.3, rel=1e-4)
    covariance[1] = np.nan
    assert expected_error.along_open(covariance, poses, [slide]) == pytest.approx(0.3, rel=1e-4)
    assert expected_error.along_open(covariance, poses, [turn]) == 0.0
    assert expected_error.along_open(None, poses, [slide]) == 0.0
