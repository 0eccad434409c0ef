"""Planes by all points near them: against a twin, on walls that cells cut, and on what is two surfaces."""

import naive_plane_refit as naive
import numba
import numpy as np
import pytest

from lvba import geometry
from lvba.kernels import plane_refit as kernel
from lvba.kernels.voxel import cell_of
from lvba.lidar import bundle_adjustment, plane_refit, surface, voxel_map
from lvba.lidar.plane import no_plane_points, no_planes
from lvba.lidar.scan import gather
from lvba.lidar.weights import observation_weights

NOISE = 0.015
SIZES = (0.25, 0.5)
SENSOR = np.zeros(3)
POSES = np.tile(np.eye(4), (2, 1, 1))


def wall(rng, count, *, tilt=0.15, step=0.0, noise=NOISE):
    """Two scans of a wall 2 m by 2 m, 3 m in front, turned by `tilt` rad out of the axes of the grid; a part of it stands
    out by `step` m. Also the wall's normal, towards the sensor, and its distance from there."""
    turn = geometry.exp(np.array([0.0, tilt, 0.7 * tilt, 0.0, 0.0, 0.0]))[:3, :3]
    flat = np.column_stack([np.full(count, 3.0), rng.uniform(-1, 1, (count, 2))])
    flat[:, 0] -= step * ((np.abs(flat[:, 1] - 0.3) < 0.2) & (np.abs(flat[:, 2]) < 0.6))
    flat[:, 0] += noise * rng.normal(size=count)
    points = (flat @ turn.T).astype(np.float32)
    return [points[::2], points[1::2]], -turn[:, 0], 3.0


def parts(scans):
    """What `surface.extract` makes planes from, and the planes as cells have them."""
    points = gather(scans)
    grid = voxel_map.build(points, POSES, SIZES)
    association = voxel_map.find_planes(grid, POSES, SENSOR, voxel_map.PlaneTest(min_scans=1))
    return points, grid, association, observation_weights(association.features, POSES)


def of_cells(monkeypatch, given):
    with monkeypatch.context() as patch:
        patch.setattr(plane_refit, "refit", lambda planes, *_: planes)
        points, grid, association, weights = given
        return surface.extract(points, grid, association, weights, POSES, SENSOR)


def errors(planes, normal, distance):
    """Of each plane: how far off it is at its center, m, and by what angle, rad."""
    off = planes.center @ normal + distance
    return np.abs(off), np.arccos(np.clip(planes.normal @ normal, -1, 1))


def test_kernel_against_its_twin(monkeypatch):
    rng = np.random.default_rng(0)
    scans, _, _ = wall(rng, 6000, step=0.02)
    given = parts(scans)
    points, grid, association, weights = given
    planes, on_planes = of_cells(monkeypatch, given)
    gate = surface.GATE * np.sqrt(planes.eigenvalues[:, 0])
    rough = plane_refit._rough(planes, grid, association, gate, weights)
    near = plane_refit._points_by_cell(on_planes, grid)
    fits = kernel.refit(kernel.LabeledPoints(on_planes.points_world, on_planes.plane), near, rough)
    level, features = grid.levels[0], association.features
    cell = np.zeros((len(points.points), 3), int)
    for c in range(len(level.key)):
        mine = near.order[near.first[level.starts[c]] : near.first[level.starts[c + 1]]]
        cell[mine] = cell_of(level.key[c : c + 1])[0]
    scan = np.repeat(np.arange(2), np.diff(points.offsets))
    world = on_planes.points_world.astype(float)
    assert len(planes) > 10
    for k in range(len(planes)):
        seen = slice(features.offsets[k], features.offsets[k + 1])
        own = dict(zip(features.scan[seen], weights.weight[seen], strict=True))
        weight = np.array([own.get(s, weights.weight[seen].mean()) for s in scan])
        center, values, normal, height, over_noise = naive.refit(
            world, cell, on_planes.plane, weight, k, planes.center[k], planes.axes, gate[k]
        )
        np.testing.assert_allclose(fits.center[k], center, atol=1e-9)
        np.testing.assert_allclose(fits.eigenvalues[k], values, rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(fits.eigenvectors[k, 0], normal, atol=1e-8)
        np.testing.assert_allclose(
            [fits.height[k], fits.over_noise[k]], [height, over_noise], rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize("tilt", [0.05, 0.15, 0.3])
def test_a_wall_that_faces_of_cells_cut_at_small_angles_is_found_where_it_is(monkeypatch, tilt):
    rng = np.random.default_rng(1)
    scans, normal, distance = wall(rng, 40_000, tilt=tilt)
    given = parts(scans)
    before, _ = of_cells(monkeypatch, given)
    after, on_planes = surface.extract(*given, POSES, SENSOR)
    (off, turned), (now_off, now_turned) = errors(before, normal, distance), errors(after, normal, distance)
    assert off.max() > 0.3 * NOISE
    assert turned.max() > 0.03
    # what the number of points leaves: a cell of 0.25 m has some hundred
    assert np.sqrt(np.mean(now_off**2)) < 0.1 * NOISE
    assert now_off.max() < 0.4 * off.max()
    assert now_turned.max() < 0.4 * turned.max()
    np.testing.assert_allclose(np.linalg.norm(after.normal, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(after.axes), 1, atol=1e-9)
    np.testing.assert_allclose(after.axes[:, :, 0], after.normal)
    assert np.mean(on_planes.plane >= 0) > 0.8


def test_a_flat_wall_is_even_and_the_edge_of_a_picture_on_it_is_not():
    rng = np.random.default_rng(2)
    scans, _, _ = wall(rng, 40_000)
    flat, _ = surface.extract(*parts(scans), POSES, SENSOR)
    assert np.median(flat.unevenness) < 0.1 * NOISE
    assert np.mean(flat.unevenness > NOISE) < 0.05
    step = 1.3 * NOISE
    scans, normal, distance = wall(rng, 40_000, step=step)
    planes, _ = surface.extract(*parts(scans), POSES, SENSOR)
    mixed = planes.unevenness > NOISE
    # planes whose centers are on neither surface are those that are named
    between = np.abs(planes.center @ normal + distance - 0.5 * step) < 0.3 * step
    assert between.sum() >= 3
    assert mixed[between].all()
    assert not mixed[~between].all()


def test_unevenness_that_all_planes_have_is_no_second_surface():
    """A depth camera's errors are alike over some centimeters, and every plane shows them."""
    rng = np.random.default_rng(3)
    clouds, _, _ = wall(rng, 40_000, noise=0.003)
    waves = [
        c + np.float32(0.004) * np.sin(c[:, [1]] * 20) * np.sin(c[:, [2]] * 20) * [1, 0, 0] for c in clouds
    ]
    planes, _ = surface.extract(*parts([w.astype(np.float32) for w in waves]), POSES, SENSOR)
    thickness = np.sqrt(planes.eigenvalues[:, 0])
    assert 0.001 < np.median(planes.unevenness) < 0.004
    assert np.mean(planes.unevenness > 2 * thickness) < 0.05


def test_both_faces_of_a_thin_wall_stay_two_planes():
    rng = np.random.default_rng(4)
    count, thick = 20_000, 0.04
    face = np.column_stack([np.full(count, 3.0), rng.uniform(-1, 1, (count, 2))])
    face[:, 0] += 0.004 * rng.normal(size=count)
    behind = np.tile(np.eye(4), (2, 1, 1))
    behind[1, 0, 3] = 6.0
    scans = [face.astype(np.float32), (face + np.array([thick - 6.0, 0, 0])).astype(np.float32)]
    points = gather(scans)
    grid = voxel_map.build(points, behind, SIZES)
    association = voxel_map.find_planes(grid, behind, SENSOR, voxel_map.PlaneTest(min_scans=1))
    weights = observation_weights(association.features, behind)
    planes, _ = surface.extract(points, grid, association, weights, behind, SENSOR)
    x = planes.center[:, 0]
    assert np.all((np.abs(x - 3.0) < 0.005) | (np.abs(x - 3.0 - thick) < 0.005))
    assert np.all(np.sign(planes.normal[:, 0]) == np.where(x < 3.02, -1, 1))


def test_any_number_of_threads_gives_the_same_bytes():
    rng = np.random.default_rng(5)
    scans, _, _ = wall(rng, 20_000, step=0.02)
    before, made = numba.get_num_threads(), []
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            planes, on_planes = bundle_adjustment.find_planes(scans, POSES)
            made.append((planes.center.tobytes(), planes.unevenness.tobytes(), on_planes.plane.tobytes()))
    finally:
        numba.set_num_threads(before)
    assert made[0] == made[1]


def test_no_planes_stay_none():
    nothing = no_planes()
    _, grid, association, weights = parts(wall(np.random.default_rng(6), 2000)[0])
    refitted = plane_refit.refit(nothing, no_plane_points(), grid, association, weights, np.zeros(0))
    assert refitted is nothing


def test_a_part_of_very_many_points_says_the_same():
    rng = np.random.default_rng(7)
    scans, normal, distance = wall(rng, 1_500_000)
    planes, _ = surface.extract(*parts(scans), POSES, SENSOR)
    assert 4 * planes.count.max() > 2 * kernel.MOST_POINTS  # with those of the cells around
    off, turned = errors(planes, normal, distance)
    assert np.median(off) < 0.02 * NOISE
    assert np.median(turned) < 0.002
