"""Mean map entropy and plane thickness."""

import naive_products as naive
import numpy as np
import pytest

from lvba.kernels import map_entropy as kernels
from lvba.products import map_quality
from lvba.products.cloud import Cloud
from lvba.steps import plane_thickness


def test_entropies_match_the_plain_twin():
    points = np.random.default_rng(0).uniform(-1, 1.5, (1500, 3)) * [1, 1, 0.3]
    values = map_quality.point_entropies(points, 0.3, 10)
    expected = naive.entropies(points, 0.3, 10)
    assert 0.2 < np.isfinite(expected).mean() < 1
    np.testing.assert_allclose(values, expected, atol=1e-9)


def test_voxel_means_match_a_plain_grouping():
    points = np.random.default_rng(1).normal(0, 0.2, (800, 3)).astype(np.float32)
    means = map_quality.voxel_means(points, 0.1)
    groups = {}
    for point in points.astype(float):
        groups.setdefault(tuple(np.floor(point / 0.1)), []).append(point)
    expected = np.array([np.mean(groups[key], axis=0) for key in sorted(groups)])
    np.testing.assert_allclose(means, expected, atol=1e-12)


def cloud_of(points):
    points = points.astype(np.float32)
    return Cloud(points, np.array([0, len(points) // 2, len(points)]), np.arange(2.0))


def test_a_thicker_wall_has_more_entropy():
    rng = np.random.default_rng(2)
    wall = rng.uniform(0, 4, (40000, 3)) * [1, 1, 0]
    noise = rng.normal(0, 1, 40000)
    scores = [
        map_quality.mean_map_entropy(cloud_of(wall + np.outer(noise, [0, 0, sigma])))
        for sigma in (0.01, 0.03, 0.1)
    ]
    assert scores[0] < scores[1] < scores[2]


def room_in_rain(rng, off):
    """A floor and a wall, 2 cm thick, seen by two scans that are `off` (m) apart, and drops everywhere."""
    floor = rng.uniform(0, 4, (80000, 3)) * [1, 1, 0]
    wall = rng.uniform(0, 4, (80000, 3)) * [1, 0, 1]
    surfaces = np.concatenate([floor, wall]) + rng.normal(0, 0.02, (160000, 3))
    surfaces[::2] += off
    drops = rng.uniform(0, 4, (4000, 3)) * [1, 1, 0.5]
    return cloud_of(np.concatenate([surfaces, drops]))


def test_surfaces_tell_a_sharp_map_where_all_that_is_in_the_air_does_not():
    rng = np.random.default_rng(8)
    apart, together = (room_in_rain(rng, off) for off in (0.03, 0.0))
    everything = [map_quality.mean_map_entropy(cloud) for cloud in (apart, together)]
    surfaces = map_quality.entropy_change(*(map_quality.entropy_blocks(cloud) for cloud in (apart, together)))
    assert surfaces.gain > 2 * (everything[0] - everything[1])
    assert surfaces.gain > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_usual_points_of_a_voxel_match_a_plain_search(seed):
    rng = np.random.default_rng(seed)
    centers, counts = rng.uniform(-2, 2, (400, 3)), rng.integers(1, 50, 400).astype(float)
    cubes = np.floor(centers / 0.7)
    expected = [counts[(np.abs(cubes - cube) <= 1).all(1)].mean() for cube in cubes]
    np.testing.assert_allclose(map_quality._usual(centers, counts, 0.7), expected)


def test_where_points_are_sparse_each_voxel_counts():
    cloud = cloud_of(np.random.default_rng(9).uniform(0, 4, (6000, 3)) * [1, 1, 0.02])
    assert map_quality.entropy_blocks(cloud).mean == map_quality.mean_map_entropy(cloud)


def test_an_empty_or_sparse_map_has_no_entropy():
    for nothing in (cloud_of(np.zeros((0, 3))), cloud_of(np.eye(3) * 10)):
        assert np.isnan(map_quality.mean_map_entropy(nothing))
        assert np.isnan(map_quality.entropy_blocks(nothing).mean)


def wall(rng, sigma, points=60000):
    """A wall of 12 m, as thick as `sigma` says for each of its meters."""
    flat = rng.uniform(0, 12, (points, 3)) * [1, 0.3, 0]
    return flat + rng.normal(0, 1, (points, 1)) * np.broadcast_to(sigma, 12)[flat[:, 0].astype(int), None] * [
        [0, 0, 1]
    ]


def blocks_of(points):
    return map_quality.entropy_blocks(cloud_of(points))


def test_a_gain_everywhere_is_beyond_chance_and_a_gain_here_and_there_is_not():
    before = wall(np.random.default_rng(3), 0.02)
    thinner = map_quality.entropy_change(blocks_of(before), blocks_of(before * [1, 1, 0.9]))
    assert thinner.gain == pytest.approx(-np.log(0.9), rel=0.05)
    assert thinner.error < 0.1 * thinner.gain
    here_and_there = np.tile([0.016, 0.016, 0.0225, 0.0225], 3)
    after = blocks_of(wall(np.random.default_rng(4), here_and_there))
    chance = map_quality.entropy_change(blocks_of(before), after)
    assert abs(chance.gain) < 2 * chance.error


def test_the_error_of_a_gain_is_the_scatter_over_draws():
    """The same wall measured again and again: gains scatter as the standard errors say."""
    rng = np.random.default_rng(5)
    changes = [
        map_quality.entropy_change(blocks_of(wall(rng, 0.02, 20000)), blocks_of(wall(rng, 0.02, 20000)))
        for _ in range(30)
    ]
    scatter = np.std([change.gain for change in changes])
    assert np.mean([change.error for change in changes]) == pytest.approx(scatter, rel=0.5)


def test_blocks_of_pieces_are_those_of_the_whole():
    found = blocks_of(wall(np.random.default_rng(6), 0.02))
    pieces = [map_quality.EntropyBlocks(found.keys[k::2], found.sums[k::2] / 2) for k in (0, 1, 0, 1)]
    whole = map_quality.blocks_together(pieces)
    np.testing.assert_array_equal(whole.keys, found.keys)
    np.testing.assert_allclose(whole.sums, found.sums)
    assert whole.mean == pytest.approx(found.mean)


def test_few_blocks_tell_no_error():
    one = blocks_of(wall(np.random.default_rng(7), 0.02)[:, [1, 1, 2]] * [0.1, 0.1, 1])
    assert np.isnan(map_quality.entropy_change(one, one).error)


@pytest.mark.parametrize("field", [{"radius_m": 0}, {"radius_m": 101}])
def test_bad_settings_are_named(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        map_quality.EntropyConfig(**field)


def test_cell_covariances_match_numpy():
    points = (np.random.default_rng(4).normal(0, 0.1, (300, 3)) + np.array([1000, -2000, 30])).astype(
        np.float32
    )
    order = np.random.default_rng(5).permutation(300)
    start = np.array([0, 1, 100, 300])
    found = kernels.cell_covariances(points, order, start)
    for cell in range(3):
        inside = points[order[start[cell] : start[cell + 1]]].astype(float)
        np.testing.assert_allclose(
            found[cell], np.cov(inside.T, bias=True) if len(inside) > 1 else 0, atol=1e-10
        )


def test_thickness_is_that_of_the_walls_on_each_set():
    rng = np.random.default_rng(6)
    wall = rng.uniform(0.01, 3.99, (60000, 3)) * [1, 1, 0] + [0, 0, 0.25]
    noise = rng.normal(0, 1, 60000)
    clouds = {
        name: cloud_of(wall + np.outer(noise, [0, 0, s])) for name, s in (("thin", 0.01), ("thick", 0.03))
    }
    clouds["bad"] = cloud_of(rng.uniform(0, 4, (60000, 3)) * [1, 1, 0.12])
    rows = map_quality.plane_thickness(clouds)
    assert rows["thin"]["planar"] == rows["thick"]["planar"] == 64
    assert rows["thin"]["own"] == pytest.approx(0.01, rel=0.05)
    assert rows["thick"]["in_thin"] == pytest.approx(0.03, rel=0.05)
    assert rows["bad"]["planar"] == 0
    assert np.isnan(rows["bad"]["own"])
    assert rows["bad"]["in_thin"] > 0.1


def test_a_cube_of_one_scan_alone_says_nothing():
    wall = (np.random.default_rng(7).uniform(0, 0.5, (400, 3)) * [1, 1, 0]).astype(np.float32)
    alone = Cloud(wall, np.array([0, len(wall)]), np.zeros(1))
    assert map_quality.plane_thickness({"one": alone})["one"]["planar"] == 0
    assert map_quality.plane_thickness({"none": cloud_of(np.zeros((0, 3)))})["none"]["planar"] == 0


def test_planes_that_are_planar_before_or_after_count_so_that_neither_map_is_favored():
    rng = np.random.default_rng(6)
    wall = rng.uniform(0, 4, (60000, 3)) * [1, 1, 0] + [0, 0, 0.25]
    noise = rng.normal(0, 1, 60000)
    thick, thin = (cloud_of(wall + np.outer(noise, [0, 0, sigma])) for sigma in (0.03, 0.01))
    cubes = [map_quality.planar_cubes(cloud) for cloud in (thick, thin, cloud_of(np.zeros((0, 3))))]
    there, back = plane_thickness.compare(cubes[0], cubes[1]), plane_thickness.compare(cubes[1], cubes[0])
    found = plane_thickness.facts([there])
    assert found["thickness_before_m"] == pytest.approx(0.03, rel=0.05)
    assert found["thickness_after_m"] == pytest.approx(0.01, rel=0.05)
    off = (cubes[1].thickness - cubes[0].thickness)[cubes[0].planar | cubes[1].planar]
    assert found["thickness_change_error_m"] == pytest.approx(off.std(ddof=1) / np.sqrt(len(off)), rel=1e-6)
    assert (back.before, back.after, back.cubes) == (there.after, there.before, there.cubes)
    assert plane_thickness.facts([there, there])["count_after"] == 2 * found["count_after"]
    assert plane_thickness.facts([plane_thickness.compare(cubes[2], cubes[1])]) is None
