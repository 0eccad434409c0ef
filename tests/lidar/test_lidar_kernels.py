"""Kernels against their plain twins, derivatives against differences, bytes against the number of threads."""

import naive_lidar as naive
import numba
import numpy as np
import pytest
import scipy.linalg

from lvba import geometry
from lvba.errors import InputError
from lvba.kernels import lidar as kernel
from lvba.kernels import point_cluster, voxel
from lvba.lidar import (
    covariance,
    degeneracy,
    noise_information,
    panels,
    plane_factor,
    plane_feature,
    voxel_map,
)
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.problem import Problem
from lvba.lidar.scan import Scans, gather
from lvba.optim.normal_equations import NormalEquations


def poses_of(rng, scans):
    return geometry.exp(rng.normal(size=(scans, 6)) * [0.3, 0.3, 0.3, 3, 3, 3])


def planes_of(rng, poses, planes=7, noise=0.02, points=40):
    """Features as lists of (scan, points in the scan's frame, weight), noisy so that no term is small."""
    features = []
    for _ in range(planes):
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        center = rng.normal(size=3) * 8
        seen = np.sort(rng.choice(len(poses), size=rng.integers(2, len(poses) + 1), replace=False))
        feature = []
        for scan in seen:
            flat = rng.uniform(-1, 1, size=(points, 3)) * [1.0, 0.7, 0] + rng.normal(size=(points, 3)) * noise
            world = center + flat @ frame.T
            feature.append(
                (
                    int(scan),
                    geometry.transform_points(geometry.inverse(poses[scan]), world),
                    rng.uniform(0.5, 2),
                )
            )
        features.append(feature)
    return features


def packed(features):
    observations = [observation for feature in features for observation in feature]
    clusters = [naive.cluster(points) for _, points, _ in observations]
    return PlaneFeatures(
        np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64),
        np.array([scan for scan, _, _ in observations], np.int32),
        PointClusters(*(np.array([c[k] for c in clusters]) for k in range(3))),
        np.array([weight for _, _, weight in observations]),
        np.ones(len(features)),
    )


def a_problem(scans, planes):
    rng = np.random.default_rng(5)
    poses = poses_of(rng, scans)
    plain = planes_of(rng, poses, planes)
    disturbed = geometry.retract(poses, rng.normal(size=(scans, 6)) * 0.005)
    return disturbed, plain, packed(plain)


@pytest.fixture
def problem():
    return a_problem(scans=6, planes=7)


@pytest.fixture
def several_tiles():
    """More scans than three tiles hold, the last tile not full, and features that skip whole tiles."""
    poses, plain, _ = a_problem(scans=3 * kernel.TILE + 5, planes=9)
    plain[0] = [seen for seen in plain[0] if not kernel.TILE <= seen[0] < 2 * kernel.TILE]
    plain[1] = plain[1][:2]
    return poses, plain, packed(plain)


def test_eigen3_against_numpy_also_where_one_value_is_tiny():
    rng = np.random.default_rng(0)
    for scale in (0.4, 1e-3, 1e-7):
        vectors = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        matrix = vectors @ np.diag([1.0, 0.5, scale]) @ vectors.T
        values, rows = np.empty(3), np.empty((3, 3))
        point_cluster.eigen3(np.array([matrix[i, j] for i, j in naive.SYMMETRIC]), values, rows)
        np.testing.assert_allclose(values, [scale, 0.5, 1.0], rtol=1e-8)
        np.testing.assert_allclose(rows @ matrix @ rows.T, np.diag(values), atol=1e-15)


def test_transform_against_the_points():
    rng = np.random.default_rng(1)
    sets = [rng.normal(size=(n, 3)) + 1000.0 for n in (1, 5, 9, 3)]
    clusters = PointClusters(*(np.array([naive.cluster(s)[k] for s in sets]) for k in range(3)))
    pose = poses_of(rng, 1)
    moved = clusters.moved(pose, np.zeros(4, np.int32))
    expected = naive.cluster(geometry.transform_points(pose[0], sets[2]))
    np.testing.assert_allclose(moved.mean[2], expected[1], rtol=1e-12)
    np.testing.assert_allclose(moved.scatter[2], expected[2], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("size", "longest"), [(0.25, 16_000.0), (0.0625, 3_800.0)])
def test_a_path_longer_than_the_grid_is_an_error_that_names_both(size, longest):
    """Before, points of the outermost scans were in no cell, and nobody was told."""
    clouds = [np.random.default_rng(8).uniform(-20, 20, size=(50, 3)).astype(np.float32)] * 6
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 1, 3] = np.linspace(0, longest, 6) - 321.0
    clouds[2] = np.vstack([clouds[2], [[9e4, 0, 0]]]).astype(np.float32)
    points = gather(clouds)
    pair = voxel_map.build(points, poses, (size,)).pair
    assert np.count_nonzero(pair < 0) == 1, "a stray point is no scan"
    poses[:, 1, 3] *= 1.2
    with pytest.raises(InputError, match=rf"extends by {1.2 * longest / 1000:.1f} km .* cells of {size} m"):
        voxel_map.build(points, poses, (size,))
    first = gather(clouds[:3])
    assert np.count_nonzero(voxel_map.build(first, poses[:3], (size,)).pair < 0) == 1, "a part of it fits"


def test_small_cells_about_one_place_need_no_margin():
    cloud = np.random.default_rng(9).uniform(-2, 2, size=(50, 3)).astype(np.float32)
    assert (voxel_map.build(gather([cloud]), np.eye(4)[None], (0.005,)).pair >= 0).all()


def test_every_level_holds_the_clusters_of_its_cells_and_scans():
    rng = np.random.default_rng(7)
    clouds = [rng.uniform(-2, 2, size=(n, 3)).astype(np.float32) for n in (300, 0, 500, 200)]
    poses = poses_of(rng, 4)
    grid = voxel_map.build(gather(clouds), poses, (0.5, 1.0, 2.0))
    assert [level.size for level in grid.up_to(1.0).up_to(4.0).levels] == [0.5, 1.0, 2.0, 4.0]
    world = np.concatenate([geometry.transform_points(p, c) for p, c in zip(poses, clouds, strict=True)])
    own = np.concatenate(clouds).astype(float)
    scan = np.repeat(np.arange(4), [len(c) for c in clouds])
    entry = (grid.pair_starts[scan] + grid.pair).astype(np.int64)
    for level in grid.levels:
        assert (np.diff(level.key) > 0).all()
        entry = level.entry_of[entry]
        # points share an entry exactly where they share cell and scan
        cell = np.floor(world / level.size).astype(int)
        together = naive.groups(np.column_stack([cell, scan]))
        assert naive.groups(entry[:, None]) == together
        assert len(level.scan) == len(together)
        for members in together:
            e = entry[members[0]]
            assert level.scan[e] == scan[members[0]]
            got = (level.clusters.count[e], level.clusters.mean[e], level.clusters.scatter[e])
            for value, wanted in zip(got, naive.cluster(own[members]), strict=True):
                np.testing.assert_allclose(value, wanted, atol=1e-9)
        # cells in Morton order, scans in order within
        corner = np.array([cell[entry == e][0] for e in range(len(level.scan))])
        corner -= np.floor(voxel_map.grid_origin(poses[:, :3, 3], 0.5) / level.size).astype(int)
        keys = [voxel.morton(*c) for c in corner]
        assert list(level.key[level.cell]) == keys
        assert (np.diff(level.scan)[np.diff(level.cell) == 0] > 0).all()


def test_cells_and_their_clusters_against_the_points():
    rng = np.random.default_rng(2)
    points = rng.uniform(-3, 3, size=(900, 3)).astype(np.float32)
    points[5] = np.nan
    points[6, 1] = np.nan
    points[7] = 1e30
    offsets = np.array([0, 400, 400, 900])
    poses = poses_of(rng, 3)
    shift = np.full(3, 64.0)
    local, keys, count = voxel.assign(points, offsets, voxel_map.at_origin(poses, -shift), 0.5)
    starts = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    turned = np.arange(starts[-1])[::-1].copy()
    found = voxel.accumulate(points, offsets, local, starts, turned)
    assert list(local[5:8]) == [-1, -1, -1]
    assert count[1] == 0
    for s in range(3):
        own = points[offsets[s] : offsets[s + 1]].astype(float)
        world = geometry.transform_points(poses[s], own)
        world[np.abs(world).max(1) > 50] = np.nan
        expected = naive.cells(world + shift, 0.5)
        assert count[s] == len(expected)
        for number, (cell, members) in enumerate(expected.items()):
            assert (local[offsets[s] + np.array(members)] == number).all()
            assert keys[offsets[s] + number] == voxel.morton(*cell)
            for got, want in zip(found, naive.cluster(own[members]), strict=True):
                np.testing.assert_allclose(got[turned[starts[s] + number]], want, atol=1e-9)


@pytest.mark.parametrize("two_sided", [True, False])
def test_planes_of_cells_and_sides_against_the_points(two_sided):
    rng = np.random.default_rng(8)
    poses = poses_of(rng, 5)
    clouds = [rng.uniform(-2, 2, size=(n, 3)).astype(np.float32) for n in (300, 500, 200, 400, 90)]
    grid = voxel_map.build(gather(clouds), poses, (1.0,))
    level, clusters = grid.levels[0], grid.levels[0].clusters
    sensor = poses[:, :3, 3] + [0.1, 0.2, 0.3]
    side, total, scans, center, values, normals = voxel.fit_cells(
        level.starts, level.scan, poses, sensor, clusters.arrays, 8, two_sided,
    )  # fmt: skip
    world = np.concatenate([geometry.transform_points(p, c) for p, c in zip(poses, clouds, strict=True)])
    scan = np.repeat(np.arange(5), [len(c) for c in clouds])
    entry = level.entry_of[grid.pair_starts[scan] + grid.pair]
    small = 0
    for c in range(len(level.key)):
        entries = np.arange(level.starts[c], level.starts[c + 1])
        inside = world[np.isin(entry, entries)]
        if len(inside) < 8:
            assert (side[entries] == -1).all()
            small += 1
            continue
        normal = np.linalg.eigh(np.cov(inside.T))[1][:, 0]
        up = [normal @ (sensor[level.scan[e]] - world[entry == e].mean(0)) >= 0 for e in entries]
        first = np.array(up) == up[0] if two_sided else np.ones(len(entries), bool)
        assert ((side[entries] == side[entries[0]]) == first).all()
        for k in range(2):
            members = world[np.isin(entry, entries[side[entries] == k])]
            assert total[c, k] == len(members)
            assert scans[c, k] == np.count_nonzero(side[entries] == k)
            if len(members) >= 4:
                moments = np.linalg.eigh(np.cov(members.T, bias=True))
                np.testing.assert_allclose(center[c, k], members.mean(0), atol=1e-9)
                np.testing.assert_allclose(values[c, k], moments[0], atol=1e-9)
                assert abs(normals[c, k] @ moments[1][:, 0]) == pytest.approx(1.0, abs=1e-6)
    assert 0 < small < len(level.key)


def test_a_table_that_has_to_grow():
    grid = np.stack(np.meshgrid(*[np.arange(40)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = (grid + 0.5).astype(np.float32)
    _, keys, count = voxel.assign(points, np.array([0, len(points)]), np.eye(4)[None], 1.0)
    assert count[0] == 40**3
    assert len(np.unique(keys)) == 40**3


def in_world(poses, gradient):
    """(S, 6) of local tangents by world axes about each sensor."""
    return np.einsum("nij,nkj->nki", poses[:, :3, :3], gradient.reshape(-1, 2, 3)).reshape(-1, 6)


def dense_of(found):
    rows, columns, blocks = found
    scans = rows.max() + 1
    return NormalEquations(rows, columns, blocks, np.zeros((scans, 6)), 0.0).dense()


def test_cost_against_the_points(problem):
    poses, plain, features = problem
    assert plane_feature.fit(features, poses).cost == pytest.approx(naive.plane_cost(poses, plain), rel=1e-11)


def test_gradient_and_hessian_against_differences_of_the_cost(problem):
    poses, _, features = problem

    def cost(step):
        return 0.5 * plane_feature.fit(features, geometry.retract(poses, step)).cost

    equations = plane_factor.linearize(features, poses, 1.0)
    rng = np.random.default_rng(3)
    for _ in range(5):
        direction = rng.normal(size=(6, 6)) * [1, 1, 1, 3, 3, 3]
        direction[0] = 0
        small, h = 1e-6, 3e-5
        slope = (cost(small * direction) - cost(-small * direction)) / (2 * small)
        bend = (cost(h * direction) - 2 * cost(0 * direction) + cost(-h * direction)) / h**2
        flat = direction.ravel()
        assert equations.gradient.ravel() @ flat == pytest.approx(slope, rel=1e-6)
        assert flat @ equations.dense() @ flat == pytest.approx(bend, rel=1e-4)


def test_gauss_newton_is_never_indefinite_and_meets_the_hessian_where_planes_are_exact():
    rng = np.random.default_rng(4)
    poses = poses_of(rng, 5)
    features = packed(planes_of(rng, poses, planes=12, noise=0.0))
    exact = plane_factor.linearize(features, poses, 1.0).dense()
    newton = plane_factor.linearize(features, poses, 1.0, exact=False).dense()
    np.testing.assert_allclose(newton, exact, atol=1e-6 * np.abs(exact).max())
    far = geometry.retract(poses, rng.normal(size=(5, 6)) * 0.2)
    values = np.linalg.eigvalsh(plane_factor.linearize(features, far, 1.0, exact=False).dense())
    assert values[0] > -1e-9 * values[-1]


def test_hessian_kernel_against_its_twin(several_tiles):
    poses, _, features = several_tiles
    fits = plane_feature.fit(features, poses)
    clusters = features.clusters.weighted(features.weight)
    laid = panels.pack(features, len(poses))
    _, diagonal, columns = kernel.linearize(
        poses, panels.by_scan(features, len(poses)), features.feature, clusters.arrays, fits.arrays, laid.panel,
        len(laid.feature), True,
    )  # fmt: skip
    still = np.broadcast_to(np.eye(4), (len(poses), 4, 4)).copy()
    got = dense_of(plane_factor.hessian_blocks(laid, diagonal, columns, still))
    place = 6 * (features.scan % kernel.TILE)[:, None] + np.arange(6)
    by_observation = columns[laid.panel[:, None, None], np.arange(3)[:, None], place[:, None]]
    expected = naive.hessian(diagonal, by_observation, features.offsets, features.scan)
    np.testing.assert_allclose(got, expected, atol=1e-11 * np.abs(expected).max())
    assert np.array_equal(got, got.T)
    turn = scipy.linalg.block_diag(*(part for pose in poses for part in [pose[:3, :3]] * 2))
    turned = dense_of(plane_factor.hessian_blocks(laid, diagonal, columns, poses))
    np.testing.assert_allclose(turned, turn.T @ got @ turn, atol=1e-12 * np.abs(got).max())
    # W is what the planes' own freedom takes away: nothing, of a motion that all scans share
    motion = np.tile([0, 0, 0, 0.3, -0.5, 0.2], len(poses))
    assert abs(motion @ got @ motion) < 1e-9 * np.abs(got).sum()


def test_only_pairs_of_scans_that_see_a_plane_together_are_kept(several_tiles):
    """Tiles 0 and 2 see the even planes, tiles 1 and 3 the odd ones."""
    poses, plain, _ = several_tiles
    apart = [
        [seen for seen in plane if seen[0] // kernel.TILE % 2 == number % 2]
        for number, plane in enumerate(plain)
    ]
    features = packed(apart)
    laid = panels.pack(features, len(poses))
    pairs = panels.pairs_of_tiles(laid)
    assert sorted(map(tuple, pairs.tolist())) == [(0, 0), (0, 2), (1, 1), (1, 3), (2, 2), (3, 3)]
    equations = plane_factor.linearize(features, poses, 1.0)
    expected = {(scan, scan) for scan in range(len(poses))}
    for plane in apart:
        scans = [seen[0] for seen in plane]
        expected |= {(first, second) for first in scans for second in scans if first < second}
    assert list(zip(equations.rows, equations.columns, strict=True)) == sorted(expected)


def test_a_panel_for_each_feature_and_tile(several_tiles):
    poses, _, features = several_tiles
    laid = panels.pack(features, len(poses))
    tile = np.repeat(np.arange(len(laid.starts) - 1), np.diff(laid.starts))
    pairs = list(zip(features.feature, features.scan // kernel.TILE, strict=True))
    assert [(laid.feature[p], tile[p]) for p in laid.panel] == pairs
    assert sorted(set(pairs), key=lambda pair: pair[::-1]) == list(zip(laid.feature, tile, strict=True))
    for p in range(len(laid.feature)):
        inside = [scan % kernel.TILE for (f, t), scan in zip(pairs, features.scan, strict=True)
                  if (f, t) == (laid.feature[p], tile[p])]  # fmt: skip
        assert laid.seen[p] == sum(1 << place for place in inside)


def test_distances_against_the_points(problem):
    poses, plain, features = problem
    fits = plane_feature.fit(features, poses)
    distance, within = kernel.distances(
        poses,
        features.offsets,
        features.scan,
        features.clusters.arrays,
        fits.center,
        fits.normal,
    )
    points = [points for feature in plain for _, points, _ in feature]
    for o, (own, f, s) in enumerate(zip(points, features.feature, features.scan, strict=True)):
        away = (geometry.transform_points(poses[s], own) - fits.center[f]) @ fits.normal[f]
        assert distance[o] == pytest.approx(away.mean(), abs=1e-12)
        assert within[o] == pytest.approx(np.sum((away - away.mean()) ** 2), rel=1e-9)


def test_gradients_of_observations_add_up_to_those_of_the_scans(problem):
    poses, _, features = problem
    each = covariance.observation_gradients(features, plane_feature.fit(features, poses), poses)
    total = np.stack([np.bincount(features.scan, each[:, k], len(poses)) for k in range(6)], 1)
    np.testing.assert_allclose(
        total, in_world(poses, plane_factor.linearize(features, poses, 1.0).gradient), rtol=1e-9, atol=1e-9
    )


def test_spread_of_the_planes_gradients(several_tiles):
    poses, _, features = several_tiles
    each = covariance.observation_gradients(features, plane_feature.fit(features, poses), poses)
    dense = np.zeros((len(features), 6 * len(poses)))
    for gradient, feature, scan in zip(each, features.feature, features.scan, strict=True):
        turn = scipy.linalg.block_diag(*[poses[scan, :3, :3]] * 2)
        dense[feature, 6 * scan : 6 * scan + 6] = turn.T @ gradient / 0.02**2
    problem = Problem(features, 0.02, None)
    got = covariance._gradient_spread(problem, poses, plane_feature.fit(features, poses)).dense()
    np.testing.assert_allclose(got, dense.T @ dense, atol=1e-11 * (dense**2).sum())


def test_information_kernel_against_its_twin(problem):
    poses, plain, features = problem
    fits = plane_feature.fit(features, poses)
    clusters = features.clusters.weighted(features.weight)
    found, noise = kernel.information(
        poses, panels.by_scan(features, len(poses)), features.feature, clusters.arrays, fits.eigenvectors,
        degeneracy.normal_variance(fits),
    )  # fmt: skip
    points = [points for feature in plain for _, points, _ in feature]
    expected = naive.information(
        poses[:, :3, :3], features.feature, features.scan, points, features.weight,
        fits.eigenvalues, fits.eigenvectors, fits.total, 50.0,
    )  # fmt: skip
    np.testing.assert_allclose(found, expected[0], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(noise, expected[1], rtol=1e-8, atol=1e-10)


def test_noise_information_about_all_poses_against_its_twin(several_tiles):
    poses, plain, features = several_tiles
    turn = scipy.linalg.block_diag(*(part for pose in poses for part in [pose[:3, :3]] * 2))
    fits = plane_feature.fit(features, poses)
    got = turn @ noise_information.linearize(features, fits, poses, 0.02).dense() @ turn.T
    expected = naive.noise_information(poses, plain, 0.02, degeneracy.TRUSTED_POINTS)
    np.testing.assert_allclose(got, expected, atol=1e-9 * np.abs(expected).max())


def test_cost_does_not_depend_on_the_frame(problem):
    poses, _, features = problem
    motion = geometry.exp(np.array([0.4, -1.0, 0.3, 50.0, -20.0, 7.0]))
    here, there = (plane_feature.fit(features, p).cost for p in (poses, motion @ poses))
    assert there == pytest.approx(here, rel=1e-9)
    # the gradient has no part along a common motion
    gradient = in_world(poses, plane_factor.linearize(features, poses, 1.0).gradient)
    moment = gradient[:, :3].sum(0) + np.cross(poses[:, :3, 3], gradient[:, 3:]).sum(0)
    scale = np.abs(gradient).sum()
    assert np.abs(gradient[:, 3:].sum(0)).max() < 1e-9 * scale
    assert np.abs(moment).max() < 1e-9 * scale


def test_same_bytes_for_one_and_two_threads(several_tiles):
    poses, _, features = several_tiles
    rng = np.random.default_rng(6)
    points = rng.uniform(-3, 3, size=(4000, 3)).astype(np.float32)
    scans = Scans(points, np.linspace(0, 4000, 7).astype(np.int64))

    def run():
        equations = plane_factor.linearize(features, poses, 1.0)
        grid = voxel_map.build(scans, poses[:6], (0.25, 0.5, 1.0))
        arrays = [equations.blocks, equations.gradient, grid.pair]
        for level in grid.levels:
            arrays += [level.key, level.scan, level.entry_of, level.clusters.mean, level.clusters.scatter]
        return [array.tobytes() for array in arrays]

    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        single = run()
        numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
        assert run() == single
    finally:
        numba.set_num_threads(before)
