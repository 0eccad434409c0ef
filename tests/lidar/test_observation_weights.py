"""Weights of observations, where the points of one have an error in common and where they have none."""

import numpy as np
import plane_world
import pytest

from lvba import trajectory
from lvba.lidar.bundle_adjustment import refine
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.weights import observation_weights

SCANS, PLANES = 30, 60


def seen(common, seed=0):
    """Planes seen by all scans, with few points or many and noise of 2 to 20 mm; what a plane's points in one scan are
    off by together has `common` of the variance of their noise. With the noise (O,) and the poses."""
    rng = np.random.default_rng(seed)
    noise = np.repeat(rng.uniform(0.002, 0.02, PLANES), SCANS)
    count = np.exp(rng.uniform(np.log(8), np.log(1000), PLANES * SCANS)).astype(int)
    means, scatters = [], []
    for sigma, points in zip(noise, count, strict=True):
        flat = rng.uniform(-1, 1, (points, 2))
        height = sigma * (rng.normal(size=points) + np.sqrt(common) * rng.normal())
        place = np.column_stack([flat, height])
        means.append(place.mean(0))
        off = place - place.mean(0)
        scatters.append((off.T @ off)[np.triu_indices(3)])
    clusters = PointClusters(count.astype(float), np.array(means), np.array(scatters))
    features = PlaneFeatures(
        offsets=np.arange(0, PLANES * SCANS + 1, SCANS),
        scan=np.tile(np.arange(SCANS, dtype=np.int32), PLANES),
        clusters=clusters,
        weight=np.ones(PLANES * SCANS),
        size=np.ones(PLANES),
    )
    return features, noise, np.tile(np.eye(4), (SCANS, 1, 1))


@pytest.mark.parametrize("common", [0.05, 0.5])
def test_an_error_that_points_have_in_common_is_found(common):
    features, noise, poses = seen(common)
    weights = observation_weights(features, poses)
    np.testing.assert_allclose(np.median(weights.offset_sigma / noise), np.sqrt(common), rtol=0.15)
    # many points tell no more than their common error lets them
    most = weights.sigma**2 / weights.offset_sigma**2
    assert (features.clusters.count * weights.weight <= most).all()


def test_points_with_noise_of_their_own_count_each():
    features, noise, poses = seen(0.0)
    weights = observation_weights(features, poses)
    many = features.clusters.count > 300
    each = np.median((weights.weight * noise**2)[many]) / weights.sigma**2
    assert 0.7 < each < 1.05


def test_ranges_bent_by_the_direction_of_the_beam():
    """1 % to and fro, three times round: dense walls that are a centimeter off together must not outvote all others."""
    scans, truth, rough = plane_world.recording("courtyard", scans=24, points=6400, seed=3)
    bent = []
    for scan in scans:
        turn = np.arctan2(scan[:, 1], scan[:, 0])
        bent.append((scan * (1 + 0.01 * np.sin(3 * turn)[:, None])).astype(np.float32))
    result = refine(bent, rough)
    poses = trajectory.align(result.world_from_scan, truth) @ result.world_from_scan
    error = trajectory.pose_error(poses, truth)
    assert error.ate_m < 0.1  # 0.116 with weights that grow with the number of points
    assert error.rotation_deg < 0.35  # 0.634
    promised = np.sqrt(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2).mean())
    assert error.ate_m < 3 * promised  # 11 times
