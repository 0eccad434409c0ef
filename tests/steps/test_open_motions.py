"""Scans slide along what planes leave open for all of them, as their cameras have it: corridors and tunnels."""

from dataclasses import replace

import numpy as np
from fusion_cases import SCAN_TIMES, cameras, errors, scans

from lvba.lidar.covariance import Covariance
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.steps import pose_fusion


def corridor(rng, rise=0.0):
    """Scans that slide along x as the odometry has it, each by itself; their covariances say that they rise with it."""
    given, covariance, truth = scans(rng)
    slide = np.cumsum(0.03 * rng.normal(size=len(SCAN_TIMES)))
    poses = given.world_from_sensor.copy()
    poses[:, 0, 3] += slide - slide.mean()
    along = poses[:, :3, :3].swapaxes(1, 2) @ np.array([1.0, 0.0, rise])
    of_slide = np.zeros((len(poses), 6, 6))
    of_slide[:, 3:, 3:] = along[:, :, None] * along[:, None, :]
    conditional, wide = (covariance.conditional + size**2 * of_slide for size in (0.02, 0.2))
    step = covariance.conditional[1:] + covariance.conditional[:-1] + 0.03**2 * of_slide[1:]
    return (
        replace(given, world_from_sensor=poses),
        Covariance(wide, conditional, wide, step),
        truth,
    )


ALONG = DegenerateDirection(np.array([0, 0.002, 0, 1.0, 0, 0]), np.repeat([0.01, 0.05], 3), 0.1)


def test_what_planes_leave_open_for_all_scans_goes_where_the_cameras_have_it():
    """A corridor: planes let each scan slide along x, and images hold the cameras there.

    Images begin .137 s after the scans, and end .063 s before: scans .037 and .063 s past the ends slide, too.
    """
    given, covariance, truth = corridor(np.random.default_rng(5))
    found = pose_fusion.fuse(given, covariance, cameras(np.random.default_rng(6)), [ALONG])
    assert errors(given.world_from_sensor, truth).max() > 0.1
    assert errors(found.world_from_scan, truth)[1:].max() < 0.005
    off = np.sqrt(np.square(errors(found.world_from_scan, truth)[2:-2]).mean())
    assert 0.3 * off < found.slide_sigma_m < 3 * off
    assert pose_fusion.fuse(given, covariance, cameras(np.random.default_rng(6))).slide_sigma_m == 0.0


def test_scans_that_only_slide_stay_in_all_else():
    given, covariance, truth = corridor(np.random.default_rng(5))
    seen = cameras(np.random.default_rng(6))
    seen = replace(seen, group=np.zeros(len(seen.world_from_scan), np.int64))
    found = pose_fusion.fuse(given, covariance, seen, [ALONG])
    slid = found.slid
    assert slid.only_slid
    assert not found.only_slid
    assert slid.slid is None
    before = given.world_from_sensor
    np.testing.assert_allclose(slid.world_from_scan[:, :3, :3], before[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(slid.world_from_scan[:, 1:3, 3], before[:, 1:3, 3], atol=1e-12)
    assert np.abs((slid.world_from_scan - truth)[1:, 0, 3]).max() < 0.005
    # certain along the corridor, and in nothing else
    x, y = before[:, 0, :3], before[:, 1, :3]
    promised = [np.einsum("si,sij,sj->s", one, slid.covariance[:, 3:, 3:], one) for one in (x, y)]
    own = np.einsum("si,sij,sj->s", y, covariance.marginal[:, 3:, 3:], y)
    assert promised[0][1:].max() < 0.02**2
    np.testing.assert_allclose(promised[1], own, rtol=0.05)
    assert pose_fusion.fuse(given, covariance, seen).slid is None


def test_images_of_one_group_are_counted_on_along_what_planes_leave_open():
    given, covariance, truth = corridor(np.random.default_rng(5))
    seen = cameras(np.random.default_rng(6))
    images = len(seen.world_from_scan)

    def along_x(group):
        """(S,) m, promised, and whether images are counted on."""
        fused = pose_fusion.fuse(given, covariance, replace(seen, group=group), [ALONG])
        x = fused.world_from_scan[:, 0, :3]
        return (
            np.sqrt(np.einsum("si,sij,sj->s", x, fused.covariance[:, 3:, 3:], x)),
            fused.open_by_images,
            fused,
        )

    by_odometry, counted, _ = along_x(np.zeros(0, np.int64))
    assert not counted
    assert by_odometry.min() > 0.19
    # two halves that nothing ties may be anywhere
    halves, counted, _ = along_x(np.repeat([0, 1], [images // 2, images - images // 2]))
    assert not counted
    np.testing.assert_array_equal(halves, by_odometry)
    one, counted, fused = along_x(np.full(images, 3))
    assert counted
    off = np.abs((fused.world_from_scan - truth)[:, 0, 3])
    assert 0.3 * off.std() < one.mean() < 3 * off.std()
    assert one[1:].max() < 0.02
    # what planes hold is promised as before
    without = pose_fusion.fuse(given, covariance, seen, [ALONG])
    z = fused.world_from_scan[:, 2, :3]
    by_group, by_none = (
        np.einsum("si,sij,sj->s", z, each.covariance[:, 3:, 3:], z) for each in (fused, without)
    )
    np.testing.assert_allclose(by_group, by_none, rtol=0.05)
    # the scans beside an image that is alone are as the odometry has them
    lone = np.where(np.arange(images) == 20, 9, 3)
    but_one, counted, _ = along_x(lone)
    assert counted
    beside = but_one > 0.15
    assert 1 <= beside.sum() <= 4
    np.testing.assert_allclose(but_one[~beside], one[~beside])


def test_a_slide_does_not_leak_into_what_planes_hold():
    """Where scans slide along the whole corridor, planes hold their heights, whatever covariances of neighbors say."""
    given, covariance, truth = corridor(np.random.default_rng(5), rise=0.1)
    seen = cameras(np.random.default_rng(6))
    seen = replace(seen, covariance=seen.covariance + np.diag([0, 0, 0, 0, 0, 0.05**2]))
    alone, apart = (
        pose_fusion.fuse(given, covariance, seen, open_).world_from_scan for open_ in ([], [ALONG])
    )
    risen = [np.abs((each - truth)[1:, 2, 3]).max() for each in (alone, apart)]
    assert risen[1] < 0.5 * risen[0]
    assert errors(apart, truth)[1:].max() < 0.01
