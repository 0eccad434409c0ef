"""Expected errors of map points and how they are summed up."""

import numpy as np
import pytest

from lvba import geometry
from lvba.products import map_error
from lvba.products.map_file import PointMap


def poses_and_covariances(rng):
    """Three poses, and covariances whose rotation and translation are correlated."""
    poses = geometry.exp(rng.normal(size=(3, 6)) * [1, 1, 1, 5, 5, 5])
    root = rng.normal(size=(3, 6, 6)) * np.array([1e-3] * 3 + [5e-3] * 3)[:, None]
    return poses, root @ np.swapaxes(root, 1, 2)


def test_points_are_off_as_moving_their_pose_at_random_moves_them():
    rng = np.random.default_rng(0)
    poses, covariance = poses_and_covariances(rng)
    points = rng.normal(0, 10, (12, 3))
    scan = np.arange(12) % 3
    found = map_error.of_points(points, scan, poses, covariance)
    for k, s in enumerate(scan):
        own = geometry.transform_points(geometry.inverse(poses[s]), points[k : k + 1])[0]
        moves = geometry.exp(rng.multivariate_normal(np.zeros(6), covariance[s], 20_000))
        moved = (poses[s] @ moves @ np.append(own, 1.0))[:, :3]
        assert found[k] == pytest.approx(np.sqrt(np.square(moved - points[k]).sum(1).mean()), rel=0.03)


def test_what_is_not_known_is_nan():
    rng = np.random.default_rng(1)
    poses, covariance = poses_and_covariances(rng)
    covariance[1] = np.nan
    none = np.zeros(3)
    point_map = PointMap(
        rng.normal(size=(3, 3)).astype(np.float32), np.zeros((3, 3), np.uint8), none.astype(np.uint8),
        none.astype(np.float32), 0.1, np.arange(3, dtype=np.int32),
    )  # fmt: skip
    known = np.isfinite(map_error.with_error(point_map, poses, covariance).error)
    assert known.tolist() == [True, False, True]
    assert np.isnan(map_error.with_error(point_map, poses, None).error).all()


def test_errors_counted_in_pieces_are_those_of_the_whole():
    error = np.exp(np.random.default_rng(2).normal(-6, 1, 5000)).astype(np.float32)
    error[::7] = np.nan
    tally = map_error.Tally()
    for piece in np.array_split(error, 4):
        tally.add(piece)
    found, known = tally.facts(), error[np.isfinite(error)].astype(float)
    assert found["position_m"] == pytest.approx(np.sqrt(np.mean(known**2)))
    assert found["position_p95_m"] == pytest.approx(np.quantile(known, 0.95), rel=0.006)
    assert map_error.Tally().facts() is None


def scanned(rng, reach_m, strays_m=()):
    """A map of a scan at 1 km from the origin, its pose, and a covariance of turns and shifts that are 1e-3 rad and m."""
    directions = rng.normal(size=(5000, 3))
    arms = directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(1, reach_m, (5000, 1))
    for k, stray_m in enumerate(strays_m):
        arms[k] *= stray_m / np.linalg.norm(arms[k])
    pose = geometry.from_rotation_translation(np.eye(3), np.array([1000.0, 0, 0]))[None]
    none = np.zeros(5000)
    point_map = PointMap(
        (arms + pose[0, :3, 3]).astype(np.float32), np.zeros((5000, 3), np.uint8), none.astype(np.uint8),
        none.astype(np.float32), 0.1, none.astype(np.int32),
    )  # fmt: skip
    return map_error.with_error(point_map, pose, 1e-6 * np.eye(6)[None]), pose


@pytest.mark.parametrize(
    ("reach_m", "strays_m"), [(20.0, (156e3,)), (20.0, (3000.0,) * 50), (120.0, (5000.0, 90e3))]
)
def test_stray_points_do_not_count_for_the_error_of_the_map(reach_m, strays_m):
    """Before, one point of 5000 at 156 km made 2200 mm of 17."""
    point_map, poses = scanned(np.random.default_rng(3), reach_m, strays_m)
    expected = np.delete(point_map.error, np.arange(len(strays_m))).astype(float)
    tally = map_error.Tally()
    tally.add(map_error.counted(point_map, poses))
    assert tally.facts()["position_m"] == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-6)
    assert point_map.error[0] > 1, "the point itself keeps its error"


def test_far_points_of_ordinary_maps_count():
    point_map, poses = scanned(np.random.default_rng(4), 10.0, (100.0, 299.0))
    assert map_error.counted(point_map, poses).tobytes() == point_map.error.tobytes()
